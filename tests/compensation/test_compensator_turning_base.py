"""Base that turns and reference that bends between samples, against SciPy on equation (2) of the theory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import piga
from piga.compensation import Mounted, SetCompensator
from piga.units import G0
from tests.compensation.triads import orthogonal
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of

K, PHI = K_G / G0, 0.3
Input = Callable[[float], np.ndarray]


def record(rate: float, seconds: float, force: Input, turn: Input, axes: np.ndarray | None = None) -> tuple:
    """Times, output angle, samples of force and base rate in the instrument's axes, mean of ``a_x`` over each interval."""
    t = np.arange(0.0, seconds, 1.0 / rate)
    axes = np.eye(3) if axes is None else axes

    def motion(s: float, x: np.ndarray) -> list[float]:
        f = axes @ force(s)
        u = K * f - axes @ turn(s)
        return [u[0] + TAN_BETA * (u[1] * np.sin(x[0]) - u[2] * np.cos(x[0])), f[0]]

    solution = solve_ivp(
        motion, (0.0, t[-1]), [PHI, 0.0], method="DOP853", rtol=1e-12, atol=1e-12, t_eval=t, max_step=0.1
    )
    samples = [np.array([axes @ given(s) for s in t]) for given in (force, turn)]
    return t, solution.y[0] - PHI, *samples, np.diff(solution.y[1]) * rate


def still(_: float) -> np.ndarray:
    return np.zeros(3)


def steady(_: float) -> np.ndarray:
    return G0 * np.array([1.0, 0.5, 0.2])


def swaying(s: float) -> np.ndarray:
    """0.3 rad/s at 0.3 Hz."""
    w = 2.0 * np.pi * 0.3
    return np.array([0.3 * np.sin(w * s), 0.2 * np.cos(w * s), 0.1 * np.sin(w * s + 1.0)])


def calibration(angle_rms: float = 1e-6, **std: float) -> piga.Calibration:
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI}
    return calibration_of(values, std, angle_rms=angle_rms)


def left(columns: tuple, angle_rms: float = 1e-6, **more: object) -> tuple[np.ndarray, np.ndarray]:
    """Error and u_ax of every interval [g]."""
    t, psi, f, omega, mean = columns
    given = {"t": t, "output": psi, "f": f, "base_rate": omega, **more}
    rows = piga.Compensator(calibration(angle_rms)).push(given)
    return (rows.ax[1:] - mean) / G0, rows.u_ax[1:] / G0


@pytest.mark.interpreted
@pytest.mark.parametrize(("rate", "most"), [(50.0, 3e-6), (100.0, 0.4e-6)])
def test_angles_on_a_swaying_base(rate, most):
    """Between the ends of each interval the mean rate of the base is wrong by 40 and 10 micro-g with the chord alone."""
    error, _ = left(record(rate, 4.0, steady, swaying))
    assert np.abs(error[2:]).max() < most
    assert np.abs(error[2:]).max() > 0.02 * most


@pytest.mark.parametrize("turned", [0.003, 0.1, 0.4])
def test_a_bow_weighs_with_the_angle_whatever_the_output_turns_in_an_interval(turned):
    """Cubic input, which three differences tell exactly."""
    h = turned / K_G

    def force(s: float) -> np.ndarray:
        x = s / h
        return G0 * np.array([1.0, 0.5 + 0.01 * x**2 + 0.002 * x**3, 0.4 - 0.013 * x**2 - 0.001 * x**3])

    columns = record(1.0 / h, 5.5 * h, force, still)
    error, _ = left(columns)
    bow = TAN_BETA * 0.02 / 12.0
    assert np.abs(error[2:]).max() < 0.06 * bow


