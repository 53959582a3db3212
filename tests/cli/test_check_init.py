"""``piga init`` as its user sees it: with ``--yes``, in a terminal, and with what the log does not say."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest

from tests.cli.runner import invoked, on_terminal

LOGS = Path(__file__).resolve().parents[1] / "data" / "logs"
SCALE = "instrument.scale_factor=0.8884 rad/s/g"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return Path(shutil.copy(LOGS / "german.csv", tmp_path))


def run(*arguments: object) -> tuple[int, str, str]:
    done = invoked(*arguments)
    message = "" if done.exception is None or isinstance(done.exception, SystemExit) else str(done.exception)
    return done.exit_code, done.stdout, message


def test_it_writes_a_run_file_that_check_accepts(log: Path) -> None:
    code, out, _ = run("init", log, "--yes", "--set", SCALE)
    assert code == 0
    assert "It reads 960 of 960 rows in 12 segments" in out
    assert "Zählerstand" in out
    code, out, _ = run("check", log.with_suffix(".toml"))
    assert code == 0
    assert "Record of G-0417 german.toml Rows used: 960, of 960" in " ".join(out.split())


def test_what_is_missing_is_named_with_the_option(log: Path) -> None:
    """The German log has the counts of a revolution, so its scale factor can be computed. That of LabVIEW has not."""
    assert run("init", log, "--yes")[0] == 0
    assert 'scale_factor = "0.888' in log.with_suffix(".toml").read_text(encoding="utf-8")
    shutil.copy(LOGS / "labview.lvm", log.parent)
    code, out, _ = run("init", log.with_name("labview.lvm"), "--yes")
    assert code == 0
    assert "instrument.scale_factor: nominal scale factor" in out
    assert "--set instrument.scale_factor='0.8884 rad/s/g'" in out
    text = log.with_name("labview.toml").read_text(encoding="utf-8")
    assert '# scale_factor = "0.8884 rad/s/g"' in text
    _, _, message = run("check", log.with_name("labview.toml"))
    assert "scale_factor" in message


def test_an_open_line_that_is_answered_makes_the_run_file_whole(log: Path) -> None:
    shutil.copy(LOGS / "labview.lvm", log.parent)
    run("init", log.with_name("labview.lvm"), "--yes", "--set", "instrument.counts_per_revolution=72000")
    path = log.with_name("labview.toml")
    run("init", log.with_name("labview.lvm"), "--yes", "--force")
    text = path.read_text(encoding="utf-8").replace(
        "# scale_factor", "counts_per_revolution = 72000\nscale_factor"
    )
    path.write_text(text, encoding="utf-8")
    assert run("check", path)[0] == 0


def test_a_run_file_that_was_changed_stays(log: Path) -> None:
    """An unchanged draft is replaced. Beside a changed one the new draft lies in ``2``, and reads the same log."""
    path = log.with_suffix(".toml")
    for _ in range(2):
        assert run("init", log, "--yes")[0] == 0
    path.write_text(f"# mine\n{path.read_text(encoding='utf-8')}", encoding="utf-8")
    code, out, _ = run("init", log, "--yes")
    assert (code, "It reads 960 of 960 rows" in out) == (0, True)
    assert path.read_text(encoding="utf-8").startswith("# mine")
    assert run("check", log.parent / "2" / path.name)[0] == 0


@pytest.mark.parametrize(("setting", "words"), [
    ("scale", "is not table.key=value"),
    ("instrument.scale_factor=0.8884 kg", "is given in 'kg'"),
    ("data.sheep=3", "has the unknown key 'sheep'"),
    ("instrument.scale_factor=-1 rad/s/g", "must be positive"),
    ("data.output=counter", "[data.output]: expected a table { ... }, got text"),
    ("model.phase=x", "[model.phases]: 'x' is not one of the allowed values"),
])  # fmt: skip
def test_settings_that_cannot_be_used(log: Path, setting: str, words: str) -> None:
    _, _, message = run("init", log, "--yes", "--set", SCALE, "--set", setting)
    assert words in message
    assert not log.with_suffix(".toml").exists()


@pytest.mark.parametrize("content", [b"", b"hello\nworld\n", b"\x00\x01\x02" * 100, "ä\n".encode("cp1252")])
def test_files_that_are_no_logs(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(content)
    code, _, message = run("init", path, "--yes", "--set", SCALE)
    assert code != 0
    assert "x.csv" in message


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_in_a_terminal_it_asks(tmp_path: Path) -> None:
    log = Path(shutil.copy(LOGS / "labview.lvm", tmp_path))
    text, code = on_terminal(["init", log], typed=b"0.8884 kg\n0.8884 rad/s/g\ninstrument.serial=Q-5\n\n")
    assert code == 0, text
    assert "nominal scale factor" in text
    assert "is given in 'kg'" in text
    written = log.with_suffix(".toml").read_text(encoding="utf-8")
    assert 'serial = "Q-5"' in written
    assert 'scale_factor = "0.8884 rad/s/g"' in written
