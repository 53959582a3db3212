"""Noise that is in the covariance of a run but not in its weights.

**All noise of a fit.** :func:`include_noise` searches for each kind of noise in turn (the rules: docs/theory/noise).

**A random walk that is not significant.** Its estimated variance, which may be negative, enters the covariance only.
If it is unclear whether a record contains a random walk in addition to white noise, the weights stay those of white
noise. They lose little. The walk adds its likely variance times the covariance per unit walk. A variance that must not be
negative is too large on average if there is no walk. A variance that is set to zero below a limit is too small if
there is a small walk. The restricted likelihood is therefore searched wherever the covariance of the record is
positive definite, down to a negative variance (``faint_least``). The reason: the slow values of a record scatter less than
its white noise says as often as they scatter more. The uncertainty of that variance enters the degrees of freedom. The
intervals are then valid for any walk, after [Kenward1997]; own derivation, docs/theory.

**Scores, for a joint calibration.**
The weights W are those of the significant noise. The estimate is ``A^-1 X'W y``. Further noise of covariance ``v B B'``
adds ``v A^-1 (X'W B)(X'W B)' A^-1`` to the covariance, where A is the information of all runs together. ``X'W B`` of
a run, its *scores*, is a small matrix. It does not depend on the other runs (own derivation, docs/theory).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from piga._kernels.estimation.noise import CANDIDATES
from piga.calibration.fit.one_run import Colour, FaintWalk, Fit, log_determinant, whitened_rows, without_slow
from piga.calibration.intervals.coloured_noise import include_coloured_noise
from piga.calibration.intervals.slow_noise import include_slow_noise, include_stated_scatter
from piga.calibration.model.design import Design
from piga.calibration.model.solution import Solution, solve
from piga.calibration.noise.components import RATES, RateBins
from piga.calibration.noise.levels import Noise, deviance_sums, least_on_grid
from piga.calibration.noise.likelihood import restricted
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.weighting import (
    BesideStated,
    DriftBasis,
    NoiseColumns,
    SegmentBasis,
    Whitener,
    reduce_segments,
)
from piga.results import Array


@dataclass(frozen=True)
class AddedNoise:
    """A noise that is in the covariance only: its variance (may be negative), the uncertainty of this variance, and its scores.

    ``scores`` (m, K) per phase group, for unit variance. ``together``: True if one noise acts on all groups, False if each
    group has its own. ``shared`` is the covariance of its variance with that of the noise before it. ``gain`` is the gain of
    twice the log-likelihood by the coloured noise of the run; 0 for other noise. ``otherwise``: True if the noise counts
    only where the coloured noise of the run does not.
    """

    name: str
    variance: float
    deviation: float
    together: bool
    scores: tuple[Array, ...] = field(repr=False)
    shared: float = 0.0
    gain: float = 0.0
    otherwise: bool = False

    def select(self, held: tuple[str, ...], columns: tuple[str, ...]) -> AddedNoise:
        """The noise for some of the columns."""
        at = [held.index(name) for name in columns]
        return replace(self, scores=tuple(part[at] for part in self.scores))

    def mixed(self, matrices: list[Array]) -> AddedNoise:
        """The noise for combinations of the columns: ``matrices`` (m, wanted) of the phase groups."""
        return replace(
            self, scores=tuple(matrix.T @ part for matrix, part in zip(matrices, self.scores, strict=True))
        )

    def scaled(self, information: float) -> AddedNoise:
        """The noise for rows with ``information`` times the weight."""
        return replace(self, scores=tuple(part * information for part in self.scores))

    def per_unit(self, jacobians: list[Array]) -> Array:
        """Sum of ``J' S S' J``, where J are the derivatives of the column coefficients in each group by the parameters."""
        moved = [jacobian.T @ part for jacobian, part in zip(jacobians, self.scores, strict=True)]
        whole = sum(moved) if self.together else np.hstack(moved)
        added: Array = whole @ np.transpose(whole)
        return added


def added_noise(fit: Fit, design: Design) -> tuple[AddedNoise, ...]:
    """The noise that is in the covariance of a fit but not in its weights, for the columns of ``design``."""
    noises = []
    if fit.slow_part is not None:
        drifting = fit.noise.drift > 0.0
        basis = DriftBasis.of(design.run) if drifting else SegmentBasis.of(design.run)
        scores = _grouped(
            _slow_scores(fit, design, basis, np.sqrt(basis.unit()) * np.eye(basis.count)), design.groups
        )
        name = "drift" if drifting else "scatter"
        noises.append(AddedNoise(name, fit.noise.slow, fit.slow_deviation, True, scores))
    if fit.colour is not None:
        noises += _coloured(fit, fit.colour, design)
        plain = include_faint_walk(without_slow(fit))
        noises += [replace(noise, otherwise=True) for noise in _faint(plain, design)]
    return (*noises, *_faint(fit, design))


def _faint(fit: Fit, design: Design) -> list[AddedNoise]:
    """A random walk that is not significant; empty without one."""
    if fit.faint is None:
        return []
    deviation = float(np.sqrt(np.linalg.inv(fit.faint.information)[1, 1]))
    scores = _walk_scores(design, fit.mode, fit.weights, NOISE.degrees_probe * deviation)
    return [AddedNoise("walk", fit.faint.walk - fit.noise.walk, deviation, False, scores)]


def _coloured(fit: Fit, colour: Colour, design: Design) -> list[AddedNoise]:
    """The likeliest coloured noise, and its effect on the random walk."""
    bins = RateBins.of(design.run)
    root = positive_root(RATES[colour.name](bins, colour.time))
    weight = 1.0 / fit.sample_variance if fit.mode == "samples" else 1.0
    scores = tuple(weight * part for part in _grouped(_slow_scores(fit, design, bins, root), design.groups))
    noises = [AddedNoise(colour.name, colour.variance, colour.deviation, True, scores, gain=colour.gain)]
    if not bins.point:
        walk = _grouped(_slow_scores(fit, design, bins, positive_root(RATES["walk"](bins, 0.0))), design.groups)
        deviation, shared = colour.walk_deviation, colour.walk_shared
        noises.append(AddedNoise("walk", colour.walk, deviation, True, walk, shared, colour.gain))
    return noises


def _grouped(parts: list[Array], groups: tuple[int, ...]) -> tuple[Array, ...]:
    """Sums over the segments of every phase group."""
    return tuple(
        np.sum([part for part, own in zip(parts, groups, strict=True) if own == group], axis=0)
        for group in range(max(groups) + 1)
    )


def _slow_scores(fit: Fit, design: Design, basis: NoiseColumns, root: Array) -> list[Array]:
    """``X'W B`` (m, k) of every segment for unit slow noise; ``root`` (count, k) is a root of the covariance of its numbers.

    If the weights include a stated scatter ``d b b'`` of a segment, ``W = V^-1 - V^-1 b b' V^-1 / (1/d + b' V^-1 b)``.
    """
    m, stated = len(design.names), fit.weights.stated if fit.counted is None else ()
    wide: NoiseColumns = BesideStated(SegmentBasis.of(design.run), basis) if stated else basis
    products = [np.zeros((m + wide.size, wide.size)) for _ in design.run.labels]
    for segment, columns in whitened_rows(fit, design, fit.weights, wide):
        products[segment] += columns[:-1] @ columns[m:-1].T
    scores = []
    for segment, product in enumerate(products):
        if stated:
            own = product[:, 0] / (1.0 / max(stated[segment], 1e-300) + product[m, 0])
            weighted = product[:m, 1:] - np.outer(own[:m], product[m, 1:])
        else:
            weighted = product[:m]
        scores.append(basis.placed(weighted, segment) @ root)
    return scores


def _walk_scores(design: Design, mode: str, noise: Noise, probe: float) -> tuple[Array, ...]:
    """A root of ``X'W H W X`` (m, m) of every group; H is the covariance of unit walk. It is minus d(``X'W X``)/d(walk)."""
    m = len(design.names)
    near = [
        _grouped([part.factor[:, :m].T @ part.factor[:, :m] for part in parts], design.groups)
        for parts in (
            reduce_segments(design, mode, replace(noise, walk=noise.walk + moved)) for moved in (probe, -probe)
        )
    ]
    return tuple(positive_root((below - above) / (2.0 * probe)) for above, below in zip(*near, strict=True))


def positive_root(matrix: Array) -> Array:
    """S with ``S S'`` equal to a matrix without its negative eigenvalues; the diagonal is scaled to one for the computation."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale[scale == 0.0] = 1.0
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    root: Array = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def include_faint_walk(fit: Fit) -> Fit:
    """The fit with a random walk that is not significant in its covariance; unchanged if the walk is significant.

    Not done with slow noise, coarse counts, given noise levels, methods other than whitened least squares in one go,
    more than ``restricted_rows`` increments, or if the coefficients leave no slow values.
    """
    noise = fit.noise
    able = fit.seeks_noise and fit.mode == "increments" and fit.counted is None
    if not able or noise.slow > 0.0 or fit.design.rows > NOISE.restricted_rows:
        return fit
    unit = slowest(fit)
    if noise.white == 0.0 or noise.walk > NOISE.faint_unclear * unit * noise.white:
        return fit
    if 2.0 * _walk_information(fit, 0.0)[1, 1] * unit**2 < NOISE.faint_enough:
        return fit
    share = _likely_share(fit)
    part = _per_walk(fit, NOISE.faint_probe * unit * noise.white)
    faint = FaintWalk(share * unit * noise.white, part, _walk_information(fit, share) / noise.white**2)
    return replace(
        fit, faint=faint, covariance=fit.solution.covariance + (faint.walk - noise.walk) * faint.part
    )


