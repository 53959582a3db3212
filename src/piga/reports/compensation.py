"""A compensation shown, of one instrument or of several that were solved together: curves, figures, page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.compensation import FLAGS, Compensated, CompensatedSet, Mounted
from piga.compensation.model import MEANING
from piga.compensation.result import Inputs
from piga.errors import CalibrationError
from piga.records.arrays import changes, middles
from piga.records.calibration.calibration import Calibration
from piga.records.run import Run
from piga.reports.calibration.tables import coefficient_table, judgement, quality_table, scale_factor, sentence
from piga.reports.render.figure import POINTS, XYZ, Axis, Figure, Plot, Role
from piga.reports.render.numbers import count, rounded, short
from piga.reports.render.page import ALONE, Judgement, Notice, Page, Section, TableOf, Tile, Tone, named_values
from piga.reports.render.page import sections as shown_sections
from piga.results import Array
from piga.units import G0, MICRO_G


class CompensationOutline:
    """A compensation with its records and calibrations, and its curves (n,) by name [m/s^2].

    The components are ``a_x``; of a set ``f_x``, ``f_y``, ``f_z``. A curve is a component itself, or has ``indicated``,
    ``correction`` or ``u`` before its name. A set also has ``correction`` of each instrument, and a redundant one
    ``residual`` and ``misfit`` of each. A curve that is not known is missing.
    """

    def __init__(
        self,
        result: Compensated | CompensatedSet,
        records: Sequence[Run] = (),
        calibrations: Sequence[Calibration] = (),
        mounted: Sequence[Mounted] = (),
    ) -> None:
        self.result, self.records, self.calibrations = result, tuple(records), tuple(calibrations)
        self.mounted, self.t = tuple(mounted), result.t - result.t[0]
        single = isinstance(result, Compensated)
        self.components = ("a_x",) if single else tuple(f"f_{axis}" for axis in XYZ)
        force, u = (result.ax, result.u_ax) if isinstance(result, Compensated) else (result.f, result.u_f)
        self.curves = dict(zip(self.components, force.reshape(result.size, -1).T, strict=True))
        if u.size:
            named = (f"u {name}" for name in self.components)
            self.curves |= dict(zip(named, u.reshape(result.size, -1).T, strict=True))

    def add_indicated(self, *indicated: Array) -> None:
        """Add what the instruments indicate of each component."""
        for name, values in zip(self.components, indicated, strict=True):
            self.curves |= {f"indicated {name}": values, f"correction {name}": values - self.curves[name]}

    @property
    def redundant(self) -> bool:
        """True if there are more instruments than unknowns, so that a misfit exists."""
        return len(self.mounted) > 3

    def flags_of(self, instrument: int) -> NDArray[np.int32]:
        """Flags of one instrument; those of all if they are not known apart."""
        each = getattr(self.result, "each", None)
        return each[instrument] if each is not None and each.size else self.result.flags

    def raised(self) -> dict[str, Array]:
        """Times of the rows with each flag that is raised, since the first row [s]."""
        times = {name: self.t[self.result.flagged(name)] for name in FLAGS}
        return {name: t for name, t in times.items() if t.size}

    def rms(self, *names: str) -> float:
        """Root mean square of all finite values of curves, taken together as components; nan without values."""
        finite = [
            values[np.isfinite(values)] for name in names if (values := self.curves.get(name)) is not None
        ]
        parts = [float(values @ values) / values.size for values in finite if values.size]
        return math.sqrt(sum(parts)) if parts else math.nan


def _turned(record: Run, without: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Length of each interval [s] and turn of the output over it, the base added."""
    h = np.where(without, 0.0, changes(record.t))
    turn = (
        h * middles(record.output) if record.kind == "rate" else np.where(h > 0.0, changes(record.output), 0.0)
    )
    if record.base_rate is not None:
        turn = turn + h * middles(record.base_rate[:, 0])
    return h, turn


def _indicated(
    record: Run, calibration: Calibration, begins: NDArray[np.bool_], flags: NDArray[np.int32]
) -> Array:
    """Specific force that the output indicates along the input axis [m/s^2]."""
    K = scale_factor(calibration)
    if record.kind == "rate":
        omega = 0.0 if record.base_rate is None else record.base_rate[:, 0]
        return (record.output + omega) / K
    h, turn = _turned(record, begins | ((flags & FLAGS["no_increment"]) != 0))
    return turn / (K * np.where(h > 0.0, h, np.nan))


def of_record(record: Run, calibration: Calibration, result: Compensated) -> CompensationOutline:
    """Outline of a single instrument."""
    outline = CompensationOutline(result, [record], [calibration])
    outline.add_indicated(_indicated(record, calibration, record.begins, result.flags))
    return outline


