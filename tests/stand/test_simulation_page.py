"""Page and command of a simulated test."""

import json
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from piga.calibration.calibrate import calibrate
from piga.cli.main import app
from piga.instrument.twin.parameters import PRESETS
from piga.reports.render.figure import Figure
from piga.reports.render.page import page_html
from piga.reports.stand import simulation_figures, simulation_page, simulation_text
from piga.stand import (
    DividingHead,
    Imperfections,
    Specimen,
    read_run,
    simulate_test,
)
from piga.stand.write_run import coefficients
from tests.stand.simulated import COUNTS, INST, SITE, written

pytestmark = pytest.mark.compiled


@pytest.mark.only_compiled
def test_page_shows_stand_output_servo_and_truth():
    stand = DividingHead(SITE, (0.0, 1.0), dwell=1.0, move=1.0)
    specimen = Specimen(INST, twin=replace(PRESETS["example"], torque_limit=0.01))
    test = simulate_test(stand, specimen, COUNTS, model="twin", imperfections=Imperfections(gravity=1e-5))
    keys = [figure.key for figure in simulation_figures(test)]
    assert keys == [
        "stand",
        "imperfections",
        "output",
        "locking",
        "servo",
        "loop-bode",
        "loop-step",
        "loop-poles",
    ]
    for figure in simulation_figures(test):
        assert isinstance(figure, Figure)
        assert all(panel.x.quantity and panel.y.quantity for panel in figure.panels)
    html = page_html(simulation_page(test, "S-1"))
    for words in ("Simulated test of S-1", "pendulosity", "gravity", "tan_beta"):
        assert words in html
    text = simulation_text(test)
    assert "servo twin" in text
    shown = next(line.split() for line in text.splitlines() if line.startswith("  k0 "))
    k0 = next(value.value for value in coefficients(test) if value.name == "k0")
    assert float(shown[1]) == pytest.approx(1e6 * k0, rel=1e-6)
    assert shown[2] == "ug", "the unit of a calibration"


@pytest.mark.only_compiled
def test_command_writes_all_files_and_json(tmp_path):
    path = written(tmp_path)
    result = CliRunner().invoke(app, ["simulate", str(path), "--out", str(tmp_path / "out"), "--json"])
    assert result.exit_code == 0
    assert json.loads(result.stdout)["schema"] == "piga.truth/1"
    names = {p.name for p in (tmp_path / "out").glob("[!.]*")}
    assert names == {"run.toml", "run.parquet", "truth.json", "report.html"}
    assert calibrate(read_run(tmp_path / "out" / "run.toml"))["k0"].value == pytest.approx(3e-4, abs=1e-5)


def test_command_says_what_was_simulated(tmp_path):
    result = CliRunner().invoke(
        app, ["simulate", str(written(tmp_path)), "--out", str(tmp_path), "--seed", "7"]
    )
    assert result.exit_code == 0
    assert "tan_beta" in result.stdout
    assert "seed 7" in (tmp_path / "run.toml").read_text()
