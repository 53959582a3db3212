"""The uncertainty budget: table of contributions, table of sensitivities, and lines for the terminal."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from piga.records.calibration import Calibration, Coefficient
from piga.records.terms import shown_unit
from piga.reports.calibration.tables import SHOWN_NAMES, common_coefficients
from piga.reports.render.numbers import pretty_unit, printed, short
from piga.reports.render.page import Cell, Column, Table

ACROSS, SENSITIVITIES_ACROSS = 4, 6
"""Coefficients beside each other in a table of the page: they fit the screen and A4."""
NOTHING = 1e-3
"""Contribution, in standard uncertainties of the coefficient, below which it says nothing: 0.0001 % of the variance."""
DESCRIBED = 5
"""Columns of the budget that describe a source: name, type, distribution, standard uncertainty, degrees of freedom."""
SLIGHT = 0.01
"""Share of the variance below which a source is left out on the terminal."""


def budget_table(cal: Calibration) -> Table:
    """Uncertainty budget: one row per source, one column per coefficient, combined at the end.

    A row of ``cal.budget`` is ``{"source": text, "type": "A" | "B", "standard_uncertainty": {"value",
    "unit"} or None, "contributions": {coefficient key: change in the coefficient's unit}}``. Without a row of type A the
    standard uncertainties of the fit are put first.
    """
    coefficients = common_coefficients(cal)[:SHOWN_NAMES]
    sources: list[dict[str, Any]] = list(cal.budget)
    if not any(source.get("type") == "A" for source in sources):
        fit = {coefficient.key: coefficient.std for coefficient in coefficients}
        sources.insert(0, {"source": "Fit to the record", "type": "A", "contributions": fit})
    names = [_friendly_unit(coefficient) for coefficient in coefficients]
    columns = (
        Column("Source", align="text"),
        Column("Type", align="text"),
        Column("Distribution", align="text"),
        Column("Standard uncertainty", align="text"),
        Column("Degrees of freedom"),
        *(Column(c.key, pretty_unit(unit)) for c, (unit, _) in zip(coefficients, names, strict=True)),
    )
    total = {c.key: math.hypot(*(_contribution(source, c) for source in sources)) for c in coefficients}
    rows = [_budget_row(source, coefficients, total) for source in sources]
    if len(sources) > 1:
        combined = {"source": "Combined", "type": "", "contributions": total}
        rows.append(_budget_row(combined, coefficients, {}))
    note = "Sensitivity times standard uncertainty of the source, and its share of the combined variance."
    return Table(columns, tuple(rows), notes=(note,))


def budget_tables(cal: Calibration) -> tuple[Table, ...]:
    """The budget for the page: the sources, then what each adds to the coefficients, as many as fit the page."""
    whole = budget_table(cal)
    sources = whole.only(range(DESCRIBED))
    sources = replace(sources, rows=tuple(row for row in sources.rows if row[1]), notes=())
    contributions = whole.only([0, *range(DESCRIBED, len(whole.columns))])
    return (sources, *contributions.parts(1, ACROSS))


def _friendly_unit(coefficient: Coefficient) -> tuple[str, float]:
    scale, unit = shown_unit(coefficient.name, coefficient.unit)
    return unit, scale


def _contribution(source: dict[str, Any], coefficient: Coefficient) -> float:
    return float(source.get("contributions", {}).get(coefficient.key, 0.0))


def _budget_row(
    source: dict[str, Any], coefficients: list[Coefficient], total: dict[str, float]
) -> tuple[str | Cell, ...]:
    cells = []
    for coefficient in coefficients:
        part = abs(_contribution(source, coefficient))
        amount, whole = part * _friendly_unit(coefficient)[1], total.get(coefficient.key, 0.0)
        share = f" ({100.0 * (part / whole) ** 2:.0f} %)" if whole > 0.0 else ""
        shown = part > NOTHING * coefficient.std
        cells.append(Cell(printed(short(amount, 2)) + share) if shown else Cell("–", "quiet"))
    given = source.get("standard_uncertainty")
    entered = f"{printed(short(given['value']))} {pretty_unit(given['unit'])}".strip() if given else "–"
    degrees = source.get("degrees_of_freedom")
    return (
        str(source.get("source", "")),
        str(source.get("type", "")),
        str(source.get("distribution", "")),
        entered,
        "see above"
        if source.get("type") == "A"
        else "∞"
        if degrees is None and source.get("type")
        else printed(short(degrees, 3))
        if degrees
        else "",
        *cells,
    )


def sensitivity_tables(cal: Calibration) -> tuple[Table, ...]:
    """Change of each coefficient for one unit of a source; none when no source has a size (or in old files)."""
    rows = [row for row in cal.budget if row.get("sensitivities")]
    if not rows:
        return ()
    coefficients = common_coefficients(cal)[:SHOWN_NAMES]
    units = [_friendly_unit(coefficient) for coefficient in coefficients]
    columns = (
        Column("Source", align="text"),
        Column("Change for", align="text"),
        *(Column(c.key, pretty_unit(unit)) for c, (unit, _) in zip(coefficients, units, strict=True)),
    )
    cells = tuple(
        (
            str(row["source"]),
            f"1 {pretty_unit(row['standard_uncertainty']['unit'])}".strip(),
            *(_sensitivity(row, c, scale) for c, (_, scale) in zip(coefficients, units, strict=True)),
        )
        for row in rows
    )
    return Table(columns, cells).parts(2, SENSITIVITIES_ACROSS)


def _sensitivity(row: dict[str, Any], coefficient: Coefficient, scale: float) -> str | Cell:
    found = row["sensitivities"].get(coefficient.key)
    if found is None or abs(_contribution(row, coefficient)) <= NOTHING * coefficient.std:
        return Cell("–", "quiet")
    return printed(short(found["value"] * scale, 3))


def budget_text(cal: Calibration) -> list[str]:
    """The budget for the terminal, coefficient by coefficient; nothing without a source of Type B."""
    if not any(row.get("type") == "B" for row in cal.budget):
        return []
    blocks = [(c, _text_rows(cal, c)) for c in common_coefficients(cal)]
    width = [max(len(row[i]) for _, rows in blocks for row in rows) for i in range(6)]
    lines = [f"  uncertainty budget (sources below {100 * SLIGHT:.0f} % of a variance left out)"]
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
    whole = math.hypot(*(_contribution(row, coefficient) for row in cal.budget))
    scale, rows = shown_unit(coefficient.name, coefficient.unit)[0], []
    for row in cal.budget:
        part = abs(_contribution(row, coefficient))
        share = (part / whole) ** 2 if whole else 0.0
        if share < SLIGHT:
            continue
        given, found = row.get("standard_uncertainty"), row.get("sensitivities", {}).get(coefficient.key)
        entered = f"{short(given['value'])} {given['unit']}" if given else ""
        sensitivity = f"{short(found['value'] * scale, 3)} per {given['unit']}" if given and found else ""
        shown = (
            str(row["source"]),
            str(row["type"]),
            entered,
            sensitivity,
            short(part * scale, 2),
            f"{100 * share:.0f} %",
        )
        rows.append(tuple(text.replace("–", "-").replace("\u202f", "") for text in shown))
    return rows
