"""Compensate one record from file to file in bounded memory. An interrupted run can be resumed from its parts."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import secrets
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.compensation.compensator import Chunk, compensate_in_pieces, init_state
from piga.compensation.model import FLAGS
from piga.compensation.result import Compensated, Inputs, Resampler, TableWriter, notes_on
from piga.errors import ArgumentError
from piga.output import hold, put_in_place, write_whole
from piga.progress import Progress, report
from piga.records.calibration import Calibration
from piga.records.calibration.document import calibration_to_bytes
from piga.records.run import Run
from piga.records.spool import give_back, spans

FOLDER, GOING = ".parts", "-done-"
"""Suffix of the folder of parts, and the mark added while the folder is being deleted."""
LOCK = "lock"
"""Lock file in the folder; the process that works on the parts holds it."""
PART_ROWS = 1 << 22
"""Rows of a part. After an interruption at most this many rows are computed again."""


def key_of(options: Any, calibration: Calibration, record: Run) -> str:
    """SHA-256 of everything that the result depends on: options, version, calibration, and every sample read.

    The samples include all inputs as parsed: data, run file, stand and the profile that it follows.
    """
    digest = hashlib.sha256(repr((__version__, options, record.serial, record.kind, record.labels)).encode())
    digest.update(repr((record.scale_factor, record.phase_group, record.resolution)).encode())
    digest.update(calibration_to_bytes(calibration))
    columns = (record.t, record.output, *record.f.T, record.segment_index, record.begins)
    columns += () if record.base_rate is None else tuple(record.base_rate.T)
    columns += () if record.temperature is None else (record.temperature,)
    for values in columns:
        for part in spans(values.size):
            digest.update(np.ascontiguousarray(values[part]).data)
    return digest.hexdigest()


class Parts:
    """The parts of one result. They are locked for this process until :meth:`remove` or its end.

    Parameters
    ----------
    out:
        The target.
    key:
        From :func:`key_of`.
    restart:
        True: remove parts of another run.

    Raises
    ------
    ArgumentError
        If another process works on the parts, if parts of another run exist, or if none can be written.
    """

    def __init__(self, out: Path, key: str, restart: bool = False) -> None:
        self.folder, self.count = out.with_name(f".{out.name}{FOLDER}"), 0
        for left in _going(out):
            shutil.rmtree(left, ignore_errors=True)
        try:
            self.folder.mkdir(exist_ok=True)
            self._release = self._hold(out)
        except OSError as error:
            raise ArgumentError(
                f"{out}: cannot be written ({error.strerror})", remedy="choose another --out"
            ) from None
        mark = self.folder / "key.json"
        owner = _content(mark)
        if owner not in (None, key):
            if not restart:
                self.close()
                raise ArgumentError(
                    f"--resume: {self.folder} holds parts of another input, calibration or set of options",
                    remedy="run the command that was stopped, or begin again with --force",
                )
            for path in self.folder.iterdir():
                if path.name != LOCK:
                    path.unlink()
        write_whole(mark, lambda path: path.write_bytes(json.dumps(key).encode()))
        while (self.folder / f"{self.count}.json").exists():
            self.count += 1

    def _hold(self, out: Path) -> Callable[[], None]:
        """Lock the parts against other processes."""
        try:
            return hold(self.folder / LOCK)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK):
                raise ArgumentError(
                    f"--resume: another process writes {out}", remedy="wait for it, or choose another --out"
                ) from None
            raise

    def close(self) -> None:
        """Release the lock on the parts."""
        release, self._release = self._release, lambda: None
        release()

    def carried(self) -> dict[str, Any] | None:
        """State stored with the last complete part; None if there is none."""
        if self.count == 0:
            return None
        state: dict[str, Any] = _content(self.folder / f"{self.count - 1}.json")
        return state

    def writer(self) -> TableWriter:
        """Writer of the next part."""
        return TableWriter(self.folder / "part.new", "parquet")

    def keep(self, carried: Mapping[str, Any], rows: int) -> None:
        """Complete the next part of ``rows`` rows: write it to disk, then its state."""
        if rows:  # at a slower rate there may be none
            put_in_place(self.folder / "part.new", self.folder / f"{self.count}.parquet")
        text = json.dumps(dict(carried)).encode()
        write_whole(self.folder / f"{self.count}.json", lambda path: path.write_bytes(text))
        self.count += 1

    def rows(self) -> Iterator[dict[str, NDArray]]:
        """All rows, in the pieces in which they were written."""
        from pyarrow import parquet

        for path in (self.folder / f"{index}.parquet" for index in range(self.count)):
            if not path.exists():
                continue
            with parquet.ParquetFile(path, pre_buffer=False) as source:
                for group in range(source.num_row_groups):
                    table = source.read_row_group(group, use_threads=False).combine_chunks()
                    yield {name: _numbers(table.column(name).chunk(0)) for name in table.column_names}

    def remove(self) -> None:
        """Delete the parts in one step; the result is complete."""
        gone = self.folder.with_name(f"{self.folder.name}{GOING}{secrets.token_hex(4)}")
        self.folder.replace(gone)
        self.close()
        shutil.rmtree(gone, ignore_errors=True)


def was_begun(out: Path) -> bool:
    """True when a run with ``--resume`` was interrupted before its result was complete or its parts were deleted."""
    return out.with_name(f".{out.name}{FOLDER}").exists() or bool(_going(out))


def _going(out: Path) -> list[Path]:
    """Folders whose deletion was interrupted."""
    start = f".{out.name}{FOLDER}{GOING}"
    return [path for path in out.parent.iterdir() if path.name.startswith(start)] if out.parent.is_dir() else []


def _content(path: Path) -> Any:
    """Content of a small file; None if it does not exist."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _numbers(column: Any) -> NDArray:
    kind = np.int32 if str(column.type) == "int32" else np.float64
    return np.frombuffer(column.buffers()[1], dtype=kind)[column.offset : column.offset + len(column)]


