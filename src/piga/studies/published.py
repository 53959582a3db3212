"""The published recursion for tan_beta and the phase [Wei2024, eq. 12-18, 22-24], for comparison.

It uses rates. It predicts the phase from the input instead of reading it, takes ``a_t`` along the direction of the first
transverse force, and needs a first guess. It can converge to a wrong solution. This implementation does not hide that.

The published compensation of a set of instruments [Wei2024] stands beside it, for comparison with the exact one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.jit import kernel
from piga.compensation.compensator import find_begins, init_state
from piga.compensation.model import FLAGS, make_model
from piga.compensation.result import CompensatedSet
from piga.compensation.set_compensator import Mounted, check_count
from piga.errors import CalibrationError
from piga.records import Calibration
from piga.records.run import Run
from piga.results import Array
from piga.units import G0

START = (4.5e-3, 0.4)
"""First guess of the published run: tan_beta, phi [rad]."""
VARIANCE = 1e10
"""Diagonal of the first covariance of the published run."""
POINTS = 400
"""Points of the history."""


def published_recursion(
    run: Run,
    terms: tuple[str, ...] = ("tan_beta",),
    *,
    start: tuple[float, ...] = START,
    variance: float = VARIANCE,
) -> Calibration:
    """Calibrate a record by the published recursion, with its history.

    The indicated acceleration is the increment (or rate) of the output plus the base rotation about X0, divided by
    the nominal K. The phase is ``s = int K a_x`` from the start. The recursion estimates ``phi`` less the constant direction of
    the transverse force, which is added afterwards. ``history`` has the states as the recursion returns them: tan_beta may be
    negative and phi beyond half a turn.

    Parameters
    ----------
    run:
        The record.
    terms:
        ``("tan_beta",)`` or ``("tan_beta", "k0", "k1", "k2")``.
    start, variance:
        First states (tan_beta, phi [rad], then k0, k1, k2 in g units; those that are not given are 0), and the diagonal of their
        first covariance.

    Raises
    ------
    CalibrationError
        For other terms, or too many values of ``start``.
    """
    names = {
        ("tan_beta",): ("tan_beta", "phi"),
        ("tan_beta", "k0", "k1", "k2"): ("tan_beta", "phi", "k0", "k1", "k2"),
    }.get(tuple(terms))
    if names is None or len(start) > len(names):
        raise CalibrationError(
            "the published recursion estimates (tan_beta) or (tan_beta, k0, k1, k2), and starts from as many values and phi",
            remedy="give these terms, or use piga.calibrate",
        )
    indicated, force, s = _series(run)
    direction = _direction(force)
    a_t = (force[1] * np.cos(direction) + force[2] * np.sin(direction)) / G0
    state = np.zeros(len(names))
    state[: len(start)] = start
    state[1] -= direction
    covariance = np.eye(state.size) * variance
    marks = np.unique(np.linspace(1, s.size, min(POINTS, s.size)).astype(np.int64))
    history = np.empty((marks.size, state.size))
    total = _recursion(indicated / G0, force[0] / G0, a_t, s, state, covariance, marks, history)
    state[1] += direction
    history[:, 1] += direction
    values = {"sample": marks.astype(float)} | {name: history[:, i] for i, name in enumerate(names)}
    if state[0] < 0.0:
        state[0], state[1] = -state[0], state[1] + np.pi
    state[1] = math.remainder(state[1], 2.0 * math.pi)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0) * total / (s.size - state.size))
    given = {name: (float(v), float(u)) for name, v, u in zip(names, state, std, strict=True)}
    result = Calibration.from_coefficients(given, serial=run.serial, scale_factor_nominal=run.scale_factor)
    return replace(result, terms=tuple(terms), method="published", history=values)


def _series(run: Run) -> tuple[Array, Array, Array]:
    """Indicated acceleration [m/s^2], force (3, n) and predicted phase, per sample or mid-interval."""
    omega = np.zeros(run.size) if run.base_rate is None else run.base_rate[:, 0]
    h = np.diff(run.t)
    h[run.begins[1:]] = 0.0
    step = run.scale_factor * h * 0.5 * (run.f[1:, 0] + run.f[:-1, 0])
    s = np.concatenate(([0.0], np.cumsum(step)))
    if run.kind == "rate":
        return (run.output + omega) / run.scale_factor, run.f.T, s
    formed = h > 0.0
    rate = np.diff(run.output)[formed] / h[formed] + 0.5 * (omega[1:] + omega[:-1])[formed]
    force = 0.5 * (run.f[1:] + run.f[:-1])[formed].T
    return rate / run.scale_factor, force, 0.5 * (s[1:] + s[:-1])[formed]


def _direction(force: Array) -> float:
    """Direction of the transverse force at its largest size [rad]."""
    at = int(np.argmax(force[1] ** 2 + force[2] ** 2))
    return float(np.arctan2(force[2, at], force[1, at]))


@kernel
def _recursion(
    indicated: Array,
    a_x: Array,
    a_t: Array,
    s: Array,
    x: Array,
    P: Array,
    marks: NDArray[np.int64],
    history: Array,
) -> float:
    """Run the recursion over all samples; ``x`` and ``P`` are updated in place.

    ``y = indicated - a_x``, ``row = [a_t sin(s + x2), a_t x1 cos(s + x2), 1, a_x, a_x^2]`` cut to the
    states, ``gain = P row / (1 + row P row)``, as published [Wei2024, eq. 12-18 and 22-24]. After sample
    ``marks[i] - 1`` the state goes into ``history[i]``. Returns the sum of squared innovations.
    """
    m = x.size
    row = np.empty(m)
    Pr = np.empty(m)
    total = 0.0
    mark = 0
    for i in range(indicated.size):
        sine, cosine = math.sin(s[i] + x[1]), math.cos(s[i] + x[1])
        row[0] = a_t[i] * sine
        row[1] = a_t[i] * x[0] * cosine
        residual = indicated[i] - a_x[i] - a_t[i] * x[0] * sine
        if m > 2:
            row[2] = 1.0
            row[3] = a_x[i]
            row[4] = a_x[i] * a_x[i]
            residual -= x[2] + x[3] * a_x[i] + x[4] * a_x[i] * a_x[i]
        denominator = 1.0
        for j in range(m):
            Pr[j] = 0.0
            for k in range(m):
                Pr[j] += P[j, k] * row[k]
            denominator += row[j] * Pr[j]
        for j in range(m):
            gain = Pr[j] / denominator
            x[j] += gain * residual
            for k in range(m):
                P[j, k] -= gain * Pr[k]
        total += residual * residual
        while mark < marks.size and marks[mark] == i + 1:
            history[mark] = x
            mark += 1
    return total


class PublishedSet:
    """Compensate a set by the published formula [Wei2024], for comparison.

    First, the indications of all instruments are combined into a force (least squares), as if each measured along its
    input axis. The components of this force across each instrument enter the published formula at the output angle.
    The corrected indications then give the force. The error is of second order in the coupling. It is of first order in
    all error terms except ``k0``, because these are not corrected.

    Parameters
    ----------
    instruments:
        As for :class:`piga.compensation.SetCompensator`.
    sampled:
        True when rates are recorded beside the angles.

    Raises
    ------
    ArgumentError
        If there are fewer than three instruments.
    """

    def __init__(self, instruments: Sequence[Mounted], *, sampled: bool = False) -> None:
        check_count(len(instruments))
        self._axes = np.array([np.asarray(item.axes, dtype=float) for item in instruments])
        self._solve = np.linalg.pinv(self._axes[:, 0, :])
        self._models = [
            make_model(item.calibration, method="published", segment=item.segment, phase=item.phase)
            for item in instruments
        ]
        self._sampled = sampled
        self._clock = init_state()
        self._last: tuple[Array, Array, Array, Array] | None = None

    def push(
        self,
        t: ArrayLike,
        output: ArrayLike,
        *,
        rate: ArrayLike | None = None,
        base_rate: ArrayLike | None = None,
        temperature: ArrayLike | None = None,
        begins: NDArray[np.bool_] | None = None,
    ) -> CompensatedSet:
        """Compensate the next samples. Arguments as for :class:`piga.compensation.SetCompensator`."""
        del temperature
        time, psi = np.atleast_1d(np.asarray(t, dtype=float)), np.asarray(output, dtype=float)
        psi = psi.reshape(len(self._models), time.size)
        omega = np.zeros((*psi.shape, 3)) if base_rate is None else np.asarray(base_rate, dtype=float)
        marks = find_begins(self._clock, time) if begins is None else np.array(begins, dtype=np.bool_)
        if time.size == 0:
            return self._result(time, np.zeros((0, 3)), np.zeros((0, 3)), marks)
        if self._last is None:
            marks[0] = True
            self._last = time[:1], psi[:, :1], omega[:, :1], np.zeros((1, 3))
        before = self._last
        step = np.where(marks, 0.0, np.diff(time, prepend=before[0]))
        if self._sampled:
            force = self._force(psi, np.asarray(rate, dtype=float), omega)
            both = np.concatenate((before[3], force))
            dv = 0.5 * step[:, None] * (both[1:] + both[:-1])
        else:
            known, turning = (
                np.concatenate((before[1], psi), axis=1),
                np.concatenate((before[2], omega), axis=1),
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                rates = np.where(step > 0.0, np.diff(known, axis=1) / step, np.nan)
            force = self._force(
                0.5 * (known[:, 1:] + known[:, :-1]), rates, 0.5 * (turning[:, 1:] + turning[:, :-1])
            )
            dv = np.where(step[:, None] > 0.0, force * step[:, None], 0.0)
        self._clock["seen"], self._clock["t"] = 1.0, time[-1]
        self._last = time[-1:], psi[:, -1:], omega[:, -1:], force[-1:]
        return self._result(time, force, dv, step == 0.0)

    def _force(self, psi: Array, rate: Array, omega: Array) -> Array:
        """Force (n, 3) in the common frame from angles and rates (N, n)."""
        p = [model.instrument[0] for model in self._models]
        indicated = [(rate[i] + omega[i, :, 0]) / q["K"] - q["k0"] for i, q in enumerate(p)]
        first = self._combined(indicated)
        corrected = []
        for i, q in enumerate(p):
            y, z = (sum(self._axes[i, row, k] * first[k] for k in range(3)) for row in (1, 2))
            K, tangent = q["K"], q["tan_beta"]
            Y = tangent * (K * y - omega[i, :, 1]) + q["offset_y"]
            Z = tangent * (K * z - omega[i, :, 2]) + q["offset_z"]
            alpha = q["phi"] + psi[i]
            corrected.append(indicated[i] - (Y * np.sin(alpha) - Z * np.cos(alpha)) / K)
        return np.stack(self._combined(corrected), axis=1)

    def _combined(self, along: list[Array]) -> list[Array]:
        """Components in the common frame from components along the input axes, added one by one."""
        return [np.asarray(sum(self._solve[k, i] * a for i, a in enumerate(along))) for k in range(3)]

    def _result(self, t: Array, force: Array, dv: Array, none: NDArray[np.bool_]) -> CompensatedSet:
        flags = np.where(none, FLAGS["no_increment"], 0).astype(np.int32)
        return CompensatedSet(t, force, dv, np.zeros((0, 3)), np.full(t.size, np.nan), flags)
