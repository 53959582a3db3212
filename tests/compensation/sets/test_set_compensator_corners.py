"""Corners of sets and of the uncertainty that ordinary records pass by: whole tiles, far turns, many coefficients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import piga
from piga._kernels.compensation.layout import TILE
from piga.compensation import Mounted, SetCompensator, compensate_set, identify_phase
from piga.units import G0
from tests.compensation.sets.triads import SKEWED, made, orthogonal, rotation
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, run_of

pytestmark = pytest.mark.compiled

AXES = {"orthogonal": orthogonal(), "skewed": [rotation(a) for a in SKEWED]}


def moving(t: np.ndarray) -> np.ndarray:
    return np.array([1.0, -0.7, 0.4]) * G0 * (1.0 + 0.3 * np.sin(2.0 * t))[:, None]


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("size", [TILE, 3 * TILE])
def test_chunks_of_whole_tiles(axes: str, size: int) -> None:
    """Nothing lies behind the last row of such a chunk that could stand in for it."""
    t = np.arange(6 * TILE) * 0.01
    runs, mounted = made(t, moving(t), AXES[axes])
    psi = np.array([r.output for r in runs])
    whole, stream = SetCompensator(mounted), SetCompensator(mounted)
    expected = whole.push(np.append(t, t[-1] + 0.01), np.column_stack([psi, psi[:, -1]]))
    parts = [stream.push(t[k : k + size], psi[:, k : k + size]) for k in range(0, t.size, size)]
    for name in ("f", "dv", "u_f", "residual", "flags"):
        result = np.concatenate([getattr(p, name) for p in parts])
        assert result.tobytes() == getattr(expected, name)[: t.size].tobytes(), name


@pytest.mark.parametrize("axes", AXES)
def test_a_stretch_begins_without_an_increment(axes: str) -> None:
    t = np.arange(40) * 0.01
    runs, mounted = made(t, moving(t), AXES[axes])
    begins = np.arange(t.size) == 25
    rows = SetCompensator(mounted).push(t, [r.output for r in runs], begins=begins)
    assert np.flatnonzero(rows.flagged("no_increment")).tolist() == [0, 25]
    assert (rows.dv[[0, 25]] == 0.0).all()
    rates, _ = made(t, moving(t), AXES[axes], "rate")
    psi, rate = ([r.output for r in part] for part in (runs, rates))
    for uncertainty in (True, False):  # without it three instruments go a way of their own
        stream = SetCompensator(mounted, sampled=True, uncertainty=uncertainty)
        sampled = stream.push(t, psi, rate=rate, begins=begins)
        assert np.flatnonzero(sampled.flagged("no_increment")).tolist() == [0, 25]
    recorded = compensate_set([replace(run, begins=begins | (t == 0.0)) for run in runs], mounted)
    assert recorded.flags.tolist() == rows.flags.tolist()


@pytest.mark.parametrize("axes", AXES)
def test_intervals_that_turn_far_under_a_changing_force(axes: str) -> None:
    """Up to 0.4 rad in half an interval, the base turning: the mean force of each interval comes back."""
    t = np.arange(60) * 0.1
    f = np.array([8.0, -7.0, 9.0]) * G0 * (1.0 + 0.02 * t)[:, None]
    runs, mounted = made(t, f, AXES[axes], base=np.array([7e-5, 3e-3, -2e-3]))
    assert max(np.abs(np.diff(run.output)).max() for run in runs) > 0.6
    compensated = compensate_set(runs, mounted)
    error = compensated.f[1:] - 0.5 * (f[1:] + f[:-1])
    assert np.abs(error).max() < 1e-7 * G0


@pytest.mark.parametrize("count", range(5, 13))
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


@pytest.mark.parametrize("name", ["k2", "k_YY", "k_ZZ", "k_YZ", "k_XY", "k_XZ"])
def test_products_of_changing_forces_in_a_set(name: str) -> None:
    """The mean of a product over an interval is not the product of the means: 1e-5 g at 8 g/s."""
    t = 0.01 * np.arange(40)
    f = G0 * (1.0 + 8.0 * t)[:, None] * np.array([1.0, -0.7, 0.8])
    runs, mounted = made(t, f, AXES["orthogonal"], errors={name: 0.02})
    error = compensate_set(runs, mounted).f[1:] - 0.5 * (f[1:] + f[:-1])
    assert np.abs(error[2:10]).max() < 3e-6 * G0


def test_a_first_harmonic_does_not_move_the_phase() -> None:
    """It is as large as the coupling, at another angle: what is known of it is taken out before the phase is sought."""
    t = np.arange(0.0, 30.0, 0.02)
    errors = {"s1": 2e-3, "c1": -3e-3}
    f = np.tile(np.array([0.7, 0.7, 0.1]) * G0, (t.size, 1))
    run = run_of(t, f, phi=2.5, errors=errors)
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, **errors}
    assert identify_phase(run, calibration_of(values, angle_rms=1e-8), 30.0).value == pytest.approx(
        2.5, abs=1e-4
    )


@pytest.mark.parametrize(
    "mounting", [orthogonal(), [rotation(a) for a in SKEWED[:3]]], ids=["orthogonal", "skewed"]
)
def test_three_sampled_instruments_without_uncertainty_say_the_same(mounting: list[np.ndarray]) -> None:
    t = np.arange(130) * 0.01
    angles, mounted = made(t, moving(t), mounting)
    rates, _ = made(t, moving(t), mounting, "rate")
    psi, rate = ([r.output for r in part] for part in (angles, rates))
    plain = SetCompensator(mounted, sampled=True, uncertainty=False).push(t, psi, rate=rate)
    full = SetCompensator(mounted, sampled=True).push(t, psi, rate=rate)
    assert np.abs(plain.f - moving(t)).max() < 1e-12 * G0
    np.testing.assert_allclose(plain.f, full.f, rtol=0.0, atol=1e-13 * G0)
    np.testing.assert_allclose(plain.dv, full.dv, rtol=0.0, atol=1e-15 * G0)
    assert plain.flags.tolist() == full.flags.tolist()


def test_axes_that_span_a_plane_only() -> None:
    """No two along each other, and yet nothing is known across the plane."""
    cal = calibration_of({"k0": 0.0})
    turned = [rotation((0.0, 0.0, angle)) for angle in (0.0, 1.0, 2.0)]
    with pytest.raises(piga.ArgumentError, match="the input axes lie in one plane"):
        SetCompensator([Mounted(cal, axes) for axes in turned])
    SetCompensator([Mounted(cal, axes) for axes in (*turned[:2], rotation((0.0, 1.0, 0.0)))])


def test_a_young_calibration_raises_no_flag() -> None:
    t = 0.01 * np.arange(30)
    run = run_of(t, np.tile(np.array([1.0, 0.5, 0.2]) * G0, (t.size, 1)), phi=0.4)
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.4})
    young, any_age = piga.compensate(run, cal, max_age_days=1e6), piga.compensate(run, cal)
    assert young.flags.tolist() == any_age.flags.tolist()
