"""``piga check``, ``convert``, ``init``, ``noise`` and the words of keys, terms and methods, as a user runs them."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from piga.cli.check import explain
from piga.data import copy_example, example_files
from piga.keys import FILES, places_of
from piga.records.terms import TERM_WORDS, UNITS, term_words
from tests.cli.runner import invoked, outcome
from tests.records.files import lines, write_log, write_run


def dirty(folder: Path) -> Path:
    rows = lines(60)
    del rows[20:23]
    rows[5] = rows[5].replace("1.0", "NaN")
    rows.insert(31, rows[30])
    write_log(folder, rows)
    return write_run(folder)


def test_everything_in_one_pass_with_a_page(tmp_path: Path) -> None:
    text = " ".join(run("check", dirty(tmp_path), "--out", tmp_path / "page")[1].split())
    for words in ("missing-value 1 7", "gap", "repeated-row 1", "Calibration: information, 2 terms"):
        assert words in text
    page = (tmp_path / "page" / "check.html").read_text(encoding="utf-8")
    for words in ("missing-value", "interval [s]", "specific force [g]", "output [rev]", "SHA-256"):
        assert words in page


@pytest.mark.parametrize(
    ("entry", "words"), [("levelling = '1 arcsex'", "arcsex"), ("arm_radius = '1 um'", "arm_radius")]
)
def test_an_uncertainty_that_the_stand_does_not_have_is_refused_before_the_fit(tmp_path, entry, words) -> None:
    path = copy_example(tmp_path)
    stand = "[stand]\nkind = 'dividing-head'\nlatitude = '40 deg'\npositions = '0:360:15 deg'\n"
    logged = re.sub(r"(?m)^(reference|base_rate) =.*$", "", path.read_text().split("[uncertainty]")[0])
    path.write_text(f"{logged}{stand}[uncertainty]\n{entry}\n")
    code, _, message = run("check", path)
    assert code != 0
    assert words in message


def test_a_stand_beside_logged_columns_is_said_not_to_be_the_reference(tmp_path: Path) -> None:
    path = copy_example(tmp_path)
    path.write_text(
        f"{path.read_text()}\n[stand]\nkind = 'dividing-head'\nlatitude = '40 deg'\npositions = ['0 deg']\n"
    )
    text = " ".join(run("check", path)[1].split())
    assert "of the logged columns; [stand] is used for the uncertainties alone" in text


def test_convert_keeps_units_and_findings(tmp_path: Path) -> None:
    path = dirty(tmp_path)
    run("convert", path, "--out", tmp_path / "clean.parquet")
    schema = pq.read_schema(tmp_path / "clean.parquet")
    assert schema.field("fx").metadata == {b"unit": b"m/s^2"}
    assert b"missing-value" in schema.metadata[b"quality"]
    assert "must end in .parquet" in run("convert", path, "--out", tmp_path / "clean.csv")[2]


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
    code, out, _ = run("init", log, "--set", SCALE)
    assert code == 0
    assert "It reads 960 of 960 rows in 12 segments" in out
    assert "Zählerstand" in out
    code, out, _ = run("check", log.with_suffix(".toml"))
    assert code == 0
    assert "Record of G-0417 german.toml Rows used: 960, of 960" in " ".join(out.split())


def test_what_is_missing_is_named_with_the_option(log: Path) -> None:
    """The German log has the counts of a revolution, so its scale factor can be computed. That of LabVIEW has not."""
    assert run("init", log)[0] == 0
    assert 'scale_factor = "0.888' in log.with_suffix(".toml").read_text(encoding="utf-8")
    shutil.copy(LOGS / "labview.lvm", log.parent)
    code, out, _ = run("init", log.with_name("labview.lvm"))
    assert code == 0
    assert "instrument.scale_factor: nominal scale factor" in out
    assert "--set instrument.scale_factor='0.8884 rad/s/g'" in out
    text = log.with_name("labview.toml").read_text(encoding="utf-8")
    assert '# scale_factor = "0.8884 rad/s/g"' in text
    _, _, message = run("check", log.with_name("labview.toml"))
    assert "scale_factor" in message


def test_an_open_line_that_is_answered_makes_the_run_file_whole(log: Path) -> None:
    shutil.copy(LOGS / "labview.lvm", log.parent)
    run("init", log.with_name("labview.lvm"), "--set", "instrument.counts_per_revolution=72000")
    path = log.with_name("labview.toml")
    run("init", log.with_name("labview.lvm"), "--force")
    text = path.read_text(encoding="utf-8").replace(
        "# scale_factor", "counts_per_revolution = 72000\nscale_factor"
    )
    path.write_text(text, encoding="utf-8")
    assert run("check", path)[0] == 0


def test_a_run_file_that_was_changed_stays(log: Path) -> None:
    """An unchanged draft is replaced. Beside a changed one the new draft lies in ``2``, and reads the same log."""
    path = log.with_suffix(".toml")
    for words in ((), (), ("--set", SCALE)):
        assert run("init", log, *words)[0] == 0
    path.write_text(f"# mine\n{path.read_text(encoding='utf-8')}", encoding="utf-8")
    code, out, _ = run("init", log)
    assert (code, "It reads 960 of 960 rows" in out) == (0, True)
    assert path.read_text(encoding="utf-8").startswith("# mine")
    assert run("check", log.parent / "2" / path.name)[0] == 0


@pytest.mark.parametrize(("setting", "words"), [
    ("scale", "is not table.key=value"),
    ("instrument.scale_factor=0.8884 kg", "is given in 'kg'"),
    ("data.sheep=3", "the nearest keys: data.sheet, data.settle"),
    ("stand.hight=3 m", "--set stand.hight: a run file has no such key\n  remedy: the nearest keys: stand.height"),
    ("foo.bar=3", "the nearest keys: instrument, data, model, estimation, uncertainty, stand"),
    ("instrument.scale_factor=-1 rad/s/g", "must be positive"),
    ("data.output=counter", "[data.output]: expected a table { ... }, got text"),
    ("model.phases=x", "--set model.phases: 'x' is not known\n  remedy: one of: shared, per-segment"),
    ("stand.kind=x", "--set stand.kind: 'x' is not known\n  remedy: one of: dividing-head, centrifuge, rate-table, "),
])  # fmt: skip
def test_settings_that_cannot_be_used(log: Path, setting: str, words: str) -> None:
    _, _, message = run("init", log, "--set", SCALE, "--set", setting)
    assert words in message
    assert not log.with_suffix(".toml").exists()


@pytest.mark.parametrize("content", [b"", b"hello\nworld\n", b"\x00\x01\x02" * 100, "ä\n".encode("cp1252")])
def test_files_that_are_no_logs(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(content)
    code, _, message = run("init", path, "--set", SCALE)
    assert code != 0
    assert "x.csv" in message


@pytest.fixture
def static_log(tmp_path):
    rng, n, step = np.random.default_rng(31), 5000, 0.1
    rate = 2.5 + 5e-4 / np.sqrt(step) * rng.standard_normal(n)
    rows = np.column_stack((step * np.arange(n), rate))
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t [s],U [V]", comments="", fmt="%.9g")
    return tmp_path / "log.csv"


def test_text_page_and_json(static_log, tmp_path, capsys):
    code, out, err = outcome(capsys, "noise", static_log, "--out", tmp_path / "noise")
    assert code == 0, err
    assert "random walk N" in out
    assert "not seen" in out
    assert "V/sqrt(Hz)" in out
    page = (tmp_path / "noise" / "noise.html").read_text()
    assert "Deviations of the rate" in page
    assert "Spectrum of the rate" in page
    document = json.loads((tmp_path / "noise" / "noise.json").read_text())
    code, out, err = outcome(capsys, "noise", static_log, "--json")
    assert json.loads(out) == document
    walk = document["levels"]["random_walk"]
    assert walk["unit"] == "V/sqrt(Hz)"
    assert walk["interval_95"][0] < 5e-4 < walk["interval_95"][1]
    assert list(document["deviations"]) == ["allan", "modified", "hadamard"]
    assert document["deviations"]["allan"]["tau_s"][0] == pytest.approx(0.1)


def test_an_integral_has_a_rate_per_second(static_log, capsys):
    code, out, _ = outcome(
        capsys, "noise", static_log, "--column", "U", "--kind", "angle", "--unit", "count", "--json"
    )
    assert code == 0
    assert json.loads(out)["unit"] == "count/s"


def test_a_column_that_is_not_there(static_log, capsys):
    code, _, err = outcome(capsys, "noise", static_log, "--column", "I")
    assert code == 2
    assert "no column 'I'; the columns are: t, U" in err
    assert "--column" in err


@pytest.mark.parametrize("file", FILES)
def test_every_key_has_a_sentence_and_an_example(file: str) -> None:
    keys = places_of(file)
    assert len(keys) > 4
    for place in keys:
        assert place.words.sentence.endswith("."), place.path
        assert place.words.example, place.path
        tomllib.loads(f"x = {place.words.example}")


def test_explain() -> None:
    done = invoked("check", "--explain", "data.time.stamp")
    assert done.exit_code == 0
    assert 'example  stamp = "DD.MM.YYYY hh:mm:ss.f"' in done.stdout
    assert {place.file for place in explain("terms")} == {"run"}
    assert next(place.path for place in explain("[data] time")) == "data.time"
    assert '"centrifuge"' in explain("stand.kind")[0].kind
    document = json.loads(invoked("check", "--explain", "criterion", "--json").stdout)
    assert document[0]["key"] == "plan.criterion"
    wrong = invoked("check", "--explain", "data.tme")
    assert "did you mean" in str(wrong.exception)
    assert "no run file is named" in str(invoked("check").exception)


def test_terms() -> None:
    assert set(TERM_WORDS) - {"sn", "cn"} == set(UNITS)
    out = invoked("terms").stdout
    for name in UNITS:
        assert f"{name}  [{UNITS[name]}]  {TERM_WORDS[name].meaning}" in out
    assert term_words("s2").formula == "s2 sin(2 psi)"
    assert "s3 sin(3 psi)" in invoked("terms", "s3").stdout
    assert "is not a term" in str(invoked("terms", "k9").exception)
    rows = json.loads(invoked("terms", "--json").stdout)
    assert {row["name"] for row in rows} == set(TERM_WORDS)


ROOT = Path(__file__).resolve().parents[2]


def test_every_example_is_written(tmp_path: Path) -> None:
    done = invoked("examples", "--out", tmp_path / "examples")
    assert done.exit_code == 0
    for path in (ROOT / "examples").rglob("*.*"):
        if path.suffix in (".toml", ".py"):
            assert (
                tmp_path / "examples" / path.relative_to(ROOT / "examples")
            ).read_bytes() == path.read_bytes()
    assert "wrote" in done.stdout


def test_what_the_docs_name_is_there() -> None:
    names = set(example_files())
    for page in [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]:
        for name in re.findall(r"\bexamples/([\w/-]+\.(?:toml|py))", page.read_text(encoding="utf-8")):
            assert name in names, (page.name, name)


def test_a_shell_completes_commands() -> None:
    asked = {"_PIGA_COMPLETE": "complete_bash", "COMP_WORDS": "piga cal", "COMP_CWORD": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "piga"], capture_output=True, env=os.environ | asked, check=False
    )
    assert done.stdout.split() == [b"calibrate"]


@pytest.mark.parametrize(
    ("words", "remedy"),
    [
        (["completion", "bash"], "piga --install-completion"),
        (["init", "log.csv", "--yes"], "init does not ask"),
        (["ui", "--host=0.0.0.0"], "ssh -L"),
        (["platform", "simulate", "s.toml", "--every", "2"], "take every N-th row"),
        (["records", "backup", "--store", "s"], "records export"),
        (["compensate", "-", "--arrow"], "send lines"),
    ],
)
def test_what_is_gone_has_its_remedy(words: list[str], remedy: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = outcome(capsys, *words)
    assert code == 2
    assert "is gone" in err
    assert remedy in err


def test_a_value_that_was_a_command_is_a_value(capsys: pytest.CaptureFixture[str]) -> None:
    _, _, err = outcome(capsys, "records", "verify", "--store", "backup")
    assert "is gone" not in err
