"""Results on the disk: never in place of an input, nor of other results unasked; all files of a run, or none."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from piga import output
from piga.errors import ArgumentError, PigaError
from piga.output import check_results, results
from piga.text_files import files_named_in
from tests.cli.runner import outcome
from tests.compensation.run_files import write

Capture = pytest.CaptureFixture[str]
NAMES = ("a.txt", "b.txt", "figures/*")


def fill(
    folder: Path, text: str, names: tuple[str, ...] = ("a.txt", "b.txt", "figures/c.txt"), **more: object
) -> None:
    with results(folder, "test", NAMES, (), **{"force": False} | more) as (stage, *_):  # type: ignore[arg-type]
        for name in names:
            (stage / name).parent.mkdir(exist_ok=True)
            (stage / name).write_text(text)


def held(folder: Path) -> dict[str, str]:
    """What a reader of the folder sees."""
    check_results(folder)
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".piga") for part in path.relative_to(folder).parts)
    }


@pytest.mark.parametrize("kind", ["same", "symbolic link", "hard link", "other spelling"])
@pytest.mark.parametrize("what", ["data", "run file", "calibration"])
def test_an_output_that_is_an_input_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture, kind: str, what: str
) -> None:
    run = write(tmp_path)
    source = {"data": tmp_path / "run.parquet", "run file": run, "calibration": tmp_path / "run.json"}[what]
    before, out = source.read_bytes(), tmp_path / "out.parquet"
    if kind == "symbolic link":
        out.symlink_to(source)
    elif kind == "hard link":
        os.link(source, out)
    else:
        (tmp_path / "x").mkdir()
        out = source if kind == "same" else tmp_path / "x" / ".." / source.name
    said = {}
    for name, words in {
        "compensate": (run, "--calibration", tmp_path / "run.json", "--out", out),
        "convert": (run, "--out", out),
    }.items():
        if name == "convert" and (what == "calibration" or out.suffix != ".parquet"):
            continue
        code, _, said[name] = outcome(capsys, name, *words, "--force")
        assert code == 2
        assert f"is the input {source}" in said[name]
    assert source.read_bytes() == before


def test_files_that_a_run_file_names(tmp_path: Path) -> None:
    """Data, profile and what a triad file leads to; names of nothing are no files."""
    for name in ("d.csv", "p.csv", "c.json", "unused.csv"):
        (tmp_path / name).write_text("x")
    (tmp_path / "r.toml").write_text('a = "d.csv"\n[stand]\nparts = [{ file = "p.csv" }]\nb = "none.csv"\n')
    (tmp_path / "t.toml").write_text('[[triad.instrument]]\nrun = "r.toml"\ncalibration = "c.json"\n')
    seen = {path.name for path in files_named_in(tmp_path / "t.toml")}
    assert seen == {"t.toml", "r.toml", "c.json", "d.csv", "p.csv"}
    assert files_named_in(tmp_path / "none.toml") == [tmp_path / "none.toml"]


def test_results_of_the_same_command_and_inputs_are_replaced_others_go_beside(tmp_path: Path) -> None:
    """What was changed by hand, or comes from other inputs, stays: the new results are in ``2``, then in ``3``."""
    out = tmp_path / "out"
    fill(out, "one")
    fill(out, "two", names=("a.txt",))
    assert held(out) == {"a.txt": "two"}
    (out / "mine.txt").write_text("mine")
    fill(out, "three")
    three = {"a.txt": "three", "b.txt": "three", "figures/c.txt": "three", "mine.txt": "mine"}
    assert held(out) == three
    (out / "b.txt").write_text("edited by hand")
    fill(out, "four")
    assert (out / "b.txt").read_text() == "edited by hand"
    assert held(out / "2") == {"a.txt": "four", "b.txt": "four", "figures/c.txt": "four"}
    for inputs, options, place in (((tmp_path / "other.toml",), (), "3"), ((), ("terms=k0",), "4")):
        with results(out, "test", NAMES, inputs, options=options) as (stage, _, why):
            (stage / "a.txt").write_text("other")
        assert why == "results of other options or inputs"
        assert held(out / place) == {"a.txt": "other"}
    fill(out, "five", force=True)
    assert (out / "b.txt").read_text() == "five"
    assert held(out / "2")["b.txt"] == "four"


@pytest.mark.parametrize(("umask", "file", "folder"), [(0o022, 0o644, 0o755), (0o077, 0o600, 0o700)])
def test_everything_obeys_the_umask(tmp_path: Path, umask: int, file: int, folder: int) -> None:
    """The hidden folder of a file that is being written has the mode 0700."""
    before = os.umask(umask)
    try:
        fill(tmp_path / "out", "x")
        fill(tmp_path / "out", "y", force=True)
        seen: list[int] = []

        def write(path: Path) -> None:
            seen.append(path.parent.stat().st_mode & 0o777)
            path.write_text("x")

        output.write_whole(tmp_path / "whole", write)
    finally:
        os.umask(before)
    assert seen == [0o700]
    for path in tmp_path.rglob("*"):
        assert path.stat().st_mode & 0o777 == (folder if path.is_dir() else file), path


@pytest.mark.parametrize("name", ["a.txt", "figures/c.txt", "late.txt"])
def test_a_folder_in_place_of_a_result(tmp_path: Path, name: str) -> None:
    """It is refused before anything is in place; ``late.txt`` is no pattern that the command names beforehand."""
    (tmp_path / "out" / name).mkdir(parents=True)
    for _ in range(2):
        with pytest.raises(ArgumentError, match="is a folder where a result goes"):
            fill(tmp_path / "out", "one", ("a.txt", "b.txt", "figures/c.txt", "late.txt"), force=True)
        assert [path for path in (tmp_path / "out").rglob("*") if path.name != "figures"] == [
            tmp_path / "out" / name
        ]
    (tmp_path / "out" / name).rmdir()
    fill(tmp_path / "out", "one", force=True)


def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    for there in (False, True):
        with pytest.raises(ZeroDivisionError), results(out, "test", NAMES, (), force=False) as (stage, *_):
            (stage / "a.txt").write_text(str(1 / 0))
        assert out.exists() == there
        assert not list(tmp_path.rglob(".piga*")) + list(tmp_path.rglob("a.txt"))
        out.mkdir(exist_ok=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(PigaError, match=r"file: is a file"):
        fill(tmp_path / "file", "x")
    with pytest.raises(PigaError, match=r"file/out: results cannot be written there"):
        fill(tmp_path / "file" / "out", "x")


@pytest.mark.parametrize("at", range(3))
def test_a_stop_while_results_are_put_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    """Who reads the folder is told that it holds two runs, until the command has run again."""
    out = tmp_path / "out"
    fill(out, "one")
    replace, count = Path.replace, []

    def replaced(self: Path, target: Path) -> Path:
        count.append(1)
        if len(count) > at:
            raise KeyboardInterrupt
        return replace(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", replaced)
        with pytest.raises(KeyboardInterrupt) as caught:
            fill(out, "two", names=("a.txt", "b.txt"))
    assert f"{out}: results of two runs" in caught.value.__notes__[0]
    with pytest.raises(PigaError, match="holds results of two runs of 'piga test'") as refused:
        held(out)
    assert "--force" in str(refused.value.remedy)
    fill(out, "three", names=("a.txt",), force=True)
    assert held(out) == {"a.txt": "three"}
    assert not list(out.glob(".piga-stage*"))


def test_a_link_leads_nothing_outside(tmp_path: Path) -> None:
    outside, out = tmp_path / "outside", tmp_path / "out"
    outside.mkdir()
    out.mkdir()
    (outside / "mine.txt").write_text("mine")
    (out / "figures").symlink_to(outside)
    with pytest.raises(ArgumentError, match="is a folder where a result goes"):
        fill(out, "one", force=True)
    fill(out, "one", names=("a.txt",), force=True)
    assert held(out) == {"a.txt": "one"}
    assert [path.read_text() for path in outside.iterdir()] == ["mine"]


WORK = """
import sys
from pathlib import Path
from piga.output import results
print("begun", flush=True)
for k in range(100000):
    with results(Path({out!r}), "test", {names!r}, (), force=True) as (stage, *_):
        (stage / "figures").mkdir()
        for name in ("a.txt", "b.txt", "figures/c.txt"):
            (stage / name).write_text(f"{tag}-{{k}}" * 2000)
