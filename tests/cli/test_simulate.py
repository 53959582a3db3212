"""``piga simulate`` and ``piga reproduce`` as a user runs them."""

from __future__ import annotations

import json

import pytest

from piga.calibration.calibrate import calibrate
from piga.stand import read_run
from piga.studies import reproduction
from piga.studies.case import Case, Chapter
from tests.cli.runner import exit_code, invoked
from tests.stand.simulated import written


@pytest.mark.interpreted
@pytest.mark.long
def test_command_writes_all_files_and_json(tmp_path):
    path = written(tmp_path)
    result = invoked("simulate", path, "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout)["schema"] == "piga.truth/1"
    names = {p.name for p in (tmp_path / "out").glob("[!.]*")}
    assert names == {"run.toml", "run.parquet", "truth.json", "report.html"}
    assert calibrate(read_run(tmp_path / "out" / "run.toml"))["k0"].value == pytest.approx(3e-4, abs=1e-5)


def test_json_is_one_document_of_the_interface(capsys):
    assert exit_code("reproduce", "--only", "redundancy-angle", "--json") == 0
    cases = json.loads(capsys.readouterr().out)["cases"]
    assert len(cases) == 7
    for case in cases:
        assert case["verdict"] in ("pass", "fail", "info")
        assert case["difference"] == case["computed"] - case["published"]
        assert abs(case["difference"]) <= case["tolerance"]


def test_unknown_id_names_the_known_ones(capsys):
    assert exit_code("reproduce", "--only", "nothing") == 2
    assert "one of: constant-input, period" in capsys.readouterr().err


@pytest.mark.long
def test_out_writes_page_and_pictures(tmp_path):
    assert exit_code("reproduce", "--only", "closed-forms", "--out", tmp_path / "new") == 0
    assert sorted(path.name for path in (tmp_path / "new" / "figures").iterdir()) == [
        "closed-forms-varying.png",
        "closed-forms-varying.svg",
    ]
    page = (tmp_path / "new" / "reproduction.html").read_text(encoding="utf-8")
    assert "closed-forms-varying" in page
    assert "rate where form and integrator differ most" in page


def test_disagreement_ends_with_exit_code_1(monkeypatch):
    wrong = Case(
        id="mounting.moves", source="[Wei2024]", quantity="skew", unit="arcsec", published=1000.0, computed=900.0,
        tolerance=0.1, note="a wrong number",
    )  # fmt: skip
    monkeypatch.setitem(
        reproduction.CHAPTERS, "mounting", lambda: Chapter("mounting", "Mounting", "", "", (wrong,), ())
    )
    done = invoked("reproduce", "--only", "mounting")
    assert done.exit_code == 1
    assert "1 cases: 0 agree, 1 do not" in done.stdout