def slowest(fit: Fit) -> float:
    """Walk over white noise [1/s] at which both are equal in the slowest value of the longest stretch.

    The least eigenvalue of white noise in the increments of N samples is ``4 sin^2(pi/2N)``. The covariance is positive
    definite for any walk above minus this value, if all intervals equal the longest.
    """
    edges = np.append(np.flatnonzero(fit.design.run.begins), fit.design.run.size)
    longest = max(int(np.diff(edges).max()), 2)
    return float(4.0 * np.sin(0.5 * np.pi / longest) ** 2 / fit.h.max())


def _likely_share(fit: Fit) -> float:
    """Walk of greatest restricted likelihood, in units of ``slowest`` times the white noise; negative down to -1."""
    from scipy.interpolate import CubicSpline

    unit, low, high = slowest(fit), math.log(NOISE.faint_least), math.log(NOISE.faint_most)
    nodes = np.linspace(low, high, NOISE.faint_nodes)
    information = CubicSpline(nodes, _logarithms(fit, nodes))
    best = 0.0
    for _ in range(NOISE.faint_passes):
        grid = np.linspace(low, high, CANDIDATES)
        log, square = _sums(fit, unit * np.expm1(grid))
        best = least_on_grid(
            grid, restricted(log, square, fit.design.rows - fit.solution.parameters) + information(grid)
        )
        spacing = (high - low) / (CANDIDATES - 1)
        low, high = (
            max(best - spacing, math.log(NOISE.faint_least)),
            min(best + spacing, math.log(NOISE.faint_most)),
        )
    return math.expm1(best)


