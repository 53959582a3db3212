"""Tables of what a calibration says about itself: leverage of the segments, first order against Monte Carlo."""

from __future__ import annotations

from typing import Any

from piga.records.calibration import Calibration
from piga.records.terms import shown_unit
from piga.reports.calibration.tables import common_coefficients
from piga.reports.render.numbers import pretty_unit, printed, short, signed
from piga.reports.render.page import Cell, Column, Table

OWN_TABLES = frozenset({"leverage", "monte_carlo", "missing_terms", "advice", "model_comparison"})
"""Diagnostics that are shown as tables or remarks of their own."""
LEVERAGE_LEAD = (
    "Leverage: the share of each coefficient's information that one segment holds, and in brackets how many standard "
    "uncertainties the coefficient changes without it. Good: no share above 90 %, no change above 3."
)
COMPARISON_LEAD = (
    "First order (GUM) against Monte Carlo (JCGM 101, clause 8): 95 % intervals both ways. Good: they agree within the "
    "numerical tolerance; otherwise the Monte Carlo interval is the result."
)
_SHOWN = 24
_ALONE, _SHIFT = 0.9, 3.0


def leverage_table(cal: Calibration) -> Table | None:
    """Leverage of the segments, of many those with the most; None without."""
    found: dict[str, Any] = cal.diagnostics.get("leverage", {})
    if not found:
        return None
    most = sorted(found, key=lambda label: -found[label]["leverage"])[:_SHOWN]
    names = [c.name for c in common_coefficients(cal)]
    columns = (Column("Segment", align="text"), Column("Leverage"), *(Column(name) for name in names))
    rows: tuple[tuple[str | Cell, ...], ...] = tuple(
        (
            label,
            f"{row['leverage']:.2f}",
            *(_share(row["share"].get(name), row["shift"].get(name)) for name in names),
        )
        for label, row in found.items()
        if label in most
    )
    notes = (f"The {_SHOWN} of {len(found)} segments with the most leverage.",) if len(found) > _SHOWN else ()
    return Table(columns, rows, notes=notes)


def _share(share: float | None, shift: float | None) -> Cell:
    if share is None:
        return Cell("–", "quiet")
    moved = "not determined" if shift is None and share else "" if shift is None else signed(shift, 1)
    bad = share > _ALONE or (shift is not None and abs(shift) > _SHIFT)
    text = f"{100.0 * share:.0f} %" + (f" ({moved})" if moved else "")
    return Cell(printed(text), "doubtful" if bad else "")


def comparison_table(cal: Calibration) -> Table | None:
    """First-order and Monte Carlo intervals side by side with the verdict; None without Monte Carlo."""
    found: dict[str, Any] = cal.diagnostics.get("monte_carlo", {})
    if not found:
        return None
    columns = (
        Column("Coefficient", align="text"),
        Column("Unit", align="text"),
        Column("u, first order"),
        Column("u, Monte Carlo"),
        Column("95 %, first order"),
        Column("95 %, symmetric"),
        Column("95 %, shortest"),
        Column("Tolerance"),
        Column("Agreement", align="text"),
    )
    rows: list[tuple[str | Cell, ...]] = []
    for c in cal.coefficients:
        row = found["coefficients"].get(c.key)
        if row is None:
            continue
        scale, unit = shown_unit(c.name, c.unit)
        intervals = (_interval(row[name], scale) for name in ("first_order", "symmetric", "shortest"))
        verdict = Cell("yes", "good") if row["validated"] else Cell("no: Monte Carlo holds", "doubtful")
        rows.append(
            (
                c.key, pretty_unit(unit), printed(short(c.std * scale, 3)), printed(short(row["std"] * scale, 3)),
                *intervals, printed(short(row["tolerance"] * scale, 1)), verdict,
            )
        )  # fmt: skip
    return Table(columns, tuple(rows), notes=(f"{found['trials']} trials.",))


def _interval(ends: list[float], scale: float) -> str:
    low, high = (printed(short(end * scale, 6)) for end in ends)
    return f"{low} … {high}"
