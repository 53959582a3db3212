"""The uncertainty budget of a calibration: tables of the page, and lines for the terminal."""

from __future__ import annotations

import math
from dataclasses import replace

from piga.records.calibration import BudgetEntry, Calibration, Coefficient
from piga.records.terms import shown_unit
from piga.reports.calibration.tables import TABLES, common_coefficients
from piga.reports.render.numbers import ascii_text, pretty_unit, printed, short
from piga.reports.render.page import Cell, Table, TableColumn

DESCRIBED = 5
"""Columns of the budget that describe a source: name, type, distribution, standard uncertainty, degrees of freedom."""


def budget_table(cal: Calibration) -> Table:
    """Uncertainty budget: one row per source, one column per coefficient, combined at the end.

    Without an entry of Type A the standard uncertainties of the fit are put first.
    """
    coefficients = common_coefficients(cal)[: TABLES.coefficients]
    sources = _sources(cal, coefficients)
    names = [shown_unit(c.name, c.unit) for c in coefficients]
    columns = (
        TableColumn("Source", align="text"),
        TableColumn("Type", align="text"),
        TableColumn("Distribution", align="text"),
        TableColumn("Standard uncertainty", align="text"),
        TableColumn("Degrees of freedom"),
        *(TableColumn(c.key, pretty_unit(unit)) for c, (_, unit) in zip(coefficients, names, strict=True)),
    )
    total = {c.key: math.hypot(*(source.contribution(c) for source in sources)) for c in coefficients}
    rows = [_budget_row(source, coefficients, total) for source in sources]
    if len(sources) > 1:
        rows.append(("Combined", "", "", "–", "", *_cells(total, coefficients, {})))
    note = "Sensitivity times standard uncertainty of the source, and its share of the combined variance."
    return Table(columns, tuple(rows), notes=(note,))


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
    sources = replace(sources, rows=rows, notes=())
    contributions = whole.only([0, *range(DESCRIBED, len(whole.columns))])
    return (sources, *contributions.parts(1, TABLES.across))


def _cells(
    contributions: dict[str, float], coefficients: list[Coefficient], total: dict[str, float]
) -> list[Cell]:
    """Contributions to the coefficients, with their shares of the variances ``total`` squared."""
    cells = []
    for coefficient in coefficients:
        part = abs(contributions.get(coefficient.key, 0.0))
        amount, whole = (
            part * shown_unit(coefficient.name, coefficient.unit)[0],
            total.get(coefficient.key, 0.0),
        )
        share = f" ({100.0 * (part / whole) ** 2:.0f} %)" if whole > 0.0 else ""
        shown = part > TABLES.negligible * coefficient.std
        cells.append(Cell(printed(short(amount, 2)) + share) if shown else Cell("–", "quiet"))
    return cells


def _budget_row(
    source: BudgetEntry, coefficients: list[Coefficient], total: dict[str, float]
) -> tuple[str | Cell, ...]:
    given, degrees = source.standard_uncertainty, source.degrees_of_freedom
    entered = f"{printed(short(given.value))} {pretty_unit(given.unit)}".strip() if given else "–"
    known = "∞" if degrees is None else printed(short(degrees, 3)) if degrees else ""
    return (
        source.source,
        source.type,
        source.distribution,
        entered,
        "see above" if source.type == "A" else known,
        *_cells(source.contributions, coefficients, total),
    )


def sensitivity_tables(cal: Calibration) -> tuple[Table, ...]:
    """Change of each coefficient for one unit of a source; none when no source has a size (or in old files)."""
    rows = [
        (row, row.standard_uncertainty.unit)
        for row in cal.budget
        if row.sensitivities and row.standard_uncertainty
    ]
    if not rows:
        return ()
    coefficients = common_coefficients(cal)[: TABLES.coefficients]
    units = [shown_unit(c.name, c.unit) for c in coefficients]
    columns = (
        TableColumn("Source", align="text"),
        TableColumn("Change for", align="text"),
        *(TableColumn(c.key, pretty_unit(unit)) for c, (_, unit) in zip(coefficients, units, strict=True)),
    )
    cells = tuple(
        (
            row.source,
            f"1 {pretty_unit(given)}".strip(),
            *(_sensitivity(row, c, scale) for c, (scale, _) in zip(coefficients, units, strict=True)),
        )
        for row, given in rows
    )
    return Table(columns, cells).parts(2, TABLES.sensitivities_across)


def _sensitivity(row: BudgetEntry, coefficient: Coefficient, scale: float) -> str | Cell:
    sensitivity = row.sensitivities.get(coefficient.key)
    if sensitivity is None or abs(row.contribution(coefficient)) <= TABLES.negligible * coefficient.std:
        return Cell("–", "quiet")
    return printed(short(sensitivity.value * scale, 3))


def budget_text(cal: Calibration) -> list[str]:
    """The budget for the terminal, coefficient by coefficient; nothing without a source of Type B."""
    if not any(row.type == "B" for row in cal.budget):
        return []
    blocks = [(c, _text_rows(cal, c)) for c in common_coefficients(cal)]
    width = [max(len(row[i]) for _, rows in blocks for row in rows) for i in range(6)]
    lines = [f"  uncertainty budget (sources below {100 * TABLES.slight:.0f} % of a variance left out)"]
    for coefficient, rows in blocks:
        lines.append(f"  {coefficient.key} [{shown_unit(coefficient.name, coefficient.unit)[1]}]")
        for source, kind, u, sensitivity, part, share in rows:
            lines.append(
                f"    {source:<{width[0]}} {kind} {u:>{width[2]}}  {sensitivity:<{width[3]}}  "
                f"{part:>{width[4]}} {share:>{width[5]}}"
            )
    return lines


def _text_rows(cal: Calibration, coefficient: Coefficient) -> list[tuple[str, ...]]:
    """Source, type, standard uncertainty, sensitivity, contribution and share of a coefficient's budget."""
    whole = math.hypot(*(row.contribution(coefficient) for row in cal.budget))
    scale, rows = shown_unit(coefficient.name, coefficient.unit)[0], []
    for row in cal.budget:
        part = abs(row.contribution(coefficient))
        share = (part / whole) ** 2 if whole else 0.0
        if share < TABLES.slight:
            continue
        given, effect = row.standard_uncertainty, row.sensitivities.get(coefficient.key)
        entered = f"{short(given.value)} {given.unit}" if given else ""
        sensitivity = f"{short(effect.value * scale, 3)} per {given.unit}" if given and effect else ""
        shown = (
            row.source,
            row.type,
            entered,
            sensitivity,
            short(part * scale, 2),
            f"{100 * share:.0f} %",
        )
        rows.append(tuple(map(ascii_text, shown)))
    return rows
