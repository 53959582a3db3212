"""A compensation shown, of one instrument or of several that were solved together: curves, figures, page."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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
from piga.reports.calibration.tables import judgement, quality_table, scale_factor, sentence
from piga.reports.render.figure import XYZ, Axis, Figure, Plot, Role
from piga.reports.render.numbers import count, rounded, short
from piga.reports.render.page import (
    ALONE,
    Content,
    Judgement,
    Notice,
    Page,
    Section,
    TableOf,
    Tile,
    Tone,
    named_values,
    sections,
)
from piga.results import Array
from piga.units import G0, MICRO_G


class CompensationOutline:
    """A compensation with its records and calibrations, and its curves (n,) by name [m/s^2].

    The components are ``a_x``; of a set, whose instruments are ``mounted``, ``f_x``, ``f_y``, ``f_z``. A curve is a component
    itself, or has ``indicated``, ``correction`` or ``u`` before its name. A set also has ``correction`` of each instrument, and
    a redundant one ``residual`` and ``misfit`` of each. A curve that is not known is missing.
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
        self.redundant = len(mounted) > 3
        single = isinstance(result, Compensated)
        self.components = ("a_x",) if single else tuple(f"f_{axis}" for axis in XYZ)
        force, u = (result.ax, result.u_ax) if isinstance(result, Compensated) else (result.f, result.u_f)
        force = force.reshape(result.size, -1).T
        self.curves: dict[str, Array] = dict(zip(self.components, force, strict=True))
        if u.size:
            self.curves |= {f"u {c}": u.reshape(result.size, -1)[:, k] for k, c in enumerate(self.components)}
        if not records:
            return
        begins = np.logical_or.reduce([record.begins for record in records])
        pairs = enumerate(zip(records, calibrations, strict=True))
        along = np.array([_indicated(*pair, begins, self.flags_of(i)) for i, pair in pairs])
        axes = np.array([item.axes[0] for item in mounted] or [[1.0]], dtype=float)
        for c, values in zip(self.components, np.linalg.pinv(axes) @ along, strict=True):
            self.curves |= {f"indicated {c}": values, f"correction {c}": values - self.curves[c]}
        for i in range(len(mounted)):
            self.curves[f"correction {i}"] = along[i] - axes[i] @ force
        if isinstance(result, CompensatedSet) and self.redundant:
            misfits = {f"misfit {i}": values for i, values in enumerate(result.misfit)}
            self.curves |= misfits | {"residual": result.residual}

    def flags_of(self, instrument: int) -> NDArray[np.int32]:
        """Flags of one instrument; those of all if they are not known apart."""
        each = getattr(self.result, "each", None)
        return each[instrument] if each is not None and each.size else self.result.flags

    def rms(self, *names: str) -> float:
        """Root mean square of all finite values of curves, taken together as components; nan without values."""
        known = (self.curves[name] for name in names if name in self.curves)
        parts = [float(np.mean(np.square(seen))) for one in known if (seen := one[np.isfinite(one)]).size]
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


# --- figures --------------------------------------------------------------------------------

TIME = "time since the first row [s]"
_COMPARED = 1 << 24
"""Most rows of a record that is compared with its reference: it takes eight columns of memory."""


def _error_figure(record: Run, dv: Array, K: float) -> Figure:
    """Error against time of a record whose reference holds ``a_x``. ``dv``: compensated increments; K [(rad/s)/(m/s^2)]."""
    h, turn = _turned(record, record.begins)
    t, force, scale = record.t - record.t[0], h * middles(record.f[:, 0]), 1e3 * (1.0 if record.direct else K)
    error = "velocity error [mm/s]" if record.direct else "velocity error as output angle [mrad]"
    plot = Plot("compensation-error", "Error before and after compensation.", TIME, error)
    plot.line(t, np.cumsum(scale * (turn / K - force)), "as indicated", "before")
    plot.line(t, np.cumsum(scale * (dv - force)), "compensated", "after")
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
    return plot.caption(
        "Indicated: output rate over the calibrated scale factor, the base rate added where it is recorded."
        f"{'' if single else along} The correction, indicated less compensated, is the cross-coupling and the error terms "
        "of the calibration; both curves carry the same noise, so it does not."
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
    outline = CompensationOutline(result, *([[made[0]], [made[1]]] if made else []))  # type: ignore[arg-type]
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
    outline = CompensationOutline(result, [run], [calibration])
    return compensation_page(outline, (data[0],), (data,), {"method": result.method})


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
        sections=sections(
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
    headline = f"The calibrations that were used: {worst.headline}"
    return Judgement(worst.tone, headline, "", problems)


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
    text = "Three instruments fit any force exactly: nothing is left over that could contradict it."
    content: tuple[Content, ...] = (Notice("info", text),)
    if outline.redundant:
        faults = int(np.count_nonzero(outline.result.flagged("fault")))
        rows = f"{count(faults)} rows contradict themselves" if faults else "No row contradicts itself"
        words = f"{rows} beyond the uncertainties of the calibrations (flag fault)."
        content = (Notice("warning" if faults else "good", words), misfit_figure(outline, names))
    return Section("Instruments against each other", "misfit", content)


def _reference(outline: CompensationOutline) -> Section:
    words = (
        "Where the record holds a reference along the input axis that is worth comparing with (a laboratory does), "
        "these are the errors against it; they hold the errors of that reference, too."
    )
    K = scale_factor(outline.calibrations[0])
    content: Content = partial(_error_figure, outline.records[0], outline.result.dv, K)
    if outline.t.size > _COMPARED:
        content = Notice("info", f"The error is shown for records of at most {count(_COMPARED)} rows.")
    return Section("Against the reference", "reference", (words, content))


def _flags(outline: CompensationOutline, names: Sequence[str]) -> Section:
    times = {name: outline.t[outline.result.flagged(name)] for name in FLAGS}
    raised = {name: t for name, t in times.items() if t.size}
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
    """How it was compensated, and the files."""
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
    how = named_values("", "", options, "How it was compensated.")
    read = named_values("file", "SHA-256", files, "Files as they were read.", code=True)
    return Section("Provenance", "provenance", (how, read))
