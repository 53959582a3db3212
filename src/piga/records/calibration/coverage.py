"""Coverage: factor k, expanded uncertainty U and limits of a coefficient, and the factor of a joint region.

Every number for 95 % comes from this module. Terminal, report, calibration.json, certificate, DCC, decision rules,
ledger and trend call :func:`coverage`. Only the joint region of a DCC uses another factor, :func:`joint_factor`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from piga.records.calibration import Coefficient

PROBABILITY = 0.95
"""Coverage probability of every interval that piga states."""
TYPE_A_ONLY = "Type A only; the reference's uncertainty was not given"
"""Remark beside every uncertainty of a calibration whose budget has no source of Type B."""
OF_THE_MODEL = ("servo ", "k3 ", "meaning of ")
"""Prefixes of the names of Type B sources that belong to the model, not to the reference."""
ALMOST_KNOWN = 1e9
"""From this number of degrees of freedom on, F(n, nu) equals F(n, infinity) to every printed digit."""


@dataclass(frozen=True)
class Coverage:
    """95 % coverage of one coefficient, in the coefficient's unit.

    ``factor`` is k. It is nan if ``monte_carlo`` is True: a Monte Carlo interval has no factor (JCGM 101, 5.3).
    ``half_width`` is U: k u, or half the Monte Carlo interval. ``low`` and ``high`` are the limits of the interval.
    Without Monte Carlo they are value -+ U.
    """

    factor: float
    half_width: float
    low: float
    high: float
    monte_carlo: bool


def is_of_reference(source: str) -> bool:
    """True for a source of Type B that describes the reference, the clock, the thermometer or the stand."""
    return not source.startswith(OF_THE_MODEL)


@overload
def coverage_factor(degrees_of_freedom: float, probability: float = PROBABILITY) -> float: ...


@overload
def coverage_factor(
    degrees_of_freedom: NDArray[np.float64], probability: float = PROBABILITY
) -> NDArray[np.float64]: ...


def coverage_factor(
    degrees_of_freedom: float | NDArray[np.float64], probability: float = PROBABILITY
) -> float | NDArray[np.float64]:
    """Student's t for a two-sided interval of this probability (JCGM 100, G.3), one number or an array.

    Infinite degrees of freedom give the factor of the normal distribution. Zero or unknown degrees of freedom give nan.
    """
    from scipy.special import ndtri, stdtrit

    tail = 0.5 * (1.0 + probability)
    if isinstance(degrees_of_freedom, np.ndarray):
        known = np.isinf(degrees_of_freedom)
        return np.where(known, ndtri(tail), stdtrit(np.where(known, 1.0, degrees_of_freedom), tail))
    return float(ndtri(tail) if math.isinf(degrees_of_freedom) else stdtrit(degrees_of_freedom, tail))


def welch_satterthwaite(components: ArrayLike, degrees: ArrayLike) -> Any:
    """Degrees of freedom of a sum of independent components (JCGM 100, eq. G.2b).

    Parameters
    ----------
    components:
        (..., n) standard uncertainties of the components, in one unit.
    degrees:
        (..., n) their degrees of freedom; ``inf`` where a component is known.

    Returns
    -------
    float, or array (...,) where several sums are given.
    """
    u, nu = np.abs(np.asarray(components, dtype=float)), np.asarray(degrees, dtype=float)
    largest = u.max(axis=-1, initial=0.0)
    share = (u / np.where(largest == 0.0, 1.0, largest)[..., None]) ** 2
    known = np.sum(share**2 / nu, axis=-1)
    certain = known == 0.0
    result = np.where(certain, math.inf, np.sum(share, axis=-1) ** 2 / np.where(certain, 1.0, known))
    return float(result) if result.ndim == 0 else result


def coverage(coefficient: Coefficient) -> Coverage:
    """Coverage factor, expanded uncertainty and limits of a coefficient for 95 %.

    ``U = k u``, with k from Student's t for the coefficient's effective degrees of freedom (JCGM 100, G.4). If a Monte
    Carlo propagation replaced the first order (``coefficient.interval``), its interval is used instead (JCGM 101, 8.1).
    """
    if coefficient.interval is not None:
        low, high = coefficient.interval
        return Coverage(math.nan, 0.5 * (high - low), low, high, monte_carlo=True)
    factor = coverage_factor(coefficient.degrees_of_freedom)
    half = factor * coefficient.std
    return Coverage(factor, half, coefficient.value - half, coefficient.value + half, monte_carlo=False)


def joint_factor(coefficients: Iterable[Coefficient]) -> float:
    """Coverage factor of the ellipsoid that holds all coefficients together with 95 %.

    The region is ``(x - y)' V^-1 (x - y) <= k_p^2`` (JCGM 102, 6.5.2). Suppose one
    estimated variance with nu degrees of freedom scales the whole covariance V of n coefficients. Then the quadratic
    form over n is distributed as F(n, nu), and ``k_p = sqrt(n F_0.95(n, nu))``. Here each coefficient has its own
    degrees of freedom, and nu is the smallest of them. The result is exact if all are equal; otherwise the region
    holds at least 95 %. Infinite degrees of freedom give ``sqrt(chi2_0.95(n))``.
    """
    from scipy.special import chdtri, fdtri

    degrees = [coefficient.degrees_of_freedom for coefficient in coefficients]
    count, fewest = len(degrees), min(degrees)
    if fewest > ALMOST_KNOWN:
        return math.sqrt(float(chdtri(count, 1.0 - PROBABILITY)))
    return math.sqrt(count * float(fdtri(count, fewest, PROBABILITY)))