HELD_ROWS = 1 << 18
"""Rows of all records together above which their columns are kept on disk, to bound the memory."""
BEHIND = 2
"""Pieces that wait to be written while the next one is computed."""
HELD_BYTES = 270_000_000
"""Resident memory [bytes] above which freed memory is returned to the system. It is checked after so many pieces,
and sooner if a page is filled as well."""
GIVEN_BACK_AFTER, GIVEN_BACK_SOONER = 16, 2
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
    parts: Parts | None = None,
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
        (:mod:`piga.progress`). ``out`` is then not complete; ``parts`` keep the rows that are done.
    parts:
        Intermediate parts. The rows are written there first, and complete parts are not computed again. The result is
        identical to the bit.
    watch:
        Called with every piece before resampling. Not allowed with ``parts``.
    inputs:
        Input files of the result, for the metadata of a Parquet file.

    Raises
    ------
    CalibrationError
        As :func:`piga.compensate`.
    """
    summary, state = FileSummary(), init_state()
    notes = notes_on(calibration)
    remedy = "start again; nothing was written" if parts is None else "go on with --resume"
    done_rows = 0

    def advance(count: int) -> None:
        nonlocal done_rows
        done_rows += count
        report(progress, done_rows, record.size, "compensating", remedy)

    advance(0)
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
        summary = FileSummary(**carried["summary"])
        if resampler is not None:
            resampler.go_on(carried["resampler"])
    rows = 0 if carried is None else carried["rows"]
    pieces = compensate_in_pieces(record, calibration, state=state, done=done, **options)
    while rows < record.size:
        with parts.writer() as writer:
            count, taken = _work_off(pieces, writer, summary, resampler, advance, PART_ROWS)
            done, rows = done + count, rows + taken
        parts.keep(
            {
                "pieces": done, "rows": rows, "state": state.tolist(), "summary": asdict(summary),
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
    """Write pieces until ``most`` rows of the record are done. Returns the number of pieces and of rows done."""
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
