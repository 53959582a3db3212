"""Reports of a compensation, for one instrument and for several that were solved together: reduced data, figures, page."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.calibration.orders import order_spectrum
from piga.compensation import FLAGS, Compensated, CompensatedSet, Mounted
from piga.compensation.model import MEANING
from piga.compensation.result import Inputs
from piga.errors import CalibrationError
from piga.records.arrays import changes, middles
from piga.records.calibration import Calibration, Coefficient, Residuals
from piga.records.run import Run
from piga.records.terms import shown_unit
from piga.reports.calibration.figures import spectrum_figure
from piga.reports.calibration.tables import judgement, scale_factor, sentence
from piga.reports.render.envelope import POINTS, envelope_rows, leading_part
from piga.reports.render.figure import XYZ, Axis, Figure, Plot, Role
from piga.reports.render.numbers import count, pretty_unit, rounded, short
from piga.reports.render.page import (
    ALONE,
    Judgement,
    Notice,
    Page,
    Section,
    TableOf,
    Tile,
    Tone,
    named_values,
)
from piga.results import Array
from piga.units import G0, MICRO_G

Flags = NDArray[np.int32]

CURVE_POINTS = 1 << 15
"""Most points of an envelope; fewer rows are kept whole."""


def rms(values: Array) -> float:
    """Root mean square of the values that are finite; nan where there is none."""
    finite = values[np.isfinite(values)]
    return math.sqrt(float(finite @ finite) / finite.size) if finite.size else math.nan


@dataclass(frozen=True)
class Indication:
    """One instrument: rms of its correction [m/s^2], and rows of each flag."""

    calibration: Calibration
    scale_factor: float
    correction: float
    flagged: dict[str, int]


def _indication_of(
    record: Run, calibration: Calibration, begins: NDArray[np.bool_], ax: Array, flags: Flags
) -> tuple[Indication, Array]:
    """An instrument with its compensation, and the indicated specific force [m/s^2]."""
    K = scale_factor(calibration)
    h, turn, _ = _turned(record, begins | ((flags & FLAGS["no_increment"]) != 0))
    if record.kind == "rate":
        omega = 0.0 if record.base_rate is None else record.base_rate[:, 0]
        indicated = (record.output + omega) / K
    else:
        indicated = turn / (K * np.where(h > 0.0, h, np.nan))
    flagged = {name: int(np.count_nonzero(flags & bit)) for name, bit in FLAGS.items()}
    return Indication(calibration, K, rms(indicated - ax), flagged), indicated


def _turned(record: Run, without: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
    """Length of each interval [s] and turn of the output over it, the base added; and the output angle [rad]."""
    h = np.where(without, 0.0, changes(record.t))
    if record.kind == "rate":
        turn = h * middles(record.output)
        psi = np.cumsum(turn)
    else:
        turn, psi = np.where(h > 0.0, changes(record.output), 0.0), record.output
    if record.base_rate is not None:
        turn = turn + h * middles(record.base_rate[:, 0])
    return h, turn, psi


class CompensationOutline:
    """Outline of a compensation: its result and records, and envelopes of its curves.

    Curves by name, for each of the ``components`` (``a_x``; or ``f_x``, ``f_y``, ``f_z`` of a set): the component itself,
    ``indicated``, ``correction`` and ``u`` before its name; of a set also ``residual`` and a ``misfit`` of each instrument.
    """

    def __init__(
        self, result: Compensated | CompensatedSet, records: Sequence[Run], mounted: Sequence[Mounted] = ()
    ) -> None:
        self.result, self.records, self.mounted = result, tuple(records), tuple(mounted)
        self.components = tuple(f"f_{axis}" for axis in XYZ) if mounted else ("a_x",)
        self.instruments: list[Indication] = []
        self.size, self.t = result.size, result.t - result.t[0]
        self.velocity = np.atleast_1d(result.dv.sum(axis=0))
        self.u_velocity = np.atleast_1d(result.u_velocity)
        self._curves: dict[str, tuple[Array, Array]] = {}
        self._rms: dict[str, float] = {}

    @property
    def flags(self) -> dict[str, Array]:
        """Times of the rows with each flag that is raised, since the first row [s]."""
        times = {name: self.t[self.result.flagged(name)] for name in FLAGS if self.result.flags.size}
        return {name: t for name, t in times.items() if t.size}

    @property
    def redundant(self) -> bool:
        """True if there are more instruments than unknowns, so that a misfit exists."""
        return len(self.mounted) > 3

    def add(self, name: str, values: Array) -> None:
        """Add a curve of all rows."""
        rows = envelope_rows(values, CURVE_POINTS)
        self._curves[name], self._rms[name] = (self.t[rows], values[rows]), rms(values)

    def add_component(self, name: str, indicated: Array, force: Array, u: Array) -> None:
        """Add the curves of a component [m/s^2]; ``u`` may be empty."""
        curves = {"": force, "indicated ": indicated, "correction ": indicated - force, "u ": u}
        for kind, values in curves.items():
            if values.size:
                self.add(kind + name, values)

    def curve(self, name: str) -> tuple[Array, Array]:
        """Times since the first row [s], and the envelope of a curve."""
        return self._curves[name]

    def has(self, name: str) -> bool:
        """Whether the curve has a value."""
        return math.isfinite(self.rms(name))

    def rms(self, name: str) -> float:
        """Root mean square of all values of a curve; nan where there is none."""
        return self._rms.get(name, math.nan)


def of_record(record: Run, calibration: Calibration, result: Compensated) -> CompensationOutline:
    """Outline of a single instrument."""
    outline = CompensationOutline(result, [record])
    one, indicated = _indication_of(record, calibration, record.begins, result.ax, result.flags)
    outline.instruments.append(one)
    outline.add_component("a_x", indicated, result.ax, result.u_ax)
    return outline


def of_set(records: Sequence[Run], mounted: Sequence[Mounted], result: CompensatedSet) -> CompensationOutline:
    """Outline of a set; ``result`` with details."""
    outline = CompensationOutline(result, records, mounted)
    begins = np.logical_or.reduce([record.begins for record in records])
    from_axes = np.linalg.pinv(np.array([item.axes[0] for item in mounted], dtype=float))
    indicated = np.zeros((3, result.size))
    for i, (record, item) in enumerate(zip(records, mounted, strict=True)):
        axis, flags = (
            np.asarray(item.axes[0], dtype=float),
            result.each[i] if result.each.size else result.flags,
        )
        one, along = _indication_of(record, item.calibration, begins, result.f @ axis, flags)
        outline.instruments.append(one)
        for k, share in enumerate(from_axes[:, i]):
            indicated[k] += share * along
        if outline.redundant:
            outline.add(f"misfit {i}", result.misfit[i])
    for k, name in enumerate(outline.components):
        outline.add_component(
            name, indicated[k], result.f[:, k], result.u_f[:, k] if result.u_f.size else result.u_f
        )
    if outline.redundant:
        outline.add("residual", result.residual)
    return outline


# --- figures --------------------------------------------------------------------------------

_WINDOW = 16
"""Turns of the output that a spectrum looks at together."""
TIME = "time since the first row [s]"
_FLAG_ROLES: dict[str, Role] = {"no_increment": "muted", "near_critical": "model", "age": "reference"}


def error_figures(
    record: Run, result: Compensated, scale_factor: float, noise: tuple[float, float] = (0.0, 0.0)
) -> tuple[Figure, ...]:
    """Error figures of a record whose reference holds ``a_x`` too: in time, and in revolution order.

    ``scale_factor`` is K [(rad/s)/(m/s^2)]; ``noise`` the white noise of the angle [rad, rms] and its random walk [rad/sqrt(s)].
    """
    errors = compensation_errors(record, result, scale_factor)
    if record.direct:
        return (error_figure(errors),)
    return error_figure(errors), _error_spectrum_figure(leading_part(errors), scale_factor, noise)


def compensation_errors(record: Run, result: Compensated, scale_factor: float) -> Residuals:
    """Error of the velocity as an angle [rad; a direct instrument: m/s], indicated (``before``) and compensated (``after``)."""
    h, turn, psi = _turned(record, record.begins)
    force = h * middles(record.f[:, 0])
    scale = 1.0 if record.direct else scale_factor
    before, after = (np.cumsum(scale * error) for error in (turn / scale_factor - force, result.dv - force))
    number, nothing = np.arange(1, before.size + 1), np.broadcast_to(0.0, before.size)
    segment = record.segment_index if record.segment_index.size else np.zeros(before.size, np.int32)
    unit = "m/s" if record.direct else "rad"
    return Residuals(number, record.t, psi, nothing, before, after, nothing, segment, unit=unit)


def in_windows(residuals: Residuals) -> Residuals:
    """The residuals with every segment cut into windows of ``_WINDOW`` turns: where the force changes, so does the drift.

    A spectrum of revolution orders takes out one drift per segment; over a moving record that is not enough.
    """
    psi = residuals.psi
    change = np.diff(residuals.segment, prepend=-1) != 0
    starts = psi[change][np.cumsum(change) - 1]
    window = np.floor((psi - starts) / (2.0 * np.pi * _WINDOW))
    segment = np.cumsum(change | (np.diff(window, prepend=0.0) != 0.0))
    return replace(residuals, segment=segment.astype(np.int32))


def error_figure(errors: Residuals) -> Figure:
    """Error of the velocity against time before and after."""
    plot = Plot(
        "compensation-error",
        "Error before and after compensation.",
        TIME,
        "velocity error as output angle [mrad]" if errors.unit == "rad" else "velocity error [mm/s]",
    )
    roles: tuple[tuple[Role, str], ...] = (("before", "as indicated"), ("after", "compensated"))
    for role, name in roles:
        plot.line(errors.t - errors.t[0], 1e3 * getattr(errors, role), name, role)
    if errors.unit != "rad":
        return plot.caption("The running error of the velocity against the reference.")
    return plot.caption(
        "The running error of the velocity against the reference, in units of the output angle: the cross-coupling "
        "ripples once a revolution and drifts; what is left after compensation is the noise of the output."
    )


def _error_spectrum_figure(errors: Residuals, scale_factor: float, noise: tuple[float, float]) -> Figure:
    drawn = spectrum_figure(order_spectrum(in_windows(errors), scale_factor, noise))
    caption = (
        "Lines at whole orders are errors that turn with the output: the cross-coupling at order 1, its pulling and "
        "the servo at order 2. After a good compensation no order stands out of the noise."
    )
    title = "Error in revolution order."
    return replace(drawn, key="compensation-spectrum", title=title, caption=caption, notes=())


def force_figure(outline: CompensationOutline) -> Figure:
    """Indicated and compensated specific force, their difference, and the uncertainty, against time."""
    components = outline.components
    roles: tuple[Role, ...] = ("data",) if len(components) == 1 else XYZ
    where = "along the input axis" if len(components) == 1 else "in the common frame"
    plot = Plot("compensation-force", f"Specific force {where}.", height=2.3)
    for name in components:
        plot.panel(TIME, f"specific force {name} [g]")
        plot.line(*_curve(outline, f"indicated {name}", G0), "indicated", "before")
        plot.line(*_curve(outline, name, G0), "compensated", "after")
    plot.panel(TIME, "correction [µg]")
    for name, role in zip(components, roles, strict=True):
        plot.line(*_curve(outline, f"correction {name}", MICRO_G), f"correction of {name}", role)
    if outline.has(f"u {components[0]}"):
        curves = [_curve(outline, f"u {name}", MICRO_G) for name in components]
        highest = max(float(np.nanmax(u)) for _, u in curves)
        plot.panel(TIME, Axis("standard uncertainty", "µg", limits=(0.0, 1.15 * highest or 1.0)))
        for (t, u), name, role in zip(curves, components, roles, strict=True):
            plot.line(t, u, f"u({name}) of a row", "model" if role == "data" else role)
    along = (
        ""
        if len(components) == 1
        else " Several instruments: taken as force along the input axes, by least squares."
    )
    note = f"Outlines of at most {POINTS} points; lowest and highest values are kept."
    return plot.caption(
        f"Indicated: output rate over the calibrated scale factor, the base rate added where it is recorded.{along} "
        "The correction, indicated less compensated, is the cross-coupling and the error terms of the calibration; both "
        "curves carry the same noise, so it does not.",
        *([] if outline.size <= POINTS else [note]),
    )


def _curve(outline: CompensationOutline, name: str, unit: float) -> tuple[Array, Array]:
    t, y = outline.curve(name)
    return t, y / unit


def misfit_figure(outline: CompensationOutline, names: Sequence[str]) -> Figure:
    """Residual of a redundant set, and how far each instrument is from the force that fits all."""
    plot = Plot("compensation-misfit", "What the instruments say against each other.", height=1.7)
    plot.panel(TIME, "residual of the set [µg]")
    plot.line(*_curve(outline, "residual", MICRO_G), "residual: root of the summed squares")
    for i, name in enumerate(names):
        plot.panel(TIME, f"misfit of {name} [µg]")
        plot.line(*_curve(outline, f"misfit {i}", MICRO_G), "misfit", "model")
    return plot.caption(
        "Indication of an instrument less the force that fits all, along its effective input axis. Noise is good; a line, "
        "a step or a drift in one of them points at its calibration, its mounting, its phase or a fault."
    )


def result_figure(result: Compensated | CompensatedSet) -> Figure:
    """Force, correction and uncertainty; without its record the compensated force alone."""
    if isinstance(result, Compensated) and result.made_from is not None:
        run, calibration = result.made_from
        return force_figure(of_record(run, calibration, result))
    columns, t = result.columns(), result.t - result.t[0]
    names: dict[str, tuple[str, Role]] = {"ax": ("a_x", "after")}
    names |= {f"f{axis}": (f"f{axis}", axis) for axis in XYZ}
    where = "along the input axis" if "ax" in columns else "in the common frame"
    plot = Plot("compensation-force", f"Specific force {where}.", TIME, "specific force [g]", height=2.3)
    shown = [key for key in names if key in columns]
    for key in shown:
        plot.line(t, columns[key] / G0, *names[key])
    if f"u_{shown[0]}" in columns:
        plot.panel(TIME, "standard uncertainty [µg]")
        for key in shown:
            plot.line(t, columns[f"u_{key}"] / MICRO_G, f"u({names[key][0]}) of a row", names[key][1])
    return plot.caption("Compensated specific force, and its standard uncertainty.")


def flag_figure(outline: CompensationOutline) -> Figure | None:
    """Times of every raised flag; None if no flag is raised."""
    if not outline.flags:
        return None
    axis = Axis("bit position of flag", "1", limits=(-0.5, 9.5))
    plot = Plot("compensation-flags", "Flags against time.", TIME, axis, height=2.8)
    for name, t in outline.flags.items():
        bit = FLAGS[name].bit_length() - 1
        rows = "1 row" if t.size == 1 else f"{t.size} rows"
        shown = t[:: -(-t.size // POINTS)]
        label, role = f"{bit} {name}: {rows}", _FLAG_ROLES.get(name, "warning")
        plot.points(shown, np.full(shown.size, float(bit)), label, role)
    return plot.caption("One mark per flagged row, or fewer in long records; the counts are of all rows.")


# --- page -----------------------------------------------------------------------------------

COMPARED_ROWS = 1 << 18
"""Most rows of a record that is compared with its reference."""


def figures(result: Compensated | CompensatedSet) -> dict[str, Callable[[], Figure]]:
    """The figure of a compensation in memory."""
    return {"force": partial(result_figure, result)}


def brief(result: Compensated | CompensatedSet) -> Page:
    """What a notebook and the terminal show of a compensation in memory."""
    facts = named_values("", "", result.in_brief())
    return Page(result.heading(), sections=(Section("", "result", (facts, result_figure(result))),))


def page(result: Compensated) -> Page:
    """The page of a compensation in memory."""
    if result.made_from is None:
        raise CalibrationError(
            "report: this compensation was read or copied without its record and calibration",
            remedy="compensate again: piga.compensate(run, cal)",
        )
    run, calibration = result.made_from
    data = Path(run.source).name or "arrays in memory", next(iter(run.input_sha256.values()), "")
    return compensation_page(
        of_record(run, calibration, result), (data[0],), (data,), {"method": result.method}
    )


def _coefficient_words(c: Coefficient) -> tuple[str, str]:
    """A coefficient with its standard uncertainty in brackets, and its unit, as the calibration's own report has them."""
    scale, unit = shown_unit(c.name, c.unit)
    return rounded(c.value * scale, c.std * scale).concise, pretty_unit(unit)


