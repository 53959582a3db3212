from __future__ import annotations

import numba
import numpy as np
import pytest

import piga
from piga.compensation import Mounted, SetCompensator, compensate_set
from piga.units import G0
from tests.compensation.sets.triads import SKEWED, made, orthogonal, rotation
from tests.compensation.twin_data import K_G, calibration_of

ROWS = 300 if numba.config.DISABLE_JIT else 3000


@pytest.mark.compiled
@pytest.mark.parametrize(
    "axes", [orthogonal(), [rotation(a) for a in SKEWED[:3]], [rotation(a) for a in SKEWED]]
)
def test_constant_force_comes_back_in_any_mounting(axes):
    t = np.arange(ROWS) * 0.01
    f = np.tile(np.array([1.0, -0.7, 0.4]) * G0, (t.size, 1))
    runs, mounted = made(t, f, axes, base=np.array([7e-5, 3e-3, -2e-3]))
    compensated = compensate_set(runs, mounted)
    rounding = 4 * np.finfo(float).eps * 3.0 * max(1.0, 0.009 * ROWS) / (K_G / G0 * 0.01)
    assert np.abs(compensated.f[1:] - f[1:]).max() < max(rounding, 1e-13)


@pytest.mark.compiled
@pytest.mark.parametrize("axes", [orthogonal(), [rotation(a) for a in SKEWED]])
def test_samples_of_angle_and_rate_come_back_to_1e12_g(axes):
    t = np.arange(ROWS) * 0.01
    f = np.array([1.0, -0.7, 0.4]) * G0 * (1.0 + 0.3 * np.sin(2.0 * t))[:, None]
    errors = {"k0": 1e-3, "k1": -2e-3, "k2": 2e-3, "m_Y": 2e-4, "k_XY": 1e-4, "k_YZ": 3e-5}
    angle, mounted = made(t, f, axes, errors=errors)
    rate, _ = made(t, f, axes, "rate", errors=errors)
    stream = SetCompensator(mounted, sampled=True)
    rows = stream.push(t, [r.output for r in angle], rate=[r.output for r in rate])
    assert np.abs(rows.f - f).max() < 1e-12 * G0


@pytest.mark.compiled
def test_full_error_model_of_angles():
    t = np.arange(ROWS) * 0.01
    f = np.tile(np.array([1.0, -0.7, 0.4]) * G0, (t.size, 1))
    errors = {
        "k0": 1e-3,
        "k1": -2e-3,
        "k2": 2e-3,
        "k3": 1e-4,
        "m_Y": 2e-4,
        "k_XY": 1e-4,
        "s1": 1e-5,
        "c1": 2e-5,
    }
    runs, mounted = made(t, f, [rotation(a) for a in SKEWED[:3]], errors=errors)
    compensated = compensate_set(runs, mounted)
    assert np.abs(compensated.f[1:] - f[1:]).max() < 2e-12 * G0 * max(1.0, 0.009 * ROWS)


@pytest.mark.only_compiled
@pytest.mark.parametrize("size", [3, 37])
def test_a_redundant_set_that_locks_is_the_same_whatever_the_chunks(size: int) -> None:
    """Weights follow the force that is found without them: both solutions look back over the edges of the chunks."""
    t = np.linspace(0.0, 26.0, ROWS // 2)
    f = G0 * np.column_stack([np.cos(0.7 * t), np.sin(0.7 * t), 0.4 + 0.0 * t])
    runs, mounted = made(t, f, [rotation(a) for a in SKEWED], std={"phi": 1e-5, "tan_beta": 1e-6})
    psi = np.array([run.output for run in runs])
    whole, stream = SetCompensator(mounted).push(t, psi), SetCompensator(mounted)
    assert whole.flagged("near_critical").any()
    parts = [stream.push(t[i : i + size], psi[:, i : i + size]) for i in range(0, t.size, size)]
    for name in ("f", "dv", "u_f", "residual", "flags"):
        assert (
            np.concatenate([getattr(part, name) for part in parts]).tobytes() == getattr(whole, name).tobytes()
        )


@pytest.mark.compiled
def test_set_is_the_same_to_the_bit_whatever_the_chunks():
    t = np.arange(ROWS) * 0.01
    f = np.array([1.0, -0.7, 0.4]) * G0 * (1.0 + 0.3 * np.sin(2.0 * t))[:, None]
    runs, mounted = made(t, f, [rotation(a) for a in SKEWED])
    psi = np.array([r.output for r in runs])
    whole = SetCompensator(mounted).push(t, psi)
    stream = SetCompensator(mounted)
    parts = [stream.push(t[a:b], psi[:, a:b]) for a, b in ((0, 1), (1, 70), (70, 71), (71, 200), (200, ROWS))]
    for name in ("f", "dv", "u_f", "residual"):
        assert np.concatenate([getattr(p, name) for p in parts]).tobytes() == getattr(whole, name).tobytes()


def test_fault_of_one_instrument_is_flagged():
    t = np.arange(ROWS) * 0.01
    f = np.tile(np.array([1.0, -0.7, 0.4]) * G0, (t.size, 1))
    runs, mounted = made(t, f, [rotation(a) for a in SKEWED])
    psi = np.array([r.output for r in runs])
    sound = SetCompensator(mounted).push(t, psi)
    psi[2, 100:] += 0.01
    broken = SetCompensator(mounted).push(t, psi)
    assert not sound.flagged("fault").any()
    assert np.flatnonzero(broken.flagged("fault")).tolist() == [100]


def test_axes_in_one_plane_and_mirrored_axes_are_refused():
    cal = calibration_of({"k0": 0.0})
    with pytest.raises(piga.ArgumentError, match="in one plane"):
        SetCompensator([Mounted(cal, np.eye(3))] * 3)
    with pytest.raises(piga.ArgumentError, match="instrument 0: the rows are not a right-handed"):
        SetCompensator([Mounted(cal, np.diag([1.0, 1.0, -1.0]))] * 3)
