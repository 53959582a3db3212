"""Figures of the compensation models as data: lines day by day, histories, position, spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from piga.platform.model.scenario import Model
from piga.platform.navigation.analysis import case_rates, spectrum
from piga.platform.runs.chain import Comparison, ModelRun
from piga.reports.platform.figures import (
    ARCMIN,
    DAY,
    HOUR,
    MINUTE,
    averaged,
    model_name,
    schuler_peak,
    time_axis,
)
from piga.reports.render.figure import Axis, Figure, Panel, Role, Series

MODEL_ROLES: dict[str, Role] = {"none": "muted", "A": "before", "B": "after", "C": "model"}
_LABELS = {
    "east_velocity": ("east velocity line", "m/s", 1.0),
    "north_velocity": ("north velocity line", "m/s", 1.0),
    "heading": ("heading line", "arcmin", ARCMIN),
    "roll": ("roll line", "arcmin", ARCMIN),
}


_SAYINGS = {
    "A": "Model A grows with the redundancy angle.",
    "B": "Model B follows the redundancy angle.",
    "C": "Model C removes the wobble as well.",
}


Case = Literal["amplitude", "equatorial"]
"""Which lines: at the polar case's rate, or at the equatorial one's where it turns at another speed."""
REFERENCE_MODEL: dict[Case, Model] = {"amplitude": "A", "equatorial": "none"}
"""Model whose theory stands beside the lines: what A leaves grows at the polar rate, at the equatorial one it is nothing."""


def lines_figure(comparison: Comparison, which: Case = "amplitude") -> Figure:
    """Amplitude at a case-rotation period against the day, each model, with the theory dashed."""
    panels = []
    for name in ("east_velocity", "heading", "roll", "north_velocity"):
        quantity, unit, scale = _LABELS[name]
        series = []
        for model, found in comparison.models.items():
            role = MODEL_ROLES[model]
            label = model_name(model)
            series.append(
                Series(found.lines.day, getattr(found.lines, which)[name] / scale, label, "line+points", role)
            )
            if model == REFERENCE_MODEL[which] and found.theory is not None:
                series.append(
                    Series(
                        found.theory.day,
                        getattr(found.theory, which)[name] / scale,
                        f"theory, {model_name(model)}",
                        "line",
                        "reference",
                        dashed=True,
                    )
                )
        panels.append(Panel(Axis("day", "1"), Axis(quantity, unit, log=True), tuple(series)))
    key, whose = ("fig-lines-per-day", "case-rotation") if which == "amplitude" else (
        "fig-equatorial-lines-per-day", "equatorial case's")  # fmt: skip
    sayings = [_SAYINGS[m] for m in comparison.models if m in _SAYINGS]
    return Figure(
        key,
        f"What each model leaves at the {whose} period",
        tuple(panels),
        " ".join(["Amplitude fitted over each day.", *(sayings if which == "amplitude" else ())]),
        columns=2,
        height=2.6,
    )


def histories_figure(comparison: Comparison) -> Figure:
    """Errors over the whole run: east velocity, heading, roll, horizontal position."""
    times = next(iter(comparison.models.values())).errors.times
    axis, unit = time_axis(float(times[-1]))
    return _channels(
        comparison,
        slice(None),
        axis,
        unit,
        "fig-histories",
        "Navigation errors over the run",
        "The models leave the Schuler motion of the start and, model A, a line that grows. Without a model the "
        "errors are far larger and would hide these.",
        0.0,
        ("A", "B", "C"),
    )


def published_figure(comparison: Comparison) -> Figure:
    """The last forty minutes, as the publication shows day ten: the oscillation left at the case period."""
    times = next(iter(comparison.models.values())).errors.times
    begin = max(0.0, float(times[-1]) - 40.0 * MINUTE)
    part = slice(int(np.searchsorted(times, begin)), None)
    return _channels(
        comparison,
        part,
        Axis("time before the end", "min"),
        MINUTE,
        "fig-last-minutes",
        "The last forty minutes",
        "Means taken out. The period is that of the case rotation.",
        float(times[-1]),
        ("A", "B", "C"),
    )


def _channels(
    comparison: Comparison,
    part: slice,
    axis: Axis,
    unit: float,
    key: str,
    title: str,
    caption: str,
    origin: float,
    only: Sequence[str] = ("none", "A", "B", "C"),
) -> Figure:
    shown = {m: r for m, r in comparison.models.items() if m in only} or dict(comparison.models)
    over = _quiet(comparison)
    if over > 1:
        caption += " Heading and roll are means over half a minute, freed of most of the gimbal noise."
    rows: list[tuple[str, str, float]] = [
        ("east velocity error", "m/s", 1.0),
        ("heading error", "arcmin", ARCMIN),
        ("roll error", "arcmin", ARCMIN),
    ]
    panels = []
    for k, (quantity, name, scale) in enumerate(rows):
        series = []
        for model, run in shown.items():
            e, width = run.errors, over if k else 1
            values = (e.velocity[:, 1], e.attitude[:, 2], e.attitude[:, 0])[k][part] / scale
            values = averaged(values - values.mean() if origin else values, width)
            times = averaged(e.times[part] - origin, width) / unit
            series.append(Series(times, values, model_name(model), "line", MODEL_ROLES[model]))
        panels.append(Panel(axis, Axis(quantity, name), tuple(series)))
    return Figure(key, title, tuple(panels), caption, height=2.2)


def _quiet(comparison: Comparison) -> int:
    """Rows of half a minute where the gimbals are read with noise, else one."""
    if comparison.run.scenario.sensors.gimbal_noise == 0.0:
        return 1
    times = next(iter(comparison.models.values())).errors.times
    return max(1, round(0.5 * MINUTE / float(times[1] - times[0])))


def position_figure(comparison: Comparison) -> Figure:
    """Horizontal position error against time."""
    times = next(iter(comparison.models.values())).errors.times
    axis, unit = time_axis(float(times[-1]))
    peaks = {
        m: np.maximum(schuler_peak(run.errors.times, run.errors.horizontal), 1e-9)
        for m, run in comparison.models.items()
    }
    series = tuple(
        Series(times / unit, peak, model_name(m), "line", MODEL_ROLES[m]) for m, peak in peaks.items()
    )
    largest, least = max(peak.max() for peak in peaks.values()), min(peak.min() for peak in peaks.values())
    decades = bool(largest > 30.0 * least)
    return Figure(
        "fig-position",
        "Horizontal position error",
        (Panel(axis, Axis("horizontal position error", "m", log=decades), series),),
        "Distance between where the navigator says it is and where it is; largest of 84 minutes.",
    )


def spectrum_figure(comparison: Comparison) -> Figure:
    """Amplitude spectrum of the east velocity over the last day, with the lines to expect."""
    s = comparison.run.scenario
    series, low, high = [], np.inf, 0.0
    for model, run in comparison.models.items():
        part = run.errors.times > run.errors.times[-1] - DAY
        frequency, amplitude = spectrum(run.errors.times[part], run.errors.velocity[part, 1])
        keep = (frequency > 1.0 / (6.0 * HOUR)) & (frequency < 1.0 / 60.0)
        amplitude = np.maximum(amplitude[keep], 1e-9)
        low, high = min(low, float(np.percentile(amplitude, 10))), max(high, float(amplitude.max()))
        label = model_name(model)
        series.append(Series(1.0 / frequency[keep] / MINUTE, amplitude, label, "line", MODEL_ROLES[model]))
    if s.polar_rotation.rate > 0.0 or s.equatorial_rotation.rate > 0.0:
        rates = case_rates(s)
        labels = ("case rotation",) if len(rates) == 1 else ("polar case", "equatorial case")
        roles: tuple[Role, Role] = ("reference", "warning")
        for rate, label, role in zip(rates, labels, roles, strict=False):
            if rate > 0.0:
                period = 2.0 * np.pi / rate / MINUTE
                series.append(Series([period] * 2, [low, 2.0 * high], label, "line", role, dashed=True))
    panel = Panel(
        Axis("period", "min", log=True), Axis("east velocity amplitude", "m/s", log=True), tuple(series)
    )
    return Figure(
        "fig-spectrum",
        "Spectrum of the east velocity, last day",
        (panel,),
        "Amplitude of a sine at each period (Hann window). The Schuler motion stands at 84 min.",
    )


def model_figure(run: ModelRun) -> Figure:
    """Errors of one model over the run and over its last forty minutes."""
    e = run.errors
    axis, unit = time_axis(float(e.times[-1]))
    late = e.times > e.times[-1] - 40.0 * MINUTE
    name = run.compensator.model
    named: tuple[tuple[str, Role], ...] = (("roll", "x"), ("pitch", "y"), ("heading", "z"))
    panels = []
    for part, ax, origin, scale in (
        (np.ones_like(late), axis, 0.0, unit),
        (late, Axis("time before the end", "min"), e.times[-1], MINUTE),
    ):
        x = (e.times[part] - origin) / scale
        velocity = (
            Series(x, e.velocity[part, 1], "east", "line", "x"),
            Series(x, e.velocity[part, 0], "north", "line", "y"),
        )
        angles = tuple(
            Series(x, e.attitude[part, k] / ARCMIN, label, "line", role)
            for k, (label, role) in enumerate(named)
        )
        panels += [
            Panel(ax, Axis("velocity error", "m/s"), velocity),
            Panel(ax, Axis("attitude error", "arcmin"), angles),
        ]
    order = (panels[0], panels[2], panels[1], panels[3])
    return Figure(
        f"fig-model-{name}",
        "No model" if name == "none" else f"Model {name}",
        order,
        "Left: the whole run. Right: its last forty minutes.",
        columns=2,
        height=2.4,
    )