def compensation_page(
    outline: CompensationOutline, names: Sequence[str], files: Inputs, options: dict[str, str]
) -> Page:
    """The page of a compensation of instruments with these names.

    ``files`` are all files read, each with the SHA-256 of the bytes read; ``options`` those given, in words.
    """
    single, kind = not outline.mounted, outline.records[0].kind
    serial = outline.instruments[0].calibration.serial
    sections = [Section("Specific force", "specific-force", (force_figure(outline),))]
    if not single:
        sections.append(_misfit(outline, names))
    direct = outline.instruments[0].calibration.direct
    if single:
        sections.append(_reference(outline))
    sections.append(_flags(outline, names))
    if not single:
        sections.append(_instruments(outline, names))
    sections += [*_repairs(outline), _provenance(outline, names, files, options)]
    return Page(
        title=f"Compensation of {serial if single else f'{len(outline.mounted)} instruments'}",
        subtitle=f"{', '.join(names)}; {count(outline.size)} rows; the output is of kind "
        f"{'count' if direct and kind == 'angle' else kind}.",
        tiles=_tiles(outline),
        sections=tuple(sections),
        judgement=_judgement(outline, names),
        kicker="piga · compensation",
        footer=f"Made by piga {__version__} on {datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}. {ALONE}",
    )


