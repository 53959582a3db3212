"""A gap, a segment and a chunk boundary mean the same in the array form and in a stream."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga.units import G0
from tests.short_record import SCALE


def test_a_segment_is_a_gap_without_time():
    """At the same samples, a segment and a gap of marks form no increment; the stream hears of it by ``begins``."""
    t = np.arange(200) * 0.05
    f = G0 * np.column_stack([1.0 + 0 * t, 0.3 + 0 * t, 0 * t])
    inst = piga.Instrument(scale_factor=SCALE, beta="500 arcsec", alpha0=0.4)
    psi = piga.propagate(inst, t, f, between="linear")
    cal = piga.Calibration.from_coefficients({"scale_factor": 0.8884, "tan_beta": inst.tan_beta, "phi": 0.0})
    marks = t == t[100]
    by_segment = piga.Run.from_arrays(t, psi, f, scale_factor=SCALE, segment=np.repeat([0, 1], 100), units="SI")
    by_gap = piga.Run.from_arrays(t, psi, f, scale_factor=SCALE, gaps=marks, units="SI")
    one, other = piga.compensate(by_segment, cal), piga.compensate(by_gap, cal)
    assert np.array_equal(one.dv, other.dv)
    begins = marks | (t == 0.0)
    streamed = piga.Compensator(cal).push({"t": t, "output": psi, "f": f, "begins": begins})
    assert np.array_equal(streamed.dv, one.dv)
    assert one.dv[100] == 0.0


def test_propagate_turns_on_through_a_gap():
    """The gimbal turns on while nothing is recorded: force is linear between samples, across a gap as well."""
    inst = piga.Instrument(scale_factor=SCALE, beta="1000 arcsec", alpha0=0.4)
    fine = np.arange(0.0, 10.0, 0.01)
    f = np.tile([9.8, 4.0, 1.0], (fine.size, 1))
    kept = (fine < 3.0) | (fine > 7.0)
    whole = piga.propagate(inst, fine, f, between="linear")
    assert piga.propagate(inst, fine[kept], f[kept], between="linear")[-1] == pytest.approx(
        whole[-1], abs=1e-10
    )
