"""The record that a calibration is from, in words: files, duration, segments."""

from __future__ import annotations

import math
from pathlib import Path

from piga.records.calibration import Calibration
from piga.reports.calibration.figures import elapsed_time
from piga.reports.render.long_record import outline
from piga.reports.render.numbers import significant


def files_in_words(cal: Calibration) -> str:
    """The data files, or the runs."""
    if cal.runs:
        return ", ".join(run.name for run in cal.runs)
    names = [Path(name).name for name in cal.provenance.input_sha256]
    data = [name for name in names if not name.endswith(".toml")] or names
    return ", ".join(data) or "a record in memory"


def total_duration(cal: Calibration) -> float:
    """Duration of all segments [s]."""
    if cal.segments:
        return math.fsum(segment.duration for segment in cal.segments)
    return (
        float(elapsed_time(outline(cal.residuals))[-1])
        if cal.residuals is not None and cal.residuals.t.size
        else 0.0
    )


def period_in_words(seconds: float) -> str:
    """A duration in seconds, minutes or hours."""
    if seconds < 120.0:
        return f"{significant(seconds, 3)} s"
    return (
        f"{significant(seconds / 60.0, 3)} min" if seconds < 7200.0 else f"{significant(seconds / 3600.0, 3)} h"
    )


def segments_in_words(cal: Calibration) -> str:
    """How many runs and segments."""
    runs = f"{len(cal.runs)} runs, " if cal.runs else ""
    return runs + ("one segment" if len(cal.segments) == 1 else f"{len(cal.segments)} segments")
