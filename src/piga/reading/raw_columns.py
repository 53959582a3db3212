"""All chunks of a data file put together: its columns as read, in the units of the file."""

from __future__ import annotations

import hashlib
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.formats.columns import Chunk, RecordStream
from piga.formats.stream import TEXT_SUFFIXES, file_kind, open_stream
from piga.reading.visits import Visits
from piga.records.calibration import Event
from piga.records.limits import LARGEST_SAMPLE, MAX_SEGMENTS, open_regular, read_whole
from piga.records.run_file import DataTable
from piga.records.spool import Arrays, arrays_like

Array = NDArray[np.float64]

LARGE_ROWS = 1 << 22
"""Records of more rows are worked on in columns on disk: half as slow again, in a third of the memory."""
MAX_SIDECAR = 1 << 16
"""Largest ``.sha256`` [bytes]: a line of 64 digits and a file name."""


@dataclass
class RawColumns:
    """``numbers`` in the units of the file (n,), ``segment`` (n,) with ``labels``, 1-based file ``rows`` (n,).

    ``inputs`` holds the SHA-256 of the data file and of its ``.sha256`` as they were read, by name.
    """

    path: Path
    numbers: dict[str, Array]
    segment: NDArray[np.int32]
    labels: tuple[str, ...]
    rows: NDArray[np.int64]
    units: dict[str, str]
    events: list[Event]
    arrays: Arrays
    inputs: dict[str, str] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Rows read."""
        return int(self.rows.size)


def read_columns(folder: Path, data: DataTable, held: int | None = None) -> RawColumns:
    """Read the data file of a run file whole; one of more than ``held`` rows into columns on disk beside it.

    ``held`` is :data:`LARGE_ROWS` unless given.

    Raises
    ------
    DataError
        If the file cannot be read as the run file says, is not the one of its ``.sha256``, or changes meanwhile.
    """
    path = folder / data.file
    steady = SteadyFile(path, "[data] file is relative to the run file")
    sidecar = _check_sidecar(path)
    text = file_kind(path) in TEXT_SUFFIXES
    seen = hashlib.sha256()
    with ThreadPoolExecutor(1) as pool:
        digest = None if text else pool.submit(file_digest, path)
        stream = open_stream(folder, data, seen.update)
        raw = _collect(path, data, stream, LARGE_ROWS if held is None else held)
    steady.check()
    raw.inputs.update({path.name: digest.result() if digest else seen.hexdigest()} | sidecar)
    return raw


def _collect(path: Path, data: DataTable, stream: RecordStream, held: int) -> RawColumns:
    names, arrays = data.number_columns(), Arrays(path.parent)
    numbers = {name: arrays.growing(most=held) for name in names}
    segment, rows = arrays.growing(np.int32, held), arrays.growing(np.int64, held)
    visits = Visits(stream.label_names)
    for chunk in stream.chunks():
        room = stream.expected_rows
        for name in names:
            _check_size(path, name, chunk)
            numbers[name].append(chunk.numbers[name], room)
        rows.append(chunk.rows, room)
        if chunk.codes is None:
            segment.append(np.zeros(chunk.rows.size, np.int32), room)
            continue
        if len(stream.label_names) > MAX_SEGMENTS:
            raise DataError(
                f"{path}: column '{data.segment}' has more than {MAX_SEGMENTS} different segments",
                remedy="name the column that numbers the positions",
            )
        segment.append(visits.segment(chunk.codes, chunk.rows), room)
    visits.finish()
    file_rows = rows.finish()
    return RawColumns(
        path,
        {name: column.finish() for name, column in numbers.items()},
        segment.finish(),
        ("all",) if data.segment is None else tuple(visits.names),
        file_rows,
        stream.units,
        [*stream.events(), *visits.events],
        arrays_like(file_rows),
    )


def _check_size(path: Path, name: str, chunk: Chunk) -> None:
    """Refuse numbers that no instrument gives and whose squares overflow; what is not finite is counted elsewhere."""
    size = np.abs(chunk.numbers[name])
    bad = (size > LARGEST_SAMPLE) & (size < np.inf)
    if bad.any():
        at = int(np.argmax(bad))
        raise DataError(
            f"{path}: row {chunk.rows[at]}, column '{name}': {chunk.numbers[name][at]:g} is too large to compute with",
            remedy="correct it in the file",
        )


class SteadyFile:
    """A file that must not change while it is read: looked at now, and again by :meth:`check`.

    Raises
    ------
    DataError
        If it is not there or not a regular file.
    """

    def __init__(self, path: Path, remedy: str) -> None:
        self.path, self._remedy = path, remedy
        self._before = self._state()

    def check(self) -> None:
        """Refuse the file if it was written to or replaced since.

        Raises
        ------
        DataError
            Naming the file.
        """
        if self._state() != self._before:
            raise DataError(
                f"{self.path}: the file changed while it was read", remedy="stop what writes it, then try again"
            )

    def _state(self) -> tuple[int, int, int, int]:
        """What changes when a file is written to: size, times, and which file it is."""
        if self.path.exists() and not self.path.is_file():
            raise DataError(f"{self.path}: is no regular file", remedy=f"name the file: {self._remedy}")
        try:
            found = os.stat(self.path)  # noqa: PTH116 - one call for all four
        except OSError as error:
            raise DataError(f"{self.path}: cannot be read ({error.strerror})", remedy=self._remedy) from None
        return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino


def file_digest(path: Path) -> str:
    """SHA-256 of a file, as hexadecimal digits."""
    with open_regular(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _check_sidecar(path: Path) -> dict[str, str]:
    """Compare with ``FILE.sha256`` where the logger wrote one; its own SHA-256 by name."""
    sidecar = path.with_name(path.name + ".sha256")
    try:
        sidecar.lstat()
    except OSError:
        return {}
    raw = read_whole(sidecar, MAX_SIDECAR, "a line with the SHA-256")
    words = raw.decode("ascii", errors="replace").split()
    if not words or words[0].lower() != file_digest(path):
        raise DataError(
            f"{path}: its SHA-256 is not the one in {sidecar.name}",
            remedy="the file was damaged or changed: copy it again",
        )
    return {sidecar.name: hashlib.sha256(raw).hexdigest()}
