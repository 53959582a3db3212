"""Figures of a calibration: residuals against time, order and output angle; Allan deviation; whiteness; segments."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit import lagged_products
from piga.calibration.orders import (
    OrderSpectrum,
    order_spectrum,
    residual_angles,
    ripple,
    segment_slices,
)
from piga.noise.deviations import allan_deviation
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.diagnostics import COUNTED, Residuals
from piga.reports.calibration.tables import residual_quantity, scale_factor
from piga.reports.render.figure import POINTS, Axis, Figure, Plot, Role, envelope_rows
from piga.reports.render.numbers import shown_output
from piga.results import Array
from piga.units import ARCSEC, G0, MICRO_G

_LAGS = 40
"""Lags of the autocorrelation."""
_SHOWN, _OUTLINE = 1 << 20, 50_000
"""Samples that figures work on at most, and points of the residuals of a longer record."""
_BEAT = "the beat of whole counts with the sampling makes it, not the instrument"
"""Why a line stands in the spectrum of a counted output."""
_COUNTED_NOTE = "The output is read in whole counts: the distribution is flat, and rounding can correlate lags outside the band."
"""Why whitened residuals of a counted output are not normal."""


def figures_of(cal: Calibration) -> dict[str, Callable[[], Figure | None]]:
    """Functions that make the figures, by name. None, or no function: the calibration has no data for the figure.

    Without ``cal.residuals`` (a calibration read back from JSON) those of the residuals are missing.
    """
    made: dict[str, Callable[[], Figure | None]] = {
        "segments": partial(segment_figure, cal),
        "creep": partial(creep_figure, cal),
    }
    if cal.residuals is None or not cal.residuals.t.size:
        return made
    part = _leading_part(cal.residuals)
    angles = residual_angles(part, cal.diagnostics.residual_kind)
    runs = tuple(run.name for run in cal.runs)
    made["residuals"] = partial(residual_figure, cal.residuals, residual_quantity(cal), runs)
    made["whiteness"] = partial(_whiteness_figure, part, cal.diagnostics.verdict)
    if not runs:
        made["allan"] = partial(_allan_figure, cal, angles)
    if not cal.direct:
        made |= {"orders": partial(_order_figure, cal, angles), "ripple": partial(_ripple_figure, cal, angles)}
    return made


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


def calibration_figures(cal: Calibration) -> dict[str, Figure]:
    """All figures that this calibration has the data for, by name."""
    made = {name: make() for name, make in figures_of(cal).items()}
    return {name: figure for name, figure in made.items() if figure is not None}


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
    notes = tuple(
        note for name, part in parts if part.t.size for note in _draw_residuals(plot, name, part, quantity, per)
    )
    before = "Before: measured output less K a_x with the nominal K."
    if per == ARCSEC:
        before = "Before: measured angle less the nominal model without cross-coupling."
    return plot.caption(
        f"{before} After: less the fitted model. The scales differ. Good: a band of noise around zero, without waves, steps or "
        "trends.",
        *notes,
    )


def _draw_residuals(
    plot: Plot, name: str, residuals: Residuals, quantity: tuple[str, str], per: float
) -> Iterator[str]:
    """Draw before and after, broken between segments and at holes of more than ten usual steps. Yields a note on a long record."""
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
    if kept.size > POINTS:
        rows = max(int(np.ptp(residuals.row)) + 1, residuals.t.size)
        yield (
            f"Drawn of {rows} rows: the lowest and the highest of each stretch of time. Zooming in shows the same points; "
            "residuals.parquet holds all rows."
        )


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
    spectrum = order_spectrum(angles, scale_factor(cal), (cal.angle_rms, cal.angle_random_walk))
    return spectrum_figure(spectrum, cal) if spectrum.segments else None


def spectrum_figure(spectrum: OrderSpectrum, cal: Calibration) -> Figure:
    """Ripple amplitude against revolution order. Lines above the noise are named in the notes."""
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
        words = _BEAT if explained else "neither the noise nor whole counts explain it"
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
    """Overlapping Allan deviation with its 68 % band, the noise found, and the slope of a bias drift for comparison.

    ``residuals`` are angles [rad].
    """
    per, shown = shown_output(cal.unit)
    white, walk = cal.angle_rms**2, cal.angle_random_walk**2
    levels = {2: 3.0 * white, 0: walk}
    deviation = allan_deviation(residuals.after, residuals.t, _begins(residuals), noise=levels)
    if deviation.tau.size < 2:
        return None
    tau, measured = deviation.tau, deviation.deviation / per
    angle, wander = np.sqrt(3.0 * white) / tau / per, np.sqrt(walk / tau) / per
    both = np.hypot(angle, wander)
    drift = both[-1] / math.sqrt(tau[-1] / 3.0) * np.sqrt(tau / 3.0)
    near = tau >= 0.1 * tau[-1]
    limits = (
        0.3 * min(float(measured.min()), float(both.min())),
        3.0 * max(float(deviation.upper.max()) / per, float(both.max())),
    )
    y = Axis("Allan deviation of the rate", shown, log=True, limits=limits)
    plot = Plot("allan", "Allan deviation of the residual rate.", "log averaging time [s]", y, height=3.4)
    band = (deviation.lower / per, deviation.upper / per)
    plot.band(tau, *band, "68 % band").marked(tau, measured, "residual", "after")
    plot.line(tau, both, "noise found", "model")
    if white > 0.0:
        plot.dashed(tau, angle, "white noise", "x")
    if walk > 0.0:
        plot.dashed(tau, wander, "random walk", "y")
    plot.dashed(tau[near], drift[near], "slope of a drift", "warning")
    return plot.caption(
        "Overlapping Allan deviation of what the calibration leaves, with its 68 % band. Stretches are pooled, "
        "not joined: nothing longer than a third of the longest one is seen. Good: the curve follows the noise found; "
        "one that turns upwards along the dashed slope, above it, shows a drift of the bias that was not found."
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
    return plot.caption(
        "Each residual divided by what the noise model expects of it. Good: the found distribution lies on the expected "
        "one, and the autocorrelation stays inside its band.",
        *((_COUNTED_NOTE,) if verdict == COUNTED else ()),
    )


# -- segments and creep -----------------------------------------------------------------------------------


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


def creep_figure(cal: Calibration) -> Figure | None:
    """Residual rate against the time since the start of the position; None if creep was not tested."""
    creep = cal.diagnostics.creep
    if creep is None or not creep.time:
        return None
    t, mean, band = np.array(creep.time), 1e6 * np.array(creep.mean), 1e6 * np.array(creep.band)
    plot = Plot(
        "creep", "Residual after a move.", "time since the start of the position [s]",
        "residual rate over K [µg]", height=2.7,
    )  # fmt: skip
    plot.band(t, -band, band, "95 % by the scatter of the positions", "reference")
    plot.marked(t, mean, "mean over the positions", "after")
    return plot.caption(
        "Residual rate over K, less its mean in the position, stacked by the time since the start of the position. Good: all "
        "points but one in twenty lie in the band. A curve that begins outside and comes back is a creep after each move: "
        "leave out that time with settle in [data]."
    )
