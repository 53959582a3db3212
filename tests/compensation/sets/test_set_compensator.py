"""Sets whose angles alone are logged: smooth force comes back at rounding, against a power series at 40 digits."""

from __future__ import annotations

import mpmath
import numba
import numpy as np
import pytest

from piga.compensation import Mounted, SetCompensator
from piga.compensation.sets.set_compensator import PublishedSet
from piga.units import G0
from tests.compensation.sets.triads import PHASES, SKEWED, made, orthogonal, rotation
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of

TERMS = 16
ROWS = 40 if numba.config.DISABLE_JIT else 400
SKEW3, SKEW4 = [rotation(a) for a in SKEWED[:3]], [rotation(a) for a in SKEWED]


def smooth(t: np.ndarray) -> np.ndarray:
    """A force [m/s^2] that sways at 0.5 Hz and below, samples (n, 3)."""
    along = (1.0 + 0.3 * np.sin(np.pi * t), -0.7 + 0.2 * np.cos(1.3 * t), 0.4 + 0.1 * np.sin(2.1 * t))
    return G0 * np.stack(along, axis=1)


def series_angles(t: np.ndarray, f: np.ndarray, phi: float) -> np.ndarray:
    """Output angle [rad] for samples ``f`` (n, 3) in the axes of the instrument, linear in between.

    ``alpha' = u_x + tan(beta) (u_Y sin(alpha) - u_Z cos(alpha))`` by the Taylor series of ``alpha``, ``sin`` and ``cos``
    about every sample, ``TERMS`` terms at 40 digits: ``(0.01)^16`` leaves nothing.
    """
    with mpmath.workdps(40):
        K, tangent = mpmath.mpf(K_G / G0), mpmath.mpf(TAN_BETA)
        alpha, result = mpmath.mpf(phi), [0.0]
        times = [mpmath.mpf(x) for x in t.tolist()]
        inputs = [[K * mpmath.mpf(x) for x in row] for row in f.tolist()]
        for i in range(1, len(times)):
            h = times[i] - times[i - 1]
            u = [[a, (b - a) / h] for a, b in zip(inputs[i - 1], inputs[i], strict=True)]
            a, s, c = [alpha], [mpmath.sin(alpha)], [mpmath.cos(alpha)]
            for n in range(TERMS):
                value = (u[0][n] if n < 2 else 0) + tangent * sum(
                    u[1][m] * s[n - m] - u[2][m] * c[n - m] for m in range(min(n, 1) + 1)
                )
                a.append(value / (n + 1))
                s.append(sum((k + 1) * a[k + 1] * c[n - k] for k in range(n + 1)) / (n + 1))
                c.append(-sum((k + 1) * a[k + 1] * s[n - k] for k in range(n + 1)) / (n + 1))
            alpha = sum(value * h**n for n, value in enumerate(a))
            result.append(float(alpha - phi))
    return np.array(result)


@pytest.mark.compiled
@pytest.mark.parametrize("axes", [orthogonal(), SKEW3, SKEW4])
def test_smooth_force_comes_back_from_angles_alone(axes):
    """100 Hz: 1e-12 g from the fourth interval on; before that the differences there are."""
    t = np.arange(40) * 0.01
    f = smooth(t)
    psi = np.array([series_angles(t, f @ m.T, PHASES[i]) for i, m in enumerate(axes)])
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA}
    mounted = [Mounted(calibration_of({**values, "phi": PHASES[i]}), m) for i, m in enumerate(axes)]
    rows = SetCompensator(mounted).push(t, psi)
    error = np.abs(rows.f[1:] - 0.5 * (f[1:] + f[:-1])).max(axis=1) / G0
    assert error[4:].max() < 1e-12
    assert (error[:3] < (5e-8, 2e-10, 2e-11)).all()
    assert (rows.residual[5:] < 1e-12 * G0).all()


@pytest.mark.compiled
@pytest.mark.parametrize("axes", [orthogonal(), SKEW3, SKEW4])
def test_the_same_with_error_terms_and_a_base_that_turns_faster_and_faster(axes):
    t = np.arange(ROWS) * 0.01
    errors = {"k0": 1e-3, "k1": -1e-3, "k2": 2e-3, "k3": 1e-4, "m_Y": 2e-4, "k_XY": 1e-4, "k_YY": 5e-5}
    f = smooth(t)
    base = np.array([7e-3, 3e-2, -2e-2]) * (1.0 + 0.7 * t)[:, None]
    runs, mounted = made(t, f, axes, errors=errors, base=base)
    stream = SetCompensator(mounted)
    rows = stream.push(t, [r.output for r in runs], base_rate=[r.base_rate for r in runs])
    error = np.abs(rows.f[1:] - 0.5 * (f[1:] + f[:-1])).max(axis=1) / G0
    assert error[4:].max() < 1e-11


@pytest.mark.compiled
@pytest.mark.parametrize("said", [True, False])
def test_a_gap_begins_the_differences_anew(said):
    t = np.arange(40) * 0.01 + np.where(np.arange(40) < 20, 0.0, 1.0)
    f = smooth(t)
    axes, begins = orthogonal(), np.arange(40) == 20
    psi = np.array([series_angles(t, f @ m.T, PHASES[i]) for i, m in enumerate(axes)])
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA}
    mounted = [Mounted(calibration_of({**values, "phi": PHASES[i]}), m) for i, m in enumerate(axes)]
    rows = SetCompensator(mounted).push(t, psi, begins=begins if said else None)
    assert np.flatnonzero(PublishedSet(mounted).push(t, psi).flagged("no_increment")).tolist() == [0, 20]
    error = np.abs(rows.f[1:] - 0.5 * (f[1:] + f[:-1])).max(axis=1) / G0
    assert np.isnan(error[19])
    assert np.nanmax(error[23:]) < 1e-12
    assert (error[20:22] < (1e-7, 1e-9)).all()
