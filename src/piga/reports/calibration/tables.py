"""Tables of a calibration: coefficients, correlation, budget, segments, quality, diagnostics, comparison of term sets."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import NO_REFERENCE, Amount, BudgetEntry, Coefficient, StandSource
from piga.records.calibration.diagnostics import Grade, Quality
from piga.records.terms import integral_unit, shown_unit, term_words
from piga.reports.render.numbers import (
    Rounded,
    count,
    fixed,
    pretty_unit,
    relative,
    rounded,
    short,
    shown_output,
    signed,
)
from piga.reports.render.page import Cell, Item, Judgement, Section, Table, TableOf, Text, Tone
from piga.units import ARCSEC, G0

_SEGMENTS, _OUTLIERS, _LEVERAGE, _COEFFICIENTS = 60, 30, 24, 14
"""Most segments, outliers and segments by their leverage that have a row; most coefficients with columns in a table."""
_MANY = 1000
"""Above this number, degrees of freedom are shown as ``> 1000``."""
_ACROSS, _SHORT_ACROSS = 4, 6
"""Coefficients beside each other in a table of the page, so that they fit the screen and A4; in one of short numbers."""
_NEGLIGIBLE = 1e-3
"""Contributions below this, in standard uncertainties of the coefficient, are not shown (0.0001 % of the variance)."""
TONES: dict[Grade, Tone] = {"clear": "good", "doubt": "doubtful", "do not use": "bad"}
"""Tone of each grade of a verdict."""


def judgement(cal: Calibration, subject: str = "") -> Judgement:
    """The verdict on a calibration as the box of a page. ``subject`` names the calibration on pages about something else."""
    verdict = cal.verdict
    remedy = verdict.doubts[0].remedy if verdict.doubts else ""
    problems = tuple((sentence(doubt.what), doubt.remedy) for doubt in verdict.doubts[1:])
    headline = f"{subject}{verdict.headline}"
    return Judgement(TONES[verdict.grade], headline, remedy, problems, verdict.tested, verdict.not_tested)


def sentence(text: str) -> str:
    """Text with a capital letter, unless it begins with the name of a coefficient (``k2``)."""
    name = text.split(maxsplit=1)[0].rstrip(":") if text else ""
    return text if re.search(r"[_\d\[]", name) else f"{text[:1].upper()}{text[1:]}"


def common_coefficients(cal: Calibration) -> list[Coefficient]:
    """Coefficients of the instrument and of whole runs (phases of single segments stand in the segment table)."""
    return [coefficient for coefficient in cal.coefficients if coefficient.segment is None]


def _shown_coefficients(cal: Calibration) -> list[Coefficient]:
    return common_coefficients(cal)[:_COEFFICIENTS]


def scale_factor(cal: Calibration) -> float:
    """``K`` in SI, (rad/s)/(m/s^2): the estimate, or the nominal value if it was not estimated."""
    estimated = (coefficient.value_si for coefficient in cal.coefficients if coefficient.name == "scale_factor")
    return next(estimated, cal.scale_factor_nominal)


def coefficient_table(cal: Calibration, *, every: bool = False) -> Table:
    """Coefficients with standard uncertainty u and expanded uncertainty, each rounded by its own uncertainty.

    ``every``: with those of single segments.
    """

    def known(cell: Callable[[Coefficient], str | Cell]) -> Callable[[Coefficient], str | Cell]:
        return lambda c: cell(c) if c.determined else "–"

    def shown(c: Coefficient, spread: float) -> Rounded:
        scale = shown_unit(c.name, c.unit)[0]
        return rounded(c.value * scale, spread * scale)

    undetermined = Cell("not determined", "doubtful")
    return (
        TableOf(cal.coefficients if every else common_coefficients(cal))
        .text("Coefficient", lambda c: named(c, cal.direct))
        .number("Value", lambda c: shown(c, c.std).value if c.determined else undetermined)
        .number("u", known(lambda c: shown(c, c.std).uncertainty))
        .number(
            "k u (95 %)" if cal.type_a_only else "U (95 %)", known(lambda c: shown(c, c.expanded).uncertainty)
        )
        .text("Unit", lambda c: pretty_unit(shown_unit(c.name, c.unit)[1] if c.determined else c.unit) or "1")
        .number(
            "u / value",
            known(lambda c: Cell(relative(c.value, c.std), "doubtful" if c.std > abs(c.value) else "")),
        )
        .number("dof", known(freedom))
        .number("k", known(factor))
        .table(notes=_coefficient_notes(cal))
    )


def freedom(coefficient: Coefficient) -> str:
    """Effective degrees of freedom in words."""
    nu = coefficient.degrees_of_freedom
    if math.isnan(nu):
        return "–"
    if _MANY < nu < math.inf:
        return f"> {count(_MANY)}"
    return "∞" if math.isinf(nu) else count(round(nu)) if nu >= 100.0 else f"{nu:.3g}"


def factor(coefficient: Coefficient) -> str:
    """Coverage factor as printed; a dash where a Monte Carlo interval holds."""
    k = coefficient.coverage_factor
    return "–" if math.isnan(k) else f"{k:.2f}"


def monte_carlo_interval(coefficient: Coefficient) -> str:
    """Limits of the interval that holds, rounded by their width, with their unit: ``299.1 to 300.7 µg``."""
    scale, unit = shown_unit(coefficient.name, coefficient.unit)
    ends = [rounded(end * scale, coefficient.expanded * scale).value for end in coefficient.limits]
    return f"{ends[0]} to {ends[1]} {pretty_unit(unit)}".rstrip()


def named(coefficient: Coefficient, direct: bool = False) -> Cell:
    """The key of a coefficient. Its meaning is shown when the pointer rests on it; sizes are known of gyro accelerometers."""
    try:
        words = term_words(coefficient.name)
    except KeyError:  # a term of a later version
        return Cell(coefficient.key)
    return Cell(
        coefficient.key,
        title=f"{words.meaning}; adds {words.formula}; shown by {words.shown_by}"
        + (f"; e.g. {words.known}" if words.known and not direct else ""),
    )


def _coefficient_notes(cal: Calibration) -> tuple[str, ...]:
    half = "k u" if cal.type_a_only else "U"
    wide = "k u" if cal.type_a_only else "U = k u"
    basis = "k from Student's t with the effective degrees of freedom (dof) of each coefficient (JCGM 100, G.4)"
    notes = [
        f"u: standard uncertainty. {wide}: for 95 % coverage, {basis}. The unit g is 9.80665 m/s² exactly."
    ]
    if cal.type_a_only:
        notes.insert(0, sentence(f"{NO_REFERENCE}."))
    for c in common_coefficients(cal):
        if c.name == "tan_beta":
            beta = rounded(math.atan(c.value) / ARCSEC, c.std / ARCSEC / (1.0 + c.value**2))
            notes.append(f"tan_beta corresponds to β = {beta.concise}″.")
        if c.interval is not None:
            notes.append(
                f"{c.name}: shortest 95 % interval {monte_carlo_interval(c)} by Monte Carlo (JCGM 101); {half} is its "
                "half-width."
            )
        if c.std > abs(c.value):
            notes.append(f"{c.key} is smaller than its own uncertainty: this record does not show it.")
    return tuple(notes)


_CORRELATED = 0.9
"""Correlation beyond which a record trades one coefficient for the other."""


def correlation_table(cal: Calibration) -> Table | None:
    """Correlation matrix of the common coefficients, or None when there is but one."""
    index = [row for row, c in enumerate(cal.coefficients) if c.segment is None][:_COEFFICIENTS]
    if len(index) < 2:
        return None
    covariance = np.asarray(cal.covariance, dtype=float)[np.ix_(index, index)]
    std = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = covariance / np.outer(std, std)

    def cell(i: int, j: int) -> Cell:
        value = float(matrix[i, j])
        if i == j or not math.isfinite(value):
            return Cell("1" if i == j else "–", "quiet")
        return Cell(signed(value, 2), "doubtful" if abs(value) > _CORRELATED else "")

    names, rows = [cal.coefficients[row].key for row in index], range(len(index))
    table = TableOf(rows).text("", lambda i: names[i]).across(rows, lambda j: names[j], cell)
    return table.table(upright=True)


def residual_quantity(cal: Calibration) -> tuple[str, str]:
    """Quantity of the residuals and its unit in reports: an angle, or a rate for a rate log; of a direct instrument its output."""
    kind = "output" if cal.direct else cal.diagnostics.residual_kind
    return f"residual {kind}", shown_output(cal.residual_unit)[1]


def shown_noise(cal: Calibration, white: float, walk: float) -> tuple[str, str, str, str]:
    """White noise and random walk of the output as numbers with their units: an angle in seconds of arc."""
    per, unit = shown_output(integral_unit(cal.unit))
    slow = f"{cal.unit}/√Hz" if unit == f"{cal.unit} s" else f"{unit}/√s"
    return short(white / per), unit, short(walk / per), slow


def segment_table(cal: Calibration) -> Table:
    """One row per segment; of very many the ones with the largest residuals."""
    worst = sorted(range(len(cal.segments)), key=lambda index: -cal.segments[index].rms)
    chosen = sorted(worst[:_SEGMENTS])
    shown = [cal.segments[index] for index in chosen]
    note = f"The {_SEGMENTS} of {len(cal.segments)} segments with the largest residuals."
    per, unit = shown_output(cal.residual_unit)
    phases = {c.owner: c for c in cal.coefficients if c.name == "phi" and c.segment is not None}
    typical = float(np.median([segment.rms for segment in shown])) if shown else 0.0
    table = (
        TableOf(shown)
        .text("Segment", lambda segment: segment.label)
        .number("Samples", lambda segment: count(segment.rows))
        .number("Duration", lambda segment: f"{segment.duration:.1f}", "s")
        .number("Mean a_x", lambda segment: fixed(segment.mean_a_x / G0, 5), "g")
    )
    if not cal.direct:
        table.number("Turns", lambda segment: fixed(segment.turns or 0.0, 2), "rev")
    table = (
        table.number("rms before", lambda segment: short(segment.rms_before / per), unit)
        .number(
            "rms after",
            lambda segment: Cell(short(segment.rms / per), "doubtful" if segment.rms > 3.0 * typical else ""),
            unit,
        )
        .number("Largest after", lambda segment: short(segment.max_after / per), unit)
    )
    if phases:
        table.number("Phase φ", lambda segment: _phase(phases.get(segment.label)), "rad")
    notes = (note,) if len(shown) < len(cal.segments) else ()
    return table.table(notes=notes, segments=tuple(chosen))


def _phase(phi: Coefficient | None) -> str:
    if phi is None:
        return "–"
    return rounded(phi.value, phi.std).concise if phi.determined else "not determined"


def runs_table(cal: Calibration) -> Table:
    """One row per run of a joint calibration."""
    _, white, _, walk = shown_noise(cal, 0.0, 0.0)
    per, unit = shown_output(cal.residual_unit)
    return (
        TableOf(cal.runs)
        .text("Run", lambda run: run.name if run.raw else f"{run.name} (summary)")
        .text("Stand", lambda run: run.stand or "–")
        .number("Equations", lambda run: count(run.rows))
        .number("White noise", lambda run: shown_noise(cal, run.angle_rms, 0.0)[0], white)
        .number("Random walk", lambda run: shown_noise(cal, 0.0, run.angle_random_walk)[2], walk)
        .number("rms before", lambda run: short(run.residual_rms_before / per), unit)
        .number("rms after", lambda run: short(run.residual_rms / per), unit)
        .text("Alone it cannot separate", lambda run: ", ".join(run.undetermined) or "–")
        .table()
    )


def outlier_table(cal: Calibration) -> Table:
    """Samples that were left out, with their times: jumps and stuck readings, then spikes; of many the first."""
    listed = sorted(cal.outliers, key=lambda outlier: outlier.kind == "spike")
    per, unit = shown_output(cal.residual_unit)
    more = len(cal.outliers) - _OUTLIERS
    notes = (f"The first {_OUTLIERS} of {count(len(cal.outliers))} findings.",) if more > 0 else ()
    table = TableOf(listed[:_OUTLIERS])
    if any(outlier.run for outlier in cal.outliers):
        table.text("Run", lambda outlier: outlier.run or "–")
    return (
        table.text("Kind", lambda outlier: outlier.kind)
        .number("Time", lambda outlier: f"{outlier.time:.3f}", "s")
        .number("Row", lambda outlier: count(outlier.row))
        .number("Samples left out", lambda outlier: count(outlier.samples))
        .number("Miss", lambda outlier: short(outlier.size / per), unit)
        .table(notes=notes)
    )


def quality_table(quality: Quality) -> Table:
    """Faults detected and repaired in the data."""
    return (
        TableOf(quality.events)
        .text("Finding", lambda event: event.kind)
        .number("Count", lambda event: count(event.count))
        .number("First row", lambda event: "–" if event.first_row is None else count(event.first_row))
        .text("Detail", lambda event: event.detail)
        .table()
    )


_ALONE, _SHIFT = 0.9, 3.0


def leverage_tables(cal: Calibration) -> tuple[Table, ...]:
    """Leverage of the segments, of many those with the most, with as many coefficients across as fit; none without."""
    leverage = cal.diagnostics.leverage
    if not leverage:
        return ()

    def share(label: str, name: str) -> Cell:
        held, shift = leverage[label].share.get(name), leverage[label].shift.get(name)
        if held is None:
            return Cell("–", "quiet")
        moved = signed(shift, 1) if shift is not None else "not determined" if held else ""
        bad = held > _ALONE or (shift is not None and abs(shift) > _SHIFT)
        return Cell(f"{100.0 * held:.0f} %" + (f" ({moved})" if moved else ""), "doubtful" if bad else "")

    most = sorted(leverage, key=lambda label: -leverage[label].leverage)[:_LEVERAGE]
    labels = [segment.label for segment in cal.segments]
    chosen = [label for label in leverage if label in most]
    table = TableOf(chosen).text("Segment", str)
    table.number("Leverage", lambda label: f"{leverage[label].leverage:.2f}")
    table.across([c.name for c in common_coefficients(cal)], str, share)
    more = f"The {_LEVERAGE} of {len(leverage)} segments with the most leverage."
    at = tuple(labels.index(label) if labels.count(label) == 1 else None for label in chosen)
    whole = table.table(notes=(more,) if len(leverage) > _LEVERAGE else (), segments=at)
    return whole.parts(2, _SHORT_ACROSS)


def propagation_tables(cal: Calibration) -> tuple[Table, ...]:
    """First-order and Monte Carlo intervals side by side with the verdict; none without Monte Carlo."""
    monte_carlo = cal.diagnostics.monte_carlo
    if monte_carlo is None:
        return ()

    def interval(ends: tuple[float, float], scale: float) -> str:
        return " … ".join(short(end * scale, 6) for end in ends)

    agreed, holds = Cell("yes", "good"), Cell("no: Monte Carlo holds", "doubtful")
    tried = [
        (c, monte_carlo.coefficients[c.key], *shown_unit(c.name, c.unit))
        for c in cal.coefficients
        if c.key in monte_carlo.coefficients
    ]
    table = (
        TableOf(tried)
        .text("Coefficient", lambda row: row[0].key)
        .text("Unit", lambda row: pretty_unit(row[3]))
        .number("u, first order", lambda row: short(row[0].std * row[2], 3))
        .number("u, Monte Carlo", lambda row: short(row[1].std * row[2], 3))
        .number("95 %, first order", lambda row: interval(row[1].first_order, row[2]))
        .number("95 %, symmetric", lambda row: interval(row[1].symmetric, row[2]))
        .number("95 %, shortest", lambda row: interval(row[1].shortest, row[2]))
        .number("Tolerance", lambda row: short(row[1].tolerance * row[2], 1))
        .text("Agreement", lambda row: agreed if row[1].validated else holds)
    )
    return (table.table(notes=(f"{monte_carlo.trials} trials.",)),)


# -- uncertainty budget ----------------------------------------------------------------------------------

DESCRIBED = 5
"""Columns of the budget that describe a source: name, type, distribution, standard uncertainty, degrees of freedom."""


def budget_table(cal: Calibration) -> Table:
    """Uncertainty budget: one row per source, one column per coefficient, combined at the end."""
    coefficients = _shown_coefficients(cal)
    total = {c.key: math.hypot(*(row.contribution(c) for row in cal.budget)) for c in coefficients}
    table = (
        TableOf(cal.budget)
        .text("Source", lambda row: row.source)
        .text("Type", lambda row: row.type)
        .text("Distribution", lambda row: row.distribution)
        .text("Standard uncertainty", lambda row: _amount(row.standard_uncertainty))
        .number("Degrees of freedom", _degrees)
    )
    _across_coefficients(table, cal, lambda row, c: _contribution(row.contribution(c), c, total[c.key]))
    note = "Sensitivity times standard uncertainty of the source, and its share of the combined variance."
    shown = table.table(notes=(note,))
    if len(cal.budget) < 2:
        return shown
    whole = [_contribution(total[c.key], c) for c in coefficients]
    return replace(shown, rows=(*shown.rows, ("Combined", "", "", "–", "", *whole)))


def _across_coefficients(
    table: TableOf[Item], cal: Calibration, cell: Callable[[Item, Coefficient], str | Cell]
) -> TableOf[Item]:
    """A column for each coefficient of the instrument, in the unit in which it is shown."""
    unit = lambda c: pretty_unit(shown_unit(c.name, c.unit)[1])  # noqa: E731
    return table.across(_shown_coefficients(cal), lambda c: c.key, cell, unit)


def _amount(amount: Amount | None) -> str:
    return f"{short(amount.value)} {pretty_unit(amount.unit)}".strip() if amount else "–"


def _degrees(row: BudgetEntry) -> str:
    if row.type == "A":
        return "see above"
    degrees = row.degrees_of_freedom
    return "∞" if degrees is None else short(degrees, 3) if degrees else ""


def _contribution(part: float, c: Coefficient, whole: float = 0.0) -> Cell:
    """Contribution to a coefficient, with its share of the variance ``whole`` squared."""
    part = abs(part)
    if part <= _NEGLIGIBLE * c.std:
        return Cell("–", "quiet")
    share = f" ({100.0 * (part / whole) ** 2:.0f} %)" if whole > 0.0 else ""
    return Cell(short(part * shown_unit(c.name, c.unit)[0], 2) + share)


def budget_tables(cal: Calibration) -> tuple[Table, ...]:
    """The budget for the page: the sources, then what each adds to the coefficients, as many as fit the page."""
    whole = budget_table(cal)
    sources = whole.only(range(DESCRIBED))
    rows = tuple(row for row in sources.rows if row[1])
    contributions = whole.only([0, *range(DESCRIBED, len(whole.columns))])
    return (replace(sources, rows=rows, notes=()), *contributions.parts(1, _ACROSS))


def sensitivity_tables(cal: Calibration) -> tuple[Table, ...]:
    """Change of each coefficient for one unit of a source; at the end the sources of the stand that nobody stated."""
    rows: list[tuple[str | Cell, str, float, dict[str, float]]] = []
    for row in cal.budget:
        if (u := row.standard_uncertainty) and u.value:
            effects = {key: change / u.value for key, change in row.contributions.items()}
            rows.append((row.source, f"1 {pretty_unit(u.unit)}".strip(), u.value, effects))
    for source in unstated(cal):
        per = f"1 {pretty_unit(source.unit)}" if source.effects else source.reason
        for name, effects in (source.effects or {source.name: {}}).items():
            rows.append((Cell(f"{name}, not stated", "doubtful"), per, 1.0, effects))
    if not rows:
        return ()

    def change(row: tuple[str | Cell, str, float, dict[str, float]], c: Coefficient) -> str | Cell:
        effect = row[3].get(c.key, 0.0)
        if not abs(effect) * row[2] > _NEGLIGIBLE * c.std:
            return Cell("–", "quiet")
        return short(effect * shown_unit(c.name, c.unit)[0], 3)

    table = TableOf(rows).text("Source", lambda row: row[0]).text("Change for", lambda row: row[1])
    return _across_coefficients(table, cal, change).table().parts(2, _SHORT_ACROSS)


def unstated(cal: Calibration) -> list[StandSource]:
    """Sources of the stand that nobody stated."""
    return [source for source in cal.sources if source.status in ("unstated", "assumed")]


# -- comparison of term sets ---------------------------------------------------------------------------


def comparison_sections(cal: Calibration) -> tuple[Section, ...]:
    """The section of the report, if term sets were compared."""
    document: Any = cal.diagnostics.model_comparison
    if not document:
        return ()
    lead = (
        "Which terms the record asks for. Sets are compared with the same noise weights. A term that the record needs "
        "lowers BIC by much; one that it does not need raises it a little."
    )
    words = "The record determines none of the sets."
    if document["best"] is not None:
        words = f"Least BIC: {', '.join(document['best'])}."
    shown = (Text(words), _comparison_table(document), _shift_table(document))
    return (Section("Model choice", "model-choice", (lead, *shown)),)


def _comparison_table(document: dict[str, Any]) -> Table:
    """One row per set, the least BIC first."""
    numbered = sorted(
        enumerate(document["sets"], start=1), key=lambda item: (item[1].get("bic", math.inf), item[0])
    )

    def number(key: str, digits: int = 3) -> Callable[[tuple[int, Any]], str]:
        return lambda item: short(item[1][key], digits) if key in item[1] else "–"

    table = (
        TableOf(numbered)
        .number("set", lambda item: str(item[0]))
        .text("terms", lambda item: ", ".join(item[1]["terms"]))
        .number("coefficients", lambda item: str(item[1].get("parameters", "–")))
        .number("chi²/dof", number("chi_square_per_degree", digits=4))
        .number("BIC above best", number("bic_above_best"))
    )
    if any("reason" in one for _, one in numbered):
        table.text("remark", lambda item: str(item[1].get("reason", "")))
    notes = (
        f"Noise weights of all sets: those found with {', '.join(document['noise_terms'])}.",
        f"{count(document['observations'])} observations.",
    )
    return table.table("Term sets compared", notes)


def _shift_table(document: dict[str, Any]) -> Table | None:
    """Coefficients in the sets that the record determines; None with fewer than two."""
    known = {
        number: {c["key"]: c for c in one["coefficients"] if "[" not in c["key"]}
        for number, one in enumerate(document["sets"], start=1)
        if "bic" in one
    }
    if len(known) < 2:
        return None
    units = {key: shown_unit(key, c["unit"]) for of_set in known.values() for key, c in of_set.items()}

    def shifted(key: str, number: int) -> str:
        c, scale = known[number].get(key), units[key][0]
        if c is None:
            return "–"
        change = f" ({signed(c['change'], 1)})" if c["change"] else ""
        return rounded(c["value"] * scale, c["std"] * scale).concise + change

    note = "Type A. In brackets behind: distance from the set of least BIC, in standard uncertainties of that."
    return (
        TableOf(units)
        .text("coefficient", str)
        .text("unit", lambda key: pretty_unit(units[key][1]) or "1")
        .across(known, lambda number: f"set {number}", shifted)
        .table("Coefficients in every set", (note,))
    )
