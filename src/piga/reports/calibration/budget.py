"""The uncertainty budget of a calibration as tables."""

from __future__ import annotations

import math
from dataclasses import replace

from piga.records.calibration import BudgetEntry, Calibration, Coefficient
from piga.records.terms import shown_unit
from piga.reports.calibration.tables import ACROSS, COEFFICIENTS, NEGLIGIBLE, SHORT_ACROSS, common_coefficients
from piga.reports.render.numbers import pretty_unit, short
from piga.reports.render.page import Cell, Table, TableOf

DESCRIBED = 5
"""Columns of the budget that describe a source: name, type, distribution, standard uncertainty, degrees of freedom."""


def budget_table(cal: Calibration) -> Table:
    """Uncertainty budget: one row per source, one column per coefficient, combined at the end.

    Without an entry of Type A the standard uncertainties of the fit are put first.
    """
    coefficients = common_coefficients(cal)[:COEFFICIENTS]
    sources = _sources(cal, coefficients)
    total = {c.key: math.hypot(*(source.contribution(c) for source in sources)) for c in coefficients}
    table = (
        TableOf(sources)
        .text("Source", lambda row: row.source)
        .text("Type", lambda row: row.type)
        .text("Distribution", lambda row: row.distribution)
        .text("Standard uncertainty", _entered)
        .number("Degrees of freedom", _degrees)
        .across(
            coefficients,
            lambda c: c.key,
            lambda row, c: _contribution(row.contribution(c), c, total[c.key]),
            lambda c: pretty_unit(shown_unit(c.name, c.unit)[1]),
        )
        .table(
            notes=(
                "Sensitivity times standard uncertainty of the source, and its share of the combined variance.",
            )
        )
    )
    if len(sources) < 2:
        return table
    whole = [_contribution(total[c.key], c) for c in coefficients]
    combined: tuple[str | Cell, ...] = ("Combined", "", "", "–", "", *whole)
    return replace(table, rows=(*table.rows, combined))


def _entered(row: BudgetEntry) -> str:
    given = row.standard_uncertainty
    return f"{short(given.value)} {pretty_unit(given.unit)}".strip() if given else "–"


def _degrees(row: BudgetEntry) -> str:
    if row.type == "A":
        return "see above"
    degrees = row.degrees_of_freedom
    return "∞" if degrees is None else short(degrees, 3) if degrees else ""


def _contribution(part: float, c: Coefficient, whole: float = 0.0) -> Cell:
    """Contribution to a coefficient, with its share of the variance ``whole`` squared."""
    part = abs(part)
    if part <= NEGLIGIBLE * c.std:
        return Cell("–", "quiet")
    share = f" ({100.0 * (part / whole) ** 2:.0f} %)" if whole > 0.0 else ""
    return Cell(short(part * shown_unit(c.name, c.unit)[0], 2) + share)


def budget_shares(cal: Calibration) -> tuple[list[str], dict[str, list[float]]]:
    """Keys of the coefficients with a budget, and the share [%] of each source in the variance of each."""
    coefficients = [c for c in common_coefficients(cal)[:COEFFICIENTS] if c.std > 0.0]
    sources = _sources(cal, coefficients)
    total = {c.key: math.hypot(*(source.contribution(c) for source in sources)) for c in coefficients}
    known = [c for c in coefficients if total[c.key] > 0.0]
    shares = {
        source.source: [100.0 * (source.contribution(c) / total[c.key]) ** 2 for c in known]
        for source in sources
    }
    return [c.key for c in known], shares


def _sources(cal: Calibration, coefficients: list[Coefficient]) -> list[BudgetEntry]:
    """Rows of the budget; without one of Type A the standard uncertainties of the fit come first."""
    sources = list(cal.budget)
    if not any(source.type == "A" for source in sources):
        fit = {coefficient.key: coefficient.std for coefficient in coefficients}
        sources.insert(0, BudgetEntry(source="Fit to the record", type="A", distribution="", contributions=fit))
    return sources


def budget_tables(cal: Calibration) -> tuple[Table, ...]:
    """The budget for the page: the sources, then what each adds to the coefficients, as many as fit the page."""
    whole = budget_table(cal)
    sources = whole.only(range(DESCRIBED))
    rows = tuple(row for row in sources.rows if row[1])
    contributions = whole.only([0, *range(DESCRIBED, len(whole.columns))])
    return (replace(sources, rows=rows, notes=()), *contributions.parts(1, ACROSS))


def sensitivity_tables(cal: Calibration) -> tuple[Table, ...]:
    """Change of each coefficient for one unit of a source; none when no source has a size (or in old files)."""
    rows = []
    for row in cal.budget:
        if row.sensitivities and row.standard_uncertainty:
            changes = {
                c.key: row.sensitivities[c.key].value
                for c in common_coefficients(cal)
                if c.key in row.sensitivities and abs(row.contribution(c)) > NEGLIGIBLE * c.std
            }
            rows.append((row.source, f"1 {pretty_unit(row.standard_uncertainty.unit)}".strip(), changes))
    return _change_tables(cal, "Source", rows)


def source_tables(cal: Calibration) -> tuple[Table, ...]:
    """The sources of the stand that nobody stated: the change of each coefficient for one unit. Empty if all are stated."""
    rows = []
    for source in cal.sources:
        if source.status in ("unstated", "assumed"):
            for component, effects in (source.effects or {source.name: {}}).items():
                changes = {
                    c.key: effects[c.key]
                    for c in common_coefficients(cal)
                    if abs(effects.get(c.key, 0.0)) > NEGLIGIBLE * c.std
                }
                size = f"1 {pretty_unit(source.unit)}" if effects else source.reason
                rows.append((component, size, changes))
    return _change_tables(cal, "Source that is not stated", rows)


def _change_tables(
    cal: Calibration, heading: str, rows: list[tuple[str, str, dict[str, float]]]
) -> tuple[Table, ...]:
    """Tables of changes: source, for how much of it, and the change of each coefficient; none without rows."""
    if not rows:
        return ()

    def change(row: tuple[str, str, dict[str, float]], c: Coefficient) -> str | Cell:
        if c.key not in row[2]:
            return Cell("–", "quiet")
        return short(row[2][c.key] * shown_unit(c.name, c.unit)[0], 3)

    table = TableOf(rows).text(heading, lambda row: row[0]).text("Change for", lambda row: row[1])
    table.across(
        common_coefficients(cal)[:COEFFICIENTS],
        lambda c: c.key,
        change,
        lambda c: pretty_unit(shown_unit(c.name, c.unit)[1]),
    )
    return table.table().parts(2, SHORT_ACROSS)