def _judgement(outline: CompensationOutline, names: Sequence[str]) -> Judgement:
    """The verdicts on all calibrations in one box, the worst on top; each doubt of a set names its instruments."""
    each = [judgement(instrument.calibration) for instrument in outline.instruments]
    if len(each) == 1:
        return judgement(outline.instruments[0].calibration, "The calibration that was used: ")
    worst = max(each, key=lambda one: _SEVERITY.index(one.tone))
    named: dict[tuple[str, str], list[str]] = {}
    for name, instrument in zip(names, outline.instruments, strict=True):
        for doubt in instrument.calibration.verdict.doubts:
            named.setdefault((sentence(doubt.what), doubt.remedy), []).append(name)
    problems = tuple((f"{', '.join(names)}: {what}", remedy) for (what, remedy), names in named.items())
    tested, open_ones = (
        tuple(dict.fromkeys(words for one in each for words in getattr(one, name)))
        for name in ("tested", "not_tested")
    )
    headline = f"The calibrations that were used: {worst.headline}"
    return Judgement(worst.tone, headline, "", problems, tested, open_ones)


_SEVERITY: tuple[Tone, ...] = ("", "quiet", "good", "doubtful", "bad")


def _micro_g(value: float) -> str:
    return short(value / MICRO_G) if math.isfinite(value) else "–"


