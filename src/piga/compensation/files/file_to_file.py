"""From a record of any length to a compensated file: memory is bounded, computing and writing overlap."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from piga.compensation.compensate import compensate_in_pieces
from piga.compensation.files import parts as parts_module
from piga.compensation.files.parts import Parts
from piga.compensation.flags import FLAGS
from piga.compensation.resample import Resampler
from piga.compensation.result import Compensated, notes_on
from piga.compensation.step import Chunk, init_state
from piga.compensation.writers import Inputs, TableWriter
from piga.records.calibration import Calibration
from piga.records.run import Run
from piga.records.spool import give_back

HELD_ROWS = 1 << 18
"""Rows of all records together above which their columns lie on disk: so memory does not grow with them."""
BEHIND = 2
"""Pieces that wait to be written while the next one is computed."""
HELD_BYTES = 270_000_000
"""Resident memory above which what was freed is given back, after so many pieces; sooner when a page is filled, too."""
GIVEN_BACK_AFTER, GIVEN_BACK_SOONER = 16, 2
Watch = Callable[[str, Chunk, Compensated], object]
"""Sees the label of a segment, its samples, and what became of them."""


@dataclass
class FileSummary:
    """What was written: rows, velocity [m/s], and rows per flag."""

    rows: int = 0
    velocity: float = 0.0
    flags: dict[str, int] = field(default_factory=dict)

    def add(self, part: Compensated) -> None:
        """Count a part."""
        self.rows += part.size
        self.velocity += float(part.dv.sum())
        found = int(np.bitwise_or.reduce(part.flags))
        for name, bit in FLAGS.items():
            if found & bit:
                count = int(np.count_nonzero(part.flags & bit))
                self.flags[name] = self.flags.get(name, 0) + count

    def carried(self) -> dict[str, Any]:
        """What has been counted, for :meth:`go_on`."""
        return {"rows": self.rows, "velocity": self.velocity, "flags": self.flags}

    def go_on(self, carried: dict[str, Any]) -> None:
        """Count on from there."""
        self.rows, self.velocity, self.flags = carried["rows"], carried["velocity"], dict(carried["flags"])


def found_while_reading(*records: Run) -> dict[str, int]:
    """How often each kind of finding was met in the records, as ``piga check`` counts them."""
    counts: dict[str, int] = {}
    for record in records:
        for event in record.quality.events:
            counts[event.kind] = counts.get(event.kind, 0) + event.count
    return counts


def compensate_to_file(
    record: Run,
    calibration: Calibration,
    out: Path,
    kind: str,
    *,
    resampler: Resampler | None = None,
    advance: Callable[[int], None] = lambda _rows: None,
    parts: Parts | None = None,
    watch: Watch | None = None,
    inputs: Inputs = (),
    **options: Any,
) -> FileSummary:
    """Compensate a record into ``out`` (``kind``: parquet or csv), piece by piece.

    Parameters
    ----------
    record, calibration, **options:
        As :func:`piga.compensate` takes them.
    out, kind:
        The file, and whether it is ``"parquet"`` or ``"csv"``.
    resampler:
        Brings the rows to its rate.
    advance:
        Is told how many rows of the record are done.
    parts:
        The rows go there first; those that lie there already are not computed again. The result is the same to the bit.
    watch:
        Is shown every piece, before it is brought to another rate; it does not go with ``parts``.
    inputs:
        Files that the result is computed from, for the metadata of a Parquet file.

    Raises
    ------
    CalibrationError
        As :func:`piga.compensate`.
    """
    summary, state = FileSummary(), init_state()
    notes = notes_on(calibration)
    if parts is None:
        with TableWriter(out, kind, notes, inputs) as writer:
            pieces = compensate_in_pieces(record, calibration, state=state, **options)
            _work_off(pieces, writer, summary, resampler, advance, math.inf, watch)
        return summary
    done = 0
    carried = parts.carried()
    if carried is not None:
        done, state[:] = carried["pieces"], carried["state"]
        advance(carried["rows"])
        summary.go_on(carried["summary"])
        if resampler is not None:
            resampler.go_on(carried["resampler"])
    rows = 0 if carried is None else carried["rows"]
    pieces = compensate_in_pieces(record, calibration, state=state, done=done, **options)
    while rows < record.size:
        with parts.writer() as writer:
            count, taken = _work_off(pieces, writer, summary, resampler, advance, parts_module.PART_ROWS)
            done, rows = done + count, rows + taken
        parts.keep(
            {
                "pieces": done, "rows": rows, "state": state.tolist(), "summary": summary.carried(),
                "resampler": resampler.carried() if resampler else None,
            },
            writer.rows,
        )  # fmt: skip
    with TableWriter(out, kind, notes, inputs) as writer:
        for columns in parts.rows():
            writer.write(columns)
    return summary


def _work_off(
    pieces: Iterator[tuple[str, Chunk, Compensated]], writer: TableWriter, summary: FileSummary,
    resampler: Resampler | None, advance: Callable[[int], None], most: float, watch: Watch | None = None,
) -> tuple[int, int]:  # fmt: skip
    """Write pieces until ``most`` rows of the record are done: how many pieces, and rows, were taken."""
    pending: deque[Future[None]] = deque()
    number = rows = 0
    with ThreadPoolExecutor(1) as pen:
        for label, chunk, piece in pieces:
            number, rows = number + 1, rows + piece.size
            if number % (GIVEN_BACK_AFTER if watch is None else GIVEN_BACK_SOONER) == 0:
                give_back(HELD_BYTES)
            advance(piece.size)
            if watch is not None:
                watch(label, chunk, piece)
            part = resampler.push_rows(piece) if resampler else piece
            summary.add(part)
            if part.size:
                pending.append(pen.submit(writer.write, part.columns()))
            while len(pending) > BEHIND:
                pending.popleft().result()
            if rows >= most:
                break
        for write in pending:
            write.result()
    return number, rows
