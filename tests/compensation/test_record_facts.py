"""What the calibration record tells the compensation besides coefficients: time zero of the drift, valid range."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import piga
from piga.units import G0

pytestmark = pytest.mark.compiled


def drifting(seconds: float = 40.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """An instrument whose bias drifts by 1e-5 g/s; the input is the same before and after."""
    t = 100.0 + np.arange(0.0, seconds, 0.01)
    f = G0 * np.column_stack([1.0 + 0.3 * np.sin(0.5 * t), 0.5 * np.cos(0.3 * t), 0.0 * t])
    drift = np.zeros_like(f)
    drift[:, 0] = 1e-5 * G0 * (t - 100.0)
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="200 arcsec")
    every = slice(None, None, 10)  # a smooth force between the samples of the record
    return t[every], f[every], piga.propagate(inst, t, f + drift)[every]


def test_a_part_of_the_record_is_compensated_at_its_own_time(tmp_path: Path) -> None:
    t, f, alpha = drifting()
    whole = piga.Run.from_arrays(t, alpha, f, scale_factor="0.8884 rad/s/g")
    path = tmp_path / "c.json"
    piga.calibrate(whole, ["scale_factor", "tan_beta", "k0", "k0_t"]).to_json(path)
    calibration = piga.Calibration.from_json(path)
    assert calibration["k0_t"].value == pytest.approx(1e-5, rel=1e-3)
    late = slice(300, None)
    part = piga.Run.from_arrays(t[late], alpha[late], f[late], scale_factor="0.8884 rad/s/g")
    compensated = piga.compensate(part, calibration)
    velocity = G0 * (t - 0.6 * np.cos(0.5 * t))
    middle = np.diff(velocity[late]) / 0.1
    np.testing.assert_allclose(compensated.ax[2:], middle[1:], atol=2e-6 * G0)


def test_rows_outside_the_calibrated_range_are_flagged() -> None:
    t, f, alpha = drifting(20.0)
    calibration = piga.calibrate(
        piga.Run.from_arrays(t, alpha, f, scale_factor="0.8884 rad/s/g"), ["scale_factor", "tan_beta", "k0"]
    )
    low, high = calibration.diagnostics.range["a_x"]
    assert (low, high) == (f[:, 0].min(), f[:, 0].max())
    strong = f * [2.0, 1.0, 1.0]
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="200 arcsec")
    run = piga.Run.from_arrays(t, piga.propagate(inst, t, strong), strong, scale_factor="0.8884 rad/s/g")
    flagged = piga.compensate(run, calibration).flagged("out_of_range")
    assert flagged[1:].mean() > 0.5
