"""What the servo leaves in runs together where its terms are not asked for, on records that SciPy integrates."""

import re
from dataclasses import replace

import numpy as np
import pytest

from piga.calibration import RunSummary
from piga.calibration.calibrate import calibrate
from piga.records.calibration.coefficient import OF_THE_MODEL
from piga.records.run_file import ASSUMED_SOURCES, EstimationTable, UncertaintyTable
from tests.calibration.made.servo_data import TERMS, TRUTH, head, levels, recorded

pytestmark = pytest.mark.long

PLAIN = TERMS[:5]
MEANING = "meaning of the cubic signature: servo or k3"
UNNAMED = "servo that is not named"
BY_K3 = TRUTH["scale_factor"] * (1.0 - 1.3e-5)
NOISE = 2e-6


def noisy(forces, name, turn=0.0, **options):
    """A record whose output counts from a zero of its own, its noise given."""
    run = recorded(forces, noise=NOISE, **options)
    levels_of_noise = EstimationTable(angle_rms=f"{NOISE} rad", angle_random_walk="1e-9 rad/sqrt(s)")
    return replace(run, output=run.output - turn, estimation=levels_of_noise, input_sha256={name: name})


def two_heads(**options):
    """Two runs on heads, a power-up each."""
    return [
        noisy(head(12), "first", seconds=8.0, seed=1, **options),
        noisy(head(10, 0.21), "second", turn=1.1, seconds=8.0, seed=2, **options),
    ]


def half_width(result, source, key="scale_factor"):
    """What a row of the budget holds on either side of a coefficient."""
    rows = [row for row in result.budget if row.source == source]
    assert len(rows) == 1
    return abs(rows[0].contributions[key]) * np.sqrt(3.0)


@pytest.mark.parametrize("stored", [False, True], ids=["records", "summary"])
def test_two_heads_hold_both_meanings_of_a_cube(stored):
    runs = two_heads(d=0.0)
    if stored:
        runs[0] = RunSummary.of(runs[0], PLAIN, name="stored")
    calibration = calibrate(runs, PLAIN)
    scale = calibration["scale_factor"]
    for meaning in (TRUTH["scale_factor"], BY_K3):
        assert abs(scale.value - meaning) < scale.expanded
    far = max(abs(scale.value - meaning) for meaning in (TRUTH["scale_factor"], BY_K3))
    assert half_width(calibration, MEANING) == pytest.approx(far, rel=0.2)
    note = next(note for note in calibration.notes if "can separate servo from k3" in note)
    by_servo, by_k3 = (float(re.search(rf"(0\.\d+) with {name}", note)[1]) for name in ("servo", "k3"))
    assert by_servo == pytest.approx(TRUTH["scale_factor"], rel=1e-6)
    assert by_k3 == pytest.approx(BY_K3, rel=2e-6)
    assert MEANING.startswith(OF_THE_MODEL)


def test_two_heads_without_a_servo_hold_what_they_do_not_exclude():
    """K is off by s g^2/4 where the positions go round."""
    calibration = calibrate(two_heads(s=0.0, d=0.0), PLAIN)
    assert [row.source for row in calibration.budget][1:] == [UNNAMED]
    (servo,) = (source for source in calibration.sources if source.name == "servo")
    limit = float(re.search(r"more than ([\d.]+) ug", servo.reason)[1])
    assert half_width(calibration, UNNAMED) == pytest.approx(2.5e-7 * limit * TRUTH["scale_factor"], rel=0.2)
    runs = [
        replace(run, uncertainty=UncertaintyTable(waived=dict.fromkeys(ASSUMED_SOURCES, "no servo")))
        for run in two_heads(s=0.0, d=0.0)
    ]
    assert [row.type for row in calibrate(runs, PLAIN).budget] == ["A"]
    assert not any("cube" in note or "servo" in note for note in calibration.notes)


def test_two_heads_whose_damping_turns_the_phase():
    calibration = calibrate(two_heads(), [*PLAIN, "servo"])
    phases = [c for c in calibration.coefficients if c.name == "phi"]
    for phi, truth in zip(phases, (TRUTH["phi"], TRUTH["phi"] + 1.1), strict=True):
        assert abs(phi.value - truth) < phi.expanded
        assert half_width(calibration, "servo damping that the model lacks", phi.key) > 0.01
    assert any("servo_damping = " in note for note in calibration.notes)


def test_head_and_centrifuge_tell_what_the_model_lacks():
    runs = [
        noisy(head(8), "head", seconds=8.0),
        noisy(levels(), "arm", turn=0.9, seconds=4.0, step=0.02),
    ]
    calibration = calibrate(runs, PLAIN, per_run=[])
    source = "servo terms that the model lacks"
    assert source.startswith(OF_THE_MODEL)
    for name in ("scale_factor", "tan_beta", "k0"):
        assert abs(calibration[name].value - TRUTH[name]) < calibration[name].expanded, name
    assert abs(calibration["scale_factor"].value / TRUTH["scale_factor"] - 1.0) > 5e-6
    assert half_width(calibration, source) > 4e-6
    note = next(note for note in calibration.notes if "the runs together show servo" in note)
    assert "Add 'servo' and 'servo_damping'" in note
    whole = calibrate(runs, TERMS)
    assert source not in [row.source for row in whole.budget]
