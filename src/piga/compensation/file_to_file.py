"""From a data file of any length to a compensated file, in bounded memory: read, compute and write overlap."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from piga.compensation.compensate import check_serial_names
from piga.compensation.flags import FLAGS
from piga.compensation.large_file import LargeFile, Piece
from piga.compensation.model import Model, Phase, check_method, make_model, needs_phase
from piga.compensation.resample import Resampler
from piga.compensation.result import Compensated
from piga.compensation.step import empty_step, init_state, run_kernel, work_array
from piga.compensation.validity import age_flag
from piga.compensation.writers import TableWriter
from piga.errors import CalibrationError, DataError
from piga.records.calibration import Calibration
from piga.records.run_file import read_run_file

T = TypeVar("T")


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
        for name, bit in FLAGS.items():
            count = int(np.count_nonzero(part.flags & bit))
            if count:
                self.flags[name] = self.flags.get(name, 0) + count


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
) -> FileSummary:
    """Compensate the data of a run file into ``out`` (``kind``: parquet or csv), chunk by chunk.

    With a ``resampler`` the rows are brought to its rate.

    Raises
    ------
    DataError, CalibrationError
        As :func:`piga.read_run` and :func:`piga.compensate`.
    """
    source = LargeFile(run, read_run_file(run))
    check_serial_names(source.run_file.instrument.serial, calibration.serial, force)
    chosen = check_method(method, calibration)
    flag = age_flag(calibration, max_age_days)
    summary = FileSummary()

    def model(label: str) -> Model:
        return make_model(calibration, method=chosen, segment=label, phase=phase, flag=flag)

    stepper = _Stepper(source, model, uncertainty, needs_phase(calibration) and phase is None)
    with TableWriter(out, kind) as writer, ThreadPoolExecutor(1) as reader, ThreadPoolExecutor(1) as pen:
        pending: Future[None] | None = None
        for piece in _ahead(source.pieces(), reader):
            part = stepper.step(piece)
            advance(part.size)
            part = resampler.push_rows(part) if resampler else part
            summary.add(part)
            if pending is not None:
                pending.result()
            pending = pen.submit(writer.write, part.columns())
        if pending is not None:
            pending.result()
    if summary.rows == 0:
        raise DataError(f"{run}: no usable row", remedy="check the columns in [data]")
    summary.repairs = {name: count for name, count in source.found.items() if count}
    return summary


def _ahead(items: Iterator[T], pool: ThreadPoolExecutor) -> Iterator[T]:
    """The same items, the next one made on another thread while this one is used."""
    end = object()
    future = pool.submit(next, items, end)
    while (item := future.result()) is not end:
        future = pool.submit(next, items, end)
        yield item  # type: ignore[misc]


class _Stepper:
    """Carries the state from piece to piece."""

    def __init__(
        self, source: LargeFile, model: Callable[[str], Model], uncertainty: bool, coupled: bool
    ) -> None:
        self._source, self._model, self._uncertainty, self._coupled = source, model, uncertainty, coupled
        self._models: dict[str, Model] = {}
        self._state, self._work = init_state(), work_array()

    def step(self, piece: Piece) -> Compensated:
        """Compensate a piece."""
        if piece.lost and self._coupled:
            raise CalibrationError(
                f"{self._source.path}: about row {self._source.rows}: the counter may have rolled over unseen "
                "in a gap: the phase of the calibration does not hold behind it",
                remedy="compensate the parts one by one, each with its phase (--phase or --identify-phase)",
            )
        model = self._models.get(piece.label)
        if model is None:
            model = self._models[piece.label] = self._model(piece.label)
        chunk = piece.chunk
        result = empty_step(chunk.t.size, self._uncertainty, flags=True)
        run_kernel(model, self._state, chunk, self._source.kind, self._source.nominal, self._work, result)
        return Compensated(chunk.t, result.ax, result.dv, result.u_ax, result.flags)
