"""Report on a record before its calibration: its faults, and a figure of time, output and reference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from piga.calibration import TermProspect
from piga.calibration.model.request import lost_phase
from piga.records.run import Run
from piga.records.spool import spans, steps
from piga.reports.render.decimate import POINTS, envelope_rows
from piga.reports.render.figure import XYZ, Axis, Figure, Panel, Role, Series
from piga.reports.render.page import (
    FigureBlock,
    Notice,
    Page,
    Section,
    TableOf,
    Text,
    Tile,
    named_values,
    write_page,
)
from piga.units import G0

_BLOCK = 1 << 20
"""Samples whose outline is drawn at a time."""


def record_figure(run: Run) -> Figure:
    """Interval between samples, output and reference against time, broken where a stretch begins."""
    turns = "rev" if run.kind == "angle" else "deg/s"
    scale = 1.0 / (2.0 * np.pi) if run.kind == "angle" else 180.0 / np.pi
    time = Axis("time since the first sample", "s")
    forces = tuple(
        _thin(run, partial(_scaled, run.f[:, i], 1.0 / G0), f"a_{role.upper()}", role)
        for i, role in enumerate(XYZ)
    )
    intervals = [_thin(run, partial(steps, run.t), "inside a stretch", "data")]
    some = np.flatnonzero(run.begins)[1:]
    some = some[run.t[some] != run.t[some - 1]][:POINTS]
    if some.size:
        gap = np.abs(run.t[some] - run.t[some - 1])
        intervals.append(Series(run.t[some] - run.t[0], gap, "across a break", mark="points", role="warning"))
    output = _thin(run, partial(_scaled, run.output, scale), "output", "after")
    panels = (
        Panel(time, Axis("interval", "s", log=True), tuple(intervals), title="Time base"),
        Panel(time, Axis("output", turns), (output,), title="Output as unwrapped"),
        Panel(time, Axis("specific force", "g"), forces, title="Reference"),
    )
    return Figure(
        "record",
        "The record as it would be calibrated.",
        panels,
        caption="A good record has one interval throughout, an output without steps, and a reference that is the "
        "test that was meant. Marks above the line are breaks; no increment is formed across them.",
        height=2.1,
    )


def _scaled(values: np.ndarray, factor: float, part: slice) -> np.ndarray:
    return values[part] * factor


def _thin(run: Run, values: Callable[[slice], np.ndarray], name: str, role: Role) -> Series:
    """A quantity against time, broken where a stretch begins; of a long record its outline."""
    times, shown = [], []
    limit = max(POINTS // (1 + run.size // _BLOCK), 8)
    for start in range(0, run.size, _BLOCK):
        part = slice(start, min(start + _BLOCK, run.size))
        y = np.where(run.begins[part], np.nan, values(part))
        rows = envelope_rows(y, limit)
        times.append(run.t[part][rows] - run.t[0])
        shown.append(y[rows])
    return Series(np.concatenate(times), np.concatenate(shown), name, role=role)


def check_page(run: Run) -> Page:
    """The page of ``piga check --out``."""
    quality = run.quality
    share = 100.0 * quality.used / max(quality.rows, 1)
    tiles = (
        Tile(
            "Rows used",
            f"{quality.used}",
            "",
            f"of {quality.rows} ({share:.6g} %)",
            "good" if share > 99 else "doubtful",
        ),
        Tile("Findings", f"{len(quality.events)}", "", "kinds", "good" if not quality.events else "doubtful"),
        Tile("Segments", f"{len(run.labels)}", "", calibration_words(run), ""),
        Tile("Recorded", f"{run.duration:.6g}", "s", f"{int(run.begins.sum())} stretches", ""),
    )
    table = (
        TableOf(quality.events)
        .text("finding", lambda event: event.kind)
        .number("count", lambda event: str(event.count))
        .number("first row", lambda event: "" if event.first_row is None else str(event.first_row))
        .text("what is done", lambda event: event.detail)
        .table("All findings")
    )
    findings = table if quality.events else Notice("good", "Nothing was found.")
    digests = named_values("file", "SHA-256", run.input_sha256, "Files", code=True)
    return Page(
        f"Record of {run.serial}",
        Path(run.source).name,
        tiles,
        (
            Section("Findings", "findings", (findings,)),
            Section("The record", "picture", (FigureBlock(record_figure(run)),)),
            Section("Origin", "origin", (Text("Files that were read, by digest."), digests)),
        ),
        kicker="piga check",
    )


def check_document(record: Run, prospects: Sequence[TermProspect] = ()) -> dict[str, Any]:
    """What is in a record, as plain data for JSON; ``prospects`` say what it determines."""
    low, high = np.inf, 0.0
    for part in spans(record.size):
        size = np.linalg.norm(record.f[part], axis=1)
        low, high = min(low, float(size.min())), max(high, float(size.max()))
    return {
        "serial": record.serial,
        "quality": msgspec.to_builtins(record.quality),
        "segments": list(record.labels),
        "duration_s": record.duration,
        "rate_hz": 1.0 / step if (step := record.median_step) > 0.0 else 0.0,
        "force_g": [low / G0, high / G0],
        "phase_kept": len(set(record.phase_group)) == 1,
        "calibration": calibration_words(record),
        "calibration_possible": calibration_possible(record),
        "input_sha256": record.input_sha256,
        **({"terms": [prospect.document() for prospect in prospects]} if prospects else {}),
    }


def check_text(record: Run, name: str = "") -> str:
    """What is in a record, as lines for the terminal. ``name`` is the run file."""
    document, phase = check_document(record), "lost between segments"
    if document["phase_kept"]:
        phase = "kept through the whole record"
    low, high = document["force_g"]
    lines = [
        f"{name or 'record'}: instrument {record.serial}, {record.size} of {record.quality.rows} rows used",
        f"  segments   {len(record.labels)}, {document['duration_s']:.6g} s recorded, {document['rate_hz']:.6g} Hz",
        f"  reference  |f| {low:.6g} to {high:.6g} g",
        f"  phase      {phase}",
        f"  calibrate  {document['calibration']}",
    ]
    for event in record.quality.events:
        row = "" if event.first_row is None else f", first at row {event.first_row}"
        lines.append(
            f"  found      {event.count} x {event.kind}{row}{': ' + event.detail if event.detail else ''}"
        )
    return "\n".join(lines if record.quality.events else [*lines, "  findings   none"])


def prospects_text(prospects: Sequence[TermProspect]) -> str:
    """Which terms the record determines, as lines for the terminal."""
    width = max(len(prospect.term) for prospect in prospects)
    lines = []
    for prospect in prospects:
        mark = "asked" if prospect.asked else ""
        lines.append(f"  {mark:<9}  {prospect.term:<{width}}  {prospect.words()}")
        if prospect.remedy and prospect.asked:
            lines.append(f"{'':{width + 15}}remedy: {prospect.remedy}")
    return "\n".join(lines)


def calibration_words(run: Run) -> str:
    """Description of a calibration with this run file."""
    possible = "" if calibration_possible(run) else " (not possible: the phase was lost)"
    return f"{run.estimation.method}, {len(run.model.terms)} terms, phases {run.model.phases}{possible}"


def calibration_possible(run: Run) -> bool:
    """False if one phase is asked for and the record has lost it."""
    return lost_phase(run, run.model.terms, run.model.phases, run.estimation.method) is None


def write_check(run: Run, path: Path) -> Path:
    """Write the page of ``piga check`` for the record ``run`` to ``path``."""
    return write_page(check_page(run), path)