def _walk_information(fit: Fit, share: float) -> Array:
    """Fisher information (2, 2) of white noise and walk for unit white noise, exact for this record.

    For the restricted likelihood it is minus half the second derivative of its logarithmic terms alone,
    ``(n - m) log r + F(q/r)``, because the covariance is linear in both.
    """
    ratio, at = slowest(fit) * share, math.log1p(share)
    grid = at + NOISE.faint_twist * np.linspace(-1.0, 1.0, 3)
    log = _sums(fit, slowest(fit) * np.expm1(np.resize(grid, CANDIDATES)))[0][:3]
    below, here, above = log + _logarithms(fit, grid)
    first, second = (
        (above - below) / (2.0 * NOISE.faint_twist),
        (above - 2.0 * here + below) / NOISE.faint_twist**2,
    )
    scale = slowest(fit) * math.exp(at)
    slope, bend = first / scale, (second - first) / scale**2
    mixed, freedom = slope + ratio * bend, fit.design.rows - fit.solution.parameters
    return 0.5 * np.array([[freedom - 2.0 * ratio * slope - ratio**2 * bend, mixed], [mixed, -bend]])


def _logarithms(fit: Fit, grid: Array) -> Array:
    """``log|X' V^-1 X|`` for unit white noise at logarithms of the variance of the slowest value."""
    walks = slowest(fit) * np.expm1(grid)
    stated = tuple(variance / fit.noise.white for variance in fit.noise.stated)
    levels = [Noise(1.0, float(walk), stated=stated) for walk in walks]
    return np.array([-log_determinant(_weighted(fit, noise)) for noise in levels])


