"""Solve the summaries: one phase or one per phase group, covariance, named coefficients.

Without the phase the model is linear. One phase without a servo follows from its linear solution. Several phases, or a servo,
need nonlinear least squares on the triangular factors. Names and file units are applied last.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.calibration.model.reduction import Reduction, triangle
from piga.errors import CalibrationError
from piga.records.calibration.coefficient import Coefficient, short_way
from piga.records.terms import GYRO, si_factor, unit_of
from piga.results import Array

_UNSEEN = 1e-12
"""Size of a phase's column, relative to the largest column, below which no sample shows the phase."""
_DEEPER = 1e-9
"""Relative fall of the sum of squares above which another minimum is deeper."""
_STARTS = 8
"""Most starts: each from the best phases for the amplitudes before; one is usual."""
_STEPS = 200
"""Most steps from one start; ten are usual, and far more where a term that the model lacks moves a phase that is hardly seen."""
_SCAN = 180
"""Phases tried for each group before refinement; the cost has at most twice the highest order of minima."""
_TRIALS = 25
"""Phases from which one phase with a servo is fitted: six in a wave of the cost."""
_FEW = 6
"""Most phases of which each is also tried alone, with a servo: those of a few runs."""
_INTEGRATIONS = 50
"""Steps to the coupling with the phases integrated out; few are needed unless it is below its noise."""
_REFINEMENTS = 8
"""Newton steps from each of these minima; four are enough unless two of them lie close together."""


STIFFNESS_COLUMNS = ("servo_mean", "servo_cosine", "servo_sine")
"""Columns that the stiffness of a servo spans at any phase."""
PHASELESS = (*STIFFNESS_COLUMNS, "damping_cosine", "damping_sine")
"""Columns that the servo terms span, in the order of the kernel."""
_SPANNED = {"servo": STIFFNESS_COLUMNS, "servo_damping": PHASELESS[3:]}


def phaseless_columns(terms: Sequence[str]) -> tuple[str, ...]:
    """Columns that span the servo terms among ``terms``."""
    return tuple(column for name, columns in _SPANNED.items() if name in terms for column in columns)


def _waves(order: int, phases: Array, derivative: int) -> tuple[Array, Array]:
    """Cosine and sine of ``order`` times the phases, or a derivative of them by the phase."""
    turned = order * phases + derivative * 0.5 * math.pi
    return order**derivative * np.cos(turned), order**derivative * np.sin(turned)


def servo_rows(phases: Array, derivative: int = 0) -> dict[str, Array]:
    """Coefficients of the columns of each servo term at phases (.., columns) for a term of one, or a derivative by the phase."""
    rows = {}
    for name, order in (("servo", 2), ("servo_damping", 1)):
        cosine, sine = _waves(order, phases, derivative)
        mean = np.full_like(cosine, 0.0 if derivative else -1.0)
        rows[name] = np.stack([mean, cosine, -sine] if name == "servo" else [-cosine, -sine], axis=-1)
    return rows


def at_phase(
    part: Reduction, wanted: Sequence[str], phase: float, moved: Mapping[str, Mapping[str, float]] | None = None
) -> Reduction:
    """The triangle of the wanted columns. Those of servo terms, and the ``moved`` sums of these, are combined at the phase."""
    rows, matrix = servo_rows(np.asarray(phase)), np.zeros((len(part.names) + 1, len(wanted) + 1))
    matrix[-1, -1] = 1.0
    for column, name in enumerate(wanted):
        sizes = (moved or {}).get(name, {name: 1.0} if name in _SPANNED else None)
        if sizes is None:
            matrix[part.names.index(name), column] = 1.0
            continue
        for term, size in sizes.items():
            matrix[[part.names.index(spanned) for spanned in _SPANNED[term]], column] += size * rows[term]
    return part.mixed(tuple(wanted), matrix)


