"""Arrays of a record. Those of a long record are mapped to unnamed files on disk.

The files vanish when the process ends, even if it crashes. A background thread keeps the resident part of the
mappings small, so a record of any length needs only a bounded memory. The pages stay in the system's file cache as
long as there is room.
"""

from __future__ import annotations

import errno
import math
import mmap
import os
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from piga.errors import DataError
from piga.results import Array

BLOCK = 1 << 16
"""Rows per block. A few columns of a block fit into the second-level cache."""
TRIM_BLOCKS = 8
"""The resident pages are checked after this many blocks."""
SPARSE = 1 << 10
"""Scattered rows that are read at a time. Each one loads its own piece of the file."""
STATISTICS = Path("/proc/self/statm")
BUFFER_BYTES = 1 << 16
"""Size of the write buffer [bytes]. Larger pieces are written directly."""
RESIDENT_BYTES = 96 << 20
"""Mapped bytes that may be resident before pages are returned to the system."""


def spans(count: int) -> Iterator[slice]:
    """Slices of at most :data:`BLOCK` rows, in order."""
    for start in range(0, count, BLOCK):
        if start % (TRIM_BLOCKS * BLOCK) == 0:
            _watch.trim()
        yield slice(start, min(start + BLOCK, count))


def trim() -> None:
    """Return mapped pages to the system if many are resident. For loops that do not use :func:`spans`."""
    _watch.trim()


def give_back(above: int = 0) -> None:
    """Return freed memory, which the allocators still hold, to the system if they support it.

    With ``above``: only if more bytes than this are resident and the system reports that number.
    """
    if above and (not STATISTICS.exists() or _resident(1) <= above):
        return
    import pyarrow as pa

    pa.default_memory_pool().release_unused()


def _resident(field: int) -> int:
    """Resident bytes of this process: all (1), or only those of mapped files (2)."""
    return int(STATISTICS.read_bytes().split()[field]) * mmap.PAGESIZE


def steps(values: NDArray, part: slice) -> NDArray:
    """``values[i] - values[i - 1]`` for the rows of a slice; 0 for row 0."""
    if part.start > 0:
        return np.diff(values[part.start - 1 : part.stop])
    return np.diff(values[part], prepend=values[:1])


def means(values: NDArray, part: slice) -> NDArray:
    """Mean of ``values[i]`` and ``values[i - 1]`` for the rows of a slice; row 0 keeps its value."""
    around = values[max(part.start - 1, 0) : part.stop]
    middle = 0.5 * (around[1:] + around[:-1])
    return middle if part.start > 0 else np.concatenate((around[:1], middle))


def extent(values: NDArray) -> tuple[float, float]:
    """Least and largest value."""
    ends = [(values[part].min(), values[part].max()) for part in spans(values.shape[0])]
    return float(min(low for low, _ in ends)), float(max(high for _, high in ends))


def mean(values: NDArray) -> float:
    """Mean value."""
    return math.fsum(float(values[part].sum()) for part in spans(values.size)) / values.size


def square_sum(values: NDArray) -> float:
    """Sum of the squares."""
    return math.fsum(float(values[part] @ values[part]) for part in spans(values.size))


def gathered(values: NDArray, rows: NDArray[np.int64]) -> NDArray:
    """``values[rows]`` for scattered rows in rising order. Pages are returned to the system meanwhile."""
    parts = []
    for start in range(0, max(rows.size, 1), SPARSE):
        _watch.trim()
        parts.append(values[rows[start : start + SPARSE]])
    return np.concatenate(parts)


