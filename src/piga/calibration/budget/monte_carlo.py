"""Propagation of distributions (JCGM 101) beside the first-order one (JCGM 100), and their comparison.

The fit is linear in ``K, K tan_beta cos(phi), K tan_beta sin(phi), K k0, ...``, so that its Type A
distribution there is a multivariate t (JCGM 101, 6.4.9.5) and each source of Type B moves them by its own
sensitivities; only the step to ``tan_beta = hypot``, ``phi = atan2`` and the division by K is not linear. Trials
draw in the linear parameters and take that step exactly: they cost no fit each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCK = 10_000
"""Trials of a block; the adaptive procedure looks after each (JCGM 101, 7.9.4)."""
MOST = 1_000_000
SEED = 101
"""Trials are repeatable: the same record gives the same digits."""


@dataclass(frozen=True)
class Contribution:
    """A source of Type B: change of the linear parameters per standard uncertainty, distribution, dof.

    ``change`` (draws, n): each row is drawn by itself; the draws share what is known of the standard uncertainty.
    """

    change: Array
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf


@dataclass(frozen=True)
class Propagated:
    """Per result: estimate, standard uncertainty, 95 % intervals (2, n) both ways, and the verdict.

    ``tolerance`` is delta of JCGM 101, 7.9.2, for two significant digits; ``validated`` says where the
    first-order interval agrees with the symmetric one within it (clause 8.1).
    """

    trials: int
    mean: Array
    std: Array
    symmetric: Array
    shortest: Array
    tolerance: Array
    validated: NDArray[np.bool_]


def standard_draws(distribution: str, degrees: float, size: int, rng: np.random.Generator) -> Array:
    """Draws of unit standard uncertainty; t: scaled and shifted t as JCGM 101, 6.4.9, has it."""
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
    """Trials (size, draws) of a source; of a t distribution all draws of a trial have one estimate of the scale."""
    shape, count = source.distribution, len(np.atleast_2d(source.change))
    if shape == "t" and count > 1:
        degrees = source.degrees_of_freedom
        return rng.standard_normal((size, count)) * np.sqrt(degrees / rng.chisquare(degrees, size))[:, None]
    return np.column_stack([standard_draws(shape, source.degrees_of_freedom, size, rng) for _ in range(count)])


def tolerance(u: Array) -> Array:
    """Numerical tolerance ``delta = 10^l/2`` for two significant digits of u (JCGM 101, 7.9.2)."""
    exponent = np.floor(np.log10(np.maximum(np.round(u, 300), 1e-300))) - 1.0
    return 0.5 * 10.0**exponent


def shortest_interval(ordered: Array) -> Array:
    """Shortest interval holding 95 % of sorted trials (trials, n), shape (2, n) (JCGM 101, 5.3.4)."""
    inside = round(0.95 * ordered.shape[0])
    widths = ordered[inside:] - ordered[:-inside]
    at, columns = np.argmin(widths, axis=0), np.arange(ordered.shape[1])
    return np.stack([ordered[at, columns], ordered[at + inside, columns]])


def propagate_distributions(
    base: Array,
    covariance: Array,
    degrees: float,
    sources: list[Contribution],
    results: Callable[[Array], Array],
    first_order: Array,
    *,
    trials: int | None = None,
) -> Propagated:
    """Propagate distributions through ``results``.

    Parameters
    ----------
    base, covariance, degrees:
        Linear parameters (n,), their Type A covariance and its degrees of freedom.
    sources:
        Sources of Type B.
    results:
        From draws (trials, n) to results (trials, m).
    first_order:
        Ends of the first-order intervals, (2, m), that are put to the test.
    trials:
        A fixed number; None: adaptive, until every figure is stable to its tolerance, at most ``MOST``.
    """
    values: list[Array] = []
    figures: list[Array] = []
    for block in _blocks(base, covariance, degrees, sources):
        values.append(results(block))
        if len(values) * BLOCK >= (MOST if trials is None else trials):
            break
        if trials is None:
            figures.append(_figures(values[-1]))
            if len(values) > 1 and _stable(np.array(figures)):
                break
    drawn = np.sort(np.concatenate(values)[: trials or MOST], axis=0)
    std = drawn.std(axis=0, ddof=1)
    symmetric = np.quantile(drawn, (0.025, 0.975), axis=0)
    delta = tolerance(std)
    agrees = np.max(np.abs(first_order - symmetric), axis=0) <= delta
    return Propagated(
        drawn.shape[0], drawn.mean(axis=0), std, symmetric, shortest_interval(drawn), delta, agrees
    )


def _blocks(base: Array, covariance: Array, degrees: float, sources: list[Contribution]) -> Iterator[Array]:
    rng = np.random.default_rng(SEED)
    values, vectors = np.linalg.eigh(covariance)
    factor = vectors * np.sqrt(np.maximum(values, 0.0))
    while True:
        drawn = rng.standard_normal((BLOCK, base.size)) @ factor.T
        if math.isfinite(degrees):
            drawn *= np.sqrt(degrees / rng.chisquare(degrees, BLOCK))[:, None]
        for source in sources:
            drawn += source_draws(source, BLOCK, rng) @ np.atleast_2d(source.change)
        yield base + drawn


def _figures(block: Array) -> Array:
    """Mean, standard deviation and both ends of the 95 % interval of a block of trials, (4, m)."""
    ends = np.quantile(block, (0.025, 0.975), axis=0)
    return np.stack([block.mean(axis=0), block.std(axis=0, ddof=1), *ends])


def _stable(figures: Array) -> bool:
    """JCGM 101, 7.9.4: twice the standard deviation of the average of every figure is below the tolerance.

    ``figures`` (blocks, 4, m); the standard deviation of all trials is put together from those of the blocks.
    """
    count = len(figures)
    spread = figures.std(axis=0, ddof=1) / math.sqrt(count)
    within = (BLOCK - 1) * np.sum(figures[:, 1] ** 2, axis=0)
    between = BLOCK * (count - 1) * figures[:, 0].var(axis=0, ddof=1)
    std = np.sqrt((within + between) / (count * BLOCK - 1))
    return bool((2.0 * spread <= tolerance(std)).all())
