"""Leverage of segments: exact against calibrations without the segment, and in words where one decides."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from benchmarks.constant_force import tumble

import piga
from piga.units import G0
from tests.calibration.made.scenarios import COUPLED, SCENARIOS, Scenario

STATED = {"angle_rms": "2.5e-5 rad", "angle_random_walk": "2e-5 rad/sqrt(s)"}


def pushed(run: piga.Run, size: float) -> piga.Run:
    """The reference of position 3 off by ``size`` [g] along X0."""
    off = np.zeros_like(run.f)
    off[run.segment_index == 3, 0] = size * G0
    return replace(run, f=run.f + off)


@pytest.mark.long
@pytest.mark.parametrize("phase", ["shared", "per-segment"])
def test_influence_is_that_of_a_calibration_without_the_segment(phase):
    """Noise levels are stated: leaving a segment out changes nothing but the data."""
    scenario = SCENARIOS["static"]
    run = scenario.record(np.random.default_rng(2))
    run = replace(run, estimation=msgspec.structs.replace(run.estimation, **STATED))
    full = piga.calibrate(run, scenario.terms, phases=phase)
    for label in ("0", "7"):
        row = full.diagnostics.leverage[label]
        rest = piga.calibrate(run.without(run.segment_index == int(label)), scenario.terms, phases=phase)
        for c in full.coefficients:
            if c.segment is not None:
                continue
            shift = (rest[c.name].value - c.value) / c.std
            assert row.shift[c.name] == pytest.approx(shift, abs=1e-5 if phase == "shared" else 0.1)
            assert 0.0 <= row.share[c.name] < 0.9
    leverages = sum(row.leverage for row in full.diagnostics.leverage.values())
    assert leverages == pytest.approx(len(full.coefficients), rel=1e-6)


@pytest.mark.long
def test_a_position_that_is_wrong_is_named():
    scenario = Scenario("odd", tumble(12), white=2.5e-5, walk=2e-5, terms=COUPLED)
    run = scenario.record(np.random.default_rng(1))
    calibration = piga.calibrate(pushed(run, 3e-4), COUPLED)
    assert any("without segment '3'" in note for note in calibration.notes)
    assert not any("without segment" in note for note in piga.calibrate(run, COUPLED).notes)


@pytest.mark.long
def test_positions_that_all_scatter_are_not_named_one_by_one():
    """Thirty times the scatter that the noise explains: one remark on all, none on each; one that is far off, still."""
    scenario = replace(SCENARIOS["scatter"], scatter=1e-4)
    run = scenario.record(np.random.default_rng(4))
    calibration = scenario.calibrate(run)
    shifts = [row.shift["scale_factor"] for row in calibration.diagnostics.leverage.values()]
    assert max(map(abs, shifts)) < 3.0, "in units of the uncertainty with the scatter"
    assert any("the mean rates of the segments scatter" in note for note in calibration.notes)
    assert not any("without segment" in note for note in calibration.notes)
    notes = piga.calibrate(pushed(run, 3e-2), scenario.terms).notes
    assert any("without segment '3'" in note for note in notes)


def test_one_segment_has_no_leverage():
    run = SCENARIOS["static"].record(np.random.default_rng(2))
    assert not piga.calibrate(run.without(run.segment_index != 0), ["k1"]).diagnostics.leverage
