"""What chance allows: bounds of a variance that was estimated from a number of draws."""

from __future__ import annotations

from scipy import stats

RARE = 1e-3
"""Probability that a right program is outside the bounds, both sides together. The seeds of the tests are fixed."""


def variance_bounds(degrees: float, probability: float = RARE) -> tuple[float, float]:
    """Bounds of an estimated variance over the true one: chi-square with so many degrees of freedom."""
    low, high = stats.chi2.ppf([0.5 * probability, 1.0 - 0.5 * probability], degrees) / degrees
    return float(low), float(high)


def assert_variance(ratio: float, degrees: float, what: str = "variance") -> None:
    """Estimated over true variance lies where chi-square allows it."""
    low, high = variance_bounds(degrees)
    assert low < ratio < high, f"{what}: {ratio:.3g} times the true one; chance allows {low:.2f} to {high:.2f}"
