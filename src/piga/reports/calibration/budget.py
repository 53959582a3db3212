"""The uncertainty budget of a calibration as tables."""

from __future__ import annotations

import math
from dataclasses import replace

from piga.records.calibration import BudgetEntry, Calibration, Coefficient
from piga.records.terms import shown_unit
from piga.reports.calibration.tables import TABLES, common_coefficients
from piga.reports.render.numbers import pretty_unit, short
from piga.reports.render.page import Cell, Table, TableOf

DESCRIBED = 5
"""Columns of the budget that describe a source: name, type, distribution, standard uncertainty, degrees of freedom."""


def budget_table(cal: Calibration) -> Table:
    """Uncertainty budget: one row per source, one column per coefficient, combined at the end.

    Without an entry of Type A the standard uncertainties of the fit are put first.
    """
    coefficients = common_coefficients(cal)[: TABLES.coefficients]
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
    if part <= TABLES.negligible * c.std:
        return Cell("–", "quiet")
    share = f" ({100.0 * (part / whole) ** 2:.0f} %)" if whole > 0.0 else ""
    return Cell(short(part * shown_unit(c.name, c.unit)[0], 2) + share)


def budget_shares(cal: Calibration) -> tuple[list[str], dict[str, list[float]]]:
    """Keys of the coefficients with a budget, and the share [%] of each source in the variance of each."""
    coefficients = [c for c in common_coefficients(cal)[: TABLES.coefficients] if c.std > 0.0]
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


SOURCES = {
    "reference_scale": "scale of the reference",
    "reference_bias": "bias of the reference",
    "reference_misalignment": "direction of the reference",
    "gravity": "local gravity",
    "timing": "clock of the record",
    "temperature": "thermometer",
    "vibration": "rectification of vibration",
    "earth_rate": "rotation of the Earth",
    "height": "height of the site",
    "servo": "servo that no term describes",
    "reference_repeatability": "reference, set anew at each position",
    "mounting_repeatability": "mounting, set anew for each run",
    "levelling": "levelling of the stand",
    "angle_error": "angle of the head",
    "angle_harmonics": "periodic error of the head's angle",
    "settling": "settling of the stand",
    "arm_radius": "radius of the arm",
    "arm_stretch": "stretch of the arm",
    "rate_error": "rate of the stand",
    "rate_ripple": "ripple of the stand's rate",
    "transverse_motion": "transverse motion of the table",
    "rocking": "rocking of the table",
    "angle_repeatability": "angle of the head, set anew at each position",
    "rate_repeatability": "rate of the stand, set anew at each level",
    "levelling_repeatability": "levelling, set anew for each run",
}
"""Entries of ``[uncertainty]`` in words."""


def source_in_words(source: str) -> str:
    """A source of the budget in words, with its key: ``scale of the reference (reference_scale)``."""
    words = SOURCES.get(source.partition(" ")[0])
    return f"{words} ({source})" if words else source


def budget_tables(cal: Calibration) -> tuple[Table, ...]:
    """The budget for the page: the sources, then what each adds to the coefficients, as many as fit the page."""
    whole = budget_table(cal)
    sources = whole.only(range(DESCRIBED))
    rows = tuple((source_in_words(str(row[0])), *row[1:]) for row in sources.rows if row[1])
    contributions = whole.only([0, *range(DESCRIBED, len(whole.columns))])
    return (replace(sources, rows=rows, notes=()), *contributions.parts(1, TABLES.across))


def sensitivity_tables(cal: Calibration) -> tuple[Table, ...]:
    """Change of each coefficient for one unit of a source; none when no source has a size (or in old files)."""
    rows = [
        (row, row.standard_uncertainty.unit)
        for row in cal.budget
        if row.sensitivities and row.standard_uncertainty
    ]
    if not rows:
        return ()
    table = (
        TableOf(rows)
        .text("Source", lambda row: row[0].source)
        .text("Change for", lambda row: f"1 {pretty_unit(row[1])}".strip())
        .across(
            common_coefficients(cal)[: TABLES.coefficients],
            lambda c: c.key,
            lambda row, c: _sensitivity(row[0], c),
            lambda c: pretty_unit(shown_unit(c.name, c.unit)[1]),
        )
    )
    return table.table().parts(2, TABLES.sensitivities_across)


def source_tables(cal: Calibration) -> tuple[Table, ...]:
    """The sources of the stand that nobody stated: the change of each coefficient for one unit. Empty if all are stated."""
    rows = [
        (source, component, changes)
        for source in cal.sources
        if source.status in ("unstated", "assumed")
        for component, changes in (source.effects or {source.name: {}}).items()
    ]
    if not rows:
        return ()
    table = (
        TableOf(rows)
        .text("Source that is not stated", lambda row: source_in_words(row[1]))
        .text("Change for", lambda row: f"1 {pretty_unit(row[0].unit)}" if row[2] else row[0].reason)
        .across(
            common_coefficients(cal)[: TABLES.coefficients],
            lambda c: c.key,
            lambda row, c: _effect(row[2].get(c.key, 0.0), c),
            lambda c: pretty_unit(shown_unit(c.name, c.unit)[1]),
        )
    )
    return table.table().parts(2, TABLES.sensitivities_across)


def _effect(change: float, c: Coefficient) -> str | Cell:
    if abs(change) <= TABLES.negligible * c.std:
        return Cell("–", "quiet")
    return short(change * shown_unit(c.name, c.unit)[0], 3)


def _sensitivity(row: BudgetEntry, c: Coefficient) -> str | Cell:
    sensitivity = row.sensitivities.get(c.key)
    if sensitivity is None or abs(row.contribution(c)) <= TABLES.negligible * c.std:
        return Cell("–", "quiet")
    return short(sensitivity.value * shown_unit(c.name, c.unit)[0], 3)