@dataclass(frozen=True)
class Layout:
    """Assigns a parameter to every column of every phase group.

    The columns of a group are local (``p, q``, the harmonics and those of the servo, whose coefficients turn with its phase) or
    shared. ``servo`` are the estimated servo terms, ``given`` K times the others that the model contains. ``keys`` name the
    parameters of the shared columns of all groups as (term, run). The run is None if one parameter serves all runs.
    ``tails[g]`` are the indices into ``keys`` of the shared columns of group g.
    """

    coupled: bool
    orders: tuple[int, ...]
    keys: tuple[tuple[str, str | None], ...]
    tails: tuple[NDArray[np.int64], ...]
    servo: tuple[str, ...] = ()
    given: tuple[tuple[str, float], ...] = ()

    @property
    def servo_columns(self) -> tuple[str, ...]:
        """Columns of the servo terms, estimated or given."""
        return phaseless_columns((*self.servo, *dict(self.given)))

    @property
    def turning(self) -> int:
        """Number of columns of the coupling and of the harmonics."""
        return (2 if self.coupled else 0) + 2 * len(self.orders)

    @property
    def local(self) -> int:
        """Number of local columns."""
        return self.turning + len(self.servo_columns)

    @property
    def head(self) -> int:
        """Number of amplitudes before the ``keys``."""
        return (1 if self.coupled else 0) + 2 * len(self.orders) + len(self.servo)

    @property
    def size(self) -> int:
        """Number of amplitudes: coupling, harmonics, servo, ``keys``."""
        return self.head + len(self.keys)

    @property
    def amplitude_keys(self) -> tuple[tuple[str, str | None], ...]:
        """(term, run) of every amplitude."""
        head: list[tuple[str, str | None]] = [("tan_beta", None)] if self.coupled else []
        head += [(f"{kind}{order}", None) for order in self.orders for kind in ("s", "c")]
        return (*head, *((name, None) for name in self.servo), *self.keys)

    def turned(self, amplitudes: Array, phases: Array, derivative: int = 0, *, given: bool = True) -> Array:
        """Coefficients of the local columns (.., local) at phases (..), or a derivative of them by the phase."""
        columns: list[Array] = []
        for order in (*((1,) if self.coupled else ()), *self.orders):
            cosine, sine = _waves(order, phases, derivative)
            at = len(columns)
            if self.coupled and at == 0:
                columns += [amplitudes[0] * cosine, amplitudes[0] * sine]
                continue
            s, c = amplitudes[at - self.coupled : at - self.coupled + 2]
            # the column named s_n is int(y sin - z cos) with y = 1, z = 0; c_n is int(y cos + z sin)
            columns += [s * cosine - c * sine, s * sine + c * cosine]
        sizes = dict(zip(self.servo, amplitudes[self.head - len(self.servo) :], strict=False))
        sizes |= dict(self.given) if given else dict.fromkeys(dict(self.given), 0.0)
        rows = servo_rows(phases, derivative) if sizes else {}
        if not self.coupled:  # no phase: the mean remains
            rows = {
                name: row * (np.arange(row.shape[-1]) == 0) * (name == "servo") for name, row in rows.items()
            }
        columns += [
            sizes[name] * column for name in rows if name in sizes for column in np.moveaxis(rows[name], -1, 0)
        ]
        return np.stack(columns, axis=-1) if columns else np.zeros((*phases.shape, 0))

    def linear(self, amplitudes: Array, phase: float, group: int) -> Array:
        """Column coefficients of a group at this phase."""
        local = self.turned(amplitudes, np.array([phase]))[0]
        return np.concatenate([local, amplitudes[self.head :][self.tails[group]]])

    def directions(self, phases: Array) -> Array:
        """Derivative of ``turned`` by the amplitudes before the keys, (.., local, head); its columns are orthogonal."""
        units = [self.turned(unit, phases, given=False) for unit in np.eye(self.head)]
        return np.stack(units, axis=-1) if units else np.zeros((*phases.shape, self.local, 0))

    def from_linear(self, linear: Array, phase: ArrayLike) -> Array:
        """Amplitudes (size, ..) from the column coefficients (columns, ..) of the only group."""
        along = self.directions(np.asarray(phase))
        own = np.moveaxis(linear[: self.local], 0, -1) - self.turned(np.zeros(self.head), np.asarray(phase))
        head = np.einsum("...lh,...l->h...", along, own) / np.einsum("...lh,...lh->h...", along, along)
        return np.concatenate([head, linear[self.local :]])

    def derivative(self, amplitudes: Array, phases: Array) -> Array:
        """Derivative of the coefficients of ``columns`` by ``[amplitudes, phases]``: (groups, columns, size + phases)."""
        count, at = len(self.tails), np.arange(len(self.keys))
        result = np.zeros((count, len(self.columns), self.size + phases.size))
        result[:, self.local + at, self.head + at] = 1.0
        result[:, : self.local, : self.head] = self.directions(phases if phases.size else np.zeros(count))
        if phases.size:
            each = np.arange(count)
            result[each, : self.local, self.size + each] = self.turned(amplitudes, phases, 1)
        return result

    def jacobians(self, amplitudes: Array, phases: Array) -> tuple[Array, ...]:
        """Derivative of ``linear`` of each group by ``[amplitudes, phases]``."""
        whole, local = self.derivative(amplitudes, phases), np.arange(self.local)
        return tuple(
            own[np.append(local, self.local + tail)] for own, tail in zip(whole, self.tails, strict=True)
        )

    def stacked(self, factors: Sequence[Array]) -> Array:
        """Factors of the groups with their columns placed among ``columns``, observation last; rows of zeros fill up."""
        result = np.zeros((len(factors), max(map(len, factors)), len(self.columns) + 1))
        for own, factor, tail in zip(result, factors, self.tails, strict=True):
            own[: len(factor), [*range(self.local), *(self.local + tail), -1]] = factor
        return result

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the local columns and of ``keys``."""
        local: tuple[str, ...] = ("p", "q") if self.coupled else ()
        local += tuple(f"{kind}{order}" for order in self.orders for kind in ("s", "c"))
        return (
            local
            + self.servo_columns
            + tuple(name if run is None else f"{name}[{run}]" for name, run in self.keys)
        )


@dataclass(frozen=True)
class Estimate:
    """Estimate in internal parameters.

    ``amplitudes`` are, in this order, the coupling amplitude ``K tan_beta`` (if requested),
    ``K s_n, K c_n`` per harmonic in the frame of alpha, and the shared linear parameters. ``phases`` holds one
    phi per group. ``covariance`` is that of ``[amplitudes, phases]`` for unit noise. ``jacobians`` hold, for each
    phase group, the derivative of its column coefficients by ``[amplitudes, phases]``. ``shift`` is the change of the parameters by
    integrating out the phases, for unit noise. Its square is in the covariance; the rest and the derivatives are those before it.
    """

    amplitudes: Array
    phases: Array
    covariance: Array
    cost: float
    jacobians: tuple[Array, ...]
    shift: Array | None = field(default=None, kw_only=True)

    @property
    def inverse(self) -> Array:
        """Inverse of the information matrix: the covariance without the square of ``shift``."""
        return self.covariance if self.shift is None else self.covariance - np.outer(self.shift, self.shift)

    @property
    def parameters(self) -> int:
        """Number of parameters: amplitudes and phases."""
        return len(self.amplitudes) + len(self.phases)


def merged_groups(summaries: list[Reduction], groups: tuple[int, ...]) -> list[Reduction]:
    """One summary per phase group, from summaries per segment."""
    return [
        Reduction.stacked([part for part, own in zip(summaries, groups, strict=True) if own == group])
        for group in range(max(groups) + 1)
    ]


def solve_parts(layout: Layout, parts: list[Reduction]) -> Estimate:
    """Estimate from one summary per phase group; the groups may be of different runs.

    Linear, and exact, for one group without a servo, or without local columns; otherwise least squares on the triangular factors.
    """
    if layout.given and not layout.coupled:  # there is no phase: the mean of a given servo remains
        plain, fixed = replace(layout, given=()), layout.turned(np.zeros(layout.head), np.zeros(1))[0]
        for name, size in zip(layout.columns, fixed, strict=False):
            parts = [part.less(name, float(size)) for part in parts]
        rest = [part.select(tuple(n for n in part.names if n not in PHASELESS)) for part in parts]
        estimate = solve_parts(plain, rest)
        return replace(estimate, jacobians=layout.jacobians(estimate.amplitudes, estimate.phases))
    if layout.local and (len(parts) > 1 or layout.servo_columns):
        return _solve_groups(layout, parts)
    total = parts[0]
    if len(parts) > 1:
        rows = layout.stacked([part.factor for part in parts]).reshape(-1, len(layout.columns) + 1)
        total = Reduction(layout.columns, triangle(rows), sum(part.count for part in parts))
    linear, covariance, cost = total.solve()
    amplitudes, phases = linear, np.zeros(0)
    if layout.coupled:
        phases = np.array([np.arctan2(linear[1], linear[0])])
        amplitudes = layout.from_linear(linear, phases[0])
        inverse = np.linalg.inv(layout.derivative(amplitudes, phases)[0])
        covariance = inverse @ covariance @ inverse.T
    return Estimate(amplitudes, phases, covariance, cost, layout.jacobians(amplitudes, phases))


def _solve_groups(layout: Layout, parts: list[Reduction]) -> Estimate:
    """Solve with one phase per group and common amplitudes: least squares from the best phases of a scan."""
    if not layout.coupled:
        raise CalibrationError(
            "harmonics with more than one phase (phase 'per-segment', or several runs) need 'tan_beta' among the "
            "terms: it carries the phase",
            remedy="add 'tan_beta'",
        )
    size, several = layout.size, len(parts) > 1
    problem = _Problem(layout, layout.stacked([part.factor[:-1] for part in parts]))
    best = problem.solved()
    amplitudes, phases, rows = best[:size], best[size:], problem.rows(best)
    covariance = _inverse_information(np.asarray(np.linalg.qr(rows, mode="r")), size)
    jacobians = layout.jacobians(amplitudes, phases)
    cost = problem.cost(best) + sum(float(part.factor[-1, -1] ** 2) for part in parts)
    variance, shift = cost / max(sum(part.count for part in parts) - len(covariance), 1), np.zeros(best.size)
    if variance > 0.0 and several:
        left, bends = problem.missed(best).reshape(problem.observed.shape), layout.turned(amplitudes, phases, 2)
        bent = np.einsum("gm,gml,gl->g", left, problem.columns[..., : layout.local], bends)
        curvatures = np.sum(rows[:, size:] ** 2, axis=0) + bent
        moved = _fitted_noise(float(amplitudes[0]), curvatures, covariance, variance)
        amplitudes, phases, shift = amplitudes - moved[:size], phases - moved[size:], moved / np.sqrt(variance)
    covariance = covariance + np.outer(shift, shift)
    return Estimate(amplitudes, phases, covariance, cost, jacobians, shift=shift if several else None)


class _Problem:
    """Least squares of the amplitudes and of a phase for each group, ``x = [amplitudes, phases]``."""

    def __init__(self, layout: Layout, stack: Array) -> None:
        self.layout, self.stack = layout, stack
        self.columns, self.observed = stack[..., :-1], stack[..., -1]

    def missed(self, x: Array) -> Array:
        """Modelled less observed rows."""
        layout = self.layout
        turned = layout.turned(x, x[layout.size :])
        rows = np.einsum("gml,gl->gm", self.columns[..., : layout.local], turned)
        rows += self.columns[..., layout.local :] @ x[layout.head : layout.size] - self.observed
        return rows.ravel()

    def cost(self, x: Array) -> float:
        """Sum of squares."""
        return float(np.sum(self.missed(x) ** 2))

    def rows(self, x: Array) -> Array:
        """Derivative of ``missed``."""
        return (self.columns @ self.layout.derivative(x, x[self.layout.size :])).reshape(self.observed.size, -1)

    def from_phases(self, phases: Array, group: slice = slice(None)) -> tuple[Array, float]:
        """The best amplitudes, of all groups or of one, at fixed phases; with them the sum of squares."""
        size, shape = self.layout.size, self.observed.shape
        x = np.concatenate([np.zeros(size), phases])
        fixed = self.rows(x).reshape(*shape, -1)[group, :, :size].reshape(-1, size)
        right = -self.missed(x).reshape(shape)[group].ravel()
        x[:size] = least_squares(fixed, right, 1e-14)
        return x, float(np.sum((fixed @ x[:size] - right) ** 2))

    def alone(self, group: int) -> float:
        """Best phase of a group without the others, with a coupling that is not negative."""
        costs = []
        for phase in np.linspace(-np.pi, np.pi, _TRIALS):
            x, cost = self.from_phases(np.full(len(self.stack), phase), slice(group, group + 1))
            costs.append((x[0] < 0.0, cost, float(phase)))
        return min(costs)[2]

    def settled(self, phases: Array) -> Array:
        """The solution from these phases. The scan begins anew at it: another minimum of a phase may be deeper there."""
        from scipy.optimize import least_squares as least_squares_from

        first, best, cost = self.from_phases(phases)[0], np.zeros(0), math.inf
        for _ in range(_STARTS):
            if self.cost(first) >= cost * (1.0 - _DEEPER):
                break
            best = least_squares_from(
                self.missed, first, self.rows, method="lm", ftol=1e-15, xtol=1e-12, gtol=1e-15, max_nfev=_STEPS
            ).x
            cost = self.cost(best)
            if len(self.stack) > 1:
                first = self.from_phases(self.scan(best[: self.layout.size]))[0]
        return best

    def scan(self, amplitudes: Array, at: int | None = None) -> Array:
        """Best phase of each group for amplitudes, that at ``at`` with the other sign."""
        turned = amplitudes * np.where(np.arange(amplitudes.size) == at, -1.0, 1.0)
        return _best_phases(self.layout, turned, self.stack)

    def solved(self) -> Array:
        """The deepest minimum that is found. A damping of the other sign may be another one."""
        from scipy.optimize import least_squares as least_squares_from

        layout, several = self.layout, len(self.stack) > 1
        starts = [self.scan(_start(layout, self.stack))] if several else []
        if layout.servo_columns and len(self.stack) <= _FEW:
            starts.append(np.array([self.alone(group) for group in range(len(self.stack))]))
        best = min((self.settled(phases) for phases in starts), key=self.cost)
        if "servo_damping" in layout.servo and several:
            other = self.settled(self.scan(best[: layout.size], layout.head - 1))
            best = other if self.cost(other) < self.cost(best) * (1.0 - _DEEPER) else best
        if (
            "servo_damping" in dict(layout.given) and best[0] < 0.0
        ):  # the sign of the coupling is no choice then
            first = self.from_phases(self.scan(best[: layout.size], 0) if several else best[layout.size :])[0]
            first[0] = max(first[0], -best[0])
            least = np.where(np.arange(best.size) == 0, 0.0, -np.inf)
            best = least_squares_from(
                self.missed, first, self.rows, bounds=(least, np.inf), x_scale="jac", xtol=1e-12
            ).x
        return best


def _fitted_noise(fitted: float, curvatures: Array, covariance: Array, variance: float) -> Array:
    """By how much the parameters are wrong because each phase fits noise, and the coupling takes that noise up.

    If the phases are integrated out instead, each with equal probability over the circle, the likelihood of the coupling A
    has its maximum at ``A = A_0 - u^2 sum_g s_g (1 - I_1(s_g A)/I_0(s_g A))``. Here A_0 is the estimate with fitted phases, u its
    standard uncertainty, and ``s_g A_0`` the information on the phase of group g (own derivation, docs/theory/calibration): half
    the second derivative of the sum of squares by the phase (``curvatures``), over the variance of the noise. The other
    parameters follow by their correlation with A.
    """
    from scipy.special import i0e, i1e

    if fitted == 0.0:
        return np.zeros(len(covariance))
    known = np.maximum(curvatures, 0.0) / variance / abs(fitted)
    coupling, square = abs(fitted), float(covariance[0, 0]) * variance
    for _ in range(_INTEGRATIONS):
        coupling = max(
            abs(fitted) - square * float(known @ (1.0 - i1e(known * coupling) / i0e(known * coupling))), 0.0
        )
    shift: Array = (fitted - math.copysign(coupling, fitted)) * covariance[:, 0] / covariance[0, 0]
    return shift


def _start(layout: Layout, stack: Array) -> Array:
    """Amplitudes of a fit with free local columns in every group; the coupling is the mean of the groups that show it."""
    local = layout.local
    free = stack[:, layout.turning :, local:].reshape(-1, len(layout.keys) + 1)  # without a servo
    shared = least_squares(free[:, :-1], free[:, -1], 1e-12)
    right = stack[:, :2, -1] - stack[:, :2, local:-1] @ shared
    sizes = np.abs(np.diagonal(stack[:, :2, :2], axis1=1, axis2=2))
    shown, weights = sizes.min(axis=1) > 1e-9 * sizes.max(axis=1), sizes.min(axis=1) ** 2
    amplitude = 0.0
    if shown.any():
        coupling = np.linalg.solve(stack[shown, :2, :2], right[shown, :, None])[..., 0]
        amplitude = float(np.average(np.hypot(*coupling.T), weights=weights[shown]))
    return np.concatenate([[amplitude], np.zeros(layout.head - 1), shared])


def least_squares(rows: Array, right: Array, rcond: float) -> Array:
    """Solution of least norm of ``rows x = right``; the columns are scaled to one."""
    scale = np.linalg.norm(rows, axis=0)
    scale[scale == 0.0] = 1.0
    return np.linalg.lstsq(rows / scale, right, rcond=rcond)[0] / scale


def _best_phases(layout: Layout, amplitudes: Array, stack: Array) -> Array:
    """Phase of least cost of each group, for these amplitudes.

    The cost is a trigonometric polynomial of twice the highest order. Each of its minima on a grid is refined by Newton's method,
    and the least is used. If a group shows one direction much better than the other, its minima are narrow, and the grid
    alone does not show which is deeper. Only the first rows of a triangular factor have local columns.
    """
    local, groups = layout.local, len(stack)
    top = stack[:, :local, :local]
    right = stack[:, :local, -1] - stack[:, :local, local:-1] @ amplitudes[layout.head :]

    def modelled(phases: Array, derivative: int = 0) -> Array:
        return np.einsum("gij,gkj->gki", top, layout.turned(amplitudes, phases, derivative))

    spacing = 2.0 * np.pi / _SCAN
    trial = np.tile(spacing * np.arange(_SCAN) - np.pi, (groups, 1))
    cost = np.sum((right[:, None] - modelled(trial)) ** 2, axis=2)
    lowest = (cost <= np.roll(cost, 1, axis=1)) & (cost <= np.roll(cost, -1, axis=1))
    order = np.argsort(np.where(lowest, cost, np.inf), axis=1)[
        :, : 2 * max((1 + bool(layout.servo_columns), *layout.orders))
    ]
    first = phases = np.take_along_axis(trial, order, axis=1)
    for _ in range(_REFINEMENTS):
        slope, missed = modelled(phases, 1), right[:, None] - modelled(phases)
        square = np.sum(slope**2, axis=2)
        curvature = square - np.sum(modelled(phases, 2) * missed, axis=2)
        curvature = np.where(curvature > 0.0, curvature, square)
        step = np.divide(
            np.sum(slope * missed, axis=2), curvature, out=np.zeros_like(phases), where=curvature > 0.0
        )
        phases = np.clip(phases + step, first - spacing, first + spacing)
    cost = np.sum((right[:, None] - modelled(phases)) ** 2, axis=2)
    best: Array = phases[np.arange(groups), np.argmin(cost, axis=1)]
    return best


def _inverse_information(R: Array, first_phase: int) -> Array:
    """``(R'R)^-1`` with column scaling. A phase that no sample shows gets the variance of an even spread over the circle.

    Parameters
    ----------
    R:
        Linearised triangular factors.
    first_phase:
        Index of the first phase among the columns.
    """
    scale = np.linalg.norm(R, axis=0)
    seen = np.ones(scale.size, np.bool_)
    seen[first_phase:] = scale[first_phase:] > _UNSEEN * scale.max()
    scale = scale[seen]
    scale[scale == 0.0] = 1.0
    _, r = np.linalg.qr(R[:, seen] / scale)
    if np.abs(np.diag(r)).min() < 1e-13:
        known = np.linalg.pinv(r.T @ r, rcond=1e-13) / np.outer(scale, scale)
    else:
        inverse = np.linalg.solve(r, np.eye(r.shape[0]))
        known = inverse @ inverse.T / np.outer(scale, scale)
    covariance = np.diag(np.full(seen.size, np.pi**2 / 3.0))
    covariance[np.ix_(seen, seen)] = known
    return covariance


Owner = tuple[str | None, str | None]
"""Segment and run of a phase; None if the phase serves all of them."""


def name_parameters(
    layout: Layout,
    estimate: Estimate,
    covariance: Array,
    scale_factor: float,
    terms: tuple[str, ...],
    owners: list[Owner],
    unit: str = GYRO,
) -> tuple[tuple[Coefficient, ...], Array]:
    """Coefficients in file units and their covariance in the same units and order.

    Internal amplitudes are multiples of K (``K tan_beta``, ``K k0``, ...); division by K, estimated or
    nominal (``scale_factor``), and the change of units are propagated through the covariance to first order
    (JCGM 100, 5.1). ``terms`` give the order; ``owners`` give the segment and run of each phase; ``unit`` is that of the output
    rate.
    """
    keys = layout.amplitude_keys
    total = np.concatenate([estimate.amplitudes, estimate.phases])
    at_scale = keys.index(("scale_factor", None)) if ("scale_factor", None) in keys else None
    if at_scale is not None:
        scale_factor = float(total[at_scale])
    values, jacobian = total.copy(), np.eye(total.size)
    for i in range(len(keys)):
        if i == at_scale:
            continue
        values[i] /= scale_factor
        jacobian[i, i] = 1.0 / scale_factor
        if at_scale is not None:
            jacobian[i, at_scale] = -values[i] / scale_factor
    _make_tangent_positive(layout, values, jacobian)
    named: list[tuple[str, str | None, str | None]] = [(name, None, run) for name, run in keys]
    named += [("phi", segment, run) for segment, run in owners]
    units = np.array([1.0 / si_factor(name) for name, _, _ in named])
    values, jacobian = values * units, jacobian * units[:, None]
    result = jacobian @ covariance @ jacobian.T
    std = np.sqrt(np.maximum(np.diag(result), 0.0))
    coefficients = tuple(
        Coefficient(name, float(value), float(s), unit_of(name, unit), segment, run)
        for (name, segment, run), value, s in zip(named, values, std, strict=True)
    )
    order = asked_order(layout, terms, len(owners))
    return tuple(coefficients[i] for i in order), result[np.ix_(order, order)]


def _make_tangent_positive(layout: Layout, values: Array, jacobian: Array) -> None:
    """Make tan_beta >= 0 by moving its sign into the phase; phases in (-pi, pi]."""
    if not layout.coupled:
        return
    if values[0] < 0.0:
        values[0], jacobian[0] = -values[0], -jacobian[0]
        values[layout.size :] += np.pi
        at = 1
        for order in layout.orders:
            if order % 2:
                values[at : at + 2], jacobian[at : at + 2] = -values[at : at + 2], -jacobian[at : at + 2]
            at += 2
        for index, (name, _) in enumerate(layout.amplitude_keys):
            if name == "servo_damping":
                values[index], jacobian[index] = -values[index], -jacobian[index]
    values[layout.size :] = short_way(values[layout.size :])


def asked_order(layout: Layout, terms: tuple[str, ...], phases: int) -> list[int]:
    """Indices of the internal parameters in the order of the coefficients: as requested, phi after tan_beta."""
    names = [name for name, _ in layout.amplitude_keys] + ["phi"] * phases
    rank = {name: i for i, name in enumerate(terms)}
    rank["phi"] = rank.get("tan_beta", 0)
    return sorted(range(len(names)), key=lambda i: (rank[names[i]], i))
