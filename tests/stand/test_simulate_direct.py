"""Simulated direct instruments: the log follows the polynomial, and calibration finds the truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.stand.scenario import read_scenario, run_scenario
from piga.stand.write_run import run_file_text, truth_document, write_data

pytestmark = pytest.mark.filterwarnings("ignore::piga.errors.CalibrationWarning")
EXAMPLE = Path(__file__).parents[2] / "examples" / "direct.toml"
COUNTS = (
    ('scale_factor = "1.3 mA/g"', 'scale_factor = "130 kHz/g"'.replace("kHz", "count/ms")),
    ('scale_factor = "1.3021 mA/g"', 'scale_factor = "130210 count/s/g"'),
    ('output = "rate"\nunit = "mA"\n', 'output = "counts"\n'),
    ('angle_random_walk = "1e-6 mA s/sqrt(s)"', 'angle_random_walk = "2 count/sqrt(s)"'),
    ("[run]", "[run]\nformat = 'csv'"),
)


def changed(*changes: tuple[str, str]) -> str:
    """The example with parts replaced."""
    text = EXAMPLE.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    return text


@pytest.mark.parametrize("changes", [(), COUNTS], ids=["current", "counts"])
def test_from_scenario_to_coefficients(tmp_path: Path, changes: tuple[tuple[str, str], ...]) -> None:
    scenario = read_scenario(EXAMPLE, content=changed(*changes))
    test = run_scenario(scenario)
    name = f"run.{scenario.table.run.format}"
    write_data(test, tmp_path / name)
    (tmp_path / "run.toml").write_text(run_file_text(scenario, test, name))
    run = piga.read_run(tmp_path / "run.toml")
    result = piga.calibrate(run)
    truth = {row["name"]: row for row in truth_document(scenario, test)["coefficients"]}
    assert list(truth) == ["scale_factor", "k0", "k2", "k3", "m_Y"]
    for key, row in truth.items():
        assert row["unit"] == result[key].unit
        assert abs(result[key].value - row["value"]) < 1.5 * result[key].expanded
    assert result["k0"].std < 3e-6
    if changes:
        assert 1.8 < result.angle_random_walk < 2.2
    shown = test.summary() + json.dumps(truth_document(scenario, test)) + (tmp_path / "run.toml").read_text()
    for word in ("gimbal", "rad/s", "tan_beta", "base_rate", "counts_per_revolution"):
        assert word not in shown
    again = test.to_run()
    assert again.unit == run.unit
    assert np.array_equal(again.output, run.output)


def test_output_is_the_polynomial_of_the_force() -> None:
    quiet = changed(('angle_random_walk = "1e-6 mA s/sqrt(s)"', ""), ('imperfections = "drawn"', ""))
    scenario = replace(read_scenario(EXAMPLE, content=quiet.partition("[imperfections]")[0]))
    log = run_scenario(scenario).log
    x, y, _ = log.reference.T / 9.80665
    expected = 1.3021 * (x + 2.1e-3 + 12e-6 * x**2 + 4e-6 * x**3 + 3e-4 * y)
    assert np.abs(log.output - expected).max() < 1e-12


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((("[truth]", '[truth]\nbeta = "1 arcsec"'),), "'beta' belongs to the gimbal"),
        ((("[truth]", '[truth]\ns1 = "1 ug"'),), "'s1' belongs to the gimbal"),
        ((('output = "rate"', 'output = "angle"'),), "output 'angle' needs unit"),
        ((('unit = "mA"', 'unit = "rad/s"'),), "is that of an angle"),
        ((('kind = "direct"\n', ""),), "has no unit"),
        ((("[run]", '[run]\nmodel = "twin"'),), "'twin' is that of a gyro"),
    ],
)
def test_what_belongs_to_a_gimbal_is_refused(changes: tuple[tuple[str, str], ...], words: str) -> None:
    with pytest.raises(piga.PigaError, match=words):
        run_scenario(read_scenario(EXAMPLE, content=changed(*changes)))