def of_set(records: Sequence[Run], mounted: Sequence[Mounted], result: CompensatedSet) -> CompensationOutline:
    """Outline of a set; ``result`` with details."""
    outline = CompensationOutline(result, records, [item.calibration for item in mounted], mounted)
    begins = np.logical_or.reduce([record.begins for record in records])
    axes = np.array([item.axes[0] for item in mounted], dtype=float)
    along = np.empty((len(records), result.size))
    for i, (record, item) in enumerate(zip(records, mounted, strict=True)):
        along[i] = _indicated(record, item.calibration, begins, outline.flags_of(i))
        outline.curves[f"correction {i}"] = along[i] - result.f @ axes[i]
        if outline.redundant:
            outline.curves |= {f"misfit {i}": result.misfit[i], "residual": result.residual}
    outline.add_indicated(*(np.linalg.pinv(axes) @ along))
    return outline


# --- figures --------------------------------------------------------------------------------

TIME = "time since the first row [s]"
COMPARED_ROWS = 1 << 24
"""Most rows of a record that is compared with its reference: it takes eight columns of memory."""


def compensation_errors(record: Run, dv: Array, scale_factor: float) -> tuple[Array, Array]:
    """Error of the velocity as an angle [rad; a direct instrument: m/s], indicated and compensated.

    ``dv`` are the compensated increments, ``scale_factor`` is K [(rad/s)/(m/s^2)].
    """
    h, turn = _turned(record, record.begins)
    force = h * middles(record.f[:, 0])
    scale = 1.0 if record.direct else scale_factor
    before, after = (np.cumsum(scale * error) for error in (turn / scale_factor - force, dv - force))
    return before, after


def error_figure(record: Run, dv: Array, scale_factor: float) -> Figure:
    """Error against time of a record whose reference holds ``a_x``; ``scale_factor`` is K [(rad/s)/(m/s^2)]."""
    error = "velocity error [mm/s]" if record.direct else "velocity error as output angle [mrad]"
    plot = Plot("compensation-error", "Error before and after compensation.", TIME, error)
    before, after = compensation_errors(record, dv, scale_factor)
    plot.line(record.t - record.t[0], 1e3 * before, "as indicated", "before")
    plot.line(record.t - record.t[0], 1e3 * after, "compensated", "after")
    words = "The running error of the velocity against the reference"
    if record.direct:
        return plot.caption(f"{words}.")
    return plot.caption(
        f"{words}, in units of the output angle: the cross-coupling ripples once a revolution and drifts; what is left "
        "after compensation is the noise of the output."
    )


def force_figure(outline: CompensationOutline) -> Figure:
    """Indicated and compensated specific force, their difference, and the uncertainty, against time."""
    components, curves, t = outline.components, outline.curves, outline.t
    single = len(components) == 1
    where = "along the input axis" if single else "in the common frame"
    plot = Plot("compensation-force", f"Specific force {where}.", height=2.3)
    roles: tuple[Role, ...] = ("model",) if single else XYZ
    named = list(zip(components, roles, strict=True))
    for name in components:
        plot.panel(TIME, f"specific force {name} [g]")
        if f"indicated {name}" in curves:
            plot.line(t, curves[f"indicated {name}"] / G0, "indicated", "before")
        plot.line(t, curves[name] / G0, "compensated", "after")
    if outline.records:
        plot.panel(TIME, "correction [µg]")
        for name, role in named:
            plot.line(t, curves[f"correction {name}"] / MICRO_G, f"correction of {name}", role)
    u = [curves[f"u {name}"] / MICRO_G for name in components if f"u {name}" in curves]
    if u and math.isfinite(outline.rms(f"u {components[0]}")):
        plot.panel(TIME, Axis("standard uncertainty", "µg", limits=(0.0, 1.15 * float(np.nanmax(u)) or 1.0)))
        for (name, role), values in zip(named, u, strict=True):
            plot.line(t, values, f"u({name}) of a row", role)
    if not outline.records:
        return plot.caption("Compensated specific force, and its standard uncertainty.")
    along = " Several instruments: taken as force along the input axes, by least squares."
    note = f"Outlines of at most {POINTS} points; lowest and highest values are kept."
    return plot.caption(
        "Indicated: output rate over the calibrated scale factor, the base rate added where it is recorded."
        f"{'' if single else along} The correction, indicated less compensated, is the cross-coupling and the error terms "
        "of the calibration; both curves carry the same noise, so it does not.",
        *([] if t.size <= POINTS else [note]),
    )


