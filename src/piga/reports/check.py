"""A record before its calibration: its faults, and a figure of time, output and reference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from piga.calibration import TermProspect
from piga.calibration.model.request import lost_phase
from piga.records.arrays import changes, norms
from piga.records.run import Run
from piga.reports.calibration.tables import quality_table
from piga.reports.render.figure import POINTS, XYZ, Figure, Plot
from piga.reports.render.numbers import count
from piga.reports.render.page import Notice, Page, Section, Table, TableOf, Tile, origin
from piga.results import Array
from piga.units import G0


def figures(run: Run) -> dict[str, Callable[[], Figure]]:
    """The figure of a record."""
    return {"record": partial(record_figure, run)}


def record_figure(run: Run) -> Figure:
    """Interval between samples, output and reference with the positions, against time, broken where a stretch begins."""
    unit, scale = ("rev", 1.0 / (2.0 * np.pi)) if run.kind == "angle" else ("deg/s", 180.0 / np.pi)
    if run.direct:
        unit, scale = run.output_unit, 1.0
    time = "time since the first sample [s]"
    plot = Plot("record", "The record as it would be calibrated.", height=2.1)
    plot.panel(time, "log interval [s]", "Time base").line(*_curve(run, changes(run.t)), "inside a stretch")
    breaks = np.flatnonzero(run.begins)[1:]
    breaks = breaks[run.t[breaks] != run.t[breaks - 1]]
    if breaks.size:
        gap = np.abs(run.t[breaks] - run.t[breaks - 1])
        plot.points(run.t[breaks] - run.t[0], gap, "across a break", "warning")
    plot.panel(time, f"output [{unit}]", "Output as unwrapped")
    _draw_positions(plot, run, run.output * scale)
    plot.line(*_curve(run, run.output * scale), "output", "after")
    plot.panel(time, "specific force [g]", "Reference")
    _draw_positions(plot, run, run.f / G0)
    for i, role in enumerate(XYZ):
        plot.line(*_curve(run, run.f[:, i] / G0), f"a_{role.upper()}", role)
    return plot.caption(
        "A good record has one interval throughout, an output without steps, and a reference that is the "
        "test that was meant. Marks above the line are breaks; no increment is formed across them. Grey areas are the "
        "positions; rows between them are not used. The name of a position stands at its middle."
    )


def _draw_positions(plot: Plot, run: Run, values: Array) -> None:
    """An area for each position over the height of the values, and its name at its middle; not for a record of one."""
    edges = run.segment_edges()
    if not 3 <= edges.size <= POINTS // 4:
        return
    low, high = float(values.min()), float(values.max())
    begin, end = run.t[edges[:-1]] - run.t[0], run.t[edges[1:] - 1] - run.t[0]
    x = np.stack([begin, begin, end, end], axis=1).ravel()
    plot.band(x, np.full(x.size, low), np.tile([low, high, high, low], begin.size), "positions")
    names = tuple(run.labels[int(run.segment_index[row])] for row in edges[:-1])
    plot.points(0.5 * (begin + end), np.full(begin.size, high), "name of the position", "muted", text=names)


def _curve(run: Run, values: Array) -> tuple[Array, Array]:
    """A quantity against time, broken where a stretch begins."""
    return run.t - run.t[0], np.where(run.begins, np.nan, values)


def page(run: Run, prospects: Sequence[TermProspect] = ()) -> Page:
    """What is in a record; ``prospects`` say what it determines."""
    quality, size = run.quality, norms(run.f) / G0
    found = len(quality.events)
    share = 100.0 * quality.used / max(quality.rows, 1)
    used = f"of {count(quality.rows)} ({share:.6g} %)"
    kept = "kept through the whole record" if _kept(run) else "lost between segments"
    tiles = (
        Tile("Rows used", count(quality.used), "", used, "good" if share > 99 else "doubtful"),
        Tile("Findings", f"{found}", "kind" if found == 1 else "kinds", "", "doubtful" if found else "good"),
        Tile("Recorded", f"{run.duration:.6g}", "s", f"{int(run.begins.sum())} stretches, {rate(run):.6g} Hz"),
        Tile("Segments", f"{len(run.labels)}", "", "" if run.direct else f"phase {kept}"),
        Tile("Reference", f"{size.min():.6g} to {size.max():.6g}", "g", _reference(run)),
        Tile("Calibration", run.estimation.method, "", _calibration(run)[0]),
    )
    findings = quality_table(quality) if quality.events else Notice("good", "Nothing was found.")
    terms = (Section("Terms", "terms", (prospects_table(prospects),)),) if prospects else ()
    return Page(
        f"Record of {run.serial}",
        Path(run.source).name,
        tiles,
        (
            Section("Findings", "findings", (findings,)),
            *terms,
            Section("The record", "picture", (partial(record_figure, run),)),
            origin(run.input_sha256),
        ),
        kicker="piga check",
    )


def brief(run: Run, prospects: Sequence[TermProspect] = ()) -> Page:
    """What is in a record, for terminal and notebook."""
    return page(run, prospects).only("findings", "terms", "picture")


def prospects_table(prospects: Sequence[TermProspect]) -> Table:
    """Which terms the record determines."""
    table = (
        TableOf(prospects)
        .text("term", lambda prospect: prospect.term)
        .text("asked", lambda prospect: "asked" if prospect.asked else "")
        .text("what the record says", lambda prospect: prospect.words())
    )
    if any(prospect.asked and prospect.remedy for prospect in prospects):
        table.text("remedy", lambda prospect: prospect.remedy if prospect.asked else "")
    return table.table()


def check_document(record: Run, prospects: Sequence[TermProspect] = ()) -> dict[str, Any]:
    """What is in a record, as plain data for JSON; ``prospects`` say what it determines."""
    size, (words, possible) = norms(record.f), _calibration(record)
    return {
        "serial": record.serial,
        "quality": msgspec.to_builtins(record.quality),
        "segments": list(record.labels),
        "duration_s": record.duration,
        "rate_hz": rate(record),
        "force_g": [float(size.min()) / G0, float(size.max()) / G0],
        "phase_kept": _kept(record),
        "calibration": f"{record.estimation.method}, {words}",
        "calibration_possible": possible,
        "input_sha256": record.input_sha256,
        **({"terms": [prospect.document() for prospect in prospects]} if prospects else {}),
    }


def _reference(run: Run) -> str:
    """Where the reference comes from, in words."""
    if run.stand is None:
        return "specific force |f|"
    if run.computed_reference:
        return "specific force |f|, computed from [stand]"
    return "specific force |f| of the logged columns; [stand] is used for the uncertainties alone"


def rate(run: Run) -> float:
    """Usual rate of the samples [Hz]; 0 if there is none."""
    return 1.0 / step if (step := run.median_step) > 0.0 else 0.0


def _kept(run: Run) -> bool:
    """Whether the phase of the output is one through the whole record."""
    return len(set(run.phase_group)) == 1


def _calibration(run: Run) -> tuple[str, bool]:
    """A calibration with this run file in words; False if one phase is asked for and the record has lost it."""
    possible = lost_phase(run, run.model.terms, run.model.phases) is None
    phases = "" if run.direct else f", phases {run.model.phases}"
    lost = "" if possible else " (not possible: the phase was lost)"
    return f"{len(run.model.terms)} terms{phases}{lost}", possible
