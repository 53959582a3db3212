"""Solve the summaries: linear estimate, one phase for all or one per phase group, covariance.

The vector of linear parameters is ``[local of group 0, local of group 1, ..., shared]`` before the
phase is used; for several groups the constraint that they share tan_beta and the harmonics is brought
in by Gauss-Newton on the stacked triangular factors, from the linear solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.calibration.design import Design
from piga.calibration.reduction import Reduction, solve_upper
from piga.errors import CalibrationError

Array = NDArray[np.float64]

ITERATIONS = 50
SCAN = 72
"""Phases tried for each group before refinement: the cost on the circle has at most two minima."""


@dataclass(frozen=True)
class Solution:
    """Estimate in internal parameters.

    ``amplitudes`` are, in this order, the coupling amplitude ``K tan_beta`` (if asked for), then
    ``K s_n, K c_n`` per harmonic in the frame of alpha, then the shared linear parameters; ``phases`` one
    phi per group. ``covariance`` is that of ``[amplitudes, phases]`` for unit noise. ``values``
    (segments, m) are the linear column coefficients of every segment. ``jacobians`` hold, per phase
    group, the derivative of its column coefficients by ``[amplitudes, phases]``.
    """

    amplitudes: Array
    phases: Array
    covariance: Array
    values: Array
    cost: float
    jacobians: tuple[Array, ...]


def merged(summaries: list[Reduction], indices: list[int]) -> Reduction:
    """One summary of several."""
    total = Reduction.empty(summaries[0].names)
    for index in indices:
        total.merge(summaries[index])
    return total


def solve(design: Design, summaries: list[Reduction], groups: tuple[int, ...]) -> Solution:
    """Estimate for the given phase group of each segment (all 0: one phase)."""
    count = max(groups) + 1
    parts = [merged(summaries, [s for s, g in enumerate(groups) if g == group]) for group in range(count)]
    local = len(design.local_names)
    if local == 0 or count == 1:
        return _solve_shared(design, merged(parts, list(range(count))), groups)
    return _solve_groups(design, parts, groups)


def _solve_shared(design: Design, total: Reduction, groups: tuple[int, ...]) -> Solution:
    linear, covariance, cost = total.solve()
    shape = _Shape(design, 1)
    jacobian = np.eye(len(linear))
    if shape.coupled:
        phase = np.arctan2(linear[1], linear[0])
        amplitudes = shape.from_linear(linear, phase)
        jacobian = shape.jacobian(amplitudes, np.array([phase]), 0)
        inverse = np.linalg.inv(jacobian)
        covariance = inverse @ covariance @ inverse.T
        phases = np.array([phase])
    else:
        amplitudes, phases = linear, np.zeros(0)
    values = np.tile(linear, (len(groups), 1))
    return Solution(amplitudes, phases, covariance, values, cost, (jacobian,))


@dataclass
class _Shape:
    """The map from (amplitudes, phases) to the linear coefficients of a group, and its derivative."""

    design: Design
    groups: int

    def __post_init__(self) -> None:
        self.coupled = "p" in self.design.local_names
        self.orders = self.design.request.harmonics
        self.size = len(self.design.names) - (1 if self.coupled else 0)

    def linear(self, amplitudes: Array, phase: float) -> Array:
        """Column coefficients of a group with this phase."""
        parts: list[float] = []
        at = 0
        if self.coupled:
            parts += [amplitudes[0] * np.cos(phase), amplitudes[0] * np.sin(phase)]
            at = 1
        for order in self.orders:
            s, c = amplitudes[at], amplitudes[at + 1]
            cosine, sine = np.cos(order * phase), np.sin(order * phase)
            # the column named s_n is int(y sin - z cos) with y = 1, z = 0; c_n is int(y cos + z sin)
            parts += [s * cosine - c * sine, s * sine + c * cosine]
            at += 2
        return np.concatenate([parts, amplitudes[at:]])

    def from_linear(self, linear: Array, phase: float) -> Array:
        """Amplitudes from the column coefficients of a group whose phase is known."""
        parts: list[float] = []
        at = 0
        if self.coupled:
            parts.append(linear[0] * np.cos(phase) + linear[1] * np.sin(phase))
            at = 2
        for order in self.orders:
            s, c = linear[at], linear[at + 1]
            cosine, sine = np.cos(order * phase), np.sin(order * phase)
            parts += [s * cosine + c * sine, -s * sine + c * cosine]
            at += 2
        return np.concatenate([parts, linear[at:]])

    def jacobian(self, amplitudes: Array, phases: Array, group: int) -> Array:
        """Derivative of ``linear`` of one group by ``[amplitudes, phases]``: (m, size + groups)."""
        phase = phases[group]
        result = np.zeros((len(self.design.names), self.size + phases.size))
        row = at = 0
        if self.coupled:
            result[0, 0], result[1, 0] = np.cos(phase), np.sin(phase)
            result[0, self.size + group] = -amplitudes[0] * np.sin(phase)
            result[1, self.size + group] = amplitudes[0] * np.cos(phase)
            row, at = 2, 1
        for order in self.orders:
            cosine, sine = np.cos(order * phase), np.sin(order * phase)
            result[row : row + 2, at : at + 2] = [[cosine, -sine], [sine, cosine]]
            s, c = amplitudes[at], amplitudes[at + 1]
            result[row : row + 2, self.size + group] = [
                -order * (s * sine + c * cosine),
                order * (s * cosine - c * sine),
            ]
            row, at = row + 2, at + 2
        tail = len(self.design.names) - row
        result[row:, at : at + tail] = np.eye(tail)
        return result


def _solve_groups(design: Design, parts: list[Reduction], groups: tuple[int, ...]) -> Solution:
    """One phase per group, amplitudes shared."""
    shape = _Shape(design, len(parts))
    if not shape.coupled:
        raise CalibrationError(
            "harmonics with phase 'per-segment' need 'tan_beta' among the terms: it carries the phase",
            remedy="add 'tan_beta'",
        )
    m = len(design.names)
    factors = [part.factor for part in parts]
    shared, amplitude = _start(design, parts)
    amplitudes = np.concatenate([[amplitude], np.zeros(2 * len(shape.orders)), shared])
    phases = np.array([_scan(shape, amplitudes, factor) for factor in factors])
    amplitudes = _amplitudes_given(shape, phases, factors)
    cost = _cost(shape, amplitudes, phases, factors)
    damping = 0.0
    for _ in range(ITERATIONS):
        R, residual = _linearised(shape, amplitudes, phases, factors)
        step = _damped_step(R, residual, damping)
        new_amplitudes, new_phases = amplitudes + step[: shape.size], phases + step[shape.size :]
        new_cost = _cost(shape, new_amplitudes, new_phases, factors)
        if new_cost <= cost * (1.0 + 1e-13):
            done = cost - new_cost <= 1e-14 * cost and damping == 0.0
            amplitudes, phases, cost = new_amplitudes, new_phases, new_cost
            damping = 0.0 if damping < 1e-6 else damping / 10.0
            if done:
                break
        else:
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e6:
                break
    R, _ = _linearised(shape, amplitudes, phases, factors)
    covariance = _inverse_information(R)
    values = np.array([shape.linear(amplitudes, phases[g]) for g in groups])
    rss = cost + sum(float(part.weight[0, m]) for part in parts)
    jacobians = tuple(shape.jacobian(amplitudes, phases, g) for g in range(len(parts)))
    return Solution(amplitudes, phases, covariance, values, rss, jacobians)


def _start(design: Design, parts: list[Reduction]) -> tuple[Array, float]:
    """Shared parameters and coupling amplitude with the local columns of every group left free."""
    local, m = len(design.local_names), len(design.names)
    free = Reduction.empty(design.shared_names)
    for part in parts:
        free.absorb(part.factor[local:, local:].T)
    shared = free.solve()[0] if design.shared_names else np.zeros(0)
    squares, weights = 0.0, 0.0
    for part in parts:
        factor = part.factor
        right = factor[:local, m] - factor[:local, local:m] @ shared
        size = np.abs(np.diag(factor)[:2])
        if size.min() < 1e-9 * max(size.max(), 1e-300) or size.max() == 0.0:
            continue
        p, q = solve_upper(factor[:2, :2], right[:2] - factor[:2, 2:local] @ np.zeros(local - 2))
        weight = float(size.min() ** 2)
        squares += weight * float(np.hypot(p, q))
        weights += weight
    return shared, squares / weights if weights else 0.0


def _scan(shape: _Shape, amplitudes: Array, factor: Array) -> float:
    """Best of SCAN phases for one group."""
    m = factor.shape[0] - 1
    trial = 2.0 * np.pi * np.arange(SCAN) / SCAN - np.pi
    costs = [float(np.sum((factor[:m, :m] @ shape.linear(amplitudes, p) - factor[:m, m]) ** 2)) for p in trial]
    return float(trial[int(np.argmin(costs))])


def _amplitudes_given(shape: _Shape, phases: Array, factors: list[Array]) -> Array:
    """Amplitudes by linear least squares for fixed phases."""
    zero = np.zeros(shape.size)
    rows, right = [], []
    for group, factor in enumerate(factors):
        m = factor.shape[0] - 1
        rows.append(factor[:m, :m] @ shape.jacobian(zero, phases, group)[:, : shape.size])
        right.append(factor[:m, m])
    total = Reduction.empty(tuple(str(i) for i in range(shape.size)))
    total.add(np.vstack(rows), np.concatenate(right))
    return total.solve()[0]


def _residuals(shape: _Shape, amplitudes: Array, phases: Array, factors: list[Array]) -> list[Array]:
    m = factors[0].shape[0] - 1
    return [f[:m, m] - f[:m, :m] @ shape.linear(amplitudes, phases[g]) for g, f in enumerate(factors)]


def _cost(shape: _Shape, amplitudes: Array, phases: Array, factors: list[Array]) -> float:
    return float(sum(np.sum(r**2) for r in _residuals(shape, amplitudes, phases, factors)))


def _linearised(shape: _Shape, amplitudes: Array, phases: Array, factors: list[Array]) -> tuple[Array, Array]:
    """Triangular factor of the Jacobian and the rotated residual."""
    m = factors[0].shape[0] - 1
    rows = np.vstack([f[:m, :m] @ shape.jacobian(amplitudes, phases, g) for g, f in enumerate(factors)])
    residual = np.concatenate(_residuals(shape, amplitudes, phases, factors))
    q, r = np.linalg.qr(rows)
    return r, q.T @ residual


def _damped_step(R: Array, residual: Array, damping: float) -> Array:
    scale = np.linalg.norm(R, axis=0)
    scale[scale == 0.0] = 1.0
    if damping == 0.0 and np.abs(np.diag(R) / scale).min() > 1e-12:
        return solve_upper(R, residual)
    stacked = np.vstack([R, np.diag(scale * np.sqrt(max(damping, 1e-14)))])
    return np.linalg.lstsq(stacked, np.concatenate([residual, np.zeros(R.shape[1])]), rcond=None)[0]


def _inverse_information(R: Array) -> Array:
    """``(R'R)^-1`` with a column scaling; a phase that the record does not hold gets the circle's spread."""
    scale = np.linalg.norm(R, axis=0)
    scale[scale == 0.0] = 1.0
    _, r = np.linalg.qr(R / scale)
    diagonal = np.abs(np.diag(r))
    if diagonal.min() < 1e-13:
        return np.linalg.pinv(r.T @ r, rcond=1e-13) / np.outer(scale, scale)
    inverse = solve_upper(r, np.eye(r.shape[0]))
    return inverse @ inverse.T / np.outer(scale, scale)