class Arrays:
    """Creates the arrays of one record: in memory (``folder`` None), or mapped to files in ``folder``."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder

    def empty(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """A new array with undefined values."""
        if self.folder is None:
            return np.empty(shape, dtype)
        count = math.prod(shape) if isinstance(shape, tuple) else shape
        size = max(count * np.dtype(dtype).itemsize, 1)
        with _nameless(self.folder) as stream:
            _reserve(stream.fileno(), size, self.folder)
            return _map(stream.fileno(), size, self.folder, shape, dtype)

    def zeros(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """A new array of zeros."""
        made = self.empty(shape, dtype)
        if self.folder is None:
            made[...] = 0
        return made

    def growing(self, dtype: DTypeLike = np.float64, most: int = 0) -> Growing:
        """An array to which rows are appended. Up to ``most`` rows always stay in memory."""
        return Growing(self.folder, np.dtype(dtype), most)


def scaled(values: NDArray, factor: float, offset: float = 0.0, arrays: Arrays | None = None) -> NDArray[Any]:
    """``factor`` times the values plus ``offset``, as a new array; without ``arrays`` on disk if the values are."""
    made = (arrays or arrays_like(values)).empty(values.size)
    for part in spans(values.size):
        made[part] = values[part] * factor + offset
    return made


def scaled_rows(columns: Sequence[NDArray], factor: float) -> NDArray[Any]:
    """``factor`` times columns (n,), as rows of a new array; on disk if the columns are."""
    made = arrays_like(columns[0]).empty((len(columns), columns[0].size))
    for axis, column in enumerate(columns):
        for part in spans(column.size):
            made[axis, part] = column[part] * factor
    return made


def mapped(path: Path) -> NDArray[Any]:
    """The array of an ``.npy`` file. It is mapped on systems that can delete open files, and its pages are trimmed."""
    array = np.load(path, allow_pickle=False, mmap_mode="r")
    if os.name == "nt" or not isinstance(array, np.memmap):
        return np.array(array)
    with path.open("r+b") as stream:
        return _map(stream.fileno(), 0, path.parent, array.shape, array.dtype, array.offset)


def arrays_like(values: NDArray[Any]) -> Arrays:
    """Creates arrays of the same kind as ``values``: in memory or mapped."""
    owner: Any = values
    while isinstance(owner, np.ndarray):
        owner = owner.base
    return Arrays(owner.folder if isinstance(owner, _Map) else None)


class Growing:
    """An array of unknown length to which rows are appended. :meth:`finish` returns it."""

    def __init__(self, folder: Path | None, dtype: np.dtype, most: int = 0) -> None:
        self._folder, self._dtype, self._most, self._count = folder, dtype, most, 0
        self._held = np.empty(0, dtype)
        self._stream: Any = None

    def append(self, values: NDArray[Any], expected: int = 0) -> None:
        """Append rows. ``expected`` is the approximate final number of rows."""
        stop = self._count + values.size
        if self._stream is None and self._folder is not None and stop > self._most:
            self._stream = _nameless(self._folder)
            self._write(self._held[: self._count])
            self._held = self._held[:0].copy()
        if self._stream is not None:
            self._write(values)
        else:
            if stop > self._held.size:
                room = max(stop, expected, 2 * self._held.size)
                larger = np.empty(room if self._folder is None else min(room, self._most), self._dtype)
                larger[: self._count] = self._held[: self._count]
                self._held = larger
            self._held[self._count : stop] = values
        self._count = stop

    def _write(self, values: NDArray[Any]) -> None:
        try:
            self._stream.write(np.ascontiguousarray(values, dtype=self._dtype).data)
        except OSError as error:
            raise _no_room(self._folder, error) from None

    def __del__(self) -> None:
        if self._stream is not None:
            self._stream.close()

    def finish(self) -> NDArray[Any]:
        """All rows."""
        if self._stream is None or self._folder is None:
            return self._held[: self._count]
        with self._stream as stream:
            stream.flush()
            size = max(self._count * self._dtype.itemsize, 1)
            stream.truncate(size)
            return _map(stream.fileno(), size, self._folder, self._count, self._dtype)


class _Map(mmap.mmap):
    """A memory map that knows the folder of its file."""

    folder: Path


def _nameless(folder: Path) -> Any:
    try:
        return tempfile.TemporaryFile(dir=folder, buffering=BUFFER_BYTES)
    except OSError:
        return tempfile.TemporaryFile(buffering=BUFFER_BYTES)


def _reserve(number: int, size: int, folder: Path) -> None:
    """Reserve the disk space now: a write to a mapping cannot report a full disk."""
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(number, 0, size)
        else:
            os.truncate(number, size)
    except OSError as error:
        raise _no_room(folder, error) from None


def _no_room(folder: Path | None, error: OSError) -> DataError:
    return DataError(
        f"{folder}: no room for the columns of a long record ({error.strerror})",
        remedy="free about three times the size of the data file there, or copy the test to a larger disk",
    )


def _map(
    number: int, size: int, folder: Path, shape: int | tuple[int, ...], dtype: DTypeLike, offset: int = 0
) -> NDArray[Any]:
    try:
        mapping = _Map(number, size)
    except OSError as error:
        if error.errno == errno.ENOMEM:
            raise MemoryError from None
        raise
    mapping.folder = folder
    _watch.add(mapping)
    return np.ndarray(shape, dtype, buffer=mapping, offset=offset)


class _Watch:
    """Returns resident pages of the mappings to the system if there are too many."""

    def __init__(self) -> None:
        self._maps: weakref.WeakSet[_Map] = weakref.WeakSet()
        self._advice: int = getattr(mmap, "MADV_DONTNEED", -1)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def add(self, mapping: _Map) -> None:
        """Watch one more mapping, if the platform reports resident pages."""
        if self._advice < 0 or not STATISTICS.exists():
            return
        with self._lock:
            self._maps.add(mapping)
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._run, daemon=True, name="piga-spool")
                self._thread.start()

    def trim(self) -> None:
        """Return pages to the system if too many are resident."""
        if self._thread is None:
            return
        with self._lock:
            maps = list(self._maps)
        if _resident(2) > RESIDENT_BYTES:
            for mapping in maps:
                mapping.madvise(self._advice)

    def _run(self) -> None:
        while True:
            with self._lock:
                if not self._maps:
                    self._thread = None
                    return
            self.trim()
            time.sleep(0.01)


_watch = _Watch()


WHOLE = 1 << 21
"""Largest number of distinct values that are kept."""
_BITS = (21, 21, 22)


def exact_median(parts: Callable[[], Iterable[Array]]) -> float:
    """Exact median of non-negative numbers; 0 if there are none.

    Parameters
    ----------
    parts:
        Function that gives the numbers in parts. A long record with regular sampling has few distinct numbers: only these
        and their counts are kept. If most numbers differ, the parts are read again, once for each group of bits. This
        works because the bits of non-negative floats sort like their values.
    """
    held: list[tuple[Array, NDArray[np.int64]]] = []
    count = different = 0
    for part in parts():
        count += part.size
        if different <= WHOLE:
            held.append(np.unique(part, return_counts=True))
            different += held[-1][0].size
            if different > WHOLE and len(held) > 1:
                held = [_merged(held)]
                different = held[0][0].size if 2 * held[0][0].size < WHOLE else WHOLE + 1
    if count == 0:
        return 0.0
    ranks = ((count - 1) // 2, count // 2)
    if different > WHOLE:
        del held
        return float(np.mean([_selected(parts, rank) for rank in ranks[: 1 + (count % 2 == 0)]]))
    values, counts = _merged(held)
    return float(np.mean(values[np.searchsorted(np.cumsum(counts), ranks, side="right")]))


def _merged(held: list[tuple[Array, NDArray[np.int64]]]) -> tuple[Array, NDArray[np.int64]]:
    """Distinct numbers in rising order, and the total count of each."""
    values, where = np.unique(np.concatenate([some for some, _ in held]), return_inverse=True)
    counts = np.zeros(values.size, dtype=np.int64)
    np.add.at(counts, where, np.concatenate([times for _, times in held]))
    return values, counts


def _selected(parts: Callable[[], Iterable[Array]], rank: int) -> float:
    """The number of a given rank (from 0), found one group of bits at a time."""
    prefix, above = 0, 64
    for bits in _BITS:
        above -= bits
        counts = np.zeros(1 << bits, dtype=np.int64)
        for part in parts():
            keys = part.view(np.int64) if part.flags.c_contiguous else np.ascontiguousarray(part).view(np.int64)
            if above + bits < 64:
                keys = keys[keys >> (above + bits) == prefix]
            digits, times = np.unique((keys >> above) & ((1 << bits) - 1), return_counts=True)
            counts[digits] += times
        below = np.cumsum(counts)
        digit = int(np.searchsorted(below, rank, side="right"))
        rank -= int(below[digit - 1]) if digit else 0
        prefix = (prefix << bits) | digit
    return float(np.array([prefix], dtype=np.int64).view(np.float64)[0])