def _sums(fit: Fit, walks: Array) -> tuple[Array, Array]:
    """Sums of the likelihood for unit white noise at these walks, including a stated scatter of the segments.

    V is the covariance of white noise and walk, ``b`` the intervals of a segment, ``v`` its stated variance. The scatter
    adds ``log(1 + v b'V^-1 b)`` and subtracts ``v (b'V^-1 d)^2/(1 + v b'V^-1 b)`` from the squares.
    """
    log, square = deviance_sums(fit.d, fit.h, walks)
    if not fit.noise.stated:
        return log, square
    segment, variance = fit.design.run.segment_index, np.array(fit.noise.stated) / fit.noise.white
    columns = np.stack([fit.h, fit.d])
    for k, walk in enumerate(walks):
        b, d = Whitener("increments", Noise(1.0, float(walk)), 2).apply_columns(columns, fit.h)
        own, cross = (np.bincount(segment, b * other, minlength=variance.size) for other in (b, d))
        grown = 1.0 + variance * own
        log[k] += np.log(grown).sum()
        square[k] -= np.sum(variance * cross**2 / grown)
    return log, square


def _per_walk(fit: Fit, probe: float) -> Array:
    """Covariance per unit walk with the weights of the fit; to first order all weights give the same."""
    above, below = (
        _at_the_fit(fit, _weighted(fit, replace(fit.noise, walk=fit.noise.walk + moved)))
        for moved in (probe, -probe)
    )
    slope: Array = (above - below) / (2.0 * probe)
    return slope


def _at_the_fit(fit: Fit, solution: Solution) -> Array:
    """Covariance of a solution, linearised at the fit: near tan_beta = 0 each solution has another phase."""
    if fit.solution.phases.size != 1:
        return solution.inverse
    turn = np.linalg.solve(fit.solution.jacobians[0], solution.jacobians[0])
    moved: Array = turn @ solution.covariance @ turn.T
    return moved


def _weighted(fit: Fit, noise: Noise) -> Solution:
    return solve(fit.design, reduce_segments(fit.design, fit.mode, noise))


def include_noise(fit: Fit, stated: Array, clear: float = NOISE.slow_in_weights) -> Fit:
    """The fit with the noise that its record shows, in the covariance and, where it is clear, in the weights.

    Parameters
    ----------
    fit:
        The fit by white noise, random walk and counting.
    stated:
        Stated variance of the rate of each segment (m,) [rad^2/s^2].
    clear:
        Gain above which a drift enters the weights; inf if it must not.
    """
    fit = include_coloured_noise(include_stated_scatter(fit, stated))
    if fit.colour is not None:
        return fit
    return include_faint_walk(include_slow_noise(fit, clear=clear))
