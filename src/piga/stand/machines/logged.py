"""Replay a logged profile: specific force and base rate from arrays or a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from piga.errors import ArgumentError, DataError
from piga.formats.columns import numbers_of
from piga.records.arrays import ColumnWriter, empty, scaled
from piga.records.limits import open_regular
from piga.records.run_file import Columns, ColumnTable
from piga.results import Array, Result
from piga.stand.imperfections import Imperfections
from piga.stand.profile import Segment, plan
from piga.units import conversion_factor

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, eq=False, repr=False)
class LoggedProfile(Result):
    """Samples of specific force [m/s^2] and base rate [rad/s], (n, 3), at times ``t`` [s]. They are linear between samples."""

    t: Array
    force: Array
    base_rate: Array

    kind = "profile"
    accepted = ()

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.t.size < 2 or not self.fastest > 0.0:
            raise ArgumentError(
                "profile: the times are fewer than two, or do not increase", remedy="sort the rows by time"
            )
        for name, array in (("force", self.force), ("base rate", self.base_rate)):
            right = array.shape == (self.t.size, 3)
            if not (right and np.isfinite(array).all()):
                raise ArgumentError(
                    f"profile {name}: does not hold {self.t.size} rows of three finite numbers",
                    remedy="give one row for each time",
                )

    @property
    def fastest(self) -> float:
        """Smallest sample interval [s]."""
        return float(np.diff(self.t).min())

    def segments(self) -> tuple[Segment, ...]:
        """One segment that starts at time zero."""
        return plan([("0", float(self.t[-1] - self.t[0]), True)])

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        del errors  # general imperfections act on every stand alike
        at = t + self.t[0]
        rows = self._around(at)
        force, rate = (
            np.column_stack([np.interp(at, self.t[rows], column[rows]) for column in columns.T])
            for columns in (self.force, self.base_rate)
        )
        return force, rate

    def _around(self, at: Array) -> slice:
        """The samples that are needed for some times. Of a long profile only these are loaded."""
        if at.size == 0:
            return slice(0, 1)
        first, last = np.searchsorted(self.t, (at.min(), at.max()), side="right").tolist()
        return slice(max(first - 1, 0), last + 1)


def read_profile(
    path: Path, time: ColumnTable, force: Columns, base_rate: Columns | None = None
) -> LoggedProfile:
    """Read a profile from CSV or Parquet.

    Raises
    ------
    DataError
        If the file cannot be read, lacks a column, or a column holds text or gaps.
    """
    per_second = conversion_factor(time.unit, "s", what="[stand] time")
    per_force = conversion_factor(force.unit, "m/s^2", what="[stand] force")
    rates, unit = (base_rate.columns, base_rate.unit) if base_rate else ((), "rad/s")
    per_rate = conversion_factor(unit, "rad/s", what="[stand] base_rate")
    columns = _read_columns(path, list(dict.fromkeys([time.column, *force.columns, *rates])))
    t = scaled(columns[time.column], per_second)
    f = _vectors([columns[name] for name in force.columns], per_force)
    rate = _vectors([columns[name] for name in rates], per_rate) if rates else np.broadcast_to(0.0, f.shape)
    return LoggedProfile(t, f, rate)


def _vectors(columns: list[Array], factor: float) -> Array:
    """``factor`` times three columns, (n, 3)."""
    rows = empty((len(columns), columns[0].size))
    for axis, column in enumerate(columns):
        np.multiply(column, factor, out=rows[axis])
    return rows.T


def _read_columns(path: Path, wanted: list[str]) -> dict[str, Array]:
    """The named columns, unconverted."""
    from pyarrow import ArrowException

    row, columns = 1, {name: ColumnWriter() for name in wanted}
    try:
        with _batches(path, wanted) as batches:
            for batch in batches:
                for name in wanted:
                    columns[name].append(_numbers(path, name, batch.column(name), row))
                row += batch.num_rows
    except (OSError, ArrowException) as error:
        raise DataError(f"{path}: cannot be read: {error}", remedy="give a CSV or Parquet file") from None
    return {name: column.finish() for name, column in columns.items()}


@contextmanager
def _batches(path: Path, wanted: list[str]) -> Iterator[Iterator[pa.RecordBatch]]:
    """The named columns, some rows at a time."""
    import pyarrow as pa
    from pyarrow import csv, parquet

    if path.suffix == ".parquet":
        with (
            open_regular(path) as stream,
            parquet.ParquetFile(stream, pre_buffer=False, page_checksum_verification=True) as source,
        ):
            _check_columns(path, wanted, source.schema_arrow)
            yield source.iter_batches(1 << 15, columns=wanted)
        return
    read = csv.ReadOptions(block_size=1 << 16, use_threads=False)
    with open_regular(path) as stream, csv.open_csv(stream, read) as head:
        _check_columns(path, wanted, head.schema)
    as_numbers = csv.ConvertOptions(include_columns=wanted, column_types=dict.fromkeys(wanted, pa.float64()))
    with open_regular(path) as stream, csv.open_csv(stream, read, convert_options=as_numbers) as source:
        yield iter(source)


def _check_columns(path: Path, wanted: list[str], schema: pa.Schema) -> None:
    import pyarrow as pa

    for name in wanted:
        if name not in schema.names:
            raise DataError(f"{path}: has no column '{name}'", remedy=f"it has: {', '.join(schema.names)}")
        kind = schema.field(name).type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind)):
            raise DataError(f"{path}: column '{name}' does not hold numbers", remedy="name another column")


def _numbers(path: Path, name: str, column: pa.Array, first_row: int) -> Array:
    """Values of a column, of which ``first_row`` is the first data row."""
    values = numbers_of(column)
    gaps = np.flatnonzero(~np.isfinite(values))
    if gaps.size:
        row = first_row + int(gaps[0])
        raise DataError(f"{path}: column '{name}', row {row} is empty", remedy="repair the profile first")
    return values
