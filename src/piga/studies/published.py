"""The published recursion for tan_beta and the phase [Wei2024, eq. 12-18, 22-24], for comparison.

It uses rates. It predicts the phase from the input instead of reading it, takes ``a_t`` along the direction of the first
transverse force, and needs a first guess. It can converge to a wrong solution. This implementation does not hide that.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga._kernels.jit import kernel
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
