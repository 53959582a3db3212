"""The servo twin in the time domain: a PIGA whose float, gimbal and servo move as rigid bodies."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels import servo
from piga.errors import ArgumentError, PigaError
from piga.instrument.motion import float_array, require_finite, require_increasing, time_array
from piga.instrument.twin.parameters import TwinParameters
from piga.results import Array, Result

Start = Literal["slow-manifold", "transient"]

_ACCURACY = 1e-12
"""Default local error per step in alpha and beta [rad]."""


@dataclass(frozen=True, eq=False, repr=False)
class TwinMotion(Result):
    """Motion of the twin at the sample times.

    ``alpha`` and ``beta`` [rad], ``rate`` [rad/s], ``tilt_rate`` [rad/s], ``integral`` [rad s],
    ``torque`` [N m] of the motor, ``locked`` whether pick-off and torque motor are inside their limits.
    ``local_error`` [rad] is the sum of the integrator's own error estimates in alpha over all steps,
    an upper estimate of the global error. Errors do not grow, because the loop is stable.
    """

    t: Array
    alpha: Array
    beta: Array
    rate: Array
    tilt_rate: Array
    integral: Array
    torque: Array
    locked: NDArray[np.bool_]
    local_error: float
    steps: int

    def lock_changes(self) -> tuple[tuple[float, str], ...]:
        """Times [s] at which lock was lost or recovered."""
        turns = np.flatnonzero(np.diff(self.locked.astype(np.int8)))
        return tuple((float(self.t[i + 1]), "recovered" if self.locked[i + 1] else "lost") for i in turns)


def _tableau() -> servo.Method:
    """The eighth-order method of Dormand and Prince with its two error estimators, as in SciPy."""
    from scipy.integrate import DOP853

    parts = (DOP853.A, DOP853.B, DOP853.C, DOP853.E3, DOP853.E5)
    return servo.Method(*(np.ascontiguousarray(part, dtype=float) for part in parts))


def _inputs(t: ArrayLike, f: ArrayLike, base_rate: ArrayLike | None) -> tuple[Array, Array, Array]:
    times = time_array("t", t, least=2)
    require_increasing("t", times)
    force = float_array("f", f, (times.size, 3))
    rate = np.zeros(force.shape) if base_rate is None else float_array("base_rate", base_rate, force.shape)
    for name, array in (("f", force), ("base_rate", rate)):
        require_finite(name, array)
    return times, force, rate


def quasi_steady_state(p: TwinParameters, t: float, alpha: float, f: ArrayLike, base_rate: ArrayLike) -> Array:
    """State with zero tilt rate in which all torques balance at gimbal angle ``alpha``, shape (5,).

    This is the first guess for the slow manifold. With integral gain the pick-off is at null. Without it the tilt is
    the one that the proportional gain needs to hold the outer-axis torque.
    """
    a_x, a_Y, a_Z = np.asarray(f, dtype=float)
    o_x, o_Y, o_Z = np.asarray(base_rate, dtype=float)
    H, _ = servo.wheel(p.constants(), t)
    c, s = math.cos(alpha), math.sin(alpha)
    load = p.pendulosity * (a_Y * c + a_Z * s) - H * (o_Y * c + o_Z * s) + p.outer_torque
    w = p.pendulosity / H * a_x - o_x
    load += servo.friction(p.constants(), w)
    if p.integral_gain > 0.0:
        return np.array([alpha, p.pick_off_null, w, 0.0, load / p.integral_gain])
    tilt = load / p.proportional_gain if p.proportional_gain > 0.0 else 0.0
    return np.array([alpha, p.pick_off_null + tilt, w, 0.0, 0.0])


def slow_manifold(
    p: TwinParameters,
    t: float,
    alpha: float,
    f: ArrayLike,
    base_rate: ArrayLike,
    *,
    accuracy: float = _ACCURACY,
) -> Array:
    """State at ``t`` on the slow manifold: no nutation and no servo transient, shape (5,).

    The manifold attracts. So the twin runs up to ``t`` with constant inputs and constant wheel speed, until the
    slowest loop pole has forgotten the first guess. The start angle is corrected until this run ends at ``alpha``.
    Own method.
    """
    from piga.instrument.twin.linear import loop_poles

    slowest = -float(np.max(loop_poles(p).real))
    if slowest <= 0.0:
        raise PigaError("the loop is unstable: it has no slow manifold", remedy="use start = 'transient'")
    H, _ = servo.wheel(p.constants(), t)
    steady_wheel = replace(p, angular_momentum=H, hunting=0.0, spin_start=1.0)
    duration = 30.0 / slowest
    times = np.linspace(-duration, 0.0, max(2, math.ceil(duration * 50.0)))
    force, rate = (np.tile(np.asarray(v, dtype=float), (times.size, 1)) for v in (f, base_rate))
    state = quasi_steady_state(steady_wheel, 0.0, alpha, f, base_rate)
    start = alpha - duration * state[2]
    for _ in range(20):
        first = quasi_steady_state(steady_wheel, 0.0, start, f, base_rate)
        state = _run(steady_wheel, times, force, rate, np.zeros_like(force), first, accuracy)[0][-1]
        start += alpha - state[0]
        if abs(alpha - state[0]) < 1e-10:
            break
    state[0] = alpha
    return state


def _run(
    p: TwinParameters, t: Array, f: Array, base_rate: Array, noise: Array, start: Array, accuracy: float
) -> tuple[Array, float, int]:
    states, fast = np.empty((t.size, servo.STATES)), p.nutation
    step, tolerance = min(float(t[1] - t[0]), 0.5 / fast), accuracy * np.array([1.0, 1.0, fast, fast, 1.0])
    nodes = np.hstack((f, base_rate, noise))
    error, steps, failed = servo.integrate(
        p.constants(), t, nodes, start.copy(), step, tolerance, _tableau(), states
    )
    if failed >= 0:
        raise PigaError(
            f"the twin's motion cannot be followed beyond t = {t[failed]:.6g} s: it is too fast",
            remedy="check the design with the linear analysis (piga.instrument.twin.linear): it is unstable or "
            "too stiff",
        )
    return states, float(error), int(steps)


def run_twin(
    p: TwinParameters,
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = None,
    *,
    noise: ArrayLike | None = None,
    start: Start | ArrayLike = "slow-manifold",
    accuracy: float = _ACCURACY,
) -> TwinMotion:
    """Integrate the twin through sampled inputs.

    Parameters
    ----------
    p:
        Parameters of the instrument.
    t:
        Sample times [s], shape (n,), increasing.
    f, base_rate:
        Specific force [m/s^2] and inertial base rate [rad/s] in base axes, shape (n, 3), linear between
        samples.
    noise:
        Disturbing torque on the outer axis [N m], on the inner axis [N m], and pick-off noise [rad];
        shape (n, 3), held from a sample to the next.
    start:
        ``"slow-manifold"``: start without transient. ``"transient"``: start with the float at pick-off null and
        everything at rest. Or a state ``(alpha, beta, rate, tilt rate, integral)``.
    accuracy:
        Local error allowed per step in alpha and beta [rad]. With the default the global error over 10 s
        is below 1e-9 rad.

    Raises
    ------
    ArgumentError
        If shapes do not fit or inputs are not finite.
    PigaError
        If the motion cannot be computed (unstable design).

    Notes
    -----
    Explicit Runge-Kutta method of order 8 with local error control and substeps in each sample interval.
    Nutation is resolved if it is excited, and otherwise only kept stable.
    """
    times, force, rate = _inputs(t, f, base_rate)
    torques = np.zeros(force.shape) if noise is None else float_array("noise", noise, force.shape)
    first = _start(p, start, times[0], force[0], rate[0], accuracy)
    states, error, steps = _run(p, times, force, rate, torques, first, accuracy)
    signal = states[:, 1] - p.pick_off_null + torques[:, 2]
    e = np.clip(signal, -p.pick_off_range, p.pick_off_range)
    asked = -(p.proportional_gain * e + p.integral_gain * states[:, 4] + p.rate_gain * states[:, 3])
    locked = (np.abs(signal) <= p.pick_off_range) & (np.abs(asked) <= p.torque_limit)
    torque = np.clip(asked, -p.torque_limit, p.torque_limit)
    alpha, beta, rate, tilt_rate, integral = (np.ascontiguousarray(column) for column in states.T)
    return TwinMotion(times, alpha, beta, rate, tilt_rate, integral, torque, locked, error, steps)


def _start(
    p: TwinParameters, start: Start | ArrayLike, t: float, f: Array, base_rate: Array, accuracy: float
) -> Array:
    if not isinstance(start, str):
        state = np.asarray(start, dtype=float)
        if state.shape != (servo.STATES,):
            raise ArgumentError(
                f"start: shape {state.shape}, but a state has {servo.STATES} numbers",
                remedy="use the last state of a run, slow-manifold or transient",
            )
        return state
    if start == "transient":
        return np.array([p.alpha0, p.pick_off_null, 0.0, 0.0, 0.0])
    if start != "slow-manifold":
        raise ArgumentError(f"start: '{start}' is unknown", remedy="choose slow-manifold or transient")
    return slow_manifold(p, t, p.alpha0, f, base_rate, accuracy=accuracy)
