"""The record without its bad samples: what every reading is too large by, and what was found where."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga._kernels.outliers import correct_samples
from piga.calibration.outliers import Flags, Misses, count_flags
from piga.records.calibration import Event, Outlier
from piga.records.run import Run
from piga.records.spool import arrays_like, spans, steps

Array = NDArray[np.float64]

STUCK = 4
"""Equal readings in a row, off the path, that count as stuck."""
LISTED = 200_000
"""Findings that a result lists one by one; all are counted."""
SHOWN = 6
"""Times named in an event."""


def leave_out(run: Run, misses: Misses, flags: Flags) -> tuple[Run, tuple[Outlier, ...]]:
    """The record without bad samples, and what was found.

    Their output becomes what the model predicts (only the coupling's phase uses it); a jump is taken off all
    later samples.
    """
    wrong = _corrections(run, misses, flags)
    arrays = arrays_like(run.output)
    output = arrays.empty(run.size)
    left_out, begins = arrays.empty(run.size, np.bool_), arrays.empty(run.size, np.bool_)
    lost = False
    for part in spans(run.size):
        output[part] = run.output[part] - wrong[part]
        left_out[part] = flags[part] == 1
        begins[part] = run.begins[part] | (flags[part] == 2)
        lost = _begin_later(begins[part], left_out[part], lost)
    found, counts = _findings(run, flags, wrong)
    quality = run.quality
    count = count_flags(flags, 1)
    cleaned = replace(
        run,
        output=output,
        begins=begins,
        left_out=left_out,
        quality=replace(
            quality,
            used=quality.used - count,
            masked=quality.masked + count,
            events=(*quality.events, *_events(found, counts)),
        ),
    )
    return cleaned, found


def _begin_later(begins: NDArray[np.bool_], left_out: NDArray[np.bool_], lost: bool) -> bool:
    """Where a stretch begins with samples that are left out the first good one begins it, too, in place.

    ``lost``: so it stood at the end of the block before; returned for the next.
    """
    starts = np.flatnonzero(begins & left_out)
    for start in ([0] if lost else []) + starts.tolist():
        rest = np.flatnonzero(~left_out[start:])
        if rest.size:
            begins[start + rest[0]] = True
    if starts.size == 0 and not lost:
        return False
    last = int(starts[-1]) if starts.size else 0
    return bool(left_out[last:].all())


def _corrections(run: Run, misses: Misses, flags: Flags) -> Array:
    """What every reading is too large by."""
    wrong: Array = arrays_like(run.output).zeros(run.size)
    if not misses.point:
        correct_samples(misses.d, run.begins, flags, wrong)
        return wrong
    for part in spans(run.size):
        wrong[part] = np.where(flags[part] == 0, 0.0, misses.d[part])
    return wrong


def _findings(run: Run, flags: Flags, wrong: Array) -> tuple[tuple[Outlier, ...], dict[str, int]]:
    """Runs of bad samples and jumps, in order of time, at most LISTED; numbers of jumps and of samples of each kind."""
    found: list[Outlier] = []
    counts: dict[str, int] = {}
    for start, stop in _runs(flags):
        kind, size = _judge(run, flags, wrong, start, stop)
        if kind == "jump" and size == 0.0:
            continue
        counts[kind] = counts.get(kind, 0) + (1 if kind == "jump" else stop - start)
        if len(found) < LISTED:
            samples = 0 if kind == "jump" else stop - start
            found.append(Outlier(kind, float(run.t[start]), int(run.row[start]), samples, size))
    return tuple(found), counts


def _judge(run: Run, flags: Flags, wrong: Array, start: int, stop: int) -> tuple[str, float]:
    """Kind of a run of bad samples, or of a jump, and by how much it is off [rad, rad/s]."""
    if flags[start] == 2:
        return "jump", float(abs(wrong[start] - _before(wrong, flags, start)))
    size = float(np.abs(wrong[start:stop] - wrong[max(start - 1, 0)]).max())
    if stop - start < STUCK:
        return "spike", size
    still = float((steps(run.output, slice(start, stop)) == 0.0).mean())
    return "stuck" if still > 0.5 else "spike", size


def _runs(flags: Flags) -> Iterator[tuple[int, int]]:
    """First row of every run of bad samples, or of a jump, and the row behind it."""
    begun = -1
    for part in spans(flags.size):
        kind = np.asarray(flags[part])
        marks = np.flatnonzero(kind)
        edges = np.flatnonzero(np.diff(kind, prepend=np.int8(-1)) != 0) if marks.size or begun >= 0 else marks
        for edge in edges.tolist():
            at = part.start + edge
            if begun >= 0 and kind[edge] != 1:
                yield begun, at
                begun = -1
            if kind[edge] == 2:
                yield at, at + 1
            elif kind[edge] == 1 and begun < 0:
                begun = at
    if begun >= 0:
        yield begun, flags.size


def _before(wrong: Array, flags: Flags, at: int) -> float:
    """What the last good sample before was too large by."""
    good = np.flatnonzero(flags[max(0, at - 1000) : at] != 1)
    return float(wrong[max(0, at - 1000) + good[-1]]) if good.size else 0.0


def _events(found: tuple[Outlier, ...], counts: dict[str, int]) -> list[Event]:
    words = {
        "spike": "samples off the path of the output are left out",
        "stuck": "samples during which the output stood still are left out",
        "jump": "no increment is formed across it, and it is taken off what follows",
    }
    events = []
    for kind, text in words.items():
        those = [outlier for outlier in found if outlier.kind == kind]
        if those:
            times = ", ".join(f"{outlier.time:.6g}" for outlier in those[:SHOWN])
            more = " and more" if counts[kind] > sum(max(o.samples, 1) for o in those[:SHOWN]) else ""
            events.append(Event(f"outlier-{kind}", counts[kind], those[0].row, f"t = {times}{more} s: {text}"))
    return events