def _together(outline: CompensationOutline, kind: str) -> str:
    """Root mean square of a kind of curve, all components together."""
    return _micro_g(math.hypot(*(outline.rms(f"{kind} {name}") for name in outline.components)))


def _tiles(outline: CompensationOutline) -> tuple[Tile, ...]:
    velocity = ", ".join(short(float(v), 4) for v in outline.velocity)
    axes = "" if len(outline.velocity) == 1 else " x, y, z"
    known = [short(u, 2) for u in outline.u_velocity if math.isfinite(u)]
    u = f"standard uncertainty {', '.join(known)} m/s; " if known else ""
    tiles = [
        Tile(f"Velocity{axes}", velocity, "m/s", f"{u}sum of dv; time between stretches is not counted"),
        Tile("Correction, rms", _together(outline, "correction"), "µg", "indicated less compensated"),
    ]
    if outline.has(f"u {outline.components[0]}"):
        tiles.append(Tile("u, rms", _together(outline, "u"), "µg", "standard uncertainty of one row"))
    if outline.has("residual"):
        tiles.append(Tile("Residual, rms", _micro_g(outline.rms("residual")), "µg", "of the redundant set"))
    flagged = int(np.count_nonzero(outline.result.flags & ~FLAGS["no_increment"]))
    share = short(100.0 * flagged / max(outline.size, 1))
    tone: Tone = "good" if flagged == 0 else "doubtful"
    detail = f"{share} % of the rows, no_increment not counted"
    return (*tiles, Tile("Rows with a flag", count(flagged), "", detail, tone))


