"""Leverage of segments: exact against calibrations without the segment, and in words where one decides."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

import piga
from piga.units import G0
from tests.calibration.made.scenarios import SCENARIOS, Scenario, tumble

TERMS = ("scale_factor", "tan_beta", "k0")
STATED = {"angle_rms": "2.5e-5 rad", "angle_random_walk": "2e-5 rad/sqrt(s)"}


def known_noise(run):
    """The record with stated noise levels: leaving a segment out then changes nothing but the data."""
    return replace(run, estimation=msgspec.structs.replace(run.estimation, **STATED))


def without(run, label):
    keep = run.segment_index != run.labels.index(label)
    index = np.unique(run.segment_index[keep], return_inverse=True)[1].astype(np.int32)
    labels = tuple(name for name in run.labels if name != label)
    return replace(
        run, t=run.t[keep], output=run.output[keep], f=run.f[keep], segment_index=index, labels=labels,
        begins=run.begins[keep], phase_group=(0,) * len(labels), row=run.row[keep],
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("phase", ["shared", "per-segment"])
def test_influence_is_that_of_a_calibration_without_the_segment(phase):
    scenario = SCENARIOS["static"]
    run = known_noise(scenario.record(np.random.default_rng(2)))
    full = piga.calibrate(run, scenario.terms, phases=phase)
    for label in ("0", "7"):
        row = full.diagnostics.leverage[label]
        rest = {
            c.name: c for c in piga.calibrate(without(run, label), scenario.terms, phases=phase).coefficients
        }
        for c in full.coefficients:
            if c.segment is not None:
                continue
            exact = phase == "shared"
            shift = (rest[c.name].value - c.value) / c.std
            assert row.shift[c.name] == pytest.approx(shift, abs=1e-5 if exact else 0.1)
            assert 0.0 <= row.share[c.name] < 0.9


@pytest.mark.long
def test_leverages_add_up_to_the_number_of_parameters():
    scenario = SCENARIOS["static"]
    run = scenario.record(np.random.default_rng(2))
    table = piga.calibrate(run, scenario.terms).diagnostics.leverage
    assert sum(row.leverage for row in table.values()) == pytest.approx(6.0, rel=1e-6)
    table = piga.calibrate(run, scenario.terms, phases="per-segment").diagnostics.leverage
    assert sum(row.leverage for row in table.values()) == pytest.approx(5.0 + len(table), rel=1e-6)


@pytest.mark.long
def test_a_coefficient_that_rests_on_one_position_is_refused():
    """Only segment 8 holds another |a_x|, so k2 is its."""
    forces = np.vstack([np.tile([[1.0, 0.0, 0.1], [-1.0, 0.0, 0.1]], (4, 1)), [[0.4, 0.0, 0.1]]])
    terms = ("scale_factor", "tan_beta", "k0", "k2")
    scenario = Scenario("sole", forces, seconds=6.0, white=2.5e-5, walk=2e-5, terms=terms)
    with pytest.raises(piga.IdentifiabilityError, match=r"position '8' alone determines k0, k2") as refused:
        scenario.calibrate(scenario.record(np.random.default_rng(1)))
    assert "visit this position again" in refused.value.remedy


@pytest.mark.long
def test_a_position_that_is_wrong_is_named():
    scenario = Scenario("odd", tumble(12), white=2.5e-5, walk=2e-5, terms=TERMS)
    run = scenario.record(np.random.default_rng(1))
    off = np.zeros((12, 3))
    off[3, 0] = 3e-4 * G0
    calibration = piga.calibrate(replace(run, f=run.f + off[run.segment_index]), TERMS)
    assert any("without segment '3'" in note for note in calibration.notes)
    assert not any("without segment" in note for note in piga.calibrate(run, TERMS).notes)


@pytest.mark.long
def test_positions_that_all_scatter_are_not_named_one_by_one():
    """Thirty times the scatter that the noise explains: one remark on all, none on each; one that is far off, still."""
    scenario = replace(SCENARIOS["scatter"], scatter=1e-4)
    run = scenario.record(np.random.default_rng(4))
    calibration = scenario.calibrate(run)
    notes = calibration.notes
    shifts = [row.shift["scale_factor"] for row in calibration.diagnostics.leverage.values()]
    assert max(map(abs, shifts)) < 3.0, "in units of the uncertainty with the scatter"
    assert any("the mean rates of the segments scatter" in note for note in notes)
    assert not any("without segment" in note for note in notes)
    off = np.zeros((16, 3))
    off[3, 0] = 3e-2 * G0
    notes = piga.calibrate(replace(run, f=run.f + off[run.segment_index]), scenario.terms).notes
    assert any("without segment '3'" in note for note in notes)


def test_one_segment_has_no_leverage():
    run = SCENARIOS["static"].record(np.random.default_rng(2))
    keep = run.segment_index == 0
    alone = piga.Run.from_arrays(
        run.t[keep], run.output[keep], run.f[keep], scale_factor=run.scale_factor, units="SI"
    )
    assert not piga.calibrate(alone, ["k1"]).diagnostics.leverage
