from __future__ import annotations

import numba
import numpy as np
import pytest

import piga
from piga.units import G0
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, mean_force, run_of

RATE = 20.0 if numba.config.DISABLE_JIT else 100.0
CAL = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": np.pi / 4})


def published_record(kind: str):
    """a_x from 0 to 2.06 g in 100 s, a_Y = 5 a_x [Wei2024]."""
    t = np.arange(0.0, 100.0, 1.0 / RATE)
    f = np.outer(2.06 * G0 * t / 100.0, [1.0, 5.0, 0.0])
    return run_of(t, f, phi=np.pi / 4, kind=kind)


@pytest.mark.compiled
def test_published_error_of_005_g_goes_below_1e9_g():
    """Rates exactly; angles to the error of a slope known to first order at the two first intervals."""
    rate = published_record("rate")
    before = rate.output / rate.scale_factor - rate.f[:, 0]
    assert 0.04 * G0 < np.abs(before).max() < 0.055 * G0
    assert np.abs(piga.compensate(rate, CAL).ax - rate.f[:, 0]).max() < 1e-12 * G0
    angle = published_record("angle")
    assert np.abs(piga.compensate(angle, CAL).ax[1:] - mean_force(angle.f)).max() < 1e-9 * G0


@pytest.mark.compiled
def test_published_formula_leaves_about_1e3_g():
    """With the phase 0.8026 rad to which the published calibration converges."""
    record = published_record("angle")
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.8026})
    left = piga.compensate(record, cal, method="published").ax[1:] - mean_force(record.f)
    assert 3e-4 * G0 < np.abs(left).max() < 2e-3 * G0


@pytest.mark.compiled
@pytest.mark.parametrize("kind", ["angle", "rate"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_error_falls_with_the_sampling_interval(kind, sign):
    """Smooth input: halving the interval lowers the error of angle records by 4."""
    worst = []
    for rate in (10.0, 20.0, 40.0):
        t = np.arange(0.0, 8.0, 1.0 / rate)
        f = sign * G0 * np.stack([1.0 + 0.3 * np.sin(t), 2.0 + np.cos(1.3 * t), 0.5 * t / 8.0], axis=1)
        fine = np.arange(0.0, 8.0, 0.001)
        exact = (
            sign * G0 * np.stack([1.0 + 0.3 * np.sin(fine), 2.0 + np.cos(1.3 * fine), 0.5 * fine / 8.0], axis=1)
        )
        source = run_of(fine, exact, phi=0.2, kind=kind)
        every = slice(None, None, round(1000.0 / rate))
        record = piga.Run.from_arrays(t, source.output[every], f, scale_factor=K_G / G0, kind=kind)
        cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.2})
        result = piga.compensate(record, cal).velocity()[-1]
        step = np.diff(fine)
        last = np.searchsorted(fine, t[-1] - 1e-9)
        truth = np.sum((0.5 * step * (exact[1:, 0] + exact[:-1, 0]))[:last])
        worst.append(abs(result - truth))
    assert worst[0] / worst[1] > 3.5
    assert worst[1] / worst[2] > 3.5