def misfit_figure(outline: CompensationOutline, names: Sequence[str]) -> Figure:
    """Residual of a redundant set, and how far each instrument is from the force that fits all."""
    plot = Plot("compensation-misfit", "What the instruments say against each other.", height=1.7)
    plot.panel(TIME, "residual of the set [µg]")
    plot.line(outline.t, outline.curves["residual"] / MICRO_G, "residual: root of the summed squares")
    for i, name in enumerate(names):
        plot.panel(TIME, f"misfit of {name} [µg]")
        plot.line(outline.t, outline.curves[f"misfit {i}"] / MICRO_G, "misfit", "model")
    return plot.caption(
        "Indication of an instrument less the force that fits all, along its effective input axis. Noise is good; a line, "
        "a step or a drift in one of them points at its calibration, its mounting, its phase or a fault."
    )


# --- page -----------------------------------------------------------------------------------


def figures(result: Compensated | CompensatedSet) -> dict[str, Callable[[], Figure]]:
    """The figure of a compensation in memory; without its record the compensated force alone."""
    made = result.made_from if isinstance(result, Compensated) else None
    outline = CompensationOutline(result) if made is None else of_record(*made, result)  # type: ignore[arg-type]
    return {"force": partial(force_figure, outline)}


def brief(result: Compensated | CompensatedSet) -> Page:
    """What a notebook and the terminal show of a compensation in memory."""
    facts = named_values("", "", result.in_brief())
    return Page(result.heading(), sections=(Section("", "result", (facts, figures(result)["force"])),))


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


def compensation_page(
    outline: CompensationOutline, names: Sequence[str], files: Inputs, options: dict[str, str]
) -> Page:
    """The page of a compensation of instruments with these names.

    ``files`` are all files read, each with the SHA-256 of the bytes read; ``options`` those given, in words.
    """
    first, kind = outline.calibrations[0], outline.records[0].kind
    found = [quality_table(record.quality) for record in outline.records if record.quality.events]
    many = f"{len(outline.mounted)} instruments"
    return Page(
        title=f"Compensation of {many if outline.mounted else first.serial}",
        subtitle=f"{', '.join(names)}; {count(outline.t.size)} rows; the output is of kind "
        f"{'count' if first.direct and kind == 'angle' else kind}.",
        tiles=_tiles(outline),
        sections=shown_sections(
            Section("Specific force", "specific-force", (force_figure(outline),)),
            _misfit(outline, names) if outline.mounted else _reference(outline),
            _flags(outline, names),
            *([_instruments(outline, names)] if outline.mounted else []),
            Section("Found while reading", "repairs", tuple(found)),
            _provenance(outline, names, files, options),
        ),
        judgement=_judgement(outline, names),
        kicker="piga · compensation",
        footer=f"Made by piga {__version__} on {datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}. {ALONE}",
    )


def _judgement(outline: CompensationOutline, names: Sequence[str]) -> Judgement:
    """The verdicts on all calibrations in one box, the worst on top; each doubt of a set names its instruments."""
    each = [judgement(calibration) for calibration in outline.calibrations]
    if len(each) == 1:
        return judgement(outline.calibrations[0], "The calibration that was used: ")
    tones: tuple[Tone, ...] = ("", "quiet", "good", "doubtful", "bad")
    worst = max(each, key=lambda one: tones.index(one.tone))
    named: dict[tuple[str, str], list[str]] = {}
    for name, calibration in zip(names, outline.calibrations, strict=True):
        for doubt in calibration.verdict.doubts:
            named.setdefault((sentence(doubt.what), doubt.remedy), []).append(name)
    problems = tuple((f"{', '.join(those)}: {what}", remedy) for (what, remedy), those in named.items())
    tested = dict.fromkeys(words for one in each for words in one.tested)
    untested = dict.fromkeys(words for one in each for words in one.not_tested)
    headline = f"The calibrations that were used: {worst.headline}"
    return Judgement(worst.tone, headline, "", problems, tuple(tested), tuple(untested))


def _micro_g(outline: CompensationOutline, *names: str) -> str:
    value = outline.rms(*names)
    return short(value / MICRO_G) if math.isfinite(value) else "–"


