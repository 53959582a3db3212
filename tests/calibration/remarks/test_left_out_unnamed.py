"""A servo that is not named is in u of K as far as the record does not exclude it; truth by SciPy (``made/servo_data.py``)."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from benchmarks import verdict

import piga
from piga.calibration import RunSummary
from piga.records.run_file import UncertaintyTable
from piga.units import G0
from tests.calibration.made.servo_data import TRUTH, head, levels, recorded

TERMS = ["scale_factor", "tan_beta", "k0", "k2", "m_Y"]
SOURCE = "servo that is not named"
pytestmark = pytest.mark.filterwarnings("ignore::piga.CalibrationWarning")


def record(seed: int, positions: int = 24, size: float = 5e-6, walk: float = 2e-5) -> piga.Run:
    """A head with a servo of ``size`` [g/g^3] that a walk [rad/sqrt(s)] hides."""
    rng = np.random.default_rng([seed, 77])
    forces = head(positions, rng.uniform(0.0, 0.2))[rng.permutation(positions)]
    run = recorded(forces, seconds=30.0, step=0.5, s=size / G0**2, d=0.0)
    steps = walk * np.sqrt(np.diff(run.t, prepend=run.t[0])) * rng.standard_normal(run.size)
    steps[run.begins] = 0.0
    return replace(run, output=run.output + np.cumsum(steps) + 2e-5 * rng.standard_normal(run.size))


def waived(run: piga.Run, *names: str) -> piga.Run:
    return replace(run, uncertainty=UncertaintyTable(waived=dict.fromkeys(names, "simulated")))


def servo(result: piga.Calibration):
    return next((source for source in result.sources if source.name == "servo"), None)


def holds(result: piga.Calibration) -> bool:
    return abs(result["scale_factor"].value - TRUTH["scale_factor"]) <= result["scale_factor"].expanded


@pytest.mark.long
def test_k_holds_the_truth_beside_a_hidden_servo():
    runs = [record(seed) for seed in range(3, 10)]
    bounded = [piga.calibrate(waived(run, "earth_rate"), TERMS) for run in runs]
    assert all(map(holds, bounded))
    assert not all(holds(piga.calibrate(waived(run, "earth_rate", "servo"), TERMS)) for run in runs)
    silent = [result for result in bounded if not any("servo" in doubt.what for doubt in result.verdict.doubts)]
    assert len(silent) > 3
    assert {servo(result).status for result in silent} == {"bounded"}


def test_size_of_the_row_is_the_limit_times_the_shift_of_k():
    """Equal weights and equal angles: the mean rate falls by s a_x a_t^2, so K by s <a_x^2 a_t^2>/<a_x^2> = s g^2/4."""
    run = record(3)
    result, alone = (
        piga.calibrate(waived(run, *names), TERMS) for names in (["earth_rate"], ["earth_rate", "servo"])
    )
    limit = float(re.search(r"more than ([\d.]+) ug", servo(result).reason)[1])
    row = next(row for row in result.budget if row.source == SOURCE)
    shift = 1e6 * row.contributions["scale_factor"] * np.sqrt(3.0) / TRUTH["scale_factor"]
    assert shift == pytest.approx(limit / 4.0, rel=0.15)
    u = alone["scale_factor"].std
    assert u < result["scale_factor"].std < 2.5 * u
    assert servo(alone).status == "waived"


def test_four_positions_at_45_degrees_cannot_tell_and_say_so():
    tilt = np.radians([45.0, 225.0, 135.0, 315.0, 45.0, 225.0, 135.0, 315.0])
    forces = G0 * np.column_stack([np.cos(tilt), -np.sin(tilt), np.zeros_like(tilt)])
    run = recorded(forces, seconds=20.0, s=5e-6 / G0**2, d=0.0, noise=2e-5)
    result = piga.calibrate(waived(run, "earth_rate"), ["scale_factor", "k0"])
    assert servo(result).status == "assumed"
    assert "servo" in result.verdict.unstated
    assert any("up to 100 ug/g^3 are assumed" in doubt.what for doubt in result.verdict.doubts)
    row = next(row for row in result.budget if row.source == SOURCE)
    half = 1e6 * abs(row.contributions["scale_factor"]) * np.sqrt(3.0) / TRUTH["scale_factor"]
    assert half == pytest.approx(50.0, rel=0.01)


def test_named_servo_has_no_such_row():
    run = waived(record(2), "earth_rate")
    result = piga.calibrate(run, [*TERMS, "servo"])
    assert servo(result) is None
    assert SOURCE not in [row.source for row in result.budget]


def test_k3_in_its_place_is_a_choice_of_meaning_too():
    run = record(9)
    result, alone = (
        piga.calibrate(waived(run, *names), [*TERMS, "k3"])
        for names in (["earth_rate"], ["earth_rate", "servo"])
    )
    assert abs(result["k3"].value) < 2.0 * result["k3"].std
    assert result["scale_factor"].std > 1.2 * alone["scale_factor"].std
    assert holds(result)


ON_ARM = ["scale_factor", "tan_beta", "k0", "k2"]


@pytest.mark.parametrize("seed", [1, 2])
def test_the_servo_of_a_centrifuge_alone_is_in_u_of_all_that_it_moves(seed):
    """4 ug/g^3 move K by 35 ppm there, because the arm turns the head: 2.3 ppm was U without the source."""
    result = piga.calibrate(verdict.arm(seed, verdict.Fault(servo=4e-6 / G0**2)), ON_ARM)
    for key, true in (("scale_factor", verdict.K * G0), ("k0", 1e-3), ("k2", 0.0)):
        assert abs(result[key].value - true) < result[key].expanded, key
    assert abs(result["scale_factor"].value / (verdict.K * G0) - 1.0) > 2e-5
    (servo,) = (source for source in result.sources if source.name == "servo")
    assert servo.status == "bounded"
    assert any("servo = 4" in doubt.what for doubt in result.verdict.doubts)
    sound = piga.calibrate(verdict.arm(seed, verdict.Fault()), ON_ARM)
    assert sound["scale_factor"].expanded < 4e-6


def test_a_phase_in_each_level_leaves_the_servo_of_a_centrifuge_in_u_of_k():
    run = verdict.arm(1, verdict.Fault(servo=2e-6 / G0**2))
    result = piga.calibrate(run, ON_ARM, phases="per-segment")
    assert any(row.source in (SOURCE, "servo terms that the model lacks") for row in result.budget)
    assert abs(result["scale_factor"].value - verdict.K * G0) < result["scale_factor"].expanded


def test_a_servo_that_a_model_without_coupling_cannot_tell_is_listed_with_its_effect():
    terms = ["scale_factor", "k0", "k2"]
    sound, yielding = (
        piga.calibrate(verdict.arm(1, verdict.Fault(servo=s / G0**2)), terms) for s in (0.0, 4e-6)
    )
    (servo,) = (source for source in sound.sources if source.name == "servo")
    assert (servo.status, servo.unit) == ("unstated", "ug/g^3")
    for key, effect in servo.effects["servo"].items():
        assert yielding[key].value - sound[key].value == pytest.approx(4.0 * effect, rel=0.05), key
    assert not any(row.source == SOURCE for row in sound.budget)


def test_k2o_leaves_the_servo_in_u_of_k():
    result = piga.calibrate(verdict.head(1, verdict.Fault(servo=4e-6 / G0**2)), [*verdict.TERMS, "k2o"])
    assert any(row.source == SOURCE for row in result.budget)
    assert abs(result["scale_factor"].value - verdict.K * G0) < result["scale_factor"].expanded


def test_stored_summaries_have_the_servo_that_is_not_named_as_the_runs() -> None:
    runs = [recorded(forces, s=0.0, d=0.0, noise=1e-5) for forces in (head(), levels((-8, -4, 4, 8)))]
    terms = "scale_factor, tan_beta, k0, k2, m_Y"
    stored = [RunSummary.of(run, terms, name=f"run {k}") for k, run in enumerate(runs, start=1)]
    sizes = []
    for items in (runs, stored, runs[:1], stored[:1]):
        rows = {e.source: e.contributions["scale_factor"] for e in piga.calibrate(items, terms).budget}
        sizes.append(rows[SOURCE])
    assert sizes[1] == pytest.approx(sizes[0], rel=0.01)
    assert sizes[3] == pytest.approx(sizes[2], rel=0.01)
