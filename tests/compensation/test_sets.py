"""Sets in any mounting: known force comes back, misfits are seen, chunks do not matter, and corners are right."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

import piga
from piga.compensation import SetCompensator, compensate_set
from piga.terms import PRODUCTS
from piga.units import G0
from tests.compensation.triads import SKEWED, made, orthogonal, rotation
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, run_of

pytestmark = pytest.mark.interpreted

ROWS = 300 if numba.config.DISABLE_JIT else 3000


SKEW4 = [rotation(a) for a in SKEWED]
SKEW3 = SKEW4[:3]
ALL_TERMS = {
    "k0": 1e-3, "k1": -2e-3, "k2": 2e-3, "k3": 1e-4, "k1a": 1e-4, "k2o": 5e-5, "m_Y": 2e-4, "m_Z": -1e-4,
    "k_XY": 1e-4, "k_XZ": 2e-5, "k_YY": -3e-5, "k_ZZ": 4e-5, "k_YZ": 3e-5,
}  # fmt: skip
"""A value for each term that is a product of forces."""


def test_each_product_of_forces_is_tried_in_a_set() -> None:
    assert set(ALL_TERMS) == set(PRODUCTS) - {"scale_factor", "k0_t", "k0_T", "k1_T", "k2v"}


@pytest.mark.parametrize("axes", [orthogonal(), SKEW4])
def test_samples_of_angle_and_rate_come_back_to_1e12_g(axes):
    t = np.arange(ROWS) * 0.01
    f = np.array([1.0, -0.7, 0.4]) * G0 * (1.0 + 0.3 * np.sin(2.0 * t))[:, None]
    angle, mounted = made(t, f, axes, errors=ALL_TERMS)
    rate, _ = made(t, f, axes, "rate", errors=ALL_TERMS)
    stream = SetCompensator(mounted, sampled=True)
    rows = stream.push(t, [r.output for r in angle], rate=[r.output for r in rate])
    assert np.abs(rows.f - f).max() < 1e-12 * G0


def test_fault_of_one_instrument_is_flagged():
    t = np.arange(ROWS) * 0.01
    f = np.tile(np.array([1.0, -0.7, 0.4]) * G0, (t.size, 1))
    runs, mounted = made(t, f, SKEW4)
    psi = np.array([r.output for r in runs])
    sound = SetCompensator(mounted).push(t, psi)
    psi[2, 100:] += 0.01
    broken = SetCompensator(mounted).push(t, psi)
    assert not sound.flagged("fault").any()
    assert np.flatnonzero(broken.flagged("fault")).tolist() == [100]


def smooth(t: np.ndarray) -> np.ndarray:
    """A force [m/s^2] that sways at 0.5 Hz and below, samples (n, 3)."""
    along = (1.0 + 0.3 * np.sin(np.pi * t), -0.7 + 0.2 * np.cos(1.3 * t), 0.4 + 0.1 * np.sin(2.1 * t))
    return G0 * np.stack(along, axis=1)


@pytest.mark.parametrize("axes", [orthogonal(), SKEW3, SKEW4])
def test_smooth_force_comes_back_from_angles_alone(axes):
    """100 Hz: 1e-12 g from the fourth interval on; before that the differences there are."""
    t = np.arange(40) * 0.01
    f = smooth(t)
    runs, mounted = made(t, f, axes)
    rows = SetCompensator(mounted).push(t, [r.output for r in runs])
    error = np.abs(rows.f[1:] - 0.5 * (f[1:] + f[:-1])).max(axis=1) / G0
    assert error[4:].max() < 1e-12
    assert (error[:3] < (5e-8, 2e-10, 2e-11)).all()
    assert (rows.residual[5:] < 1e-12 * G0).all()


@pytest.mark.parametrize("axes", [orthogonal(), SKEW3, SKEW4])
def test_the_same_with_error_terms_and_a_base_that_turns_faster_and_faster(axes):
    t = np.arange(ROWS // 8) * 0.01
    errors = {name: ALL_TERMS[name] for name in ("k0", "k1", "k2", "k3", "m_Y", "k_XY", "k_YY")}
    errors |= {"s1": 1e-5, "c1": 2e-5}
    f = smooth(t)
    base = np.array([7e-3, 3e-2, -2e-2]) * (1.0 + 0.7 * t)[:, None]
    runs, mounted = made(t, f, axes, errors=errors, base=base)
    stream = SetCompensator(mounted)
    rows = stream.push(t, [r.output for r in runs], base_rate=[r.base_rate for r in runs])
    error = np.abs(rows.f[1:] - 0.5 * (f[1:] + f[:-1])).max(axis=1) / G0
    assert error[4:].max() < 1e-11


@pytest.mark.parametrize("axes", [orthogonal(), SKEW4])
def test_a_stretch_begins_the_differences_anew(axes) -> None:
    t = np.arange(40) * 0.01 + np.where(np.arange(40) < 20, 0.0, 1.0)
    begins, f = np.arange(40) == 20, smooth(t)
    runs, mounted = made(t, f, axes)
    psi, rate = [r.output for r in runs], [r.output for r in made(t, f, axes, "rate")[0]]
    for said in (begins, None):
        rows = SetCompensator(mounted).push(t, psi, begins=said)
        error = np.abs(rows.f[1:] - 0.5 * (f[1:] + f[:-1])).max(axis=1) / G0
        assert np.nanmax(error[23:]) < 1e-12
        assert (error[20:22] < (1e-7, 1e-9)).all()
        assert np.flatnonzero(rows.flagged("no_increment")).tolist() == [0, 20]
        assert np.isnan(rows.f[[0, 20]]).all()
        assert (rows.dv[[0, 20]] == 0.0).all()
    for uncertainty in (True, False):  # without it three instruments go a way of their own
        sampled = SetCompensator(mounted, sampled=True, uncertainty=uncertainty).push(
            t, psi, rate=rate, begins=begins
        )
        assert np.flatnonzero(sampled.flagged("no_increment")).tolist() == [0, 20]
    recorded = compensate_set([replace(run, begins=begins | (t == 0.0)) for run in runs], mounted)
    assert recorded.flags.tolist() == rows.flags.tolist()


@pytest.mark.parametrize("axes", [orthogonal(), SKEW4])
def test_intervals_that_turn_far_under_a_changing_force(axes) -> None:
    """Up to 0.4 rad in half an interval, the base turning: the mean force of each interval comes back."""
    t = np.arange(60) * 0.1
    f = np.array([8.0, -7.0, 9.0]) * G0 * (1.0 + 0.02 * t)[:, None]
    runs, mounted = made(t, f, axes, base=np.array([7e-5, 3e-3, -2e-3]))
    assert max(np.abs(np.diff(run.output)).max() for run in runs) > 0.6
    compensated = compensate_set(runs, mounted)
    error = compensated.f[1:] - 0.5 * (f[1:] + f[:-1])
    assert np.abs(error).max() < 1e-7 * G0


@pytest.mark.parametrize("count", [5, 12])
def test_many_correlated_coefficients(count: int) -> None:
    """``u_ax`` from the whole covariance, against differences of the result itself.

    From the fifth interval on: the first ones hold what few samples do not tell, too.
    """
    t = 0.01 * np.arange(60)
    f = G0 * np.column_stack((1.0 + 0.5 * np.sin(3.0 * t), 2.0 + np.cos(2.0 * t), -1.0 + 0.3 * t))
    names = ("scale_factor", "tan_beta", "phi", "k0", "k1", "k2", "k3", "m_Y", "m_Z", "k_XY", "k_YY", "k_YZ")[
        :count
    ]
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4} | dict.fromkeys(names[3:], 0.0)
    run = run_of(t, f, phi=0.4)
    spread = np.random.default_rng(count).standard_normal((count, count))
    size = np.array([1e-7 * abs(values[name] or 1.0) for name in names])
    covariance = (spread @ spread.T) * np.outer(size, size)
    plain = calibration_of(values)
    uncertainty = piga.compensate(run, replace(plain, covariance=covariance)).u_ax[1:]
    columns = []
    for name, step in zip(names, size, strict=True):
        up, down = (
            piga.compensate(run, calibration_of({**values, name: values[name] + d})).ax[1:]
            for d in (step, -step)
        )
        columns.append((up - down) / (2.0 * step))
    jacobian = np.array(columns).T
    expected = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, covariance, jacobian))
    np.testing.assert_allclose(uncertainty[4:], expected[4:], rtol=2e-2)
    assert (uncertainty[:4] > 0.99 * expected[:4]).all()
    assert uncertainty[0] > expected[0]


@pytest.mark.parametrize("uneven", [False, True])
def test_the_first_intervals_of_a_stretch_with_a_square_term(uneven: bool) -> None:
    """A square needs the change of the force over the interval, which the first ones know from one side only."""
    t = np.cumsum(np.where(np.arange(40) % 3 == 0, 0.012, 0.008)) if uneven else 0.01 * np.arange(40)
    ramp = 1.0 + 8.0 * t
    f = G0 * np.column_stack((ramp, 2.0 * ramp, -ramp))
    errors = {"k2": 0.02}
    run = run_of(t, f, phi=0.4, errors=errors)
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4, **errors}
    force = piga.compensate(run, calibration_of(values)).ax[1:]
    error = np.abs(force - 0.5 * (f[1:, 0] + f[:-1, 0])) / G0
    assert error[1:4].max() < 2e-6  # the square alone is 1e-5 g there


@pytest.mark.parametrize("name", ["k2", "k2o", "k_YY", "k_ZZ", "k_YZ", "k_XY", "k_XZ"])
def test_products_of_changing_forces_in_a_set(name: str) -> None:
    """The mean of a product over an interval is not the product of the means: 1e-5 g at 8 g/s."""
    t = 0.01 * np.arange(40)
    f = G0 * (1.0 + 8.0 * t)[:, None] * np.array([1.0, -0.7, 0.8])
    runs, mounted = made(t, f, orthogonal(), errors={name: 0.02})
    error = compensate_set(runs, mounted).f[1:] - 0.5 * (f[1:] + f[:-1])
    assert np.abs(error[2:10]).max() < 1e-8 * G0
