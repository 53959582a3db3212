"""Vibration rectification of a direct instrument, simulated with NumPy alone: three positions, four sizes of the vibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import piga
from piga.calibration import RunSummary
from piga.compensation import Compensator
from piga.results import Array
from piga.stand import read_scenario, run_scenario
from piga.stand.write_run import run_file_text, write_data

pytestmark = pytest.mark.filterwarnings("ignore::piga.errors.CalibrationWarning")
G, K, K0, K2V = 9.80665, 0.6, 2e-3, 40e-6
TERMS = ["scale_factor", "k0", "k2v"]


def record(seed: int = 1) -> tuple[Array, Array, Array, Array, Array]:
    """Time [s], segment, force along X0 [g], rms of the vibration [g], output [mA]; each state twice."""
    rng = np.random.default_rng(seed)
    segment = np.repeat(np.arange(24), 60)
    x = np.array([1.0, 0.0, -1.0])[segment % 3]
    v = np.array([0.0, 2.0, 4.0, 7.0])[segment // 3 % 4]
    t = 0.1 * np.arange(segment.size) + 20.0 * segment
    return t, segment, x, v, K * (x + K0 + K2V * v**2) + 2e-6 * rng.standard_normal(x.size)


def run(terms: list[str] = TERMS, seed: int = 1) -> piga.Run:
    t, segment, x, v, output = record(seed)
    return piga.Run.from_arrays(
        t, output, np.stack((x, 0.0 * x, 0.0 * x), axis=1), vibration=v, scale_factor="0.6 mA/g", kind="rate", unit="mA",
        segment=segment, model={"terms": terms}, units={"f": "g", "vibration": "g"},
    )  # fmt: skip


def test_estimate_is_that_of_least_squares_and_the_force_comes_back() -> None:
    made = run()
    result = piga.calibrate(made)
    _, _, x, v, output = record()
    fitted = np.linalg.lstsq(np.stack((x, np.ones(x.size), v**2), axis=1), output, rcond=None)[0]
    assert [result[name].value for name in TERMS] == pytest.approx(
        [fitted[0], *fitted[1:] / fitted[0]], rel=1e-9
    )
    assert result["k2v"].unit == "g/g^2"
    assert abs(result["k2v"].value - K2V) < result["k2v"].expanded
    back = piga.compensate(made, result)
    assert back.ax / G == pytest.approx(x, abs=2e-5)
    assert np.polyfit(v**2, back.ax / G - x, 1)[0] == pytest.approx(0.0, abs=1e-8)
    known = piga.Calibration.from_coefficients({"scale_factor": K, "k2v": (K2V, 1e-6)}, unit="mA")
    assert piga.compensate(made, known).u_ax == pytest.approx(1e-6 * G * v**2, rel=1e-6, abs=1e-15)


@pytest.mark.parametrize("unit", ["mA", "count/s"])
def test_mean_of_an_interval_in_which_the_vibration_grows(unit: str) -> None:
    """Vibration from 0 to 8 g in steps of 0.2 g: counts hold the mean of its square, a rate its square at the sample."""
    t = 0.1 * np.arange(41)
    v = 2.0 * t
    rate = unit == "mA"
    output = 1e9 * (1.0 + K2V * v**2 if rate else t + K2V * 4.0 * t**3 / 3.0)
    made = piga.Run.from_arrays(
        t, output, np.outer(np.ones(41), [G, 0.0, 0.0]), vibration=G * v, scale_factor=f"1e9 {unit}/g", unit=unit, units="SI",
        kind="rate" if rate else "angle",
    )  # fmt: skip
    known = piga.Calibration.from_coefficients({"scale_factor": 1e9, "k2v": K2V}, unit=unit)
    assert piga.compensate(made, known).ax[1:] / G == pytest.approx(np.ones(40), abs=1e-12)


def test_a_hidden_vibration_is_suggested_and_its_column_is_needed() -> None:
    found = piga.calibrate(run(TERMS[:2])).diagnostics.missing_terms
    assert found[0].terms == ("k2v",)
    bare = replace(run(), vibration=None)
    with pytest.raises(piga.PigaError, match="'k2v' needs the vibration"):
        piga.calibrate(bare)
    result = piga.calibrate(run())
    with pytest.raises(piga.PigaError, match="no vibration is given"):
        piga.compensate(bare, result)
    with pytest.raises(piga.PigaError, match="no vibration is given"):
        Compensator(result, kind="rate", step=0.1).push({"t": [0.0], "output": [0.6], "f": [[G, 0.0, 0.0]]})
    summary = RunSummary.of(run(seed=2))
    joined = piga.calibrate([run(), summary])
    assert joined["k2v"].std < 0.9 * result["k2v"].std


def test_from_a_scenario_to_the_coefficient(tmp_path: Path) -> None:
    """The simulated log has the column, the run file names it, and the truth lies in the interval."""
    text = Path(__file__).parents[2].joinpath("examples", "direct.toml").read_text()
    text = text.replace('m_Y = "300 urad"', 'm_Y = "300 urad"\nk2v = "40e-6 g/g^2"')
    text = text.replace("seed = 1", 'seed = 1\nvibration = ["0 g", "0 g", "2 g", "5 g", "5 g"]')
    text = text.replace('"k3", "m_Y"]', '"k3", "m_Y", "k2v"]')
    (tmp_path / "scenario.toml").write_text(text)
    scenario = read_scenario(tmp_path / "scenario.toml")
    test = run_scenario(scenario)
    write_data(test, tmp_path / "run.csv")
    (tmp_path / "run.toml").write_text(run_file_text(scenario, test, "run.csv"))
    made = piga.read_run(tmp_path / "run.toml")
    assert made.vibration is not None
    assert sorted(set(np.round(made.vibration / G, 9))) == [0.0, 2.0, 5.0]
    result = piga.calibrate(made)
    assert abs(result["k2v"].value - 40e-6) < 4.0 * result["k2v"].std
    gyro = (
        text.replace('kind = "direct"\n', "")
        .replace("mA/g", "rad/s/g")
        .replace('"rate"\nunit = "mA"', '"angle"')
    )
    (tmp_path / "gyro.toml").write_text(gyro.replace('"1e-6 mA s/sqrt(s)"', '"1e-6 rad/sqrt(s)"'))
    with pytest.raises(piga.PigaError, match=r"k2v.*direct instrument only"):
        read_scenario(tmp_path / "gyro.toml")