"""


@pytest.mark.parametrize("kills", [2, pytest.param(50, marks=pytest.mark.slow)])
def test_kills_in_a_folder(tmp_path: Path, kills: int) -> None:
    """Writers of one folder, two at a time, killed: what is read is of one run; what they left goes a day later."""
    out = tmp_path / "out"
    rng = np.random.default_rng(1)
    for k in range(kills):
        scripts = [WORK.format(out=str(out), names=NAMES, tag=f"{k}{name}") for name in "xy"[: 1 + k % 2]]
        writers = [subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE) for text in scripts]
        for writer in writers:
            assert writer.stdout is not None
            writer.stdout.readline()
        time.sleep(rng.uniform(0.0, 0.05))
        for writer in writers:
            os.kill(writer.pid, signal.SIGKILL)
            writer.communicate()
        if out.exists() and not list(out.glob(".piga-moving-*")):
            assert len(set(held(out).values())) == 1
            assert sorted(held(out)) == ["a.txt", "b.txt", "figures/c.txt"]
    for left in tmp_path.rglob(".piga-stage*"):
        os.utime(left, (0.0, 0.0))
    fill(out, "last", force=True)
    assert set(held(out).values()) == {"last"}
    assert not list(out.glob(".piga-stage*"))


@pytest.mark.parametrize("name", ["a" * 251 + ".csv", "长" * 83 + ".csv", "a." + "b" * 250])
def test_names_as_long_as_a_file_system_takes(tmp_path: Path, name: str) -> None:
    output.write_whole(tmp_path / name, lambda path: path.write_text("x"))
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_what_is_there_is_not_replaced(tmp_path: Path) -> None:
    for text in "xy":
        with nullcontext() if text == "x" else pytest.raises(PigaError, match="exists already"):
            output.write_whole(tmp_path / "a.txt", lambda path: path.write_text(text), replace=False)  # noqa: B023
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "x")]


def test_nothing_is_written_half(tmp_path: Path) -> None:
    path = tmp_path / "result.txt"
    path.write_text("old")

    def fails(temporary: Path) -> None:
        temporary.write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(PigaError, match="No space left"):
        output.write_whole(path, fails)
    assert [(p.name, p.read_text()) for p in tmp_path.iterdir()] == [("result.txt", "old")]
    with pytest.raises(PigaError, match="cannot be written"):
        output.write_whole(tmp_path / "none" / "x", lambda temporary: None)