def _misfit(outline: CompensationOutline, names: Sequence[str]) -> Section:
    title, anchor = "Instruments against each other", "misfit"
    if not outline.redundant:
        text = "Three instruments fit any force exactly: nothing is left over that could contradict it."
        return Section(title, anchor, (Notice("info", text),))
    faults = int(np.count_nonzero(outline.result.flagged("fault")))
    words = f"{count(faults)} rows contradict themselves beyond the uncertainties (flag fault)."
    notice = Notice("warning", words)
    if faults == 0:
        notice = Notice("good", "No row contradicts itself beyond the uncertainties of the calibrations.")
    return Section(title, anchor, (notice, misfit_figure(outline, names)))


def _reference(outline: CompensationOutline) -> Section:
    title, anchor = "Against the reference", "reference"
    if not isinstance(outline.result, Compensated) or outline.size > COMPARED_ROWS:
        text = f"The error against the reference along the input axis is shown for records of at most {count(COMPARED_ROWS)} rows."
        return Section(title, anchor, (Notice("info", text),))
    instrument = outline.instruments[0]
    noise = (instrument.calibration.angle_rms, instrument.calibration.angle_random_walk)
    lead = (
        "Where the record holds a reference along the input axis that is worth comparing with (a laboratory does), "
        "these are the errors against it; they hold the errors of that reference, too."
    )
    drawn = error_figures(outline.records[0], outline.result, instrument.scale_factor, noise)
    return Section(title, anchor, (lead, *drawn))


