"""Whole-revolution averaging: right where it applies, less certain than the whole angle, honest about the rest."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga.units import G0
from tests.calibration.synthetic import SCALE, TERMS, errors, record

pytestmark = pytest.mark.only_compiled


def test_same_truth_with_larger_uncertainty() -> None:
    squares = []
    for seed in range(12):
        run = record(np.random.default_rng([seed, 51]), white=5e-5, walk=1e-6, seconds=60.0)
        turns, whole = piga.calibrate(run, TERMS, "revolutions"), piga.calibrate(run, TERMS)
        z = errors(turns)
        assert all(abs(value) < 4.5 for value in z.values()), z
        assert {c.degrees_of_freedom for c in turns.coefficients} == {
            turns.diagnostics["turns"] - len(turns.segments)
        }
        squares += [value**2 for value in z.values()]
        for name in ("scale_factor", "k0", "k2", "m_Y"):
            assert 1.2 * whole[name].std < turns[name].std < 30.0 * whole[name].std
    assert np.mean(squares) < 1.3


def test_positions_that_do_not_turn_once_are_named() -> None:
    run = record(np.random.default_rng(52), seconds=20.0)
    calibration = piga.calibrate(run, ["scale_factor", "k0", "m_Y"], "revolutions")
    event = next(e for e in calibration.quality.events if e.kind == "no-whole-revolution")
    assert 0 < event.count == len(run.labels) - len(calibration.segments)
    assert "the output does not turn once" in event.detail
    short = record(np.random.default_rng(53), seconds=5.0)
    with pytest.raises(piga.CalibrationError, match="whole turns"):
        piga.calibrate(short, ["scale_factor", "k0"], "revolutions")


def pulled(beta: float, seed: int) -> piga.Run:
    """Positions 10 to 80 degrees from the horizontal on both sides under 3 g, a strongly coupled instrument."""
    rng = np.random.default_rng(seed)
    angles = np.radians([10, 15, 25, 40, 60, 80, 100, 130, 150, 165, 195, 220, 260, 300, 330, 345])
    n = 2401
    t = np.concatenate([k * 150.0 + np.arange(n) / 20.0 for k in range(angles.size)])
    f = np.repeat(np.column_stack([np.sin(angles), np.cos(angles), 0.0 * angles]) * 3.0 * G0, n, axis=0)
    segment = np.repeat(np.arange(angles.size, dtype=np.int32), n)
    output = np.empty(t.size)
    for k in range(angles.size):
        part = segment == k
        start = piga.Instrument(scale_factor=SCALE, beta=beta, alpha0=float(rng.uniform(-3.0, 3.0)))
        output[part] = piga.propagate(start, t[part], f[part])
    output += 1e-5 * rng.standard_normal(t.size)
    return piga.Run.from_arrays(t, output, f, scale_factor=SCALE, segment=segment)


def test_pulling_gives_tan_beta_without_its_phase() -> None:
    """tan_beta 0.03: the mean rate misses up to 1.5 %; found from it alone, K and k0 unharmed."""
    run = pulled(0.03, 54)
    calibration = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"], "revolutions", phase="per-segment")
    assert calibration["tan_beta"].value == pytest.approx(np.tan(0.03), abs=4.0 * calibration["tan_beta"].std)
    assert calibration["tan_beta"].std < 1e-3
    assert calibration["scale_factor"].value == pytest.approx(0.8884, abs=4.0 * calibration["scale_factor"].std)
    assert [c.name for c in calibration.coefficients] == ["scale_factor", "tan_beta", "k0"]
    blind = piga.calibrate(run, ["scale_factor", "k0"], "revolutions")
    assert abs(blind["scale_factor"].value - 0.8884) > 10.0 * blind["scale_factor"].std


def test_pulling_that_does_not_show_is_said() -> None:
    calibration = piga.calibrate(pulled(1e-5, 55), ["scale_factor", "tan_beta", "k0"], "revolutions")
    assert "tan_beta" not in {c.name for c in calibration.coefficients}
    assert any("does not show tan_beta" in note for note in calibration.notes)


def test_harmonics_are_refused() -> None:
    with pytest.raises(piga.CalibrationError, match="averages harmonics"):
        piga.calibrate(record(np.random.default_rng(56)), ["scale_factor", "k0", "s2", "c2"], "revolutions")
