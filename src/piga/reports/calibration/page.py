"""A calibration shown: the report page, what terminal and notebook show, and figures by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.calibration.weights import lagged_products, residual_angles
from piga.errors import CalibrationError
from piga.noise.deviations import NoiseLevel, allan_deviation
from piga.noise.orders import OrderSpectrum, order_spectrum, ripple, segment_slices
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import NO_REFERENCE
from piga.records.calibration.diagnostics import COUNTED, Residuals
from piga.records.terms import shown_unit
from piga.reports.calibration import tables
from piga.reports.calibration.tables import residual_quantity, scale_factor
from piga.reports.noise import draw_deviations
from piga.reports.render.figure import Axis, Figure, Plot, Role, envelope_rows
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
    named_values,
    sections,
)
from piga.results import Array, in_words
from piga.units import ARCSEC, G0, MICRO_G

_SELECTABLE = 1000
"""Most segments of a page on which the reader can select one."""
_LAGS = 40
"""Lags of the autocorrelation."""
_SHOWN, _OUTLINE = 1 << 20, 50_000
"""Samples that figures work on at most, and points of the residuals of a longer record."""


def figures(cal: Calibration) -> dict[str, Callable[[], Figure]]:
    """The figures by name. One that the calibration has no data for is refused when it is called."""
    names = ("residuals", "orders", "ripple", "segments", "allan", "whiteness")
    return {name: partial(_figure, cal, name) for name in names}


def _figure(cal: Calibration, name: str) -> Figure:
    if (drawn := calibration_figures(cal, name).get(name)) is None:
        raise CalibrationError(
            f"plot.{name}: this calibration has no data for the figure",
            remedy="calibrate a record in this process: calibration.json holds no residuals",
        )
    return drawn


def calibration_figures(cal: Calibration, *names: str) -> dict[str, Figure]:
    """All figures that this calibration has the data for, by name, or those of these ``names``.

    Without ``cal.residuals`` (a calibration read back from JSON) those of the residuals are missing.
    """
    made: dict[str, Callable[[], Figure | None]] = {
        "segments": partial(segment_figure, cal),
    }
    if cal.residuals is not None and cal.residuals.t.size:
        part = _leading_part(cal.residuals)
        angles = residual_angles(part, cal.diagnostics.residual_kind)
        runs = tuple(run.name for run in cal.runs)
        made["residuals"] = partial(residual_figure, cal.residuals, residual_quantity(cal), runs)
        made["whiteness"] = partial(_whiteness_figure, part, cal.diagnostics.verdict)
        if not runs:
            made["allan"] = partial(_allan_figure, cal, angles)
        if not cal.direct:
            made["orders"] = partial(_order_figure, cal, angles)
            made["ripple"] = partial(_ripple_figure, cal, angles)
    drawn = {name: make() for name, make in made.items() if name in (names or made)}
    return {name: figure for name, figure in drawn.items() if figure is not None}


def brief(cal: Calibration) -> Page:
    """The calibration for terminal and notebook: verdict, coefficients, noise, findings and budget."""
    notes = ("k u: half width of the 95 % interval.",) if cal.type_a_only else ()
    table = replace(tables.coefficient_table(cal, every=True), notes=notes)
    coefficients = Section("", "coefficients", (table,))
    if cal.given:
        return _page(cal, (coefficients,))
    sources = any(row.type == "B" for row in cal.budget)
    drawn = cal.residuals is not None and cal.residuals.t.size > 0 and not cal.runs
    shown = sections(
        coefficients,
        Section("", "noise", (named_values("Item", "Value", _noise(cal)),)),
        Section("Runs", "runs", (tables.runs_table(cal) if cal.runs else None,)),
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
        segments=() if len(cal.segments) > _SELECTABLE else tuple(segment.label for segment in cal.segments),
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


def _sections(cal: Calibration, shown: dict[str, Figure]) -> tuple[Section, ...]:
    if cal.given:
        return _coefficients(cal), _provenance(cal)
    turned = tuple(shown[name] for name in ("orders", "ripple") if name in shown)
    return sections(
        Section("Runs", "runs", (_RUNS, tables.runs_table(cal) if cal.runs else None)),
        _coefficients(cal),
        Section("Residuals against time", "residuals", (shown.get("residuals", _MISSING),)),
        *([] if cal.direct else [Section("Residuals against rotation", "rotation", turned or (_NO_TURN,))]),
        Section("Segments", "segments", (shown.get("segments"), tables.segment_table(cal))),
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
_NO_TURN = Notice(
    "info", "No segment with residuals turns at least twice, so no revolution order can be told from drift."
)
_MISSING = Notice("info", "The residuals are not part of this record: run the calibration again to see them.")


def _coefficients(cal: Calibration) -> Section:
    lead = (
        "The instrument's coefficients as found from this record, rounded by their uncertainty. Good: uncertainties "
        "far below the values, and below what the use of the instrument asks for."
    )
    text = "Correlation of the estimates. Good: inside ±0.9; beyond, the record trades one for the other."
    correlation = introduced(text, tables.correlation_table(cal))
    return Section("Coefficients", "coefficients", (lead, tables.coefficient_table(cal), *correlation))


def _budget(cal: Calibration) -> Section:
    lead = (
        "Where the uncertainty of each coefficient comes from, as standard uncertainties. Good: the fit (type A) and "
        "the largest source of type B are of the same size; otherwise the larger one is what to improve."
    )
    changes = (
        "Sensitivities: the change of each coefficient, in the unit of its column, for one unit of the source. "
        "Times the standard uncertainty of the source they are the contributions above."
    )
    warning = None
    if tables.unstated(cal):
        warning = (
            f"{cal.verdict.sources}. The sources that are not stated exist on this stand: add them to [uncertainty] in the "
            "run file, or waive them there with a reason."
        )
    elif cal.type_a_only:
        warning = f"{tables.sentence(NO_REFERENCE)}. Add an [uncertainty] table to the run file."
    content: tuple[Content, ...] = (
        lead,
        *(tables.budget_tables(cal) if cal.budget else ()),
        *introduced(changes, *tables.sensitivity_tables(cal)),
        Notice("warning", warning) if warning else None,
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
        named_values("Item", "Value", [("Condition number", short(cal.condition)), *_noise(cal), *_tests(cal)]),
        *introduced(leverage, *tables.leverage_tables(cal)),
        *introduced(propagation, *tables.propagation_tables(cal)),
    )
    return Section("Identifiability and noise", "identifiability", content)


def _noise(cal: Calibration) -> list[tuple[str, str]]:
    scatter = f"{short(cal.segment_scatter / cal.scale_factor_nominal / MICRO_G)} µg"
    white, unit, walk, slow = tables.shown_noise(cal, cal.angle_rms, cal.angle_random_walk)
    return [
        (f"White noise of the {'output' if cal.direct else 'angle'}", f"{white} {unit} rms"),
        ("Random walk of the output" if cal.direct else "Angle random walk", f"{walk} {slow}"),
        ("Scatter of the rate from segment to segment", scatter if cal.segment_scatter else "none seen"),
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
    read = {f"Run {run.name}": run.quality for run in cal.runs} or {"Record": cal.quality}
    rows = [
        (name, f"{count(rows.rows)} rows read, {count(rows.used)} used, {count(rows.masked)} masked")
        for name, rows in read.items()
    ]
    found: Content = Notice("good", "Nothing was found to repair or leave out.")
    if cal.quality.events or cal.quality.masked:
        found = tables.quality_table(cal.quality) if cal.quality.events else None
    text = (
        "Samples of the output that do not lie on its path were left out; an increment reaches across a spike, "
        "none is formed across a jump."
    )
    left_out = (text, tables.outlier_table(cal)) if cal.outliers else ()
    return Section("Data quality", "quality", (lead, named_values("Item", "Value", rows), found, *left_out))


def _provenance(cal: Calibration) -> Section:
    lead = "What it takes to trace and repeat this result: same input, software and options, same numbers."
    made = cal.provenance
    rows = [(f"SHA-256 of {name}", digest) for name, digest in made.input_sha256.items()]
    rows += [("Software", made.software), ("Created", made.created)]
    rows += [] if cal.direct or cal.given else [("Phase source", cal.phase_source)]
    rows += [(f"Option {name.replace('_', ' ')}", in_words(value)) for name, value in made.options.items()]
    return Section("Provenance", "provenance", (lead, named_values("Item", "Value", rows, code=True)))


def outline(residuals: Residuals) -> Residuals:
    """Rows that keep the envelope of the residuals against time; all of a short record."""
    if residuals.t.size <= _SHOWN:
        return residuals
    ends = [row for part in segment_slices(residuals.segment) for row in (part.start, part.stop - 1)]
    drawn = [envelope_rows(values, _OUTLINE) for values in (residuals.before, residuals.after)]
    return _rows_of(residuals, np.unique(np.concatenate([ends, *drawn])))


def _leading_part(residuals: Residuals) -> Residuals:
    """The first samples of every segment, neighbours as in the record; all of a short record."""
    if residuals.t.size <= _SHOWN:
        return residuals
    parts = segment_slices(residuals.segment)
    share = max(_SHOWN // len(parts), 8)
    rows = [np.arange(part.start, min(part.start + share, part.stop)) for part in parts]
    return _rows_of(residuals, np.concatenate(rows))


def _rows_of(residuals: Residuals, rows: NDArray[np.int64]) -> Residuals:
    names = ("row", "t", "psi", "a_x", "before", "after", "innovation", "segment", "run")
    known = ((name, getattr(residuals, name)) for name in names)
    return replace(residuals, **{name: values[rows] for name, values in known if values is not None})


# -- residuals against time ----------------------------------------------------------------------------


def residual_figure(
    residuals: Residuals, quantity: tuple[str, str] = ("residual angle", "arcsec"), runs: Sequence[str] = ()
) -> Figure:
    """Residual (``quantity``: what and in which unit) against time, before and after; two panels for each of the ``runs``."""
    per, shown = shown_output(residuals.unit)
    quantity = quantity if per == ARCSEC else ("residual output", shown)
    title = f"{quantity[0].capitalize()} against time."
    plot = Plot("residual-time", title, columns=2 if runs else 1, height=2.1)
    parts = [("", residuals)]
    if residuals.run is not None:
        parts = [
            (f"{name}, ", _rows_of(residuals, np.flatnonzero(residuals.run == k)))
            for k, name in enumerate(runs)
        ]
    for name, part in parts:
        if part.t.size:
            _draw_residuals(plot, name, part, quantity, per)
    before = "Before: measured output less K a_x with the nominal K."
    if per == ARCSEC:
        before = "Before: measured angle less the nominal model without cross-coupling."
    return plot.caption(
        f"{before} After: less the fitted model. The scales differ. Good: a band of noise around zero, without waves, steps or "
        "trends."
    )


def _draw_residuals(plot: Plot, name: str, residuals: Residuals, quantity: tuple[str, str], per: float) -> None:
    """Draw before and after, broken between segments and at holes of more than ten usual steps."""
    residuals = outline(residuals)
    t = elapsed_time(residuals)
    unit, scale = ("h", 3600.0) if t[-1] > 3 * 3600.0 else ("s", 1.0)
    single = bool(np.diff(residuals.segment).all()) and np.unique(residuals.segment).size == t.size
    steps = np.diff(t)
    starts = (np.diff(residuals.segment) != 0) | (steps > 10.0 * np.median(steps) if steps.size else False)
    ends = 1 + np.flatnonzero(starts)[: 0 if single else None]
    kept, gaps = np.insert(np.arange(t.size), ends, ends - 1), ends + np.arange(ends.size)
    segments = np.asarray(residuals.segment)[kept]
    both: tuple[tuple[Role, Array], ...] = (("before", residuals.before), ("after", residuals.after))
    for role, values in both:
        y = np.asarray(values)[kept] / per
        y[gaps] = np.nan
        plot.panel(f"elapsed time [{unit}]", Axis(*quantity), f"{name}{role}" if name else role.capitalize())
        plot.line(t[kept] / scale, y, role, mark="points" if single else "line", segments=segments)


def elapsed_time(residuals: Residuals) -> Array:
    """Time since the first sample [s]; segments whose clock starts again follow each other."""
    t = np.array(residuals.t, dtype=float)
    end = None
    for part in segment_slices(residuals.segment):
        if end is not None and t[part.start] < end:
            t[part] += end - t[part.start]
        end = t[part.stop - 1]
    return t - t[0]


# -- residuals against rotation ------------------------------------------------------------------------


def _order_figure(cal: Calibration, angles: Residuals) -> Figure | None:
    """Ripple amplitude against revolution order. Lines above the noise are named in the notes."""
    spectrum = order_spectrum(angles, scale_factor(cal), (cal.angle_rms, cal.angle_random_walk))
    if not spectrum.segments:
        return None
    order = spectrum.order
    plot = Plot(
        "residual-order", "Residual against revolution order.", "revolution order [cycles/rev]",
        "log ripple amplitude [µg]", height=2.9,
    )  # fmt: skip
    plot.line(order, spectrum.before / MICRO_G, "before").line(order, spectrum.after / MICRO_G, "after")
    plot.dashed(order, spectrum.noise / MICRO_G, "expected of the noise")
    if np.any(spectrum.counts > 0.0):
        shown = np.where(spectrum.counts > spectrum.noise, spectrum.counts, np.nan)
        plot.marked(order, shown / MICRO_G, "expected of whole counts, where above the noise", "warning")
    return plot.caption(
        "Specific-force ripple that would leave these residuals, by how often it repeats in one turn of the output. Good: "
        "after calibration no line stands out of what is expected. A line at a whole order is a harmonic that the model "
        "lacks (order 1: cross-coupling; 2: servo stiffness, unequal inertia; others: encoder and bearings).",
        *_order_lines(spectrum, cal),
        f"From {_segments_that_turn(spectrum.segments)}.",
    )


def _order_lines(spectrum: OrderSpectrum, cal: Calibration) -> list[str]:
    lines = []
    for order, index, explained in spectrum.lines():
        k = int(np.argmin(np.abs(spectrum.order - order)))
        size = f"{spectrum.after[k] / spectrum.noise[k]:.1f} times the expected noise"
        segment = cal.segments[index].label if index < len(cal.segments) else str(index)
        words = "neither the noise nor whole counts explain it"
        if explained:
            words = "the beat of whole counts with the sampling makes it, not the instrument"
        lines.append(f"Line at order {order:.3g}, {size}, most in segment {segment}: {words}.")
    return lines


def _ripple_figure(cal: Calibration, angles: Residuals) -> Figure | None:
    """Ripple against output angle, before and after, each on its own scale."""
    turned = ripple(angles, scale_factor(cal))
    if not turned.segments:
        return None
    plot = Plot("ripple", "Ripple in one turn of the output.", columns=2, height=2.7)
    angle = Axis("output angle ψ", "deg", limits=(0.0, 360.0))
    scatter = turned.scatter / MICRO_G if np.isfinite(turned.scatter).all() and turned.scatter.size else None
    both: tuple[tuple[Role, Array], ...] = (("before", turned.before), ("after", turned.after))
    for role, values in both:
        plot.panel(angle, "residual specific force [µg]", role.capitalize()).level([0.0, 360.0], 0.0)
        plot.marked(np.degrees(turned.psi), values / MICRO_G, role, error=scatter if role == "after" else None)
    scattered = (
        "" if scatter is None else " Error bars: standard uncertainty from the scatter between segments."
    )
    return plot.caption(
        "Residual specific force around the turn; the scales differ. Cross-coupling is one wave in the turn. Good: after "
        "calibration only scatter around zero is left.",
        f"Mean over {_segments_that_turn(turned.segments)}, each turned so that its own ripple before calibration points "
        f"to ψ = 0.{scattered}",
    )


def _segments_that_turn(number: int) -> str:
    return "the one segment that turns far enough" if number == 1 else f"{number} segments that turn far enough"


# -- noise ---------------------------------------------------------------------------------------------


def _allan_figure(cal: Calibration, residuals: Residuals) -> Figure | None:
    """Overlapping Allan deviation with its 68 % band, and the noise found. ``residuals`` are angles [rad]."""
    white, walk = cal.angle_rms, cal.angle_random_walk
    noise = {2: 3.0 * white**2, 0: walk**2}
    deviation = allan_deviation(residuals.after, residuals.t, _begins(residuals), noise=noise)
    if deviation.tau.size < 2:
        return None
    named = {"quantisation": white, "random_walk": walk}
    levels = [NoiseLevel(name, size, size, size) for name, size in named.items()]
    plot = Plot("allan", "Allan deviation of the residual rate.", height=3.4)
    return draw_deviations(plot, [deviation], levels, cal.unit).caption(
        "Overlapping Allan deviation of what the calibration leaves, with its 68 % band; white noise of the output is the "
        "quantisation Q. Stretches are pooled, not joined: nothing longer than a third of the longest one is seen. Good: the "
        "curve follows the noise found; one that turns upwards shows a drift of the bias that was not found."
    )


def _begins(residuals: Residuals) -> NDArray[np.bool_]:
    """True where a stretch begins: a new segment, or a step left by an increment that was not formed."""
    begins = np.zeros(residuals.t.size, dtype=bool)
    begins[0] = True
    begins[1:] = np.diff(residuals.segment) != 0
    begins[1:] |= (residuals.innovation[1:] == 0.0) & (np.diff(residuals.after) != 0.0)
    return begins


def _whiteness_figure(residuals: Residuals, verdict: str | None) -> Figure | None:
    """Distribution and autocorrelation of the whitened residuals; ``verdict``: that of the tests of them."""
    innovation = np.asarray(residuals.innovation, dtype=float)
    innovation = innovation[np.isfinite(innovation)]
    if not innovation.size:
        return None
    density, edges = np.histogram(innovation, bins=50, range=(-5.0, 5.0), density=True)
    centre = 0.5 * (edges[1:] + edges[:-1])
    normal = np.exp(-0.5 * centre**2) / math.sqrt(2.0 * math.pi)
    products = lagged_products(innovation - innovation.mean(), min(_LAGS, max(innovation.size - 2, 0)))
    lags, correlation = np.arange(1.0, products.size), products[1:] / (products[0] or 1.0)
    bound = np.full(lags.size, 1.96 / math.sqrt(innovation.size))
    plot = Plot("whiteness", "Whitened residuals.", columns=2, height=2.6)
    plot.panel("whitened residual", "density", "Distribution")
    plot.line(centre, density, "found", "after", mark="steps")
    plot.dashed(centre, normal, "expected of pure noise")
    plot.panel("lag [samples]", "autocorrelation", "Autocorrelation")
    plot.band(lags, -bound, bound, "95 % of white noise", "reference").marked(
        lags, correlation, "found", "after"
    )
    counted = "The output is read in whole counts: the distribution is flat, and rounding can correlate lags outside the band."
    return plot.caption(
        "Each residual divided by what the noise model expects of it. Good: the found distribution lies on the expected "
        "one, and the autocorrelation stays inside its band.",
        *((counted,) if verdict == COUNTED else ()),
    )


# -- segments ---------------------------------------------------------------------------------------------


def segment_figure(cal: Calibration) -> Figure | None:
    """Residual rms of each segment against its mean specific force; None for a single segment."""
    if len(cal.segments) < 2:
        return None
    a_x = np.array([segment.mean_a_x for segment in cal.segments]) / G0
    rows = np.argsort(a_x, kind="stable")
    labels = tuple(f"segment {cal.segments[row].label}" for row in rows)
    (quantity, unit), per = residual_quantity(cal), shown_output(cal.residual_unit)[0]
    before = np.array([segment.rms_before for segment in cal.segments])[rows] / per
    after = np.array([segment.rms for segment in cal.segments])[rows] / per
    plot = Plot(
        "segment-rms", "Residual of each segment.", "mean specific force along the input axis [g]",
        f"log {quantity}, rms [{unit}]", height=2.7,
    )  # fmt: skip
    plot.points(a_x[rows], before, "before", text=labels, segments=rows)
    plot.points(a_x[rows], after, "after", text=labels, segments=rows)
    return plot.caption(
        "Each point is one segment. Good: all points after calibration lie at one level, whatever the "
        "input; a level that rises with the input asks for another model term."
    )