def _flags(outline: CompensationOutline, names: Sequence[str]) -> Section:
    figure = flag_figure(outline)
    if figure is None:
        return Section("Flags", "flags", (Notice("good", "No row carries a flag."),))
    table = (
        TableOf(outline.flags.items())
        .text("flag", lambda row: row[0])
        .number("bit", lambda row: str(FLAGS[row[0]]))
        .number("rows", lambda row: count(row[1].size))
        .number("share", lambda row: short(100.0 * row[1].size / outline.size), "%")
    )
    notes: tuple[str, ...] = ()
    if outline.mounted:
        instruments = list(zip(names, outline.instruments, strict=True))
        table.across(instruments, lambda one: one[0], lambda row, one: count(one[1].flagged[row[0]]))
        notes = ("A row of the set carries the flags of all its instruments. A fault is one of the set.",)
    table.number("first at", lambda row: short(float(row[1][0]), 6), "s")
    table.number("last at", lambda row: short(float(row[1][-1]), 6), "s")
    table.text("meaning", lambda row: MEANING[row[0]])
    caption = "Flags that were raised; times since the first row."
    said = [Notice("warning", words) for words in outline.result.notes]
    return Section("Flags", "flags", (*said, figure, table.table(caption, notes)))


def _instruments(outline: CompensationOutline, names: Sequence[str]) -> Section:
    indices = range(len(outline.instruments))
    table = (
        TableOf(indices)
        .text("instrument", lambda i: names[i])
        .across(
            range(3),
            lambda axis: f"X0 along {XYZ[axis]}",
            lambda i, axis: short(float(outline.mounted[i].axes[0][axis]), 6),
        )
        .number("correction, rms", lambda i: _micro_g(outline.instruments[i].correction), "µg")
        .number("misfit, rms", lambda i: _micro_g(outline.rms(f"misfit {i}")), "µg")
        .table("Input axes in the common frame; what was taken out and what is left.")
    )
    return Section("Instruments", "instruments", (table,))


def _repairs(outline: CompensationOutline) -> tuple[Section, ...]:
    """What was found in the records while they were read; nothing where nothing was."""
    repairs: Counter[str] = Counter()
    for record in outline.records:
        repairs.update({event.kind: event.count for event in record.quality.events})
    if not repairs:
        return ()
    table = (
        TableOf(repairs.items())
        .text("finding", lambda item: item[0])
        .number("count", lambda item: count(item[1]))
        .table("Repairs of the record.")
    )
    return (Section("Found while reading", "repairs", (table,)),)


def _provenance(
    outline: CompensationOutline, names: Sequence[str], files: Inputs, options: dict[str, str]
) -> Section:
    many = len(outline.instruments) > 1
    options = dict(options)
    coefficients = []
    for name, instrument in zip(names, outline.instruments, strict=True):
        calibration, of = instrument.calibration, f" ({name})" if many else ""
        made = calibration.provenance
        options[f"calibration of{of}"] = f"{calibration.serial}, by {made.software} on {made.created}"
        if not calibration.direct:
            options[f"phases of the calibration{of}"] = calibration.phases
        options[f"scale factor of the indication{of}"] = (
            f"{short(instrument.scale_factor, 8)} ({calibration.unit})/(m/s²)"
        )
        coefficients += [(name, c) for c in calibration.coefficients]
    for name, item in zip(names, outline.mounted, strict=False):
        if item.phase is not None:
            phase = rounded(item.phase.value, item.phase.std).concise
            options[f"phase used ({name})"] = f"{phase} rad, as given"
    table = TableOf(coefficients)
    if many:
        table.text("instrument", lambda row: row[0])
    table.text("coefficient", lambda row: row[1].key)
    table.number("value", lambda row: _coefficient_words(row[1])[0])
    table.text("unit", lambda row: _coefficient_words(row[1])[1])
    how = named_values("", "", options, "How it was compensated.")
    read = named_values("file", "SHA-256", files, "Files as they were read.", code=True)
    used = table.table("Coefficients of the calibration, standard uncertainty in brackets.")
    return Section("Provenance", "provenance", (how, used, read))
