"""A random walk that is not significant: its estimated variance, which may be negative, enters the covariance only.

If it is unclear whether a record holds a random walk beside white noise, the weights stay those of white noise; they
lose little. The walk adds its likely variance times the covariance per unit walk. A variance that must not be
negative is too large on average if there is no walk. A variance that is set to zero below a limit is too small if
there is a small walk. The restricted likelihood is therefore searched wherever the covariance of the record is
positive definite, down to a negative variance (``faint_least``): the slow values of a record scatter less than its white
noise says as often as they scatter more. The uncertainty of that variance enters the degrees of freedom. The
intervals are then valid for any walk, after [Kenward1997]; own derivation, docs/theory.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.noise import CANDIDATES
from piga.calibration.fit.one_run import FaintWalk, Fit, log_determinant
from piga.calibration.model.solution import Solution, solve
from piga.calibration.noise.levels import Noise, deviance_sums, least_on_grid
from piga.calibration.noise.likelihood import restricted
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.weighting import Whitener, reduce_segments

Array = NDArray[np.float64]


def include_faint_walk(fit: Fit) -> Fit:
    """The fit with a random walk that is not significant in its covariance; unchanged if the walk is significant.

    Not done with slow noise, coarse counts, given noise levels, methods other than whitened least squares in one go,
    more than ``restricted_rows`` increments, or if the coefficients leave no slow values.
    """
    request, noise = fit.design.request, fit.noise
    able = fit.mode == "increments" and request.method == "information" and fit.counted is None
    if not able or request.angle_rms is not None or noise.slow > 0.0 or fit.design.rows > NOISE.restricted_rows:
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
        best = least_on_grid(grid, restricted(log, square, _freedom(fit)) + information(grid))
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
    mixed = slope + ratio * bend
    return 0.5 * np.array([[_freedom(fit) - 2.0 * ratio * slope - ratio**2 * bend, mixed], [mixed, -bend]])


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


def _freedom(fit: Fit) -> int:
    return fit.design.rows - len(fit.solution.amplitudes) - len(fit.solution.phases)


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
        return solution.covariance
    turn = np.linalg.solve(fit.solution.jacobians[0], solution.jacobians[0])
    moved: Array = turn @ solution.covariance @ turn.T
    return moved


def _weighted(fit: Fit, noise: Noise) -> Solution:
    return solve(fit.design, reduce_segments(fit.design, fit.mode, noise))
