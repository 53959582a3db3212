"""Propagation of distributions (JCGM 101). It tests the first-order intervals and replaces them where they fail.

The fit is linear in ``K, K tan_beta cos(phi), K tan_beta sin(phi), K k0, ...``. The Type A distribution of these
linear parameters is a multivariate t (JCGM 101, 6.4.9.5). Each source of Type B moves them by its own
sensitivities. Only ``tan_beta = hypot``, ``phi = atan2`` and the division by K are not linear. A trial draws the
linear parameters and takes that step exactly; it needs no new fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from piga.calibration.joint import JointFit
from piga.calibration.model.design import Design
from piga.calibration.uncertainty import Budget
from piga.records.calibration.coefficient import BudgetEntry, Coefficient, coverage_factor, short_way
from piga.records.calibration.diagnostics import MonteCarlo, MonteCarloCheck
from piga.records.terms import si_factor
from piga.results import Array

_TRIALS = 200_000
"""Trials. They give an end of a 95 % interval to 0.6 % of u."""
_RESOLVED = 0.02
"""Least tolerance [u]: three standard deviations of such an end."""
_QUANTILES = 4000
"""Quantiles of the scatter between which the trials are interpolated."""
_SEED = 101
"""Fixed seed: the same record gives the same digits."""
_DOUBTFUL = 6.0
"""Ratio of tan_beta to its standard uncertainty below which its interval is not linear (Rice-like)."""


@dataclass(frozen=True)
class Contribution:
    """A source of Type B: change of the linear parameters per standard uncertainty, distribution, dof.

    ``change`` has shape (draws, n). Each row is an independent draw. All draws share one estimate of the standard
    uncertainty.
    """

    change: Array
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf


def standard_draws(distribution: str, degrees: float, size: int, rng: np.random.Generator) -> Array:
    """Draws with unit standard uncertainty; for t, the scaled and shifted t of JCGM 101, 6.4.9."""
    if distribution == "rectangular":
        return rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), size)
    if distribution == "triangular":
        return rng.triangular(-math.sqrt(6.0), 0.0, math.sqrt(6.0), size)
    if distribution == "arcsine":
        return math.sqrt(2.0) * np.cos(rng.uniform(0.0, math.pi, size))
    if distribution == "t":
        return rng.standard_t(degrees, size)
    return rng.standard_normal(size)


def source_draws(source: Contribution, size: int, rng: np.random.Generator) -> Array:
    """Trials (size, draws) of a source. For a t distribution, all draws of a trial share one estimate of scale."""
    shape, count = source.distribution, len(np.atleast_2d(source.change))
    if shape == "t" and count > 1:
        degrees = source.degrees_of_freedom
        return rng.standard_normal((size, count)) * np.sqrt(degrees / rng.chisquare(degrees, size))[:, None]
    return np.column_stack([standard_draws(shape, source.degrees_of_freedom, size, rng) for _ in range(count)])


def tolerance(u: Array) -> Array:
    """Numerical tolerance ``delta = 10^l/2`` for two significant digits of u (JCGM 101, 7.9.2)."""
    exponent = np.floor(np.log10(np.maximum(np.round(u, 300), 1e-300))) - 1.0
    return 0.5 * 10.0**exponent


def _shortest_interval(ordered: Array) -> Array:
    """Shortest interval holding 95 % of sorted trials (trials, n), shape (2, n) (JCGM 101, 5.3.4)."""
    inside = round(0.95 * ordered.shape[0])
    widths = ordered[inside:] - ordered[:-inside]
    at, columns = np.argmin(widths, axis=0), np.arange(ordered.shape[1])
    return np.stack([ordered[at, columns], ordered[at + inside, columns]])


def propagate_distributions(
    base: Array,
    covariance: Array,
    degrees: ArrayLike,
    sources: list[Contribution],
    results: Callable[[Array], Array],
    first_order: Array,
) -> list[MonteCarloCheck]:
    """Propagate distributions through ``results`` by ``_TRIALS`` trials; one check for each result.

    The tolerance is delta of JCGM 101, 7.9.2, for two significant digits, but at least what the trials resolve.

    Parameters
    ----------
    base, covariance, degrees:
        Linear parameters (n,), their Type A covariance, and its degrees of freedom: one number, or one for each parameter. Each
        parameter then has its own t distribution, all with the same quantile of the scatter.
    sources:
        Sources of Type B.
    results:
        From draws (trials, n) to results (trials, m).
    first_order:
        Limits of the first-order intervals to be tested, (2, m).
    """
    from scipy.special import chdtri

    rng, trials = np.random.default_rng(_SEED), _TRIALS
    values, vectors = np.linalg.eigh(covariance)
    factor = vectors * np.sqrt(np.maximum(values, 0.0))
    draws = rng.standard_normal((trials, base.size)) @ factor.T
    quantile, grid = rng.uniform(size=trials), np.linspace(0.0, 1.0, _QUANTILES + 2)[1:-1]
    for column, own in enumerate(np.broadcast_to(degrees, base.size)):
        if math.isfinite(own):
            draws[:, column] *= np.interp(quantile, grid, np.sqrt(own / chdtri(own, 1.0 - grid)))
    for source in sources:
        draws += source_draws(source, trials, rng) @ np.atleast_2d(source.change)
    ordered = np.sort(results(base + draws), axis=0)
    std = ordered.std(axis=0, ddof=1)
    symmetric = np.quantile(ordered, (0.025, 0.975), axis=0)
    size = np.minimum(
        std, 0.5 * np.ptp(symmetric, axis=0)
    )  # the standard deviation of few degrees of freedom is unbounded
    delta = np.maximum(tolerance(size), _RESOLVED * size)
    agrees = np.max(np.abs(first_order - symmetric), axis=0) <= delta
    mean, shortest = ordered.mean(axis=0), _shortest_interval(ordered)

    def ends(limits: Array, at: int) -> tuple[float, float]:
        return float(limits[0, at]), float(limits[1, at])

    return [
        MonteCarloCheck(
            float(mean[k]),
            float(std[k]),
            ends(symmetric, k),
            ends(shortest, k),
            ends(first_order, k),
            float(delta[k]),
            bool(agrees[k]),
        )
        for k in range(std.size)
    ]


def monte_carlo_intervals(
    fit: JointFit, coefficients: tuple[Coefficient, ...], degrees: Array, budget: Budget
) -> tuple[tuple[Coefficient, ...], MonteCarlo | None]:
    """Coefficients with Monte Carlo intervals where the first order fails, and the comparison for the report.

    ``degrees`` are the degrees of freedom of Type A of the coefficients. The run file asks for "gum", "monte-carlo" or "auto"
    (Monte Carlo when tan_beta is not well above its noise). Several runs, records with several phases, and methods other
    than whitened least squares always use the first order.
    """
    live = fit.only
    if live is None:
        return coefficients, None
    wanted = live.run.estimation.uncertainty
    coupling = [c for c in coefficients if c.name == "tan_beta"]
    weak = any(c.value < _DOUBTFUL * c.std for c in coupling)
    able = live.fit.mode == "increments" and len(fit.estimate.jacobians) == 1
    if wanted == "gum" or not able or (wanted == "auto" and not weak):
        return coefficients, None
    design, values = fit.design_of(0, live)
    results = _results(design, coefficients)
    jacobian, base = fit.estimate.jacobians[0], values[0]
    type_a = jacobian @ fit.interval.covariance @ jacobian.T
    std = np.sqrt(np.diag(type_a))
    derivative = _derivative(results, base, std)
    sources = [
        _contribution(row, change, derivative, std)
        for row, change in zip(budget.rows[1:], budget.changes, strict=True)
    ]
    type_a = type_a - sum(
        (
            source.change.T @ source.change
            for source, stated in zip(sources, budget.in_fit, strict=True)
            if stated
        ),
        start=np.zeros_like(type_a),
    )
    known = {c.name: own for c, own in zip(coefficients, degrees.tolist(), strict=True)}
    turned = min(known.get("tan_beta", math.inf), known.get("phi", math.inf))
    own = np.array([turned if name in ("p", "q") else known.get(name, math.inf) for name in design.names])
    limits = np.array(
        [(c.value - c.coverage_factor * c.std, c.value + c.coverage_factor * c.std) for c in coefficients]
    )
    checks = propagate_distributions(base, type_a, np.maximum(own, 1.0), sources, results, limits.T)
    checked = tuple(
        c if check.validated else replace(c, interval=check.shortest)
        for c, check in zip(coefficients, checks, strict=True)
    )
    if weak:
        checked = _weak_coupling(checked)
    return checked, MonteCarlo(_TRIALS, {c.key: check for c, check in zip(coefficients, checks, strict=True)})


def _weak_coupling(coefficients: tuple[Coefficient, ...]) -> tuple[Coefficient, ...]:
    """Coefficients with limits for a size that cannot be negative. With zero among them, phi may be any angle."""
    size = next(c for c in coefficients if c.name == "tan_beta")
    phase = next(c for c in coefficients if c.name == "phi")
    limits = size_limits(size.value, max(size.std, size.value * phase.std), size.degrees_of_freedom)
    circle = (phase.value - math.pi, phase.value + math.pi)
    anywhere = {"tan_beta": limits} | ({"phi": circle} if limits[0] == 0.0 else {})
    return tuple(replace(c, interval=anywhere.get(c.name, c.interval)) for c in coefficients)


def size_limits(value: float, std: float, degrees: float) -> tuple[float, float]:
    """95 % confidence limits of the size of a plane vector, estimated as ``value`` from two components of ``std`` each.

    The estimated size is never zero. An interval about it therefore never includes zero, and neither do Monte
    Carlo trials. The limits here use the exact distribution: ``(value/std)^2`` is noncentral chi-square with 2
    degrees of freedom and noncentrality ``(size/std)^2``. At the lower limit the estimate is the 97.5 % quantile;
    at the upper limit it is the 2.5 % quantile. If no size gives a lower limit (value below 2.72 std), it is 0 and
    the interval is one-sided. The upper limit is at least the value that a size of zero exceeds with probability
    5 %. For few degrees of freedom std is multiplied by the ratio of Student's factor to the normal factor.

    Parameters
    ----------
    value, std:
        Estimate and standard uncertainty of a component, in the same unit.
    degrees:
        Degrees of freedom of ``std``, may be infinite.
    """
    from scipy.special import chdtr, chdtri, chndtrinc, ndtri

    unit = std * coverage_factor(degrees) / coverage_factor(math.inf)
    square = (value / unit) ** 2

    def size_at(probability: float) -> float:
        """Size at which the estimate is the quantile of this probability; 0 if there is none."""
        if chdtr(2.0, square) <= probability:
            return 0.0
        size = float(chndtrinc(square, 2.0, probability))
        return math.sqrt(size) if math.isfinite(size) else value / unit - float(ndtri(probability))

    return size_at(0.975) * unit, max(size_at(0.025), math.sqrt(chdtri(2.0, 0.05))) * unit


def _results(design: Design, coefficients: tuple[Coefficient, ...]) -> Callable[[Array], Array]:
    """Function from column coefficients (trials, m) to file units (trials, n), phi near its estimate."""
    at = {name: index for index, name in enumerate(design.names)}
    near = {c.name: c.value for c in coefficients}

    def results(linear: Array) -> Array:
        scale = (
            linear[:, at["scale_factor"]]
            if "scale_factor" in at
            else np.full(len(linear), design.run.scale_factor)
        )
        columns = {"scale_factor": scale}
        phase = np.zeros(len(linear))
        if "p" in at:
            p, q = linear[:, at["p"]], linear[:, at["q"]]
            phase = np.arctan2(q, p)
            columns["tan_beta"] = np.hypot(p, q) / scale
            columns["phi"] = near["phi"] + short_way(phase - near["phi"])
        for order in design.request.harmonics:
            s, c = linear[:, at[f"s{order}"]], linear[:, at[f"c{order}"]]
            cosine, sine = np.cos(order * phase), np.sin(order * phase)
            columns[f"s{order}"], columns[f"c{order}"] = (
                (s * cosine + c * sine) / scale,
                (c * cosine - s * sine) / scale,
            )
        for name in design.shared_names:
            columns.setdefault(name, linear[:, at[name]] / scale)
        return np.stack(
            [columns[c.name] / (1.0 if c.name == "phi" else si_factor(c.name)) for c in coefficients], axis=1
        )

    return results


def _derivative(results: Callable[[Array], Array], base: Array, std: Array) -> Array:
    """Derivative of the results by the column coefficients (n, m). Central differences with a step of u/1000."""
    steps = np.diag(1e-3 * np.maximum(std, 1e-300))
    moved = results(base + steps) - results(base - steps)
    return (moved / (2.0 * np.diag(steps))[:, None]).T


def _contribution(row: BudgetEntry, changes: Array, derivative: Array, std: Array) -> Contribution:
    """A budget row that changes the results by ``changes`` (draws, n), as changes of the column coefficients."""
    degrees = row.degrees_of_freedom
    return Contribution(
        (std[:, None] * np.linalg.lstsq(derivative * std, changes.T, rcond=None)[0]).T,
        row.distribution,
        math.inf if degrees is None else float(degrees),
    )
