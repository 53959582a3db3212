"""Uncertainty of the coefficients: budget, combined standard uncertainties, and Monte Carlo where the first order fails.

Type B: first order (JCGM 100, 5.1). Each source moves the record by its standard uncertainty. The change of the observations,
less that of the model, is a column of the reduction; what the fit makes of it is the contribution. A source that takes a new
value in each segment moves one segment at a time, which gives one change per segment.

Monte Carlo: propagation of distributions (JCGM 101). The fit is linear in ``K, K tan_beta cos(phi), K tan_beta sin(phi), K k0,
...``. The Type A distribution of these column coefficients is a multivariate t (JCGM 101, 6.4.9.5), and each source of Type B
moves them. Only ``tan_beta = hypot``, ``phi = atan2`` and the division by K are not linear. A trial draws the column
coefficients and takes that step exactly; it needs no new fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from piga.calibration.model.solution import asked_order
from piga.calibration.sources import SourceSummary
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import (
    Amount,
    BudgetEntry,
    BudgetTable,
    Coefficient,
    coverage_factor,
    short_way,
    welch_satterthwaite,
)
from piga.records.calibration.diagnostics import MonteCarlo, MonteCarloCheck
from piga.records.terms import si_factor, unit_of
from piga.results import Array

if TYPE_CHECKING:
    from piga.calibration.joint import JointFit

_TRIALS = 200_000
"""Trials. They give an end of a 95 % interval to 0.6 % of u."""
_RESOLVED = 0.02
"""Least tolerance [u]: three standard deviations of such an end."""
_QUANTILES = 4000
"""Quantiles of the scatter, equally likely."""
_SEED = 101
"""Fixed seed: the same record gives the same digits."""
_DOUBTFUL = 6.0
"""Ratio of tan_beta to its standard uncertainty below which its interval is not linear (Rice-like)."""


@dataclass(frozen=True)
class Budget:
    """The budget of a fit: rows, Type A first, and the coefficients with combined standard uncertainties.

    ``changes``: for each source of Type B, the change of the coefficients by each of its draws (draws, n), in file units.
    ``type_a`` and ``covariance`` are those of Type A and of all sources. ``degrees`` (n,) are the degrees of freedom of Type A.
    """

    rows: tuple[BudgetEntry, ...]
    changes: tuple[Array, ...]
    type_a: Array
    covariance: Array
    degrees: Array
    coefficients: tuple[Coefficient, ...]


def add_up(fit: JointFit, effects: Iterable[tuple[SourceSummary, Array]], more: Mapping[str, Array]) -> Budget:
    """The budget from the changes of the coefficients by each stated source, and by ``more``: rectangular, of these half-widths.

    The covariance of the fit contains the sources that its weights include; it is taken off. Stated uncertainties say nothing
    about how well the noise is known, so the degrees of freedom of Type A grow by the squared share of the variance
    (JCGM 100, eq. G.2b). Combined degrees of freedom: JCGM 100, G.4.
    """
    own, type_a = fit.coefficients, fit.covariance
    std_of_fit, moved = np.maximum(np.diag(type_a), 1e-300), list(effects)
    held = [change.T @ change for source, change in moved if source.in_fit]
    if held:
        type_a = type_a - sum(held, start=np.zeros_like(type_a))
        scale = np.sqrt(np.maximum(np.abs(np.diag(type_a)), 1e-300))
        value, vector = np.linalg.eigh(type_a / np.outer(scale, scale))
        root = scale[:, None] * vector * np.sqrt(np.maximum(value, 0.0))  # rounding can make a value negative
        type_a = root @ root.T
    degrees = fit.degrees * np.maximum(np.diag(type_a) / std_of_fit, 1e-6) ** 2
    std = np.sqrt(np.diag(type_a))
    rows = [budget_row("fit residuals (repeatability)", "A", "normal", None, "", own, std)]
    for s, change in moved:
        whole = change[0] if len(change) == 1 else np.sqrt(np.sum(change**2, axis=0))
        rows.append(budget_row(s.name, "B", s.distribution, s.value, s.unit, own, whole, s.degrees_of_freedom))
    small = {name: half / math.sqrt(3.0) for name, half in more.items()}
    rows += [budget_row(name, "B", "rectangular", None, "", own, part) for name, part in small.items()]
    changes = (*(change for _, change in moved), *(part[None] for part in small.values()))
    covariance = type_a + sum((change.T @ change for change in changes), start=np.zeros_like(type_a))
    parts = np.array([list(row.contributions.values()) for row in rows])
    freedom = np.array([np.full(len(own), row.degrees_of_freedom or math.inf) for row in rows])
    freedom[0] = degrees
    effective = welch_satterthwaite(parts.T, freedom.T)
    coefficients = tuple(
        replace(c, std=float(u), degrees_of_freedom=float(nu))
        for c, u, nu in zip(own, np.sqrt(np.diag(covariance)), effective, strict=True)
    )
    return Budget(tuple(rows), changes, type_a, covariance, degrees, coefficients)


def budget_row(
    source: str,
    kind: Literal["A", "B"],
    distribution: str,
    value: float | None,
    unit: str,
    coefficients: Sequence[Coefficient],
    change: Array,
    degrees: float | None = None,
) -> BudgetEntry:
    """A row of the budget; contributions in file units.

    A contribution is the change of a coefficient by one standard uncertainty ``value`` of the source. Degrees of freedom
    None: known exactly, or one number per coefficient (Type A).
    """
    return BudgetEntry(
        source=source,
        type=kind,
        distribution=distribution,
        standard_uncertainty=None if value is None else Amount(value, unit),
        degrees_of_freedom=degrees,
        contributions={c.key: float(part) for c, part in zip(coefficients, change, strict=True)},
    )


def with_given_servo(
    result: Calibration, known: Mapping[str, float], moved: Mapping[str, Mapping[str, float]]
) -> Calibration:
    """The result with the given coefficients of the servo appended. They were not estimated.

    They are part of the model to which K belongs. A compensation needs them.

    Parameters
    ----------
    result:
        The calibration.
    known:
        Given coefficients [1/(m/s^2)^2]. Those that are estimated are skipped.
    moved:
        By budget row: the given coefficients, moved by the standard uncertainty of the source.
    """
    names = [name for name in known if name not in result.terms]
    if not names:
        return result
    factors = np.array([si_factor(name) for name in names])
    values = np.array([known[name] for name in names]) / factors
    sizes = [[moved.get(row.source, known)[name] for name in names] for row in result.budget]
    changes = np.array(sizes) / factors - values
    others = np.array([[row.contributions[c.key] for c in result.coefficients] for row in result.budget])
    own, cross = changes.T @ changes, changes.T @ others
    std = np.sqrt(np.diag(own)).tolist()
    given = [Coefficient(n, float(v), u, unit_of(n)) for n, v, u in zip(names, values, std, strict=True)]
    rows = []
    for row, change in zip(result.budget, changes, strict=True):
        size = row.standard_uncertainty or Amount(0.0, "")
        more = budget_row(row.source, row.type, row.distribution, size.value, size.unit, given, change)
        rows.append(replace(row, contributions=row.contributions | more.contributions))
    return replace(
        result,
        terms=(*result.terms, *names),
        coefficients=(*result.coefficients, *given),
        covariance=np.block([[result.covariance, cross.T], [cross, own]]),
        budget=BudgetTable(tuple(rows)),
    )


def monte_carlo_intervals(fit: JointFit, budget: Budget) -> tuple[tuple[Coefficient, ...], MonteCarlo | None]:
    """Coefficients with Monte Carlo intervals where the first order fails, and the comparison for the report.

    The run file asks for "gum", "monte-carlo" or "auto" (Monte Carlo when tan_beta is not well above its noise). Several runs,
    records with several phases, and methods other than whitened least squares always use the first order.
    """
    live, coefficients = fit.only, budget.coefficients
    wanted = "gum" if live is None else live.design.run.estimation.uncertainty
    weak = any(c.name == "tan_beta" and c.value < _DOUBTFUL * c.std for c in coefficients)
    able = live is not None and live.design.mode == "increments" and len(fit.estimate.jacobians) == 1
    if wanted == "gum" or not able or (wanted == "auto" and not weak):
        return coefficients, None
    base, names, results = fit.values_of(fit.estimate, 0)[0], fit.wanted(0), _results(fit)
    jacobian = fit.estimate.jacobians[0]
    std = np.sqrt(np.diag(jacobian @ fit.interval.covariance @ jacobian.T))
    steps = np.diag(1e-3 * np.maximum(std, 1e-300))
    slope = (results(base + steps) - results(base - steps)).T / (2.0 * np.diag(steps))
    linear = std[:, None] * np.linalg.pinv(slope * std)
    sources = [
        (change @ linear.T, row.distribution, row.degrees_of_freedom or math.inf)
        for row, change in zip(budget.rows[1:], budget.changes, strict=True)
    ]
    degrees = {c.name: own for c, own in zip(coefficients, budget.degrees.tolist(), strict=True)}
    turned = min(degrees.get("tan_beta", math.inf), degrees.get("phi", math.inf))
    own = [turned if name in ("p", "q") else degrees.get(name, math.inf) for name in names]
    type_a = linear @ budget.type_a @ linear.T
    limits = np.array([c.limits for c in coefficients]).T
    checks = propagate_distributions(base, type_a, np.maximum(own, 1.0), sources, results, limits)
    checked = tuple(
        c if check.validated else replace(c, interval=check.shortest)
        for c, check in zip(coefficients, checks, strict=True)
    )
    table = {c.key: check for c, check in zip(coefficients, checks, strict=True)}
    return _weak_coupling(checked) if weak else checked, MonteCarlo(_TRIALS, table)


def _results(fit: JointFit) -> Callable[[Array], Array]:
    """Function from column coefficients (trials, m) of the only phase group to file units (trials, n), phi near its estimate."""
    layout = fit.layout
    names = [*(name for name, _ in layout.amplitude_keys), *("phi",) * layout.coupled]
    order = asked_order(layout, fit.terms, int(layout.coupled))
    units = np.array([si_factor(name) for name in names])
    near = next((c.value for c in fit.coefficients if c.name == "phi"), 0.0)

    def results(linear: Array) -> Array:
        columns: Array = linear.T
        phase: Any = np.zeros(len(linear))
        if layout.coupled:
            phase = np.arctan2(columns[1], columns[0])
        amplitudes = layout.from_linear(columns, phase) if layout.local else columns
        at = names.index("scale_factor") if "scale_factor" in names else None
        scale = fit.summaries[0].scale_factor if at is None else amplitudes[at]
        values = amplitudes / scale
        if at is not None:
            values[at] = scale
        if layout.coupled:
            values = np.vstack([values, near + short_way(phase - near)])
        return (values / units[:, None])[order].T

    return results


def source_draws(count: int, distribution: str, degrees: float, size: int, rng: np.random.Generator) -> Array:
    """Trials (size, count) of the draws of a source, of unit standard uncertainty; for t, the scaled t of JCGM 101, 6.4.9.

    The draws are independent. For t, all draws of a trial share one estimate of the standard uncertainty.
    """
    shape = (count, size)
    if distribution == "rectangular":
        return rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), shape).T
    if distribution == "triangular":
        return rng.triangular(-math.sqrt(6.0), 0.0, math.sqrt(6.0), shape).T
    if distribution == "arcsine":
        return math.sqrt(2.0) * np.cos(rng.uniform(0.0, math.pi, shape)).T
    drawn = rng.standard_normal(shape)
    if distribution == "t":
        drawn *= np.sqrt(degrees / rng.chisquare(degrees, size))
    return drawn.T


def propagate_distributions(
    base: Array,
    covariance: Array,
    degrees: ArrayLike,
    sources: Sequence[tuple[Array, str, float]],
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
        Sources of Type B: change of the parameters per standard uncertainty (draws, n), distribution, degrees of freedom.
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
    level, above = rng.integers(_QUANTILES, size=trials), (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    for column, own in enumerate(np.broadcast_to(degrees, base.size)):
        if math.isfinite(own):
            draws[:, column] *= np.sqrt(own / chdtri(own, above))[level]
    for change, shape, own in sources:
        draws += source_draws(len(change), shape, own, trials, rng) @ change
    ordered = np.sort(results(base + draws), axis=0)
    std = ordered.std(axis=0, ddof=1)
    symmetric = np.quantile(ordered, (0.025, 0.975), axis=0)
    # the standard deviation of few degrees of freedom is unbounded
    size = np.minimum(std, 0.5 * np.ptp(symmetric, axis=0))
    digit = 10.0 ** (np.floor(np.log10(np.maximum(np.round(size, 300), 1e-300))) - 1.0)
    delta = np.maximum(0.5 * digit, _RESOLVED * size)
    agrees = np.max(np.abs(first_order - symmetric), axis=0) <= delta
    inside, at = round(0.95 * trials), np.arange(std.size)
    start = np.argmin(ordered[inside:] - ordered[:-inside], axis=0)
    shortest = np.stack([ordered[start, at], ordered[start + inside, at]])
    ends = ((tuple(pair) for pair in limits.T.tolist()) for limits in (symmetric, shortest, first_order))
    numbers = zip(
        ordered.mean(axis=0).tolist(), std.tolist(), *ends, delta.tolist(), agrees.tolist(), strict=True
    )
    return [MonteCarloCheck(*own) for own in numbers]


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
