"""A record before it is calibrated: what was found in it, and a picture of time, output and reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from piga.records.run import Run
from piga.reports.decimate import POINTS, envelope_rows
from piga.reports.figure import Axis, Figure, Panel, Role, Series
from piga.reports.page import Column, FigureBlock, Notice, Page, Section, Table, Text, Tile, write_page
from piga.units import G0

_ROLES: tuple[Role, ...] = ("x", "y", "z")


def record_figure(run: Run) -> Figure:
    """Interval between samples, output and reference against time, broken where a stretch begins."""
    t = run.t - run.t[0]
    step = np.diff(run.t, prepend=np.nan)
    inside, across = np.where(run.begins, np.nan, step), np.where(run.begins, np.abs(step), np.nan)
    turns = "rev" if run.kind == "angle" else "deg/s"
    output = run.output / (2.0 * np.pi) if run.kind == "angle" else np.degrees(run.output)
    output = np.where(run.begins, np.nan, output)
    time = Axis("time since the first sample", "s")
    broken = [np.where(run.begins, np.nan, run.f[:, i] / G0) for i in range(3)]
    forces = tuple(_thin(t, values, f"a_{'XYZ'[i]}", _ROLES[i]) for i, values in enumerate(broken))
    intervals = [_thin(t, inside, "inside a stretch", "data")]
    if np.isfinite(across).any():
        some = np.flatnonzero(np.isfinite(across) & (across > 0.0))[:POINTS]
        intervals.append(Series(t[some], across[some], "across a break", mark="points", role="warning"))
    panels = (
        Panel(time, Axis("interval", "s", log=True), tuple(intervals), title="Time base"),
        Panel(time, Axis("output", turns), (_thin(t, output, "output", "after"),), title="Output as unwrapped"),
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


def _thin(x: np.ndarray, y: np.ndarray, name: str, role: Role) -> Series:
    rows = envelope_rows(y, POINTS)
    return Series(x[rows], y[rows], name, role=role)


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
    rows = tuple(
        (event.kind, str(event.count), "" if event.first_row is None else str(event.first_row), event.detail)
        for event in quality.events
    )
    columns = (
        Column("finding", align="text"),
        Column("count"),
        Column("first row"),
        Column("what is done", align="text"),
    )
    findings = Table(columns, rows, "All findings") if rows else Notice("good", "Nothing was found.")
    digests = Table(
        (Column("file", align="text"), Column("SHA-256", align="text")),
        tuple(run.input_sha256.items()),
        "Files",
        code=True,
    )
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


def calibration_words(run: Run) -> str:
    """What a calibration with this run file would do, in words."""
    kept = len(set(run.phase_group)) == 1
    possible = "" if kept or run.model.phase == "per-segment" else " (not possible: the phase was lost)"
    return f"{run.estimation.method}, {len(run.model.terms)} terms, phase {run.model.phase}{possible}"


def write_check(run: Run, path: Path) -> Path:
    """Write the page."""
    return write_page(check_page(run), path)
