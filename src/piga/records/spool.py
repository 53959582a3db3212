"""Blocks of rows for rooms that still work through a record block by block; see :mod:`piga.records.arrays`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from piga.records import arrays
from piga.records.arrays import scaled
from piga.results import Array

BLOCK = 1 << 16
"""Rows per block."""


def spans(count: int) -> Iterator[slice]:
    """Slices of at most :data:`BLOCK` rows, in order."""
    for start in range(0, count, BLOCK):
        yield slice(start, min(start + BLOCK, count))


def trim() -> None:
    """Nothing: the system takes mapped pages back by itself."""


def give_back(above: int = 0) -> None:
    """Return memory that Arrow has freed and still holds to the system."""
    del above
    import pyarrow as pa

    pa.default_memory_pool().release_unused()


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
    return float(values.min()), float(values.max())


def mean(values: NDArray) -> float:
    """Mean value."""
    return math.fsum(float(values[part].sum()) for part in spans(values.size)) / values.size


def square_sum(values: NDArray) -> float:
    """Sum of the squares."""
    return math.fsum(float(values[part] @ values[part]) for part in spans(values.size))


def gathered(values: NDArray, rows: NDArray[np.int64]) -> NDArray:
    """``values[rows]``."""
    return values[rows]


class Arrays:
    """Creates arrays."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder

    def empty(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """A new array with undefined values."""
        return arrays.empty(shape, dtype)

    def zeros(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """A new array of zeros."""
        return arrays.zeros(shape, dtype)

    def growing(self, dtype: DTypeLike = np.float64, most: int = 0) -> arrays.ColumnWriter:
        """A column to which rows are appended."""
        del most
        return arrays.ColumnWriter(dtype)


def arrays_like(values: NDArray[Any]) -> Arrays:
    """Creates arrays."""
    del values
    return Arrays()


def scaled_rows(columns: Sequence[NDArray], factor: float) -> NDArray[Any]:
    """``factor`` times columns (n,), as rows of a new array."""
    made = arrays.empty((len(columns), columns[0].size))
    for axis, column in enumerate(columns):
        np.multiply(column, factor, out=made[axis])
    return made


def exact_median(parts: Callable[[], Iterable[Array]]) -> float:
    """Median of the numbers in all parts; 0 if there are none."""
    values = np.concatenate([np.zeros(0), *parts()])
    return float(np.median(values, overwrite_input=True)) if values.size else 0.0


__all__ = ["BLOCK", "Arrays", "arrays_like", "exact_median", "extent", "gathered", "give_back", "mean", "means", "scaled",
           "scaled_rows", "spans", "square_sum", "steps", "trim"]  # fmt: skip