def _tiles(outline: CompensationOutline) -> tuple[Tile, ...]:
    result, components = outline.result, outline.components
    velocity = ", ".join(short(float(v), 4) for v in np.atleast_1d(result.dv.sum(axis=0)))
    known = [short(float(u), 2) for u in np.atleast_1d(result.u_velocity) if math.isfinite(u)]
    u = f"standard uncertainty {', '.join(known)} m/s; " if known else ""
    correction, own = (_micro_g(outline, *(f"{kind} {c}" for c in components)) for kind in ("correction", "u"))
    tiles = [
        Tile(
            "Velocity" if len(components) == 1 else "Velocity x, y, z",
            velocity,
            "m/s",
            f"{u}sum of dv; time between stretches is not counted",
        ),
        Tile("Correction, rms", correction, "µg", "indicated less compensated"),
    ]
    if own != "–":
        tiles.append(Tile("u, rms", own, "µg", "standard uncertainty of one row"))
    if outline.redundant:
        tiles.append(Tile("Residual, rms", _micro_g(outline, "residual"), "µg", "of the redundant set"))
    flagged = int(np.count_nonzero(result.flags & ~FLAGS["no_increment"]))
    detail = f"{short(100.0 * flagged / max(result.size, 1))} % of the rows, no_increment not counted"
    return (*tiles, Tile("Rows with a flag", count(flagged), "", detail, "doubtful" if flagged else "good"))


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
    if outline.t.size > COMPARED_ROWS:
        words = f"The error against the reference is shown for records of at most {count(COMPARED_ROWS)} rows."
        return Section(title, anchor, (Notice("info", words),))
    lead = (
        "Where the record holds a reference along the input axis that is worth comparing with (a laboratory does), "
        "these are the errors against it; they hold the errors of that reference, too."
    )
    drawn = error_figure(outline.records[0], outline.result.dv, scale_factor(outline.calibrations[0]))
    return Section(title, anchor, (lead, drawn))


def _flags(outline: CompensationOutline, names: Sequence[str]) -> Section:
    raised = outline.raised()
    if not raised:
        return Section("Flags", "flags", (Notice("good", "No row carries a flag."),))
    table = (
        TableOf(raised.items())
        .text("flag", lambda row: row[0])
        .number("bit", lambda row: str(FLAGS[row[0]]))
        .number("rows", lambda row: count(row[1].size))
        .number("share", lambda row: short(100.0 * row[1].size / outline.t.size), "%")
    )
    notes: tuple[str, ...] = ()
    if outline.mounted:
        flags = {name: outline.flags_of(i) for i, name in enumerate(names)}
        table.across(names, str, lambda row, name: count(int(np.count_nonzero(flags[name] & FLAGS[row[0]]))))
        notes = ("A row of the set carries the flags of all its instruments. A fault is one of the set.",)
    table.number("first at", lambda row: short(float(row[1][0]), 6), "s")
    table.number("last at", lambda row: short(float(row[1][-1]), 6), "s")
    table.text("meaning", lambda row: MEANING[row[0]])
    caption = "Flags that were raised; times since the first row."
    said = [Notice("warning", words) for words in outline.result.notes]
    return Section("Flags", "flags", (*said, table.table(caption, notes)))


def _instruments(outline: CompensationOutline, names: Sequence[str]) -> Section:
    table = TableOf(range(len(names))).text("instrument", lambda i: names[i])
    table.across(
        range(3),
        lambda axis: f"X0 along {XYZ[axis]}",
        lambda i, axis: short(float(outline.mounted[i].axes[0][axis]), 6),
    )
    table.number("correction, rms", lambda i: _micro_g(outline, f"correction {i}"), "µg")
    table.number("misfit, rms", lambda i: _micro_g(outline, f"misfit {i}"), "µg")
    caption = "Input axes in the common frame; what was taken out and what is left."
    return Section("Instruments", "instruments", (table.table(caption),))


def _provenance(
    outline: CompensationOutline, names: Sequence[str], files: Inputs, options: dict[str, str]
) -> Section:
    """How it was compensated, with which coefficients, and the files."""
    many = len(names) > 1
    options = dict(options)
    for name, calibration in zip(names, outline.calibrations, strict=True):
        made, of = calibration.provenance, f" ({name})" if many else ""
        options[f"calibration of{of}"] = f"{calibration.serial}, by {made.software} on {made.created}"
        if not calibration.direct:
            options[f"phases of the calibration{of}"] = calibration.phases
    for name, item in zip(names, outline.mounted, strict=False):
        if item.phase is not None:
            phase = rounded(item.phase.value, item.phase.std).concise
            options[f"phase used ({name})"] = f"{phase} rad, as given"
    used = [
        replace(
            coefficient_table(calibration, every=True),
            caption=f"Coefficients of the calibration{f' of {name}' if many else ''}.",
            notes=(),
        )
        for name, calibration in zip(names, outline.calibrations, strict=True)
    ]
    how = named_values("", "", options, "How it was compensated.")
    read = named_values("file", "SHA-256", files, "Files as they were read.", code=True)
    return Section("Provenance", "provenance", (how, *used, read))
