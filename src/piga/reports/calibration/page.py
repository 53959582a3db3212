"""A calibration shown: the report page, what terminal and notebook show, and figures by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from piga.errors import CalibrationError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import NO_REFERENCE
from piga.records.terms import integral_unit, shown_unit
from piga.reports.calibration import tables
from piga.reports.calibration.figures import (
    calibration_figures,
    elapsed_time,
    figures_of,
    outline,
    residual_figure,
)
from piga.reports.calibration.tables import facts_table, residual_quantity
from piga.reports.render.figure import Figure
from piga.reports.render.numbers import count, duration, pretty_unit, relative, rounded, short, shown_output
from piga.reports.render.page import (
    ALONE,
    Content,
    Notice,
    Page,
    Section,
    Text,
    Tile,
    Tone,
    introduced,
    sections,
)
from piga.results import in_words
from piga.units import G0

__all__ = ["brief", "figures", "page", "residual_figure"]


def figures(cal: Calibration) -> dict[str, Callable[[], Figure]]:
    """The figures by name. One that the calibration has no data for is refused when it is called."""
    names = ("residuals", "orders", "ripple", "segments", "creep", "allan", "whiteness")
    return {name: partial(_figure, cal, name) for name in names}


def _figure(cal: Calibration, name: str) -> Figure:
    make = figures_of(cal).get(name)
    drawn = make() if make is not None else None
    if drawn is None:
        raise CalibrationError(
            f"plot.{name}: this calibration has no data for the figure",
            remedy="calibrate a record in this process: calibration.json holds no residuals; creep needs five positions",
        )
    return drawn


def brief(cal: Calibration) -> Page:
    """The calibration for terminal and notebook: verdict, coefficients, noise, findings and budget."""
    coefficients = Section("", "coefficients", (replace(tables.coefficient_table(cal, every=True), notes=()),))
    if cal.given:
        return _page(cal, (coefficients,))
    sources = any(row.type == "B" for row in cal.budget)
    drawn = cal.residuals is not None and cal.residuals.t.size > 0 and not cal.runs
    shown = sections(
        coefficients,
        Section("", "noise", (facts_table(_noise(cal)),)),
        Section("Runs", "runs", (_runs(cal),)),
        Section("Data", "quality", (tables.quality_table(cal.quality) if cal.quality.events else None,)),
        Section("Uncertainty budget", "budget", tables.budget_tables(cal) if sources else ()),
        *tables.comparison_sections(cal),
        Section("", "remarks", tuple(Notice("warning", remark) for remark in cal.remarks)),
        Section("", "residuals", (figures(cal)["residuals"] if drawn else None,)),
    )
    return _page(cal, shown)


def page(cal: Calibration) -> Page:
    """The report of a calibration."""
    shown = {} if cal.given else calibration_figures(cal)
    return replace(
        _page(cal, _sections(cal, shown)),
        kicker=f"piga · {'' if cal.direct else 'gyro '}accelerometer calibration",
        footer=f"Made by {cal.provenance.software} on {cal.provenance.created}. {ALONE}",
        segments=tables.selectable_segments(cal),
    )


def _page(cal: Calibration, shown: tuple[Section, ...]) -> Page:
    title = f"Calibration of {cal.serial or 'an instrument'}"
    return Page(title, _subtitle(cal), _tiles(cal), shown, judgement=tables.judgement(cal))


def _subtitle(cal: Calibration) -> str:
    if cal.given:
        return "The coefficients were given, not estimated from a record."
    names = [run.name for run in cal.runs] or [Path(name).name for name in cal.provenance.input_sha256]
    data = [name for name in names if not name.endswith(".toml")] or names
    runs = f"{len(cal.runs)} runs, " if cal.runs else ""
    parts = "one segment" if len(cal.segments) == 1 else f"{len(cal.segments)} segments"
    seconds = math.fsum(segment.duration for segment in cal.segments)
    if not cal.segments and cal.residuals is not None and cal.residuals.t.size:
        seconds = float(elapsed_time(outline(cal.residuals))[-1])
    phases = "" if cal.direct else f", phases {cal.phases}"
    return (
        f"{', '.join(data) or 'a record in memory'}: {runs}{parts}, {duration(seconds)}, "
        f"{count(cal.quality.used)} samples used. Method {cal.method}{phases}, terms {', '.join(cal.terms)}."
    )


def _tiles(cal: Calibration) -> tuple[Tile, ...]:
    coefficients = tuple(_coefficient_tiles(cal))
    if cal.given:
        return coefficients
    better: Tone = "good" if cal.verdict.grade == "clear" else ""
    (quantity, unit), per = residual_quantity(cal), shown_output(cal.residual_unit)[0]
    rms, before = cal.residual_rms, cal.residual_rms_before
    less = f"{short(before / rms)} times less" if before > rms > 0.0 else "no improvement"
    seen = cal.quality
    share = 100.0 * seen.used / seen.rows if seen.rows else 0.0
    events = sum(event.count for event in seen.events)
    return (
        Tile(
            f"{quantity.capitalize()}, rms",
            f"{short(before / per)} → {short(rms / per)}",
            unit,
            f"before → after: {less}",
            "bad" if rms >= before else better,
        ),
        Tile(
            f"{quantity.capitalize()}, largest",
            f"{short(cal.residual_max_before / per)} → {short(cal.residual_max_after / per)}",
            unit,
            f"{short(cal.residual_max_after / rms)} times the rms after" if rms else "",
        ),
        *coefficients,
        Tile(
            "Data used",
            f"{share:.4g}",
            "%",
            f"of {count(seen.rows)} rows" + (f"; {count(events)} findings" if events else ""),
            "doubtful" if share < 95.0 else "",
        ),
    )


def _coefficient_tiles(cal: Calibration) -> list[Tile]:
    labels = {"scale_factor": "Scale factor", "tan_beta": "Cross-coupling tan β"}
    tiles = []
    for coefficient in tables.common_coefficients(cal):
        if coefficient.name in labels:
            scale, unit = shown_unit(coefficient.name, coefficient.unit)
            value, std = coefficient.value * scale, coefficient.std * scale
            detail = f"standard uncertainty {relative(value, std)}"
            tone: Tone = "doubtful" if std > 0.3 * abs(value) else ""
            number = rounded(value, std).concise
            tiles.append(Tile(labels[coefficient.name], number, pretty_unit(unit), detail, tone))
    return tiles


def _runs(cal: Calibration) -> Content:
    return tables.runs_table(cal) if cal.runs else None


def _sections(cal: Calibration, shown: dict[str, Figure]) -> tuple[Section, ...]:
    if cal.given:
        return _coefficients(cal), _provenance(cal)
    return sections(
        Section("Runs", "runs", (_RUNS, _runs(cal))),
        _coefficients(cal),
        Section("Residuals against time", "residuals", (_RESIDUALS, shown.get("residuals", _MISSING))),
        *([] if cal.direct else [_rotation(shown)]),
        Section(
            "Segments",
            "segments",
            (_SEGMENTS, shown.get("segments"), shown.get("creep"), tables.segment_table(cal)),
        ),
        _budget(cal),
        _identifiability(cal, shown),
        *tables.comparison_sections(cal),
        _quality(cal),
        _provenance(cal),
    )


_RUNS = (
    "The runs that were calibrated together, each weighted by its own noise. What one of them cannot separate, "
    "the others must."
)
_RESIDUALS = (
    "What is left of the measured output when the model is taken away: what the calibration explains is gone after it, "
    "and what it leaves should be noise."
)
_MISSING = Notice("info", "The residuals are not part of this record: run the calibration again to see them.")
_SEGMENTS = (
    "Residuals of each part of the record. Good: one level everywhere; an odd segment points to the test."
)


def _coefficients(cal: Calibration) -> Section:
    lead = (
        "The instrument's coefficients as found from this record, rounded by their uncertainty. Good: uncertainties "
        "far below the values, and below what the use of the instrument asks for."
    )
    text = "Correlation of the estimates. Good: inside ±0.9; beyond, the record trades one for the other."
    correlation = introduced(text, tables.correlation_table(cal))
    return Section("Coefficients", "coefficients", (lead, tables.coefficient_table(cal), *correlation))


def _rotation(shown: dict[str, Figure]) -> Section:
    lead = (
        "The same residuals against the rotation of the output: errors of the instrument repeat with the turn, noise "
        "does not. Good: lines and lobes before calibration, none after."
    )
    text = "No segment with residuals turns at least twice, so no revolution order can be told from drift."
    drawn: list[Content] = [shown[name] for name in ("orders", "ripple") if name in shown]
    content = (lead, *(drawn or [Notice("info", text)]))
    return Section("Residuals against rotation", "rotation", content)


def _budget(cal: Calibration) -> Section:
    lead = (
        "Where the uncertainty of each coefficient comes from, as standard uncertainties. Good: the fit (type A) and "
        "the largest source of type B are of the same size; otherwise the larger one is what to improve."
    )
    changes = (
        "Sensitivities: the change of each coefficient, in the unit of its column, for one unit of the source. "
        "Times the standard uncertainty of the source they are the contributions above."
    )
    missing, warning = tables.source_tables(cal), None
    if missing:
        warning = (
            f"{cal.verdict.sources}. The sources below exist on this stand, and nobody stated them: the change of each "
            "coefficient for one unit. Add them to [uncertainty] in the run file, or waive them there with a reason."
        )
    elif cal.type_a_only:
        warning = f"{tables.sentence(NO_REFERENCE)}. Add an [uncertainty] table to the run file."
    content: tuple[Content, ...] = (
        lead,
        *tables.budget_tables(cal),
        *introduced(changes, *tables.sensitivity_tables(cal)),
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
    leverage = (
        "Leverage: the share of each coefficient's information that one segment holds, and in brackets how many standard "
        "uncertainties the coefficient changes without it. Good: no share above 90 %, no change above 3."
    )
    propagation = (
        "First order (GUM) against Monte Carlo (JCGM 101, clause 8): 95 % intervals both ways. Good: they agree within "
        "the numerical tolerance; otherwise the Monte Carlo interval is the result."
    )
    content: tuple[Content, ...] = (
        lead,
        *(Notice("info", f"{tables.sentence(remark)}.") for remark in cal.remarks),
        shown.get("whiteness"),
        shown.get("allan"),
        facts_table([("Condition number", short(cal.condition)), *_noise(cal), *_tests(cal)]),
        *introduced(leverage, *tables.leverage_tables(cal)),
        *introduced(propagation, *tables.propagation_tables(cal)),
    )
    return Section("Identifiability and noise", "identifiability", content)


def _noise(cal: Calibration) -> list[tuple[str, str]]:
    per_turn, level = integral_unit(cal.unit), cal.segment_scatter
    scatter = f"{short(level / cal.scale_factor_nominal / G0 * 1e6)} µg ({short(level)} {cal.unit})"
    white, unit, walk, slow = tables.shown_noise(cal, cal.angle_rms, cal.angle_random_walk)
    raw = ("", "")
    if not cal.direct:
        raw = (
            f" ({short(cal.angle_rms)} {per_turn})",
            f" ({short(cal.angle_random_walk)} {per_turn}/√s)",
        )
    return [
        (f"White noise of the {'output' if cal.direct else 'angle'}", f"{white} {unit} rms{raw[0]}"),
        ("Random walk of the output" if cal.direct else "Angle random walk", f"{walk} {slow}{raw[1]}"),
        ("Scatter of the rate from segment to segment", scatter if level else "none seen"),
    ]


def _tests(cal: Calibration) -> list[tuple[str, str]]:
    """The range of the record, and the tests of its whitened residuals."""
    tests = cal.diagnostics
    units = {"a_x": "m/s²", "a_t": "m/s²", "temperature": "K"}
    rows = [
        (f"Range of {name}", f"{short(low, 4)} to {short(high, 4)} {units.get(name, '')}".rstrip())
        for name, (low, high) in tests.range.items()
    ]
    numbers = {
        "Scatter of the segments over what all noise explains": tests.segment_scatter_ratio,
        "Variance of the whitened residuals": tests.variance,
        "Correlation of neighbours": tests.lag1_correlation,
        "Probability of the Ljung-Box test": tests.ljung_box_probability,
        "Skewness": tests.skewness,
        "Excess kurtosis": tests.excess_kurtosis,
    }
    rows += [(name, short(number, 4)) for name, number in numbers.items() if number is not None]
    return [*rows, ("Whitened residuals are", tests.verdict)] if tests.verdict else rows


def _quality(cal: Calibration) -> Section:
    lead = (
        "What was found, repaired or left out while reading the data. Good: nothing, or little and explained."
    )
    found: Content = Notice("good", "Nothing was found to repair or leave out.")
    if cal.quality.events:
        found = tables.quality_table(cal.quality)
    elif cal.quality.masked:
        found = Notice("info", f"{count(cal.quality.masked)} rows are masked and were not used.")
    read = {f"Run {run.name}": run.quality for run in cal.runs} or {"Record": cal.quality}
    rows = [
        (name, f"{count(rows.rows)} rows read, {count(rows.used)} used, {count(rows.masked)} masked")
        for name, rows in read.items()
    ]
    text = (
        "Samples of the output that do not lie on its path were left out; an increment reaches across a spike, "
        "none is formed across a jump."
    )
    left_out = (text, tables.outlier_table(cal)) if cal.outliers else ()
    return Section("Data quality", "quality", (lead, facts_table(rows), found, *left_out))


def _provenance(cal: Calibration) -> Section:
    lead = "What it takes to trace and repeat this result: same input, software and options, same numbers."
    made = cal.provenance
    rows = [(f"SHA-256 of {name}", digest) for name, digest in made.input_sha256.items()]
    rows += [("Software", made.software), ("Created", made.created)]
    rows += [] if cal.direct or cal.given else [("Phase source", cal.phase_source)]
    rows += [(f"Option {name.replace('_', ' ')}", in_words(value)) for name, value in made.options.items()]
    return Section("Provenance", "provenance", (lead, facts_table(rows, code=True)))
