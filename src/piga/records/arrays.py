"""Arrays of a record.

An array above :data:`LARGE_BYTES` lies in a file without a name; NumPy works on it as on any other.
A record of any length is therefore read, calibrated and compensated with about two columns in memory: the temporaries of
one operation.
The files vanish when the process ends, even if it crashes. They lie in the folder that the environment variable ``TMPDIR``
names, else in ``/var/tmp``.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from piga.errors import DataError

LARGE_BYTES = 32 << 20
"""Size above which an array lies in a file [bytes]: 4 million numbers."""
_BLOCK_ROWS = 1 << 16
"""Rows per block where a record is worked through in blocks: columns that a stand computes, and compensation."""


def spans(count: int) -> Iterator[slice]:
    """Slices of at most :data:`_BLOCK_ROWS` rows, in order."""
    for start in range(0, count, _BLOCK_ROWS):
        yield slice(start, min(start + _BLOCK_ROWS, count))


def changes(values: NDArray[Any]) -> NDArray[Any]:
    """``values[i] - values[i - 1]``; 0 for row 0."""
    made = np.zeros_like(values)
    np.subtract(values[1:], values[:-1], out=made[1:])
    return made


def middles(values: NDArray[Any]) -> NDArray[Any]:
    """Mean of ``values[i]`` and ``values[i - 1]``; row 0 keeps its value."""
    made = values.copy()
    made[1:] += values[:-1]
    made[1:] *= 0.5
    return made


def empty(shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """A new array with undefined values. A :class:`DataError` if it is large and the disk has no room for it."""
    size = math.prod(shape if isinstance(shape, tuple) else (shape,)) * np.dtype(dtype).itemsize
    if size <= LARGE_BYTES:
        return np.empty(shape, dtype)
    with _room(), tempfile.TemporaryFile(dir=folder()) as stream:
        if hasattr(os, "posix_fallocate"):  # now: a write to mapped memory cannot report a full disk
            os.posix_fallocate(stream.fileno(), 0, size)
        return np.asarray(np.memmap(stream, dtype, "r+", shape=shape))


def stored(values: NDArray[Any]) -> NDArray[Any]:
    """The same values; in a file if they are large. For results that are kept: temporaries need no file."""
    if values.nbytes <= LARGE_BYTES:
        return values
    made = empty(values.shape, values.dtype)
    made[...] = values
    return made


def scaled(values: NDArray[Any], factor: float, offset: float = 0.0) -> NDArray[np.float64]:
    """``factor`` times the values plus ``offset``, as a new array."""
    made = np.multiply(values, factor, out=empty(values.shape))
    return made if offset == 0.0 else np.add(made, offset, out=made)


def integrated_rate(
    t: NDArray[np.float64], rate: NDArray[np.float64], begins: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Angle [rad] from a rate: trapezoid with end correction. It does not grow across gaps.

    Slopes are central differences, one-sided at both ends of a stretch.
    """
    step = np.where(begins, 0.0, changes(t))
    rise = np.where(step > 0.0, changes(rate) / np.where(step > 0.0, step, 1.0), 0.0)
    next_step, next_rise = np.append(step[1:], 0.0), np.append(rise[1:], 0.0)
    inner = (step > 0.0) & (next_step > 0.0)
    weight = np.where(inner, step + next_step, 1.0)
    slope = np.where(inner, (rise * next_step + next_rise * step) / weight, rise + next_rise)
    before = np.roll(rate, 1)
    return stored(np.cumsum(0.5 * step * (rate + before) + step**2 / 12.0 * (np.roll(slope, 1) - slope)))


def largest_size(values: NDArray[Any]) -> float:
    """Largest absolute value; nan if a value is nan."""
    return float(np.maximum(values.max(), -values.min()))


def norms(f: NDArray[Any]) -> NDArray[np.float64]:
    """Norms (n,) of vectors (n, 3)."""
    return np.sqrt(np.einsum("ij,ij->i", f, f))


class ColumnWriter:
    """A column of unknown length to which rows are appended: in memory, above LARGE_BYTES in a file without a name.

    A :class:`DataError` if the disk has no room for it.
    """

    def __init__(self, dtype: DTypeLike = np.float64) -> None:
        self._dtype = np.dtype(dtype)
        self._stream: Any = tempfile.SpooledTemporaryFile(LARGE_BYTES, dir=folder())  # noqa: SIM115 - closed by finish

    def append(self, values: NDArray[Any]) -> None:
        """Append rows."""
        with _room():
            self._stream.write(np.ascontiguousarray(values, self._dtype).data)

    def finish(self) -> NDArray[Any]:
        """All rows."""
        with _room(), self._stream as stream:
            if stream.tell() > LARGE_BYTES:
                stream.flush()
                return np.asarray(np.memmap(stream, self._dtype, "r+"))
            stream.seek(0)
            return np.frombuffer(bytearray(stream.read()), self._dtype)

    def __del__(self) -> None:
        self._stream.close()


def folder() -> str:
    """Folder of the files."""
    usual = "/var/tmp"  # noqa: S108 - the files have no name there
    return usual if "TMPDIR" not in os.environ and os.access(usual, os.W_OK) else tempfile.gettempdir()


@contextmanager
def _room() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{folder()}: no room for the columns of a long record ({error.strerror})",
            remedy="free about three times the size of the data file there, or name another folder in TMPDIR",
        ) from None
