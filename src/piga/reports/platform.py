"""Pages and figures of ``piga platform``: simulate, align, identify, navigate and compare."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Literal

import numpy as np

from piga.platform.chain import BudgetRow, ModelComparisonRun, case_rates, last_east_lines
from piga.platform.geometry import apparent_gyro, wrapped
from piga.platform.identify import (
    UNKNOWN_PHASE,
    Alignment,
    Identification,
    Parameter,
)
from piga.platform.scenario import Gyro, Model, PlatformScenario
from piga.platform.simulate import PlatformRun
from piga.reports.render.figure import XYZ, Figure, Plot, Role
from piga.reports.render.numbers import fixed, short, signed, significant
from piga.reports.render.page import Content, Notice, Page, Section, Table, TableOf, Text, Tile, sections
from piga.results import Array
from piga.units import ARCMIN, ARCSEC, DAY

_FOOTER = (
    "Simulated with the exact geometry of both nulled pick-offs; compensated with the small-angle matrices."
)
DEGREE_PER_HOUR = np.radians(1.0) / 3600.0


def page(title: str, s: PlatformScenario, tiles: tuple[Tile, ...], shown: tuple[Section, ...]) -> Page:
    """A page with the run in its subtitle."""
    length = f"{s.duration / DAY:.4g} d at {s.step:g} s"
    where = f"{fixed(float(np.degrees(s.place.latitude)), 3)} deg latitude, {length}, base {s.motion.kind}"
    return Page(title, where, tiles, shown, "piga platform", _FOOTER)


def _parameter_table(identification: Identification, s: PlatformScenario) -> Table:
    truth = _truth_by_name(
        apparent_gyro(s.polar, s.polar_rotation, s.reversal),
        apparent_gyro(s.equatorial, s.equatorial_rotation, s.reversal),
    )
    noise = ", ".join(
        f"force {level:.2g} m/s^2" if name == "force" else f"{name} {level / ARCSEC:.3g} arcsec"
        for name, level in identification.noise.items()
    )
    note = f"Noise found in the residuals: {noise}. Truth includes the circle of case-fixed drift."
    rows = (_parameter_row(p, truth.get(p.name)) for p in identification.parameters)
    return _quantities(rows, "off truth, in uncertainties", note)


def _quantities(rows: Iterable[tuple[str, ...]], off: str, note: str) -> Table:
    """Quantities with value, standard uncertainty, unit, and how far they are ``off`` the truth."""
    table = TableOf(rows).text("quantity", lambda row: row[0]).number("value", lambda row: row[1])
    table.number("standard uncertainty", lambda row: row[2]).text("unit", lambda row: row[3])
    return table.number(off, lambda row: row[4]).table(notes=(note,))


def _shown(name: str) -> tuple[str, float, str]:
    """A parameter of a gyro in words, and the unit in which it is shown: its size and name."""
    words = name.replace(".", " ").replace("harmonic", "harmonic ")
    if name.endswith("phase"):
        return words, np.radians(1.0), "deg"
    return (words, DEGREE_PER_HOUR, "deg/h") if "drift" in name or "rate" in name else (words, ARCSEC, "arcsec")


def _parameter_row(p: Parameter, true: float | None) -> tuple[str, ...]:
    name, scale, unit = _shown(p.name)
    if unit == "deg" and p.std > 0.25 * UNKNOWN_PHASE:
        return name, "not determined", "–", unit, "–"
    off = "–"
    if true is not None:
        difference = float(wrapped(p.value - true)) if unit == "deg" else p.value - true
        off = signed(difference / p.std, 2) if p.std > 1e-11 else significant(difference / scale, 2)
    return name, fixed(p.value / scale, 5), significant(p.std / scale, 2), unit, off


def _truth_by_name(polar: Gyro, equatorial: Gyro) -> dict[str, float]:
    truth = {}
    for name, gyro in (("polar", polar), ("equatorial", equatorial)):
        truth[f"{name}.misalignment"], truth[f"{name}.phase"] = gyro.misalignment, gyro.phase
        for h in gyro.harmonics:
            truth[f"{name}.harmonic{h.order}.amplitude"] = h.amplitude
            truth[f"{name}.harmonic{h.order}.phase"] = h.phase
    return truth


def simulation_page(run: PlatformRun) -> Page:
    """Page of ``piga platform simulate``."""
    s, eta = run.scenario, np.degrees(run.truth.eta)
    grew = f"grew by {short(abs(float(eta[-1] - eta[0])))} deg"
    tiles = (
        Tile("duration", short(s.duration / DAY), "d", f"{s.steps} steps of {short(s.step)} s"),
        Tile("redundancy angle", short(eta[-1]), "deg", grew),
        Tile("base", s.motion.kind, "", "motion of the vehicle"),
    )
    shown = (
        Section("What is read", "read", (partial(readouts_figure, run),)),
        Section("What was put in", "truth", (_truth_table(s),)),
    )
    return page("Platform simulation", s, tiles, shown)


def identification_page(run: PlatformRun, identification: Identification) -> Page:
    """Page of ``piga platform identify``."""
    s, tiles = run.scenario, []
    for gyro in ("polar", "equatorial"):
        m = identification[f"{gyro}.misalignment"]
        spread = f"± {short(m.std / ARCSEC)} arcsec"
        tiles.append(Tile(f"{gyro} misalignment", fixed(m.value / ARCMIN, 5), "arcmin", spread))
    tiles.append(Tile("condition", short(identification.condition), "", " + ".join(identification.sources)))
    notes = (Notice("info", note) for note in identification.notes)
    found: tuple[Content, ...] = (_parameter_table(identification, s), *notes)
    shown = (Section("Misalignments, phases and harmonics", "parameters", found),)
    return page("Platform identification", s, tuple(tiles), shown)


def alignment_page(run: PlatformRun, aligned: Alignment) -> Page:
    """Page of ``piga platform align``."""
    attitude, drift = aligned.std[:3].max() / ARCSEC, aligned.std[3:6].max() / DEGREE_PER_HOUR
    heading, spread = float(np.degrees(aligned.base_angles[2])), aligned.base_stds[2] / ARCSEC
    tiles = (
        Tile("triad attitude", short(float(attitude)), "arcsec", "largest standard uncertainty of three"),
        Tile("triad drift", short(float(drift)), "deg/h", "largest standard uncertainty"),
        Tile("base heading", fixed(heading, 4), "deg", f"± {short(float(spread))} arcsec"),
    )
    note = "Accelerometer bias is not seen: one micro-g across gravity tilts the result by 0.2 arcsec."
    table = _quantities(_alignment_rows(run, aligned), "off truth", note)
    shown = (Section("Attitude and drift", "attitude", (table,)),)
    return page("Platform alignment", run.scenario, tiles, shown)


def _truth_table(s: PlatformScenario) -> Table:
    known = [(_shown(name), value) for name, value in _truth_by_name(s.polar, s.equatorial).items()]
    rows = [(words, fixed(value / scale, 4), unit) for (words, scale, unit), value in known]
    for name, gyro, axes in (("polar", s.polar, "w1x, w1y"), ("equatorial", s.equatorial, "w2y, w2z")):
        for words, drift in ((f"drift {axes}", gyro.drift), ("case-fixed drift", gyro.case_drift)):
            pair = ", ".join(significant(w / DEGREE_PER_HOUR, 4) for w in drift)
            rows.append((f"{name} {words}", pair, "deg/h"))
    table = TableOf(rows).text("quantity", lambda row: row[0]).number("value", lambda row: row[1])
    return table.text("unit", lambda row: row[2]).table()


def _alignment_rows(run: PlatformRun, aligned: Alignment) -> Iterator[tuple[str, ...]]:
    from piga.frames import matrix_to_rotation_vector

    true, motion = matrix_to_rotation_vector(run.truth.triad_start.T), run.scenario.motion
    for k, axis in enumerate("xyz"):
        value, std = aligned.triad_vector[k] / ARCSEC, aligned.std[k] / ARCSEC
        off = (aligned.triad_vector[k] - true[k]) / ARCSEC
        yield f"triad attitude {axis}", fixed(value, 3), significant(std, 2), "arcsec", signed(off, 3)
    for k, axis in enumerate("xyz"):
        value, std = aligned.drift[k] / DEGREE_PER_HOUR, aligned.std[3 + k] / DEGREE_PER_HOUR
        yield f"triad drift {axis}", significant(value, 3), significant(std, 2), "deg/h", "–"
    put_in = {"roll": motion.roll, "pitch": motion.pitch, "heading": motion.heading}
    for k, (name, angle) in enumerate(put_in.items()):
        value, std = float(np.degrees(aligned.base_angles[k])), np.degrees(aligned.base_stds[k])
        off = float(np.remainder(value - np.degrees(angle) + 180.0, 360.0) - 180.0)
        yield f"base {name}", fixed(value, 5), significant(std, 2), "deg", significant(off, 2)


def comparison_page(comparison: ModelComparisonRun, budget: Sequence[BudgetRow] = ()) -> Page:
    """Page of ``piga platform compare``."""
    s, known = comparison.run.scenario, comparison.preparation
    histories = (partial(published_figure, comparison), partial(histories_figure, comparison))
    given = Text("The true misalignments were used.")
    table = given if known.identification is None else _parameter_table(known.identification, s)
    shown = (
        *_line_sections(comparison),
        Section("Forty minutes and the whole run", "histories", histories),
        Section("Position", "position", (partial(position_figure, comparison),)),
        Section("Notes", "notes", tuple(Notice("info", note) for note in known.notes)),
        Section("What the models were given", "given", (table,)),
        Section("Error budget by source", "budget", (_budget_table(budget) if budget else None,)),
    )
    return page("Compensation models compared", s, _comparison_tiles(comparison), sections(*shown))


def _line_sections(c: ModelComparisonRun) -> Iterator[Section]:
    """Lines at the polar case's rate and, at another speed, at the equatorial one's."""
    if not _unequal(c):
        yield Section("Lines at the case-rotation period", "lines", _line_content(c, "amplitude"))
        return
    polar, equatorial = (
        short(2.0 * np.pi / rate if rate > 0.0 else np.inf) for rate in case_rates(c.run.scenario)
    )
    title = "Lines of the {} gyro's case, period {} s"
    yield Section(title.format("polar", polar), "lines", _line_content(c, "amplitude"))
    yield Section(title.format("equatorial", equatorial), "equatorial-lines", _line_content(c, "equatorial"))


def _unequal(c: ModelComparisonRun) -> bool:
    return any(r.lines.equatorial for r in c.models.values())


_CHANNELS = {
    "east_velocity": ("mm/s", 1e3),
    "heading": ("arcmin", 1.0 / ARCMIN),
    "roll": ("arcmin", 1.0 / ARCMIN),
    "north_velocity": ("mm/s", 1e3),
}
"""Channels of the lines with their units."""


def _line_content(c: ModelComparisonRun, which: Case) -> tuple[Content, ...]:
    """What is left, in words; the figure of several days; each channel day by day."""
    days = next(iter(c.models.values())).lines.day
    figure = partial(lines_figure, c, which) if days[-1] > 1 else None
    return (
        _lines_sentence(c, which, int(days[-1])),
        figure,
        *(_line_table(c, which, channel) for channel in _CHANNELS),
    )


def _comparison_tiles(c: ModelComparisonRun) -> tuple[Tile, ...]:
    whose = " (polar, equatorial case)" if _unequal(c) else ""
    return tuple(
        Tile(
            model_name(m),
            ", ".join(short(1e3 * line) for line in last_east_lines(r.lines)),
            "mm/s",
            f"east velocity line{whose}, day {int(r.lines.day[-1])}",
        )
        for m, r in c.models.items()
    )


def _lines_sentence(c: ModelComparisonRun, which: Case, day: int) -> str:
    shown: Model = next((m for m in WITH_THEORY[which] if m in c.models), "none")
    east = {m: float(getattr(r.lines, which)["east_velocity"][-1]) for m, r in c.models.items()}
    left, name = east.get(shown, np.nan), model_name(shown)
    if not np.isfinite(left):
        return f"Amplitudes at the case-rotation period, fitted over each of {day} days."
    parts = [f"On day {day} {name} leaves an east velocity line of {short(1e3 * left)} mm/s."]
    removed = {m: 100.0 * (1.0 - line / left) for m, line in east.items() if m not in ("none", shown)}
    parts += [f"Model {m} removes {fixed(share, 1)} % of it." for m, share in removed.items()]
    if (theory := c.models[shown].theory) is not None:
        ratio = float(getattr(theory, which)["east_velocity"][-1]) / left
        parts.append(
            f"The closed form for {name} is {signed(100.0 * (ratio - 1.0), 2)} % off what was navigated."
        )
    return " ".join(parts)


def _line_table(c: ModelComparisonRun, which: Case, channel: str) -> Table:
    """One channel day by day: every model, and the theory beside those that have it."""
    unit, scale = _CHANNELS[channel]
    curves = []
    for m, r in c.models.items():
        curves.append((model_name(m), getattr(r.lines, which)[channel] * scale))
        if r.theory is not None and m in WITH_THEORY[which]:
            curves.append((f"theory, {model_name(m)}", getattr(r.theory, which)[channel] * scale))
    days = next(iter(c.models.values())).lines.day
    table = TableOf(range(len(days))).text("day", lambda k: str(int(days[k])))
    table.across(curves, lambda curve: curve[0], lambda k, curve: short(float(curve[1][k])), lambda _: unit)
    return table.table(f"{channel.capitalize().replace('_', ' ')} line")


def _budget_table(budget: Sequence[BudgetRow]) -> Table:
    table = (
        TableOf(budget)
        .text("source", lambda b: b.source)
        .number("position", lambda b: short(b.position_linear_m), "m")
        .number("velocity", lambda b: short(1e3 * b.velocity_linear_m_s), "mm/s")
    )
    return table.table(notes=("Largest horizontal error over the run, base at rest.",))


# -- figures ---------------------------------------------------------------------------------------

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


_MODEL_ROLES: dict[str, Role] = {"none": "muted", "A": "before", "B": "after", "C": "model"}
_DASHED = "C"
"""Model whose curve is dashed: it often lies on that of model B, which must be seen."""
Case = Literal["amplitude", "equatorial"]
"""Choice of lines: at the polar case's rate, or at the equatorial case's rate if that differs."""
WITH_THEORY: dict[Case, tuple[Model, ...]] = {"amplitude": ("A", "none"), "equatorial": ("none",)}
"""Models whose theory stands beside the lines: what A leaves grows at the polar rate, at the equatorial one it is nothing."""


def lines_figure(comparison: ModelComparisonRun, which: Case = "amplitude") -> Figure:
    """Amplitude at a case-rotation period against the day, each model, with the theory dashed."""
    polar = which == "amplitude"
    key, whose = ("fig-lines", "case-rotation") if polar else ("fig-equatorial-lines", "equatorial case's")
    plot = Plot(f"{key}-per-day", f"What each model leaves at the {whose} period", columns=2, height=2.6)
    for name, (unit, scale) in _CHANNELS.items():
        plot.panel("day", f"log {name.replace('_', ' ')} line [{unit}]")
        for model, run in comparison.models.items():
            label, amplitude = model_name(model), getattr(run.lines, which)[name]
            dashed = model == _DASHED
            plot.marked(run.lines.day, scale * amplitude, label, _MODEL_ROLES[model], dashed=dashed)
            if model in WITH_THEORY[which] and run.theory is not None:
                theory = getattr(run.theory, which)[name]
                plot.dashed(run.theory.day, scale * theory, f"theory, {label}")
    return plot.caption("Amplitude fitted over each day; the theory is dashed.")


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
