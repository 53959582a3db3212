"""A servo whose terms are not asked for is in u of K as far as the record does not exclude it; truth by SciPy."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from benchmarks import verdict

import piga
from piga.calibration import RunSummary
from piga.records.calibration.coefficient import OF_THE_MODEL
from piga.records.run_file import UncertaintyTable
from piga.units import G0
from tests.calibration.made.servo_data import (
    SERVO_LEFT,
    TERMS,
    TRUTH,
    UNNAMED,
    half_width,
    head,
    known_noise,
    levels,
    recorded,
)

PLAIN = TERMS[:5]
BY_K3 = TRUTH["scale_factor"] * (1.0 - 1.3e-5)
pytestmark = pytest.mark.filterwarnings("ignore::piga.CalibrationWarning")


def record(seed: int, size: float = 5e-6, walk: float = 2e-5) -> piga.Run:
    """A head with a servo of ``size`` [g/g^3] that a walk [rad/sqrt(s)] hides."""
    rng = np.random.default_rng([seed, 77])
    forces = head(24, rng.uniform(0.0, 0.2))[rng.permutation(24)]
    run = recorded(forces, seconds=30.0, step=0.5, s=size / G0**2, d=0.0)
    steps = walk * np.sqrt(np.diff(run.t, prepend=run.t[0])) * rng.standard_normal(run.size)
    steps[run.begins] = 0.0
    return replace(run, output=run.output + np.cumsum(steps) + 2e-5 * rng.standard_normal(run.size))


def waived(run: piga.Run, *names: str) -> piga.Run:
    return replace(run, uncertainty=UncertaintyTable(waived=dict.fromkeys(("earth_rate", *names), "simulated")))


def servo(result: piga.Calibration):
    return next((source for source in result.sources if source.name == "servo"), None)


def limit(result: piga.Calibration) -> float:
    """Largest servo that the record does not exclude, or that is assumed [ug/g^3]."""
    return float(re.search(r"(?:more than|up to) ([\d.]+) ug", servo(result).reason)[1])


def holds(result: piga.Calibration, truth: float = TRUTH["scale_factor"]) -> bool:
    return abs(result["scale_factor"].value - truth) <= result["scale_factor"].expanded


@pytest.mark.long
def test_k_holds_the_truth_beside_a_hidden_servo():
    runs = [record(seed) for seed in range(3, 10)]
    bounded = [piga.calibrate(waived(run), PLAIN) for run in runs]
    assert all(map(holds, bounded))
    assert not all(holds(piga.calibrate(waived(run, "servo"), PLAIN)) for run in runs)
    silent = [result for result in bounded if not any("servo" in doubt.what for doubt in result.verdict.doubts)]
    assert len(silent) > 3
    assert {servo(result).status for result in silent} == {"bounded"}


@pytest.mark.parametrize("terms", [PLAIN, ["scale_factor", "k0", "k2", "m_Y"]], ids=["coupling", "by the cube"])
def test_size_of_the_row_is_the_limit_times_the_shift_of_k(terms):
    """Equal weights and equal angles: the mean rate falls by s a_x a_t^2, so K by s <a_x^2 a_t^2>/<a_x^2> = s g^2/4."""
    run = record(3)
    result, alone = (piga.calibrate(waived(run, *names), terms) for names in ([], ["servo"]))
    shift = 1e6 * half_width(result, UNNAMED) / TRUTH["scale_factor"]
    assert shift == pytest.approx(limit(result) / 4.0, rel=0.15)
    u = alone["scale_factor"].std
    assert u < result["scale_factor"].std < 2.5 * u
    assert servo(alone).status == "waived"


def test_four_positions_at_45_degrees_cannot_tell_and_say_so():
    tilt = np.radians([45.0, 225.0, 135.0, 315.0, 45.0, 225.0, 135.0, 315.0])
    forces = G0 * np.column_stack([np.cos(tilt), -np.sin(tilt), np.zeros_like(tilt)])
    run = recorded(forces, seconds=20.0, s=5e-6 / G0**2, d=0.0, noise=2e-5)
    result = piga.calibrate(waived(run), ["scale_factor", "k0"])
    assert servo(result).status == "assumed"
    assert "servo" in result.verdict.unstated
    assert any("up to 100 ug/g^3 are assumed" in doubt.what for doubt in result.verdict.doubts)
    assert 1e6 * half_width(result, UNNAMED) / TRUTH["scale_factor"] == pytest.approx(50.0, rel=0.01)


def test_k3_in_its_place_is_a_choice_of_meaning_too():
    run = record(9)
    result, alone = (piga.calibrate(waived(run, *names), [*PLAIN, "k3"]) for names in ([], ["servo"]))
    assert abs(result["k3"].value) < 2.0 * result["k3"].std
    assert result["scale_factor"].std > 1.2 * alone["scale_factor"].std
    assert holds(result)


ON_ARM = ["scale_factor", "tan_beta", "k0", "k2"]


def yielding(size: float) -> verdict.Fault:
    """A servo of so many ug/g^3."""
    return verdict.Fault(servo=1e-6 * size / G0**2)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_servo_of_a_centrifuge_alone_is_in_u_of_all_that_it_moves(seed):
    """4 ug/g^3 move K by 35 ppm there, because the arm turns the head: 2.3 ppm was U without the source."""
    result = piga.calibrate(verdict.arm(seed, yielding(4.0)), ON_ARM)
    for key, true in (("scale_factor", verdict.K * G0), ("k0", 1e-3), ("k2", 0.0)):
        assert abs(result[key].value - true) < result[key].expanded, key
    assert abs(result["scale_factor"].value / (verdict.K * G0) - 1.0) > 2e-5
    assert any(row.source == SERVO_LEFT for row in result.budget)
    assert any("servo = " in doubt.what for doubt in result.verdict.doubts)
    assert piga.calibrate(verdict.arm(seed, yielding(0.0)), ON_ARM)["scale_factor"].expanded < 4e-6


def test_k2o_leaves_the_servo_in_u_of_k():
    result = piga.calibrate(verdict.head(1, yielding(4.0)), [*verdict.TERMS, "k2o"])
    assert any(row.source in (UNNAMED, SERVO_LEFT) for row in result.budget)
    assert holds(result, verdict.K * G0)


@pytest.mark.parametrize(
    ("terms", "phases"),
    [(["scale_factor", "k0", "k2"], "shared"), (ON_ARM, "per-segment")],
    ids=["without coupling", "a phase in each level: it takes up the damping"],
)
def test_a_servo_that_a_centrifuge_cannot_tell_is_listed_with_its_effect(terms, phases):
    sound, moved = (piga.calibrate(verdict.arm(1, yielding(size)), terms, phases=phases) for size in (0.0, 4.0))
    assert (servo(sound).status, servo(sound).unit) == ("unstated", "ug/g^3")
    for key, effect in servo(sound).effects["servo"].items():
        if key.startswith(("tan_beta", "phi")):
            continue
        assert moved[key].value - sound[key].value == pytest.approx(4.0 * effect, rel=0.05), key
    assert not any(row.source == UNNAMED for row in sound.budget)


# --- several runs


NOISE = 2e-6


def noisy(forces, name, turn=0.0, **options):
    """A record whose output counts from a zero of its own, its noise given."""
    run = known_noise(recorded(forces, noise=NOISE, **options), f"{NOISE} rad")
    return replace(run, output=run.output - turn, input_sha256={name: name})


def two_heads(**options):
    """Two runs on heads, a power-up each."""
    return [
        noisy(head(12), "first", seconds=8.0, seed=1, **options),
        noisy(head(10, 0.21), "second", turn=1.1, seconds=8.0, seed=2, **options),
    ]


@pytest.mark.long
@pytest.mark.parametrize("stored", [False, True], ids=["records", "summary"])
def test_two_heads_hold_both_meanings_of_a_cube(stored):
    runs = two_heads(d=0.0)
    if stored:
        runs[0] = RunSummary.of(runs[0], PLAIN, name="stored")
    calibration = piga.calibrate(runs, PLAIN)
    assert holds(calibration)
    assert holds(calibration, BY_K3)
    far = max(abs(calibration["scale_factor"].value - meaning) for meaning in (TRUTH["scale_factor"], BY_K3))
    assert half_width(calibration, SERVO_LEFT) == pytest.approx(far, rel=0.2)
    note = next(note for note in calibration.notes if "show servo = " in note)
    by_servo, by_k3 = (
        float(re.search(rf"{where} (0\.\d+)", note)[1]) for where in ("scale_factor", "of servo:")
    )
    assert by_servo == pytest.approx(TRUTH["scale_factor"], rel=1e-6)
    assert by_k3 == pytest.approx(BY_K3, rel=2e-6)


@pytest.mark.long
def test_two_heads_without_a_servo_hold_what_they_do_not_exclude():
    """K is off by s g^2/4 where the positions go round."""
    runs = two_heads(s=0.0, d=0.0)
    calibration = piga.calibrate(runs, PLAIN)
    assert [row.source for row in calibration.budget][1:] == [UNNAMED]
    expected = 2.5e-7 * limit(calibration) * TRUTH["scale_factor"]
    assert half_width(calibration, UNNAMED) == pytest.approx(expected, rel=0.2)
    assert [row.type for row in piga.calibrate([waived(run, "servo") for run in runs], PLAIN).budget] == ["A"]
    assert not any("cube" in note or "servo" in note for note in calibration.notes)


@pytest.mark.long
def test_two_heads_whose_damping_turns_the_phase():
    calibration = piga.calibrate(two_heads(), [*PLAIN, "servo"])
    phases = [c for c in calibration.coefficients if c.name == "phi"]
    for phi, truth in zip(phases, (TRUTH["phi"], TRUTH["phi"] + 1.1), strict=True):
        assert abs(phi.value - truth) < phi.expanded
        assert half_width(calibration, SERVO_LEFT, phi.key) > 0.01
    assert any("servo_damping = " in note for note in calibration.notes)


@pytest.mark.long
def test_head_and_centrifuge_tell_what_the_model_lacks():
    arm = noisy(levels(), "arm", turn=0.9, seconds=4.0, step=0.02)
    runs = [noisy(head(8), "head", seconds=8.0), arm]
    calibration = piga.calibrate(runs, PLAIN, per_run=[])
    assert SERVO_LEFT.startswith(OF_THE_MODEL)
    for name in ("scale_factor", "tan_beta", "k0"):
        assert abs(calibration[name].value - TRUTH[name]) < calibration[name].expanded, name
    assert abs(calibration["scale_factor"].value / TRUTH["scale_factor"] - 1.0) > 5e-6
    assert half_width(calibration, SERVO_LEFT) > 4e-6
    note = next(note for note in calibration.notes if "show servo = " in note)
    assert "Add 'servo' and 'servo_damping'" in note
    assert SERVO_LEFT not in [row.source for row in piga.calibrate(runs, TERMS).budget]


def test_stored_summaries_have_the_servo_that_is_not_named_as_the_runs() -> None:
    runs = [recorded(forces, s=0.0, d=0.0, noise=1e-5) for forces in (head(), levels((-8, -4, 4, 8)))]
    stored = [RunSummary.of(run, PLAIN, name=f"run {k}") for k, run in enumerate(runs, start=1)]
    together, apart, one, summary = (
        half_width(piga.calibrate(items, PLAIN), UNNAMED) for items in (runs, stored, runs[:1], stored[:1])
    )
    assert apart == pytest.approx(together, rel=0.01)
    assert summary == pytest.approx(one, rel=0.01)