@pytest.mark.parametrize("shape", ["step", "kink", "spike", "two"])
def test_nothing_rings(shape):
    """Rows beside a step, a kink and a bad sample of the base rate are those of straight lines; two bad ones make a twelfth."""
    n, at = 40, 20
    omega = np.zeros((n, 3))
    omega[:, 0] = {
        "step": np.where(np.arange(n) < at, 0.0, 0.1), "kink": 0.01 * np.maximum(np.arange(n) - at, 0.0),
        "spike": np.where(np.arange(n) == at, 0.1, 0.0), "two": np.where(np.arange(n) // 2 == at // 2, 0.1, 0.0),
    }[shape]  # fmt: skip
    t, f = 0.01 * np.arange(n), np.tile(steady(0.0), (n, 1))
    psi = K_G * t
    with_rate = piga.Compensator(calibration()).push({"t": t, "output": psi, "f": f, "base_rate": omega})
    without = piga.Compensator(calibration()).push({"t": t, "output": psi, "f": f})
    line = 0.5 * (omega[1:, 0] + omega[:-1, 0]) / K
    rung = np.abs((with_rate.ax - without.ax)[1:] - line).max()
    assert rung < 1e-12 * G0 if shape != "two" else rung <= 0.1001 / 12.0 / K
    touched = with_rate.u_ax[1:] > 1.01 * without.u_ax[1:]
    assert touched[at - 1] or touched[at]
    assert not touched[: at - 1].any()
    assert not touched[at + 16 :].any()


def test_the_beginning_of_a_stretch_takes_nothing_from_before():
    t, psi, f, omega, _ = record(50.0, 2.0, steady, swaying)
    begins = np.arange(t.size) == 60
    columns = {"t": t, "output": psi, "f": f, "base_rate": omega, "begins": begins}
    whole = piga.Compensator(calibration()).push(columns)
    alone = piga.Compensator(calibration()).push({name: c[60:] for name, c in columns.items()})
    assert np.array_equal(whole.ax[60:], alone.ax, equal_nan=True)
    assert np.array_equal(whole.u_ax[60:], alone.u_ax, equal_nan=True)


AXES = np.array(orthogonal())
QUIET = 1e-8
"""Noise of the angle [rad] below what the samples leave open."""


def left_of_set(
    rate: float, seconds: float, force: Input, turn: Input, **more: object
) -> tuple[np.ndarray, np.ndarray]:
    """Error and u_f of every interval [g] of three instruments, by their columns."""
    records = [record(rate, seconds, force, turn, matrix) for matrix in AXES]
    stream = SetCompensator([Mounted(calibration(QUIET), matrix) for matrix in AXES])
    rows = stream.push(records[0][0], [r[1] for r in records], base_rate=[r[3] for r in records], **more)
    mean = sum(r[4][:, None] * matrix[0] for r, matrix in zip(records, AXES, strict=True))
    return (rows.f[1:] - mean) / G0, rows.u_f[1:] / G0


@pytest.mark.parametrize("rate", [50.0, 100.0])
def test_the_first_interval_of_each_stretch_stands_in_the_uncertainty(rate):
    """Two samples tell no bow: 40 and 10 micro-g, at turning points of the sway, too."""
    columns = record(rate, 3.5, steady, swaying)
    begins = np.arange(columns[0].size) % 3 == 0
    first = np.flatnonzero(begins[:-1])
    error, u = left(columns, QUIET, begins=begins)
    noise = np.sqrt(2.0) * QUIET * rate / K_G
    for errors, sizes in ((error, u), left_of_set(rate, 3.5, steady, swaying, begins=begins)):
        assert (np.abs(errors[first]) < 2.0 * sizes[first]).all()
        assert np.abs(errors[first]).max() > 5.0 * noise
    second = first[first < begins.size - 2] + 1
    assert np.median(u[second]) < 0.1 * np.median(u[first])


def test_a_base_that_does_not_change_has_no_doubt_at_the_beginning():
    columns = record(50.0, 0.5, steady, lambda _: np.array([2.0, 0.1, 0.1]))
    _, u = left(columns)
    assert u[0] == pytest.approx(u[5], rel=1e-9)


VIBRATION = 2.0 * np.pi * 0.75


def vibrating_turn(s: float) -> np.ndarray:
    return 0.1 * np.sin(VIBRATION * s + 2.0) * np.ones(3)


def vibrating_force(s: float) -> np.ndarray:
    return G0 * np.array([1.0, 0.5 + 0.3 * np.sin(VIBRATION * s), 0.2])


def shaking(s: float) -> np.ndarray:
    return G0 * (np.array([1.0, 0.5, 0.2]) + 0.3 * np.sin(VIBRATION * s + np.arange(3.0)))


@pytest.mark.parametrize(("force", "turn"), [(steady, vibrating_turn), (vibrating_force, still)])
@pytest.mark.parametrize("rate", [4.0, 5.0, 7.0])
def test_what_is_left_stands_in_the_uncertainty(force, turn, rate):
    """0.75 Hz at 5 Hz sampling: a squared error of 4.2 times the variance without a flag."""
    error, u = left(record(rate, 20.0, force, turn))
    assert 0.1 < np.mean((error[3:] / u[3:]) ** 2) < 1.5
    assert np.abs(error[3:]).max() > 2.0 * 2.2e-6  # beyond the noise of the angle


@pytest.mark.parametrize(
    ("force", "turn"), [(steady, vibrating_turn), (vibrating_force, still), (shaking, still)]
)
def test_what_is_left_stands_in_the_uncertainty_of_a_set(force, turn):
    """The same at 5 Hz; the force that bends between samples was not in ``u_f``."""
    error, u = left_of_set(5.0, 20.0, force, turn)
    assert 0.5 < np.mean((error[3:] / u[3:]) ** 2) < 1.6
    assert np.abs(error[3:]).max() > 20.0 * QUIET * 5.0 / K_G


def surging(s: float) -> np.ndarray:
    """``a_x`` swings by 0.3 g; the force across it is large and changes slowly."""
    return G0 * np.array([1.0 + 0.3 * np.sin(VIBRATION * s + 0.4), 4.0 + 0.01 * s, 3.0 - 0.02 * s])


def surging_set(s: float) -> np.ndarray:
    return surging(s) + G0 * np.array([0.0, 0.3 * np.cos(VIBRATION * s), 0.0])


@pytest.mark.parametrize("rate", [5.0, 20.0, 100.0])
def test_a_change_within_the_first_two_intervals_of_a_stretch_stands_in_the_uncertainty(rate):
    """78 micro-g at 5 Hz in the first, 45 in the second."""
    columns = record(rate, 6.0, surging, still)
    begins = np.arange(columns[0].size) % 3 == 0
    first = np.flatnonzero(begins[:-1])
    second = first[first < begins.size - 2] + 1
    error, u = left(columns, QUIET, begins=begins)
    errors, sizes = left_of_set(rate, 6.0, surging_set, still, begins=begins)
    for e, s in ((error, u), (errors, sizes)):
        assert (np.abs(e[first]) < 2.0 * s[first]).all()
        assert np.mean(e[second] ** 2) < np.mean(s[second] ** 2)
    assert rate > 20.0 or np.abs(error[first]).max() > 20.0 * QUIET * rate / K_G
    assert np.median(u[first]) < 60.0 * np.abs(error[first]).max()
