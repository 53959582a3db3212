"""Uncertainty budget: one row per source with its contribution to every coefficient."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from piga.calibration.coefficients import name_coefficients
from piga.calibration.degrees_of_freedom import welch_satterthwaite
from piga.calibration.solution import solve
from piga.calibration.uncertainty import contributions
from piga.calibration.weighting import reduce_segments
from piga.records.calibration import Coefficient
from piga.records.run import Run

if TYPE_CHECKING:
    from piga.calibration.fit import Fit

Array = NDArray[np.float64]


def make_budget(
    fit: Fit, groups: tuple[int, ...], per_segment: bool, coefficients: tuple[Coefficient, ...], type_a: Array
) -> tuple[tuple[dict[str, Any], ...], Array]:
    """Budget rows (one per source, contribution to every coefficient) and the covariance of Type B."""
    base = np.array([coefficient.value for coefficient in coefficients])
    turns = np.array([coefficient.name == "phi" for coefficient in coefficients])

    def estimate(run: Run) -> Array:
        design = fit.design.of(run)
        summaries = (
            fit.counted.reduce(design) if fit.counted else reduce_segments(design, fit.mode, fit.weights)
        )
        solution = solve(design, summaries, groups)
        named, _ = name_coefficients(design, solution, solution.covariance, per_segment)
        values = np.array([coefficient.value for coefficient in named])
        return np.where(turns, base + np.angle(np.exp(1j * (values - base))), values)

    rows = [budget_row("fit residuals (repeatability)", "A", "normal", None, "", coefficients, type_a)]
    covariance = np.zeros((base.size, base.size))
    for source, change in contributions(fit.design.run, base, estimate):
        covariance += np.outer(change, change)
        degrees = source.degrees_of_freedom if math.isfinite(source.degrees_of_freedom) else None
        shape, size, unit = source.distribution, source.value, source.unit
        rows.append(budget_row(source.name, "B", shape, size, unit, coefficients, change, degrees))
    return tuple(rows), covariance


def propagate(sensitivities: Array, covariance: Array) -> Array:
    """Covariance of results from that of their inputs, first order (JCGM 100, eq. 13 and H.9): ``C V C'``.

    ``sensitivities`` (results, inputs) are partial derivatives.
    """
    return sensitivities @ covariance @ sensitivities.T


def combined(
    coefficients: tuple[Coefficient, ...], covariance: Array, budget: tuple[dict[str, Any], ...], type_a: Array
) -> tuple[Coefficient, ...]:
    """Coefficients with combined standard uncertainty and effective degrees of freedom (JCGM 100, G.4).

    ``type_a`` (n,) are the degrees of freedom of the budget's first row.
    """
    result = []
    for coefficient, std, nu in zip(coefficients, np.sqrt(np.diag(covariance)), type_a, strict=True):
        parts = [row["contributions"][coefficient.key] for row in budget]
        known = [row["degrees_of_freedom"] or math.inf for row in budget[1:]]
        degrees = welch_satterthwaite(parts, [nu, *known])
        result.append(replace(coefficient, std=float(std), degrees_of_freedom=degrees))
    return tuple(result)


def budget_row(
    source: str,
    kind: str,
    distribution: str,
    value: float | None,
    unit: str,
    coefficients: Sequence[Coefficient],
    change: Array,
    degrees: float | None = None,
) -> dict[str, Any]:
    """A row of the budget; contributions in file units, and sensitivities where a source has a size.

    The contribution is the change of a coefficient that one standard uncertainty ``value`` of the source makes,
    the sensitivity that of one ``unit`` of it (JCGM 100, 5.1.3). Degrees of freedom None: known exactly, or one
    per coefficient (Type A).
    """
    parts = [(c, float(part)) for c, part in zip(coefficients, change, strict=True)]
    row: dict[str, Any] = {
        "source": source,
        "type": kind,
        "distribution": distribution,
        "standard_uncertainty": None if value is None else {"value": value, "unit": unit},
        "degrees_of_freedom": degrees,
        "contributions": {c.key: part for c, part in parts},
    }
    if value:
        row["sensitivities"] = {c.key: {"value": part / value, "unit": _per(c.unit, unit)} for c, part in parts}
    return row


def _per(unit: str, source: str) -> str:
    """Unit of a sensitivity: that of the coefficient per that of the source."""
    if source in ("", "1"):
        return unit
    return f"{unit}/({source})" if "/" in source or "*" in source else f"{unit}/{source}"
