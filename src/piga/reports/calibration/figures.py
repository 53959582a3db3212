"""Figures of a calibration: residuals against time, order and output angle; Allan deviation; whiteness; segments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import cast

import numpy as np
from numpy.typing import NDArray

from piga.calibration.allan import AllanDeviation, allan_deviation, drift_line, model_deviation
from piga.calibration.fit.residuals import add_lagged_products
from piga.records.calibration import Calibration, Residuals
from piga.records.terms import shown_unit
from piga.reports.calibration.budget import budget_shares, source_in_words
from piga.reports.calibration.tables import residual_quantity, scale_factor, shown_segments
from piga.reports.render.decimate import POINTS, envelope_rows, leading_part, outline, rows_of
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series
from piga.reports.render.numbers import pretty_unit
from piga.reports.render.orders import OrderSpectrum, Ripple, segment_slices, spectrum_and_ripple
from piga.units import ARCSEC, G0, MICRO_G


def deviation_figure(deviation: AllanDeviation) -> Figure:
    """An Allan deviation by itself, with its 68 % band."""
    tau = deviation.tau
    curve = Series(tau, deviation.deviation / ARCSEC, "deviation", "line+points", "after")
    y = Axis("Allan deviation of the rate", "arcsec/s", log=True)
    return Figure(
        key="allan-deviation",
        title="Allan deviation of the rate.",
        panels=(Panel(Axis("averaging time", "s", log=True), y, (_allan_band(deviation), curve)),),
        caption="Overlapping Allan deviation with its 68 % band. Stretches are pooled, not joined.",
        height=3.4,
    )


def _allan_band(deviation: AllanDeviation) -> Series:
    lower, upper = deviation.lower / ARCSEC, deviation.upper / ARCSEC
    return Series(deviation.tau, lower, "68 % band", "band", "muted", upper=upper)


def allan_figure(
    residuals: Residuals, noise: tuple[float, float], bias_drift: float = 0.0, single: Sequence[int] = ()
) -> Figure | None:
    """Overlapping Allan deviation with its 68 % band, the noise found, and the slope of a bias drift.

    ``residuals`` are angles [rad]; ``noise`` is the white angle noise [rad] and the random walk [rad/sqrt(s)],
    ``bias_drift`` that found [rad/s/sqrt(s)]; without one a line of its slope is drawn for comparison. Each of the
    segments ``single`` gets a curve of its own, from its own samples.
    """
    white, walk = noise[0] ** 2, noise[1] ** 2
    after, time, begins = np.asarray(residuals.after, dtype=float), np.asarray(residuals.t), _begins(residuals)
    deviation = allan_deviation(after, time, begins, white=white, walk=walk)
    if deviation.tau.size < 2:
        return None
    chosen, own = frozenset(single), []
    for part in segment_slices(residuals.segment):
        index = int(residuals.segment[part.start])
        if index in chosen:
            one = allan_deviation(after[part], time[part], begins[part], white=white, walk=walk)
            curve = Series(one.tau, one.deviation / ARCSEC, mark="line+points", role="reference")
            own += [(index, curve)] if one.tau.size > 1 else []
    tau = deviation.tau
    angle, wander = (part / ARCSEC for part in model_deviation(tau, white, walk))
    both = np.hypot(np.hypot(angle, wander), drift_line(tau, bias_drift / ARCSEC))
    level = bias_drift / ARCSEC or both[-1] / math.sqrt(tau[-1] / 3.0)
    drift = drift_line(tau, level)
    near = (tau >= 0.1 * tau[-1]) | (bias_drift > 0.0)
    series = [
        _allan_band(deviation),
        Series(tau, deviation.deviation / ARCSEC, "residual", "line+points", "after"),
        Series(tau, both, "noise found", role="model"),
    ]
    series += [Series(tau, angle, "white noise", role="x", dashed=True)] if white > 0.0 else []
    series += [Series(tau, wander, "random walk", role="y", dashed=True)] if walk > 0.0 else []
    name = "bias drift" if bias_drift else "slope of a drift"
    series.append(Series(tau[near], drift[near], name, role="warning", dashed=True))
    low = 0.3 * min(float((deviation.deviation / ARCSEC).min()), float(both.min()))
    high = 3.0 * max(float((deviation.upper / ARCSEC).max()), float(both.max()))
    y = Axis("Allan deviation of the rate", "arcsec/s", log=True, limits=(low, high))
    return Figure(
        key="allan",
        title="Allan deviation of the residual rate.",
        panels=(Panel(Axis("averaging time", "s", log=True), y, tuple(series), of_segments=tuple(own)),),
        caption="Overlapping Allan deviation of what the calibration leaves, with its 68 % band. Stretches are pooled, "
        "not joined: nothing longer than a third of the longest one is seen. Good: the curve follows the noise found; "
        "one that turns upwards along the dashed slope, above it, shows a drift of the bias that was not found.",
        height=3.4,
    )


def _begins(residuals: Residuals) -> NDArray[np.bool_]:
    """True where a stretch begins: a new segment, or a step left by an increment that was not formed."""
    begins = np.zeros(residuals.t.size, dtype=bool)
    begins[0] = True
    begins[1:] = np.diff(residuals.segment) != 0
    begins[1:] |= (residuals.innovation[1:] == 0.0) & (np.diff(residuals.after) != 0.0)
    return begins


Array = NDArray[np.float64]


def spectrum_figure(spectrum: OrderSpectrum, single: Sequence[int] = ()) -> Figure:
    """Ripple amplitude against revolution order. Each of the segments ``single`` gets a curve of its own."""
    own = tuple(
        (index, Series(spectrum.order, after / MICRO_G, role="reference"))
        for index, after in spectrum.single
        if index in single
    )
    y = Axis("ripple amplitude", "µg", log=True)
    series = (
        Series(spectrum.order, spectrum.before / MICRO_G, name="before", role="before"),
        Series(spectrum.order, spectrum.after / MICRO_G, name="after", role="after"),
        Series(
            spectrum.order,
            spectrum.noise / MICRO_G,
            name="expected of the noise",
            role="reference",
            dashed=True,
        ),
    )
    return Figure(
        key="residual-order",
        title="Residual against revolution order.",
        panels=(Panel(Axis("revolution order", "cycles/rev"), y, series, of_segments=own),),
        caption="Specific-force ripple that would leave these residuals, by how often it repeats in one turn "
        "of the output. Good: after calibration no line stands out of the expected noise. A line at a whole "
        "order is a harmonic that the model lacks (order 1: cross-coupling; 2: servo stiffness, unequal "
        "inertia; others: encoder and bearings).",
        height=2.9,
        notes=(f"From {_segments_that_turn(spectrum.segments)}.",),
    )


def ripple_figure(turned: Ripple) -> Figure:
    """Ripple against output angle: polar, and unrolled on its own scale."""
    before, after = turned.before / MICRO_G, turned.after / MICRO_G
    scatter = turned.scatter / MICRO_G
    step = _nice(float(np.nanmax(np.abs(np.concatenate((before, after))))))
    degrees = np.degrees(turned.psi)
    error = scatter if np.isfinite(scatter).all() and scatter.size else None
    outer = 3.2 * step
    scattered = "" if error is None else " Error bars: standard uncertainty from the scatter between segments."
    turned_note = (
        f"Mean over {_segments_that_turn(turned.segments)}, each turned so that its own ripple before "
        "calibration points to ψ = 0."
    )
    polar = Panel(
        Axis("radius × cos ψ", "µg", limits=(-outer, outer)),
        Axis("radius × sin ψ", "µg", limits=(-outer, outer)),
        (
            *_polar_grid(step),
            _closed(turned.psi, before, 2.0 * step, "before"),
            _closed(turned.psi, after, 2.0 * step, "after"),
        ),
        title="Polar",
        equal=True,
    )
    flat = Panel(
        Axis("output angle ψ", "deg", limits=(0.0, 360.0)),
        Axis("residual specific force", "µg"),
        (
            Series(degrees, degrees * 0.0, role="reference", dashed=True),
            Series(degrees, after, name="after", mark="line+points", role="after", error=error),
        ),
        title="After, enlarged",
    )
    return Figure(
        key="ripple-polar",
        title="Cross-coupling ripple in one turn of the output.",
        panels=(polar, flat),
        caption="Residual specific force around the turn, drawn outwards from the ring of "
        f"{2 * step:g} µg, which means zero; grid rings lie {step:g} µg apart. Cross-coupling shifts the curve "
        "sideways. Good: after calibration the curve lies on the ring, and on the enlarged scale only scatter "
        "is left.",
        columns=2,
        height=3.4,
        notes=(turned_note + scattered,),
    )


def _segments_that_turn(number: int) -> str:
    return "the one segment that turns far enough" if number == 1 else f"{number} segments that turn far enough"


def _nice(size: float) -> float:
    """The next of 1, 2, 5 times a power of ten above ``size``."""
    if not size > 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(size))
    return next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= size * 0.999)


def _polar_grid(step: float) -> tuple[Series, ...]:
    turn = np.linspace(0.0, 2.0 * math.pi, 181)
    rings = [Series(r * np.cos(turn), r * np.sin(turn), role="muted") for r in (step, 3.0 * step)]
    zero = Series(
        2 * step * np.cos(turn), 2 * step * np.sin(turn), role="reference", dashed=True, name="zero ripple"
    )
    spokes_x, spokes_y = [], []
    for angle in np.arange(0.0, 2.0 * math.pi - 1e-9, math.pi / 6.0):
        spokes_x += [step * math.cos(angle), 3.0 * step * math.cos(angle), math.nan]
        spokes_y += [step * math.sin(angle), 3.0 * step * math.sin(angle), math.nan]
    return (*rings, Series(np.array(spokes_x), np.array(spokes_y), role="muted"), zero)


def _closed(psi: Array, values: Array, radius: float, role: Role) -> Series:
    psi, values = np.append(psi, psi[:1]), np.append(values, values[:1])
    text = tuple(f"ψ {np.degrees(p):.0f}°, ripple {v:.3g} µg" for p, v in zip(psi, values, strict=True))
    x, y = (radius + values) * np.cos(psi), (radius + values) * np.sin(psi)
    return Series(x, y, name=role, role=role, text=text)


_LAGS = 40


def calibration_figures(cal: Calibration) -> tuple[Figure, ...]:
    """All figures that this calibration has the data for, in reading order.

    Without ``cal.residuals`` (a calibration read back from JSON) only the segment figure is left.
    """
    figures: list[Figure] = []
    if cal.residuals is not None and cal.residuals.t.size:
        whole, part = outline(cal.residuals), leading_part(cal.residuals)
        figures += run_figures(cal) if cal.runs else [residual_figure(whole, residual_quantity(cal))]
        figures += [whiteness_figure(part)] if np.isfinite(part.innovation).any() else []
        angles = residual_angles(part, cal.diagnostics.residual_kind)
        noise, single = (cal.angle_rms, cal.angle_random_walk), shown_segments(cal)
        allan = None if cal.runs else allan_figure(angles, noise, cal.bias_drift, single)
        figures += [allan] if allan else []
        spectrum, turned = spectrum_and_ripple(angles, scale_factor(cal), noise)
        figures += [spectrum_figure(spectrum, single)] if spectrum.segments else []
        figures += [ripple_figure(turned)] if turned.segments else []
    if len(cal.segments) > 1:
        figures.append(segment_figure(cal))
    outliers = outlier_figure(cal)
    figures += [outliers] if outliers else []
    if cal.history is not None and cal.history["sample"].size > 1:
        figures.append(convergence_figure(cal))
    return tuple(figures)


def residual_angles(residuals: Residuals, kind: str) -> Residuals:
    """The residuals as angles: those of ``kind`` rate integrated over each segment."""
    if kind != "rate":
        return residuals
    step = np.diff(residuals.t, prepend=residuals.t[:1])
    step[np.diff(residuals.segment, prepend=residuals.segment[:1]) != 0] = 0.0
    before, after = _integral(residuals.before, step), _integral(residuals.after, step)
    return replace(residuals, before=before, after=after, unit="rad")


def _integral(rate: Array, step: Array) -> Array:
    return np.cumsum(step * 0.5 * (rate + np.concatenate((rate[:1], rate[:-1]))))


def convergence_figure(cal: Calibration) -> Figure:
    """Estimate of every coefficient against the number of samples used, with its standard uncertainty if it has one."""
    history = cast("dict[str, Array]", cal.history)
    samples = history["sample"]
    panels = []
    for coefficient in cal.coefficients:
        values = history.get(coefficient.key)
        if values is None:
            continue
        scale, unit = shown_unit(coefficient.name, coefficient.unit)
        quantity = coefficient.name
        if coefficient.name == "scale_factor":
            quantity, unit, scale = "scale_factor, from the result", "ppm", 1e6 / coefficient.value
            values = values - coefficient.value
        curve = Series(samples, values * scale, name="estimate", role="model")
        band: tuple[Series, ...] = ()
        if f"u({coefficient.key})" in history:
            half = history[f"u({coefficient.key})"]
            low, high = (values - half) * scale, (values + half) * scale
            band = (Series(samples, low, upper=high, name="standard uncertainty", mark="band", role="muted"),)
        limits = _settled(values * scale)
        axis = Axis(quantity, pretty_unit(unit) or "1", limits=limits)
        panels.append(Panel(Axis("samples seen", "1", log=True), axis, (*band, curve), title=coefficient.key))
    return Figure(
        key="convergence",
        title="Estimates while the record comes in.",
        panels=tuple(panels),
        caption="The last point is the result. The scale is that of the second half of the curve: what happens "
        "before may lie outside. Good: curves that settle inside their shrinking band.",
        columns=2,
        height=2.0,
    )


def _settled(values: Array) -> tuple[float, float]:
    """Limits that show the second half of a history, with some room."""
    late = values[values.size // 4 :]
    low, high = float(late.min()), float(late.max())
    room = 0.5 * (high - low) or abs(high) * 1e-6 or 1e-12
    return low - room, high + room


def elapsed_time(residuals: Residuals) -> Array:
    """Time since the first sample [s]; segments whose clock starts again follow each other."""
    t = np.array(residuals.t, dtype=float)
    end = None
    for part in segment_slices(residuals.segment):
        if end is not None and t[part.start] < end:
            t[part] += end - t[part.start]
        end = t[part.stop - 1]
    return t - t[0]


def _parts(x: Array, residuals: Residuals) -> list[slice]:
    """Parts of a curve: it starts anew at the next segment, or after a hole of more than ten usual steps."""
    steps = np.diff(x)
    starts = (np.diff(residuals.segment) != 0) | (steps > 10.0 * np.median(steps)) if steps.size else steps
    edges = [0, *(np.flatnonzero(starts) + 1).tolist(), x.size]
    return [slice(start, stop) for start, stop in pairwise(edges)]


def _with_gaps(x: Array, y: Array, parts: list[slice]) -> tuple[Array, Array, NDArray[np.int64]]:
    """Reduced curve with gaps between ``parts``, and the row of each of its points."""
    limit = max(12, POINTS // len(parts) - 1)
    pieces_x, pieces_y, kept = [], [], []
    for part in parts:
        rows = part.start + envelope_rows(y[part], limit)
        pieces_x += [x[rows], x[rows[-1:]]]
        pieces_y += [y[rows], np.array([np.nan])]
        kept += [rows, rows[-1:]]
    return np.concatenate(pieces_x), np.concatenate(pieces_y), np.concatenate(kept)


def _outline_note(drawn: int, residuals: Residuals) -> str:
    """How many rows a curve shows."""
    last, first = int(np.max(residuals.row)), int(np.min(residuals.row))
    return (
        f"Drawn: {drawn} points of {max(last - first + 1, residuals.t.size)} rows, the lowest and the highest of each stretch of "
        "time. Zooming in shows the same points; residuals.parquet holds all rows."
    )


def residual_figure(residuals: Residuals, quantity: tuple[str, str] = ("residual angle", "arcsec")) -> Figure:
    """Residual (``quantity``: what and in which unit) against time, before and after."""
    t = elapsed_time(residuals)
    unit, scale = ("h", 3600.0) if t[-1] > 3 * 3600.0 else ("s", 1.0)
    panels = []
    single = bool(np.diff(residuals.segment).all()) and np.unique(residuals.segment).size == t.size
    times = t / scale
    parts = [] if single else _parts(times, residuals)
    drawn = residuals.t.size
    both: tuple[tuple[Role, Array], ...] = (("before", residuals.before), ("after", residuals.after))
    for role, values in both:
        y = np.asarray(values) / ARCSEC
        x, y, kept = (times, y, np.arange(y.size)) if single else _with_gaps(times, y, parts)
        drawn = min(drawn, int(np.isfinite(y).sum()))
        series = Series(
            x,
            y,
            name=role,
            mark="points" if single else "line",
            role=role,
            rows=np.asarray(residuals.row)[kept],
            segments=np.asarray(residuals.segment)[kept],
        )
        panels.append(Panel(Axis("elapsed time", unit), Axis(*quantity), (series,), title=role.capitalize()))
    return Figure(
        key="residual-time",
        title=f"{quantity[0].capitalize()} against time.",
        panels=tuple(panels),
        caption="Before: measured angle less the nominal model without cross-coupling. After: less the fitted "
        "model. The scales differ. Good: a band of noise around zero, without waves, steps or trends.",
        height=2.1,
        notes=() if drawn == residuals.t.size else (_outline_note(drawn, residuals),),
    )


def run_figures(cal: Calibration) -> tuple[Figure, ...]:
    """Residuals against time of every run, each with its own clock and scales."""
    residuals = cal.residuals
    if residuals is None or residuals.run is None:
        return ()
    figures = []
    for index, run in enumerate(cal.runs):
        rows = residuals.run == index
        if rows.any():
            own = rows_of(residuals, np.flatnonzero(rows))
            figure = residual_figure(outline(own), residual_quantity(cal))
            figures.append(
                replace(figure, key=f"residual-time-{index}", title=f"Run {run.name}: {figure.title}")
            )
    return tuple(figures)


MOST_SOURCES = 6
"""Sources of the budget that the figure shows."""


def budget_figure(cal: Calibration) -> Figure | None:
    """Share of each source in the variance of each coefficient; None without a coefficient of the instrument."""
    keys, shares = budget_shares(cal)
    if not keys:
        return None
    number = np.arange(1, len(keys) + 1)
    largest = sorted(shares, key=lambda source: -max(shares[source]))[:MOST_SOURCES]
    roles: tuple[Role, ...] = ("after", "before", "model", "x", "z", "warning")
    series = []
    for k, (source, role) in enumerate(zip(largest, roles, strict=False)):
        place = number + 0.1 * (k - 0.5 * (len(largest) - 1))
        text = tuple(f"{key}: {share:.3g} %" for key, share in zip(keys, shares[source], strict=True))
        series.append(Series(place, shares[source], source_in_words(source), "points", role, text=text))
    listed = ", ".join(f"{k} {key}" for k, key in zip(number, keys, strict=True))
    x = Axis(f"coefficient: {listed}", "", limits=(0.5, number.size + 0.5))
    return Figure(
        key="budget-shares",
        title="Sources of the uncertainty.",
        panels=(Panel(x, Axis("share of the variance", "%", limits=(-3.0, 103.0)), tuple(series)),),
        caption="Share of each source in the variance of each coefficient; the largest sources are shown. The largest "
        "share is what to improve.",
        height=2.7,
    )


def outlier_figure(cal: Calibration) -> Figure | None:
    """Size of every outlier, against time."""
    runs = list(dict.fromkeys(outlier.run for outlier in cal.outliers))
    if not runs:
        return None
    panels = []
    quantity, unit = residual_quantity(cal)
    kinds: tuple[tuple[str, Role], ...] = (("spike", "after"), ("stuck", "model"), ("jump", "before"))
    for run in runs:
        series = []
        for kind, role in kinds:
            those = [o for o in cal.outliers if o.run == run and o.kind == kind and o.size > 0.0]
            if those:
                t, size = np.array([o.time for o in those]), np.array([o.size for o in those]) / ARCSEC
                series.append(Series(t, size, name=kind, mark="points", role=role))
        axis = Axis(f"miss of the {quantity.removeprefix('residual ')}", unit, log=True)
        panels.append(Panel(Axis("time", "s"), axis, tuple(series), title=f"Run {run}" if run else ""))
    return Figure(
        key="outliers",
        title="Samples left out.",
        panels=tuple(panels),
        caption="How far each finding lies off the path of the output. Good: few, and without a pattern; a pattern "
        "points to the counter, the cable or another machine.",
        height=2.3,
    )


def whiteness_figure(residuals: Residuals) -> Figure:
    """Distribution and autocorrelation of the whitened residuals."""
    innovation = np.asarray(residuals.innovation, dtype=float)
    innovation = innovation[np.isfinite(innovation)]
    density, edges = np.histogram(innovation, bins=50, range=(-5.0, 5.0), density=True)
    centre = 0.5 * (edges[1:] + edges[:-1])
    normal = np.exp(-0.5 * centre**2) / math.sqrt(2.0 * math.pi)
    lags, correlation = autocorrelation(innovation, _LAGS)
    bound = 1.96 / math.sqrt(max(innovation.size, 1))
    return Figure(
        key="whiteness",
        title="Whitened residuals.",
        panels=(
            Panel(
                Axis("whitened residual", "1"),
                Axis("density", "1"),
                (
                    Series(centre, density, name="found", mark="steps", role="after"),
                    Series(centre, normal, name="expected of pure noise", role="reference", dashed=True),
                ),
                title="Distribution",
            ),
            Panel(
                Axis("lag", "samples"),
                Axis("autocorrelation", "1"),
                (
                    Series(
                        lags,
                        lags * 0 - bound,
                        mark="band",
                        upper=lags * 0 + bound,
                        name="95 % of white noise",
                        role="reference",
                    ),
                    Series(lags, correlation, name="found", mark="line+points", role="after"),
                ),
                title="Autocorrelation",
            ),
        ),
        caption="Each residual divided by what the noise model expects of it. Good: the found distribution "
        "lies on the expected one, and the autocorrelation stays inside its band.",
        columns=2,
        height=2.6,
    )


def autocorrelation(values: Array, lags: int) -> tuple[Array, Array]:
    """Autocorrelation of ``values`` at lags 1 to ``lags``."""
    lags = min(lags, max(values.size - 2, 0))
    centred = values - values.mean() if values.size else values
    products = np.zeros(lags + 1)
    add_lagged_products(centred, products)
    return np.arange(1.0, lags + 1.0), products[1:] / (products[0] or 1.0)


def segment_figure(cal: Calibration) -> Figure:
    """Residual rms of each segment against its mean specific force."""
    a_x = np.array([segment.mean_a_x for segment in cal.segments]) / G0
    rows = np.argsort(a_x, kind="stable")
    labels = tuple(f"segment {cal.segments[row].label}" for row in rows)
    before = np.array([segment.rms_before for segment in cal.segments])[rows] / ARCSEC
    after = np.array([segment.rms for segment in cal.segments])[rows] / ARCSEC
    quantity, unit = residual_quantity(cal)
    return Figure(
        key="segment-rms",
        title="Residual of each segment.",
        panels=(
            Panel(
                Axis("mean specific force along the input axis", "g"),
                Axis(f"{quantity}, rms", unit, log=True),
                (
                    Series(
                        a_x[rows],
                        before,
                        name="before",
                        mark="points",
                        role="before",
                        text=labels,
                        segments=rows,
                    ),
                    Series(
                        a_x[rows], after, name="after", mark="points", role="after", text=labels, segments=rows
                    ),
                ),
            ),
        ),
        caption="Each point is one segment. Good: all points after calibration lie at one level, whatever the "
        "input; a level that rises with the input asks for another model term.",
        height=2.7,
    )
