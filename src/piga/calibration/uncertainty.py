"""Uncertainty budget: one row per source, and the effect of the sources of Type B on the coefficients.

Type B: first order (JCGM 100, 5.1). Each source moves the record by its standard uncertainty. The change of the observations,
less that of the model, is a column of the reduction; what the fit makes of it is the contribution. A source that takes a new
value in each segment moves one segment at a time, which gives one change per segment.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from piga.calibration.sources import Source, across_squared, sources, with_units
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import (
    Amount,
    BudgetEntry,
    BudgetTable,
    Coefficient,
    welch_satterthwaite,
)
from piga.records.run import Run
from piga.records.terms import si_factor, unit_of
from piga.results import Array

if TYPE_CHECKING:
    from piga.calibration.summary import SourceSummary


def stated_scatter(run: Run) -> tuple[float, ...]:
    """Variance [rad^2/s^2] of the mean rate of every segment (m,) by the sources with a new value in each segment.

    It is the sum over these sources of the squared ``K`` times mean change of the axial specific force. Empty without such a
    source.
    """
    variance = np.zeros(len(run.labels))
    count = np.bincount(run.segment_index, minlength=variance.size)
    for source in sources(run):
        if source.draw == "segment":
            axial = source.moved.f[:, 0] - run.f[:, 0]
            change = np.bincount(run.segment_index, axial, minlength=variance.size)
            variance += (run.scale_factor * change / count) ** 2
    return tuple(variance.tolist()) if variance.any() else ()


@dataclass(frozen=True)
class Budget:
    """Rows of the budget, Type A first, and the sources of Type B behind them.

    ``changes``: for each source, the change of the coefficients by each of its draws (draws, n), in file units.
    ``in_fit``: True where the weights of the fit include the source. The covariance of the fit then includes it.
    """

    rows: tuple[BudgetEntry, ...]
    changes: tuple[Array, ...]
    in_fit: tuple[bool, ...]

    def with_row(self, row: BudgetEntry) -> Budget:
        """The budget with one more source, of one draw, that is not in the weights."""
        change = np.array(list(row.contributions.values()))[None]
        return Budget((*self.rows, row), (*self.changes, change), (*self.in_fit, False))

    def covariances(self, covariance: Array) -> tuple[Array, Array]:
        """Type A covariance and combined covariance, from the covariance of the fit."""
        each = [change.T @ change for change in self.changes]
        nothing = np.zeros_like(covariance)
        held = sum((part for part, stated in zip(each, self.in_fit, strict=True) if stated), start=nothing)
        type_a = _positive_part(covariance - held) if any(self.in_fit) else covariance
        return type_a, type_a + sum(each, start=nothing)


def _positive_part(covariance: Array) -> Array:
    """The matrix without negative eigenvalues of its correlations, which rounding can cause."""
    std = np.sqrt(np.maximum(np.abs(np.diag(covariance)), 1e-300))
    value, vector = np.linalg.eigh(covariance / np.outer(std, std))
    root = std[:, None] * vector * np.sqrt(np.maximum(value, 0.0))
    positive: Array = root @ root.T
    return positive


def share_of_type_a(type_a: Array, covariance: Array) -> Array:
    """Factor on the degrees of freedom of the fit for its Type A part: the squared Type A share of the variance.

    Stated uncertainties say nothing about how well the noise is known (JCGM 100, eq. G.2b).
    """
    share: Array = np.maximum(np.diag(type_a) / np.maximum(np.diag(covariance), 1e-300), 1e-6) ** 2
    return share


def units_of(run: Run) -> list[Source]:
    """One unit of each source that nobody stated, and 1 ug/g^3 of a servo, averaged over turns of the output.

    Such a servo lowers the output, as a reference that is as much too large.
    """
    unit = 1e-6 * si_factor("servo")

    def force(part: slice) -> Array:
        change = np.zeros_like(run.f[part])
        change[:, 0] = unit * run.f[part, 0] * across_squared(run, part)
        return change

    unstated = [source for source in sources(with_units(run)) if "servo" not in source.fields]
    return [*unstated, Source(run, "servo", 1.0, "ug/g^3", force=force)]


def budget_of(
    coefficients: tuple[Coefficient, ...],
    covariance: Array,
    changes_by_source: Sequence[tuple[SourceSummary, Array]],
) -> Budget:
    """The budget from the changes of the coefficients by each source; ``covariance`` is that of the fit."""
    changes = tuple(change for _, change in changes_by_source)
    in_fit = tuple(source.in_fit for source, _ in changes_by_source)
    type_a = Budget((), changes, in_fit).covariances(covariance)[0]
    return Budget(_budget_rows(coefficients, type_a, changes_by_source), changes, in_fit)


def _budget_rows(
    coefficients: tuple[Coefficient, ...],
    type_a: Array,
    changes: Iterable[tuple[SourceSummary, Array]],
) -> tuple[BudgetEntry, ...]:
    """Rows of the budget: Type A with its covariance, then each source with its changes (draws, n)."""
    std = np.sqrt(np.diag(type_a))
    rows = [budget_row("fit residuals (repeatability)", "A", "normal", None, "", coefficients, std)]
    for source, change in changes:
        degrees = source.degrees_of_freedom if math.isfinite(source.degrees_of_freedom) else None
        shape, size, unit = source.distribution, source.value, source.unit
        rows.append(budget_row(source.name, "B", shape, size, unit, coefficients, together(change), degrees))
    return tuple(rows)


def together(changes: Array) -> Array:
    """Standard uncertainty (n,) of a source from all its draws (draws, n); with one draw, the change itself."""
    return changes[0] if len(changes) == 1 else np.sqrt(np.sum(changes**2, axis=0))


def propagate(sensitivities: Array, covariance: Array) -> Array:
    """Covariance of results from the covariance V of their inputs: ``C V C'`` (JCGM 100, eq. 13 and H.9).

    First order. ``sensitivities`` (results, inputs) are the partial derivatives C.
    """
    return sensitivities @ covariance @ sensitivities.T


def combined(
    coefficients: tuple[Coefficient, ...], covariance: Array, budget: tuple[BudgetEntry, ...], type_a: Array
) -> tuple[Coefficient, ...]:
    """Coefficients with combined standard uncertainty and effective degrees of freedom (JCGM 100, G.4).

    ``type_a`` (n,) are the degrees of freedom of the budget's first row.
    """
    result = []
    for coefficient, std, nu in zip(coefficients, np.sqrt(np.diag(covariance)), type_a, strict=True):
        parts = [row.contributions[coefficient.key] for row in budget]
        known = [row.degrees_of_freedom or math.inf for row in budget[1:]]
        degrees = welch_satterthwaite(parts, [nu, *known])
        result.append(replace(coefficient, std=float(std), degrees_of_freedom=degrees))
    return tuple(result)


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
    """A row of the budget; contributions in file units, and sensitivities where a source has a size.

    A contribution is the change of a coefficient by one standard uncertainty ``value`` of the source. A sensitivity
    is the change by one ``unit`` of it (JCGM 100, 5.1.3). Degrees of freedom None: known exactly, or one number
    per coefficient (Type A).
    """
    parts = [(c, float(part)) for c, part in zip(coefficients, change, strict=True)]
    return BudgetEntry(
        source=source,
        type=kind,
        distribution=distribution,
        standard_uncertainty=None if value is None else Amount(value, unit),
        degrees_of_freedom=degrees,
        contributions={c.key: part for c, part in parts},
        sensitivities={c.key: Amount(part / value, _per(c.unit, unit)) for c, part in parts} if value else {},
    )


def _per(unit: str, source: str) -> str:
    """Unit of a sensitivity: unit of the coefficient per unit of the source."""
    if source in ("", "1"):
        return unit
    return f"{unit}/({source})" if "/" in source or "*" in source else f"{unit}/{source}"


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
    changes = [
        np.array([moved.get(row.source, known)[name] for name in names]) / factors - values
        for row in result.budget
    ]
    size = len(result.coefficients)
    covariance = np.zeros((size + len(names),) * 2)
    covariance[:size, :size] = result.covariance
    for row, change in zip(result.budget, changes, strict=True):
        others = np.array([row.contributions[c.key] for c in result.coefficients])
        covariance[size:, :size] += np.outer(change, others)
        covariance[size:, size:] += np.outer(change, change)
    covariance[:size, size:] = covariance[size:, :size].T
    std = np.sqrt(np.diag(covariance)[size:])
    given = [Coefficient(n, float(v), float(u), unit_of(n)) for n, v, u in zip(names, values, std, strict=True)]
    return replace(
        result,
        terms=(*result.terms, *names),
        coefficients=(*result.coefficients, *given),
        covariance=covariance,
        budget=BudgetTable(
            tuple(_extended(row, given, change) for row, change in zip(result.budget, changes, strict=True))
        ),
    )


def _extended(row: BudgetEntry, coefficients: Sequence[Coefficient], change: Array) -> BudgetEntry:
    """A row of the budget extended by more coefficients."""
    size = row.standard_uncertainty
    value, unit = (size.value, size.unit) if size is not None else (None, "")
    more = budget_row(row.source, row.type, row.distribution, value, unit, coefficients, change)
    return replace(
        row,
        contributions=row.contributions | more.contributions,
        sensitivities=row.sensitivities | more.sensitivities if row.sensitivities else {},
    )
