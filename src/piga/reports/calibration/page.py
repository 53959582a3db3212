"""A calibration shown: the report page, what terminal and notebook show, and figures by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from piga.errors import CalibrationError
from piga.records.calibration import Calibration
from piga.records.calibration.coefficient import TYPE_A_ONLY
from piga.records.calibration.verdict import (
    COUNTED,
    RMS_FROM_ONE,
    SEPARATED,
    WELL_SEPARATED,
    Verdict,
    whitened_rms,
)
from piga.records.terms import integral_unit, meaning_of, shown_output, shown_unit
from piga.reports.calibration.budget import budget_tables, sensitivity_tables, source_tables
from piga.reports.calibration.figures import (
    BEAT,
    budget_figure,
    calibration_figures,
    convergence_figure,
    elapsed_time,
    residual_figure,
    segment_figure,
)
from piga.reports.calibration.tables import (
    LEVERAGE_LEAD,
    OWN_TABLES,
    PROPAGATION_LEAD,
    coefficient_table,
    common_coefficients,
    comparison_sections,
    correlation_table,
    facts_table,
    freedom,
    judgement,
    leverage_tables,
    outlier_table,
    propagation_tables,
    quality_table,
    residual_quantity,
    runs_table,
    scalars,
    segment_table,
    selectable_segments,
    sentence,
    shown_noise,
)
from piga.reports.render.envelope import outline
from piga.reports.render.figure import Figure
from piga.reports.render.numbers import count, duration, pretty_unit, relative, rounded, short
from piga.reports.render.page import ALONE, Content, Notice, Page, Section, Text, Tile, Tone, introduced
from piga.units import G0


def _files_in_words(cal: Calibration) -> str:
    if cal.runs:
        return ", ".join(run.name for run in cal.runs)
    names = [Path(name).name for name in cal.provenance.input_sha256]
    data = [name for name in names if not name.endswith(".toml")] or names
    return ", ".join(data) or "a record in memory"


def _total_duration(cal: Calibration) -> float:
    """Duration of all segments [s]."""
    if cal.segments:
        return math.fsum(segment.duration for segment in cal.segments)
    return (
        float(elapsed_time(outline(cal.residuals))[-1])
        if cal.residuals is not None and cal.residuals.t.size
        else 0.0
    )


def _segments_in_words(cal: Calibration) -> str:
    runs = f"{len(cal.runs)} runs, " if cal.runs else ""
    return runs + ("one segment" if len(cal.segments) == 1 else f"{len(cal.segments)} segments")


_METHODS = {
    "information": "whitened linear least squares in the angle domain",
    "rate": "linear least squares on the rate",
    "recursive": "whitened least squares in the angle domain, sample by sample",
    "published": "the published nonlinear recursion",
    "revolutions": "ends of whole turns of the output",
}


def figures(cal: Calibration) -> dict[str, Callable[[], Figure]]:
    """The figures by name. One that the calibration has no data for is refused when it is called."""
    names = (
        "residuals", "orders", "ripple", "segments", "creep", "budget", "allan", "whiteness", "outliers",
        "convergence",
    )  # fmt: skip
    return {name: partial(figure, cal, name) for name in names}


_NO_FIGURE = {
    "creep": "calibrate a record of five positions or more",
    "segments": "calibrate a record: these coefficients have no segments",
    "budget": "calibrate a record, or read a calibration.json that has a budget",
    "convergence": "calibrate in this process with method='recursive'",
}
"""What to do where a calibration lacks the data of a figure. All other figures need residuals."""


def figure(cal: Calibration, name: str) -> Figure:
    """A figure of the report by its name."""
    known = {"segments": segment_figure, "budget": budget_figure, "convergence": convergence_figure}
    lacks = (name == "segments" and not cal.segments) or (name == "budget" and not cal.budget)
    if name in known:
        drawn = None if lacks else known[name](cal)
    else:
        drawn = next((f for key, f in calibration_figures(cal).items() if key.startswith(name)), None)
    if drawn is None:
        other = "calibrate a record that has what the figure shows"
        if name not in _NO_FIGURE and cal.residuals is None and not cal.given:
            other = "calibrate the record in this process: calibration.json holds no residuals"
        raise CalibrationError(
            f"plot.{name}: this calibration has no data for the figure", remedy=_NO_FIGURE.get(name, other)
        )
    return drawn


def brief(cal: Calibration) -> Page:
    """The calibration for terminal and notebook: verdict, coefficients, noise, findings and budget."""
    sections = [Section("", "coefficients", (replace(coefficient_table(cal, every=True), notes=()),))]
    if not cal.given:
        sections += [Section("", "noise", (facts_table(_noise(cal)),)), *_brief_sections(cal)]
    return Page(_title(cal), _subtitle(cal), _tiles(cal), tuple(sections), judgement=judgement(cal))


def _brief_sections(cal: Calibration) -> Iterator[Section]:
    if cal.runs:
        yield Section("Runs", "runs", (runs_table(cal),))
    if cal.quality.events:
        yield Section("Data", "quality", (quality_table(cal.quality),))
    if any(row.type == "B" for row in cal.budget):
        yield Section("Uncertainty budget", "budget", budget_tables(cal))
    yield from comparison_sections(cal)
    if cal.remarks:
        yield Section("", "remarks", tuple(Notice("warning", remark) for remark in cal.remarks))
    if cal.residuals is not None and cal.residuals.t.size and not cal.runs:
        drawn = partial(residual_figure, cal.residuals, residual_quantity(cal))
        yield Section("", "residuals", (drawn,))


def page(cal: Calibration) -> Page:
    """The report of a calibration."""
    shown = {} if cal.given else calibration_figures(cal)
    if len(cal.budget) > 1 and (shares := budget_figure(cal)) is not None:
        shown["budget"] = shares
    lines = shown["orders"].notes[:-1] if "orders" in shown else ()
    return Page(
        title=_title(cal),
        subtitle=_subtitle(cal),
        tiles=_tiles(cal),
        sections=_sections(cal, shown),
        judgement=judgement(cal, verdict=_with_lines(cal.verdict, lines)),
        kicker=f"piga · {'' if cal.direct else 'gyro '}accelerometer calibration",
        footer=f"Made by {cal.provenance.software} on {cal.provenance.created}. {ALONE}",
        segments=selectable_segments(cal),
    )


RUNS_LEAD = (
    "The runs that were calibrated together, each weighted by its own noise. What one of them cannot separate, "
    "the others must."
)
SETTLED_LEAD = "How the estimates settled while the record came in, sample by sample."


def _sections(cal: Calibration, shown: dict[str, Figure]) -> tuple[Section, ...]:
    if cal.given:
        return _tested(cal), _coefficients(cal), _provenance(cal)
    return (
        _tested(cal),
        *([Section("Runs", "runs", (RUNS_LEAD, runs_table(cal)))] if cal.runs else []),
        _coefficients(cal),
        _residuals(cal, shown),
        *(
            [Section("Convergence", "history", (SETTLED_LEAD, shown["convergence"]))]
            if "convergence" in shown
            else []
        ),
        *([] if cal.direct else [_orders(shown)]),
        _segments(cal, shown),
        _budget(cal, shown),
        _identifiability(cal, shown),
        *comparison_sections(cal),
        _quality(cal, shown),
        _provenance(cal),
    )


def _with_lines(verdict: Verdict, lines: tuple[str, ...]) -> Verdict:
    """The verdict with the lines of the order spectrum: a line moves no coefficient but by the scatter, or as a missing term."""
    see = ": see the figure of revolution orders; a harmonic term, the encoder or a bearing may make it"
    said = tuple(
        f"{line[0].lower()}{line[1:].removesuffix('.')}{'' if BEAT in line else see}" for line in lines
    )
    return replace(verdict, tested=verdict.tested + said)


def _title(cal: Calibration) -> str:
    return f"Calibration of {cal.serial or 'an instrument'}"


def _subtitle(cal: Calibration) -> str:
    if cal.given:
        return "The coefficients were given, not estimated from a record."
    extent = f"{_segments_in_words(cal)}, {duration(_total_duration(cal))}"
    phases = "" if cal.direct else f", phases {cal.phases}"
    model = f"Method {cal.method}{phases}, terms {', '.join(cal.terms)}."
    return f"{_files_in_words(cal)}: {extent}, {count(cal.quality.used)} samples used. {model}"


def _tiles(cal: Calibration) -> tuple[Tile, ...]:
    if cal.given:
        return tuple(_coefficient_tiles(cal))
    clear = cal.verdict.grade == "clear"
    better: Tone = "bad" if cal.residual_rms >= cal.residual_rms_before else "good" if clear else ""
    (quantity, unit), per = residual_quantity(cal), shown_output(cal.residual_unit)[0]
    rms, before = cal.residual_rms, cal.residual_rms_before
    less = f"{short(before / rms)} times less" if before > rms > 0.0 else "no improvement"
    tiles = [
        Tile(
            f"{quantity.capitalize()}, rms",
            f"{short(before / per)} → {short(rms / per)}",
            unit,
            f"before → after: {less}",
            better,
        ),
        Tile(
            f"{quantity.capitalize()}, largest",
            f"{short(cal.residual_max_before / per)} → {short(cal.residual_max_after / per)}",
            unit,
            f"{short(cal.residual_max_after / rms)} times the rms after" if rms else "",
        ),
        *_coefficient_tiles(cal),
        _freedom_tile(cal),
        _condition_tile(cal),
        _whiteness_tile(cal),
        _data_tile(cal),
    ]
    return tuple(tile for tile in tiles if tile is not None)


def _coefficient_tiles(cal: Calibration) -> list[Tile]:
    tiles = []
    for coefficient in common_coefficients(cal):
        if coefficient.name in {"scale_factor", "tan_beta"}:
            scale, unit = shown_unit(coefficient.name, coefficient.unit)
            value, std = coefficient.value * scale, coefficient.std * scale
            label = "Scale factor" if coefficient.name == "scale_factor" else "Cross-coupling tan β"
            detail = f"standard uncertainty {relative(value, std)}"
            tone: Tone = "doubtful" if std > 0.3 * abs(value) else ""
            tiles.append(Tile(label, rounded(value, std).concise, pretty_unit(unit), detail, tone))
    return tiles


def _freedom_tile(cal: Calibration) -> Tile:
    fewest = min(cal.coefficients, key=lambda coefficient: coefficient.degrees_of_freedom)
    detail = f"effective, fewest of all coefficients ({fewest.key}): k = {fewest.coverage_factor:.3f} for 95 %"
    return Tile("Degrees of freedom", freedom(fewest), "", detail)


def _condition_tile(cal: Calibration) -> Tile:
    verdicts: tuple[tuple[float, str, Tone], ...] = (
        (WELL_SEPARATED, "the coefficients are well separated", "good"),
        (SEPARATED, "some coefficients are hard to separate", "doubtful"),
        (math.inf, "the record hardly separates the coefficients", "bad"),
    )
    words, tone = next((words, tone) for limit, words, tone in verdicts if not cal.condition > limit)
    return Tile("Condition number", short(cal.condition, 2), "", words, tone)


def _whiteness_tile(cal: Calibration) -> Tile | None:
    rms = whitened_rms(cal)
    if math.isnan(rms):
        return None
    white = cal.diagnostics.verdict in ("white", COUNTED)
    fits = abs(rms - 1.0) <= RMS_FROM_ONE
    words = (
        "1 expected: the noise levels do not fit"
        if not fits
        else "of size one"
        if white
        else "of size one, but not white"
    )
    return Tile("Whitened residual, rms", f"{rms:.3f}", "", words, "good" if fits and white else "doubtful")


def _data_tile(cal: Calibration) -> Tile:
    share = 100.0 * cal.quality.used / cal.quality.rows if cal.quality.rows else 0.0
    events = sum(event.count for event in cal.quality.events)
    detail = f"of {count(cal.quality.rows)} rows" + (f"; {count(events)} findings" if events else "")
    return Tile("Data used", f"{share:.4g}", "%", detail, "doubtful" if share < 95.0 else "")


def _tested(cal: Calibration) -> Section:
    terms = ", ".join(f"{term} ({meaning_of(term)})" for term in cal.terms)
    shared, seen = cal.phases == "shared", cal.quality
    phase = "one for the whole record (shared)" if shared else "one for each segment (per-segment)"
    method = _METHODS.get(cal.method, "").removesuffix(" in the angle domain" if cal.direct else "")
    if cal.runs:
        phase = "; ".join(f"run {run.name}: {run.phases}" for run in cal.runs)
    rows = [
        ("Instrument", cal.serial),
        ("Data", _files_in_words(cal)),
        ("Duration", f"{duration(_total_duration(cal))} in {_segments_in_words(cal)}"),
        ("Rows", f"{count(seen.rows)} read, {count(seen.used)} used, {count(seen.masked)} masked"),
        ("Model terms", terms),
        *(() if cal.direct else (("Phase of the output", f"{phase}; source: {cal.phase_source}"),)),
        ("Method", f"{cal.method}: {method}" if method else cal.method),
    ]
    lead = "Which instrument, which record and which model this report is about."
    return Section("What was tested", "tested", (lead, facts_table(rows)))


def _coefficients(cal: Calibration) -> Section:
    lead = (
        "The instrument's coefficients as found from this record, rounded by their uncertainty. Good: uncertainties "
        "far below the values, and below what the use of the instrument asks for."
    )
    text = "Correlation of the estimates. Good: inside ±0.9; beyond, the record trades one for the other."
    correlation = introduced(text, correlation_table(cal))
    return Section("Coefficients", "coefficients", (lead, coefficient_table(cal), *correlation))


def _residuals(cal: Calibration, shown: dict[str, Figure]) -> Section:
    lead = (
        f"What is left of the measured {'output' if cal.direct else 'angle'} when the model is taken away: what the "
        "calibration explains is gone after it, and what it leaves should be noise."
    )
    missing = Notice(
        "info", "The residuals are not part of this record: run the calibration again to see them."
    )
    drawn: list[Content] = [figure for name, figure in shown.items() if name.startswith("residuals")]
    return Section("Residuals against time", "residuals", (lead, *(drawn or [missing])))


def _orders(shown: dict[str, Figure]) -> Section:
    lead = (
        "The same residuals against the rotation of the output: errors of the instrument repeat with the turn, noise "
        "does not. Good: lines and lobes before calibration, none after."
    )
    text = "No segment with residuals turns at least twice, so no revolution order can be told from drift."
    missing = None if {"orders", "ripple"} & shown.keys() else Notice("info", text)
    content = (lead, shown.get("orders"), shown.get("ripple"), missing)
    return Section("Residuals against rotation", "rotation", content)


def _segments(cal: Calibration, shown: dict[str, Figure]) -> Section:
    lead = (
        "Residuals of each part of the record. Good: one level everywhere; an odd segment points to the test."
    )
    content = (lead, shown.get("segments"), shown.get("creep"), segment_table(cal))
    return Section("Segments", "segments", content)


def _budget(cal: Calibration, shown: dict[str, Figure]) -> Section:
    lead = (
        "Where the uncertainty of each coefficient comes from, as standard uncertainties. Good: the fit (type A) and "
        "the largest source of type B are of the same size; otherwise the larger one is what to improve."
    )
    changes = (
        "Sensitivities: the change of each coefficient, in the unit of its column, for one unit of the source. "
        "Times the standard uncertainty of the source they are the contributions above."
    )
    missing, warning = source_tables(cal), None
    if missing:
        warning = (
            f"{cal.verdict.sources}. The sources below exist on this stand, and nobody stated them: the change of each "
            "coefficient for one unit. Add them to [uncertainty] in the run file, or waive them there with a reason."
        )
    elif cal.type_a_only:
        warning = f"{TYPE_A_ONLY}. Add an [uncertainty] table to the run file."
    content: tuple[Content, ...] = (
        lead,
        *budget_tables(cal),
        shown.get("budget"),
        *introduced(changes, *sensitivity_tables(cal)),
        Notice("warning", warning) if warning else None,
        *missing,
        Text(f"Local gravity of the reference: {pretty_unit(cal.gravity)}.") if cal.gravity else None,
    )
    return Section("Uncertainty budget", "budget", content)


def _identifiability(cal: Calibration, shown: dict[str, Figure]) -> Section:
    lead = (
        "How well this record tells the coefficients apart, and whether the residuals are the noise they should be. "
        "Good: whitened residuals that look like white noise of size one. Doubts stand in the verdict at the top."
    )
    rows = [
        ("Condition number", short(cal.condition)),
        *_noise(cal),
        *scalars({key: value for key, value in asdict(cal.diagnostics).items() if key not in OWN_TABLES}),
    ]
    content: tuple[Content, ...] = (
        lead,
        *(Notice("info", f"{sentence(remark)}.") for remark in cal.remarks),
        shown.get("whiteness"),
        shown.get("allan"),
        facts_table(rows),
        *introduced(LEVERAGE_LEAD, *leverage_tables(cal)),
        *introduced(PROPAGATION_LEAD, *propagation_tables(cal)),
    )
    return Section("Identifiability and noise", "identifiability", content)


def _noise(cal: Calibration) -> list[tuple[str, str]]:
    count, level = integral_unit(cal.unit), cal.segment_scatter
    scatter = f"{short(level / cal.scale_factor_nominal / G0 * 1e6)} µg ({short(level)} {cal.unit})"
    scatter = scatter if level else "none seen"
    white, unit, walk, slow = shown_noise(cal, cal.angle_rms, cal.angle_random_walk)
    raw = ("", "") if cal.direct else (_raw(cal.angle_rms, count), _raw(cal.angle_random_walk, f"{count}/√s"))
    return [
        (f"White noise of the {'output' if cal.direct else 'angle'}", f"{white} {unit} rms{raw[0]}"),
        ("Random walk of the output" if cal.direct else "Angle random walk", f"{walk} {slow}{raw[1]}"),
        ("Scatter of the rate from segment to segment", scatter),
    ]


def _raw(value: float, unit: str) -> str:
    return f" ({short(value)} {unit})"


def _quality(cal: Calibration, shown: dict[str, Figure]) -> Section:
    lead = (
        "What was found, repaired or left out while reading the data. Good: nothing, or little and explained."
    )
    found: Content = Notice("good", "Nothing was found to repair or leave out.")
    if cal.quality.events:
        found = quality_table(cal.quality)
    elif cal.quality.masked:
        found = Notice("info", f"{count(cal.quality.masked)} rows are masked and were not used.")
    rows = [
        (
            f"Run {run.name}",
            f"{count(run.quality.rows)} rows read, {count(run.quality.used)} used, {count(run.quality.masked)} masked",
        )
        for run in cal.runs
    ]
    text = (
        "Samples of the output that do not lie on its path were left out; an increment reaches across a spike, "
        "none is formed across a jump."
    )
    left_out = (text, shown.get("outliers"), outlier_table(cal)) if cal.outliers else ()
    content = (lead, facts_table(rows) if rows else None, found, *left_out)
    return Section("Data quality", "quality", content)


def _provenance(cal: Calibration) -> Section:
    lead = "What it takes to trace and repeat this result: same input, software and options, same numbers."
    rows = [(f"SHA-256 of {name}", digest) for name, digest in cal.provenance.input_sha256.items()]
    rows += [("Software", cal.provenance.software), ("Created", cal.provenance.created)]
    rows += [(f"Option {name}", text) for name, text in scalars(cal.provenance.options)]
    return Section("Provenance", "provenance", (lead, facts_table(rows, code=True)))
