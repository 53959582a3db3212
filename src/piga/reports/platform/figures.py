"""Figures of the platform as data: one run, the compensation models day by day."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from piga.platform.alignment import Alignment
from piga.platform.analysis import case_rates, spectrum
from piga.platform.chain import ModelComparisonRun
from piga.platform.identify import GrowingIdentification
from piga.platform.scenario import Model
from piga.platform.simulate import PlatformRun
from piga.reports.render.figure import XYZ, Figure, Plot, Role
from piga.results import Array
from piga.units import ARCMIN, ARCSEC, DAY

HOUR, MINUTE = 3600.0, 60.0


def time_axis(span: float) -> tuple[str, float]:
    """Axis of time in a unit that suits the span [s], and that unit in seconds."""
    for unit, seconds in (("d", DAY), ("h", HOUR), ("min", MINUTE)):
        if span > 2.0 * seconds:
            return f"time [{unit}]", seconds
    return "time [s]", 1.0


def model_name(model: str) -> str:
    """Name of a compensation model on the pages."""
    return "no model" if model == "none" else f"model {model}"


def schuler_peak(times: Array, values: Array) -> Array:
    """Largest value within 42 minutes either side."""
    from scipy.ndimage import maximum_filter1d

    return maximum_filter1d(values, size=max(1, round(84.4 * MINUTE / float(times[1] - times[0]))))


def averaged(values: Array, over: int) -> Array:
    """Running mean of ``values`` (n,) or (n, k) over ``over`` samples, (n - over + 1, ...)."""
    start = values[:1]
    total = np.cumsum(np.concatenate([0.0 * start, values - start]), axis=0)
    return start + (total[over:] - total[:-over]) / over


def readouts_figure(run: PlatformRun) -> Figure:
    """Readouts: specific force, gimbal angles and pick-off, over the run and its first minutes."""
    r = run.readouts
    axis, unit = time_axis(float(r.times[-1]))
    early = slice(0, max(2, min(len(r.times), int(40.0 * MINUTE / r.step))))
    minutes = "time [min]"
    middle = 0.5 * (r.times[1:] + r.times[:-1])
    force = r.increments / r.step
    angles = np.unwrap(r.gimbals, axis=0)
    gimbals = ("outer", "middle", "inner")
    over = 1 if run.truth.motion.at_rest else max(1, round(MINUTE / r.step))
    close = "" if over == 1 else ", 1 min mean"
    plot = Plot("fig-readouts", "What is read on the platform", columns=2, height=2.4)
    _three(plot, axis, "specific force [m/s^2]", middle / unit, force, XYZ)
    start = _course_out(middle[early], 1e3 * force[early], over)
    _three(plot, minutes, f"force{close} [mm/s^2]", *start, XYZ)
    _three(plot, axis, "gimbal angle [deg]", r.times / unit, np.degrees(angles), gimbals)
    start = _course_out(r.times[early], angles[early] / ARCMIN, over)
    _three(plot, minutes, f"gimbal{close} [arcmin]", *start, gimbals)
    for x, part, scale in ((axis, slice(None), unit), (minutes, early, MINUTE)):
        plot.panel(x, "pick-off [arcmin]")
        plot.line(r.times[part] / scale, r.pickoff[part] / ARCMIN, "read")
        plot.line(r.times[part] / scale, run.truth.eta[part] / ARCMIN, "redundancy angle", "model")
    mean = "" if over == 1 else "; averaged over a minute, so that the motion of the vehicle does not hide it"
    return plot.caption(
        "Left: the whole run. Right: the first minutes, force and gimbal angles less a parabola, so that what "
        f"turns with the cases shows{mean}."
    )


def _three(plot: Plot, x: str, y: str, at: Array, values: Array, labels: Sequence[str]) -> None:
    """A panel of three columns against time, in the colours of the axes."""
    plot.panel(x, y)
    for k, label in enumerate(labels):
        plot.line(at, values[:, k], label, XYZ[k])


def _course_out(times: Array, values: Array, over: int) -> tuple[Array, Array]:
    """Time [min] and columns of ``values`` (n, 3), averaged over ``over`` samples and freed of a parabola."""
    t, mean = averaged(times, over), averaged(values, over)
    basis = np.polynomial.polynomial.polyvander((t - t.mean()) / (t[-1] - t[0]), 2)
    fitted, *_ = np.linalg.lstsq(basis, mean, rcond=None)
    return t / MINUTE, mean - basis @ fitted


def convergence_figure(growing: GrowingIdentification) -> Figure:
    """Estimates from growing parts of the record with their 95 % band, relative to the last one."""
    t, values, stds = growing.times / MINUTE, growing.values, growing.stds
    names = growing.parts[-1].names
    half = (len(names) - 2 * ("eta0" in names)) // 2
    plot = Plot("fig-convergence", "Identification as the record grows", columns=2, height=2.6)
    roles: tuple[Role, Role] = ("x", "y")
    for at, title in ((0, "polar"), (half, "equatorial")):
        last = values[-1, at : at + 2]
        plot.panel("time [min]", f"{title}, off its end [arcsec]")
        for k, role in enumerate(roles):
            y, s = (values[:, at + k] - last[k]) / ARCSEC, 1.96 * stds[:, at + k] / ARCSEC
            plot.band(t, -s, s, "95 % band" if k == 0 else "")
            plot.line(t, y, f"m {'cos' if k == 0 else 'sin'}(phase)", role)
    return plot.caption(
        "Estimates from growing parts of the record, less the last one; the band is their 95 % interval."
    )


def cone_figure(run: PlatformRun, aligned: Alignment) -> Figure:
    """Gravity in platform axes over the alignment, and the cone it runs on."""
    r = run.readouts.first(run.scenario.calibration_time)
    force = r.increments / r.step
    block = max(1, len(force) // 240)
    mean = force[: len(force) // block * block].reshape(-1, block, 3).mean(axis=1)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    inertial = mean[0] @ aligned.triad.T
    radius = float(np.hypot(inertial[0], inertial[1]))
    cone = (
        np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, inertial[2])], axis=1)
        @ aligned.triad
    )
    plot = Plot("fig-cone", "The gravity cone").panel(
        "specific force x [m/s^2]", "specific force y [m/s^2]", equal=True
    )
    plot.line(cone[:, 0], cone[:, 1], "cone about the Earth's axis", "muted")
    plot.points(mean[:, 0], mean[:, 1], "measured")
    return plot.caption(
        "On a platform fixed in inertial space gravity runs once round this cone in a sidereal "
        "day; the measured arc gives the Earth's axis."
    )


_MODEL_ROLES: dict[str, Role] = {"none": "muted", "A": "before", "B": "after", "C": "model"}
_DASHED = "C"
"""Model whose curve is dashed: it often lies on that of model B, which must be seen."""
_LINES = {
    "east_velocity": ("east velocity line [m/s]", 1.0),
    "heading": ("heading line [arcmin]", ARCMIN),
    "roll": ("roll line [arcmin]", ARCMIN),
    "north_velocity": ("north velocity line [m/s]", 1.0),
}
_SAYINGS = {
    "A": "Model A grows with the redundancy angle.",
    "B": "Model B follows the redundancy angle.",
    "C": "Model C removes the wobble as well.",
}
Case = Literal["amplitude", "equatorial"]
"""Choice of lines: at the polar case's rate, or at the equatorial case's rate if that differs."""
WITH_THEORY: dict[Case, tuple[Model, ...]] = {"amplitude": ("A", "none"), "equatorial": ("none",)}
"""Models whose theory stands beside the lines: what A leaves grows at the polar rate, at the equatorial one it is nothing."""


def lines_figure(comparison: ModelComparisonRun, which: Case = "amplitude") -> Figure:
    """Amplitude at a case-rotation period against the day, each model, with the theory dashed."""
    polar = which == "amplitude"
    key, whose = ("fig-lines", "case-rotation") if polar else ("fig-equatorial-lines", "equatorial case's")
    plot = Plot(f"{key}-per-day", f"What each model leaves at the {whose} period", columns=2, height=2.6)
    for name, (quantity, scale) in _LINES.items():
        plot.panel("day", f"log {quantity}")
        for model, run in comparison.models.items():
            label, amplitude = model_name(model), getattr(run.lines, which)[name]
            dashed = model == _DASHED
            plot.marked(run.lines.day, amplitude / scale, label, _MODEL_ROLES[model], dashed=dashed)
            if model in WITH_THEORY[which] and run.theory is not None:
                theory = getattr(run.theory, which)[name]
                plot.dashed(run.theory.day, theory / scale, f"theory, {label}")
    sayings = [_SAYINGS[m] for m in comparison.models if m in _SAYINGS and polar]
    return plot.caption(" ".join(["Amplitude fitted over each day.", *sayings]))


def histories_figure(comparison: ModelComparisonRun) -> Figure:
    """Errors over the whole run: east velocity, heading, roll."""
    caption = (
        "The models leave the Schuler motion of the start and, model A, a line that grows. Without a model the "
        "errors are far larger and would hide these."
    )
    return _channels(comparison, "fig-histories", "Navigation errors over the run", caption)


def published_figure(comparison: ModelComparisonRun) -> Figure:
    """The last forty minutes, as the publication shows day ten: the oscillation left at the case period."""
    caption = "Means taken out. The period is that of the case rotation."
    return _channels(comparison, "fig-last-minutes", "The last forty minutes", caption, last=True)


def _channels(
    comparison: ModelComparisonRun, key: str, title: str, caption: str, *, last: bool = False
) -> Figure:
    """Errors of the models over the run; ``last``: over its last forty minutes, less their means.

    Heading and roll are averaged over half a minute where the gimbals are read with noise.
    """
    every = next(iter(comparison.models.values())).errors.times
    end, step = float(every[-1]), float(every[1] - every[0])
    axis, unit = ("time before the end [min]", MINUTE) if last else time_axis(end)
    begin, origin = (max(0.0, end - 40.0 * MINUTE), end) if last else (0.0, 0.0)
    shown = [(m, r) for m, r in comparison.models.items() if m != "none"] or comparison.models.items()
    noisy = comparison.run.scenario.sensors.gimbal_noise > 0.0
    over = max(1, round(0.5 * MINUTE / step)) if noisy else 1
    if over > 1:
        caption += " Heading and roll are means over half a minute, freed of most of the gimbal noise."
    plot = Plot(key, title, height=2.2)
    for k, quantity in enumerate(
        ("east velocity error [m/s]", "heading error [arcmin]", "roll error [arcmin]")
    ):
        plot.panel(axis, quantity)
        for model, run in shown:
            e, width = run.errors, over if k else 1
            part = slice(int(np.searchsorted(e.times, begin)), None)
            values = (e.velocity[:, 1], e.attitude[:, 2] / ARCMIN, e.attitude[:, 0] / ARCMIN)[k][part]
            values = averaged(values - values.mean() if last else values, width)
            times = averaged(e.times[part] - origin, width) / unit
            plot.line(times, values, model_name(model), _MODEL_ROLES[model], dashed=model == _DASHED)
    return plot.caption(caption)


def position_figure(comparison: ModelComparisonRun) -> Figure:
    """Horizontal position error against time."""
    times = next(iter(comparison.models.values())).errors.times
    axis, unit = time_axis(float(times[-1]))
    peaks = {
        m: np.maximum(schuler_peak(run.errors.times, run.errors.horizontal), 1e-9)
        for m, run in comparison.models.items()
    }
    largest, least = max(peak.max() for peak in peaks.values()), min(peak.min() for peak in peaks.values())
    log = "log " if largest > 30.0 * least else ""
    plot = Plot("fig-position", "Horizontal position error", axis, f"{log}horizontal position error [m]")
    for m, peak in peaks.items():
        plot.line(times / unit, peak, model_name(m), _MODEL_ROLES[m], dashed=m == _DASHED)
    return plot.caption(
        "Distance between where the navigator says it is and where it is; largest of 84 minutes."
    )


def spectrum_figure(comparison: ModelComparisonRun) -> Figure:
    """Amplitude spectrum of the east velocity over the last day, with the lines to expect."""
    s, low, high = comparison.run.scenario, np.inf, 0.0
    title = "Spectrum of the east velocity, last day"
    plot = Plot("fig-spectrum", title, "log period [min]", "log east velocity amplitude [m/s]")
    for model, run in comparison.models.items():
        part = run.errors.times > run.errors.times[-1] - DAY
        frequency, amplitude = spectrum(run.errors.times[part], run.errors.velocity[part, 1])
        keep = (frequency > 1.0 / (6.0 * HOUR)) & (frequency < 1.0 / 60.0)
        amplitude = np.maximum(amplitude[keep], 1e-9)
        low, high = min(low, float(np.percentile(amplitude, 10))), max(high, float(amplitude.max()))
        period = 1.0 / frequency[keep] / MINUTE
        plot.line(period, amplitude, model_name(model), _MODEL_ROLES[model], dashed=model == _DASHED)
    if s.polar_rotation.rate > 0.0 or s.equatorial_rotation.rate > 0.0:
        rates = case_rates(s)
        labels = ("case rotation",) if len(rates) == 1 else ("polar case", "equatorial case")
        roles: tuple[Role, Role] = ("reference", "warning")
        for rate, label, role in zip(rates, labels, roles, strict=False):
            if rate > 0.0:
                plot.dashed([2.0 * np.pi / rate / MINUTE] * 2, [low, 2.0 * high], label, role)
    return plot.caption(
        "Amplitude of a sine at each period (Hann window). The Schuler motion stands at 84 min."
    )
