"""From a data file of any length to a compensated file, in bounded memory: read, compute and write overlap."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from piga.compensation import parts as parts_module
from piga.compensation.compensate import check_serial_names
from piga.compensation.flags import FLAGS
from piga.compensation.large_file import LargeFile, Piece
from piga.compensation.model import Model, Phase, check_method, make_model, needs_phase
from piga.compensation.parts import Parts
from piga.compensation.resample import Resampler
from piga.compensation.result import Compensated
from piga.compensation.step import Chunk, empty_step, init_state, run_kernel, work_array
from piga.compensation.validity import age_flag
from piga.compensation.warm_up import compile_apart
from piga.compensation.writers import TableWriter
from piga.errors import CalibrationError, DataError
from piga.records.calibration import Calibration
from piga.records.run_file import read_run_file
from piga.records.spool import give_back

AHEAD = 2
"""Pieces read before they are computed, and rows written behind: a stage that waits once is caught up with."""
HELD_BYTES = 270_000_000
"""Resident memory above which what was freed is given back, after so many pieces; sooner when a page is filled, too."""
GIVEN_BACK_AFTER, GIVEN_BACK_SOONER = 16, 2
T = TypeVar("T")
Watch = Callable[[str, Chunk, Compensated], object]
"""Sees the label of a segment, its samples, and what became of them."""


@dataclass
class FileSummary:
    """What was written: rows, velocity [m/s], rows per flag, and the repairs made while reading."""

    rows: int = 0
    velocity: float = 0.0
    flags: dict[str, int] = field(default_factory=dict)
    repairs: dict[str, int] = field(default_factory=dict)

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
        """What has been counted, for :meth:`go_on`; repairs are counted again while reading."""
        return {"rows": self.rows, "velocity": self.velocity, "flags": self.flags}

    def go_on(self, carried: dict[str, Any]) -> None:
        """Count on from there."""
        self.rows, self.velocity, self.flags = carried["rows"], carried["velocity"], dict(carried["flags"])


def compensate_file(
    run: Path,
    calibration: Calibration,
    out: Path,
    kind: str,
    *,
    method: str | None = None,
    phase: Phase | None = None,
    uncertainty: bool = True,
    max_age_days: float | None = None,
    force: bool = False,
    resampler: Resampler | None = None,
    advance: Callable[[int], None] = lambda _rows: None,
    parts: Parts | None = None,
    watch: Watch | None = None,
) -> FileSummary:
    """Compensate the data of a run file into ``out`` (``kind``: parquet or csv), chunk by chunk.

    With a ``resampler`` the rows are brought to its rate. With ``parts`` the rows go there first, and those that
    lie there already are not computed again; the result is the same to the bit. ``watch`` is shown every piece
    with its segment, and what became of it before it is brought to another rate; it does not go with ``parts``.

    Raises
    ------
    DataError, CalibrationError
        As :func:`piga.read_run` and :func:`piga.compensate`.
    """
    source = LargeFile(run, read_run_file(run))
    check_serial_names(source.run_file.instrument.serial, calibration.serial, force)
    chosen = check_method(method, calibration)
    flag = age_flag(calibration, max_age_days)
    compile_apart(source.kind)
    summary = FileSummary()

    def model(label: str) -> Model:
        return make_model(calibration, method=chosen, segment=label, phase=phase, flag=flag)

    stepper = _Stepper(source, model, uncertainty, needs_phase(calibration) and phase is None)
    if parts is None:
        with TableWriter(out, kind) as writer:
            _work_off(_ahead(source.pieces()), stepper, writer, summary, resampler, advance, math.inf, watch)
    else:
        _work_off_in_parts(source, stepper, parts, summary, resampler, advance)
        with TableWriter(out, kind) as writer:
            for columns in parts.rows():
                writer.write(columns)
    if summary.rows == 0:
        raise DataError(f"{run}: no usable row", remedy="check the columns in [data]")
    summary.repairs = {name: count for name, count in source.found.items() if count}
    return summary


def _work_off(
    pieces: Iterator[Piece], stepper: _Stepper, writer: TableWriter, summary: FileSummary,
    resampler: Resampler | None, advance: Callable[[int], None], most: float, watch: Watch | None = None,
) -> bool:  # fmt: skip
    """Pieces to rows, ``most`` rows at least if there are so many; False when the pieces are at their end."""
    pending: deque[Future[None]] = deque()
    start = summary.rows
    with ThreadPoolExecutor(1) as pen:
        for number, piece in enumerate(pieces, 1):
            part = stepper.step(piece)
            if number % (GIVEN_BACK_AFTER if watch is None else GIVEN_BACK_SOONER) == 0:
                give_back(HELD_BYTES)
            advance(part.size)
            if watch is not None and part.size:
                watch(piece.label, piece.chunk, part)
            part = resampler.push_rows(part) if resampler else part
            summary.add(part)
            if part.size:
                pending.append(pen.submit(writer.write, part.columns()))
            more = summary.rows - start >= most
            while len(pending) > (0 if more else AHEAD):
                pending.popleft().result()
            if more:
                return True
        for write in pending:
            write.result()
    return False


def _work_off_in_parts(
    source: LargeFile, stepper: _Stepper, parts: Parts, summary: FileSummary, resampler: Resampler | None,
    advance: Callable[[int], None],
) -> None:  # fmt: skip
    """Go on behind the last whole part: what it holds is read again, but not computed."""
    pieces = _ahead(source.pieces())
    carried = parts.carried()
    if carried is not None:
        for _ in range(carried["pieces"]):
            advance(next(pieces).chunk.t.size)
        stepper.go_on(carried["pieces"], carried["state"])
        summary.go_on(carried["summary"])
        if resampler is not None:
            resampler.go_on(carried["resampler"])
    more = carried is None or carried["more"]
    while more:
        with parts.writer() as writer:
            more = _work_off(pieces, stepper, writer, summary, resampler, advance, parts_module.PART_ROWS)
        if writer.rows == 0:
            break
        parts.keep(
            {
                "pieces": stepper.pieces, "state": stepper.state.tolist(), "summary": summary.carried(),
                "resampler": resampler.carried() if resampler else None, "more": more,
            }
        )  # fmt: skip


def _ahead(items: Iterator[T]) -> Iterator[T]:
    """The same items, the next ones made on another thread while this one is used."""
    end = object()
    with ThreadPoolExecutor(1) as pool:
        waiting = deque(pool.submit(next, items, end) for _ in range(AHEAD))
        while (item := waiting.popleft().result()) is not end:
            waiting.append(pool.submit(next, items, end))
            yield item  # type: ignore[misc]


class _Stepper:
    """Carries the state from piece to piece."""

    def __init__(
        self, source: LargeFile, model: Callable[[str], Model], uncertainty: bool, coupled: bool
    ) -> None:
        self._source, self._model, self._uncertainty, self._coupled = source, model, uncertainty, coupled
        self._models: dict[str, Model] = {}
        self.state, self._work = init_state(), work_array()
        self.pieces = 0

    def go_on(self, pieces: int, state: list[float]) -> None:
        """Stand behind so many pieces."""
        self.pieces, self.state = pieces, np.array(state)

    def step(self, piece: Piece) -> Compensated:
        """Compensate a piece."""
        if piece.lost and self._coupled:
            raise CalibrationError(
                f"{self._source.path}: near t = {piece.chunk.t[piece.chunk.begins.argmax()]:.9g} s: the counter may "
                "have rolled over unseen in a gap: the phase of the calibration does not hold behind it",
                remedy="compensate the parts one by one, each with its phase (--phase or --identify-phase)",
            )
        model = self._models.get(piece.label)
        if model is None:
            model = self._models[piece.label] = self._model(piece.label)
        chunk = piece.chunk
        result = empty_step(chunk.t.size, self._uncertainty, flags=True)
        run_kernel(model, self.state, chunk, self._source.kind, self._source.nominal, self._work, result)
        self.pieces += 1
        return Compensated(chunk.t, result.ax, result.dv, result.u_ax, result.flags)
