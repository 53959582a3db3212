"""Compensate one record from file to file in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from piga.compensation.compensator import Chunk, pieces_of, stream_of
from piga.compensation.model import FLAGS
from piga.compensation.result import Compensated, Inputs, Resampler, TableWriter, notes_on
from piga.progress import Progress, report
from piga.records.calibration import Calibration
from piga.records.run import Run

HELD_ROWS = 1 << 18
"""Rows of all records together above which their columns are kept on disk, to bound the memory."""
Watch = Callable[[str, Chunk, Compensated], object]
"""Called with the label of a segment, its samples, and their compensated rows."""


@dataclass(eq=False)
class FileSummary:
    """Totals of a written file: rows, velocity [m/s], and rows per flag."""

    rows: int = 0
    velocity: float = 0.0
    flags: dict[str, int] = field(default_factory=dict)

    def add(self, part: Compensated) -> None:
        """Add a compensated part."""
        self.rows += part.size
        self.velocity += float(part.dv.sum())
        any_flags = int(np.bitwise_or.reduce(part.flags))
        for name, bit in FLAGS.items():
            if any_flags & bit:
                count = int(np.count_nonzero(part.flags & bit))
                self.flags[name] = self.flags.get(name, 0) + count


def found_while_reading(*records: Run) -> dict[str, int]:
    """Number of findings of each kind in the records, as ``piga check`` counts them."""
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
    progress: Progress | None = None,
    watch: Watch | None = None,
    inputs: Inputs = (),
    **options: Any,
) -> FileSummary:
    """Compensate a record piece by piece into the file ``out``.

    Parameters
    ----------
    record, calibration, **options:
        As for :func:`piga.compensate`.
    out, kind:
        The file, and its format: ``"parquet"`` or ``"csv"``.
    resampler:
        Resamples the rows to its rate.
    progress:
        Called as ``progress(done, total, what)`` with the rows of the record that are done; it returns False to stop
        (:mod:`piga.progress`). ``out`` is then not complete.
    watch:
        Called with every piece before resampling.
    inputs:
        Input files of the result, for the metadata of a Parquet file.

    Raises
    ------
    CalibrationError
        As :func:`piga.compensate`.
    """
    summary, rows = FileSummary(), 0
    report(progress, 0, record.size, "compensating")
    with TableWriter(out, kind, notes_on(calibration), inputs) as writer:
        stream = stream_of(record, calibration, **options)
        for _, label, chunk in pieces_of(record, stream):
            piece = stream.push(chunk)
            rows += piece.size
            report(progress, rows, record.size, "compensating")
            if watch is not None:
                watch(label, chunk, piece)
            part = resampler.push_rows(piece) if resampler else piece
            summary.add(part)
            if part.size:
                writer.write(part.columns())
    return summary
