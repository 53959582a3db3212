"""Replay of a logged profile: specific force and base rate from arrays or a file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError, DataError
from piga.stand.imperfections import Imperfections
from piga.stand.profile import Segment, plan
from piga.units import conversion_factor

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoggedProfile:
    """Samples of specific force [m/s^2] and base rate [rad/s], (n, 3), at times ``t`` [s], linear between."""

    t: Array
    force: Array
    base_rate: Array

    kind = "profile"
    accepted = ()

    def __post_init__(self) -> None:
        if self.t.ndim != 1 or self.t.size < 2 or not np.all(np.diff(self.t) > 0.0):
            raise ArgumentError("profile: needs at least two times, increasing")
        for name, array in (("force", self.force), ("base rate", self.base_rate)):
            if array.shape != (self.t.size, 3) or not np.all(np.isfinite(array)):
                raise ArgumentError(f"profile {name}: needs {self.t.size} finite rows of three numbers")

    @property
    def fastest(self) -> float:
        """Smallest sample interval [s]."""
        return float(np.diff(self.t).min())

    def segments(self) -> tuple[Segment, ...]:
        """One segment, from time zero."""
        return plan([("0", float(self.t[-1] - self.t[0]), True)])

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        del errors  # general imperfections act on every stand alike
        at = t + self.t[0]
        force = np.column_stack([np.interp(at, self.t, column) for column in self.force.T])
        rate = np.column_stack([np.interp(at, self.t, column) for column in self.base_rate.T])
        return force, rate


def read_profile(
    path: Path,
    time: tuple[str, str],
    force: tuple[tuple[str, str, str], str],
    base_rate: tuple[tuple[str, str, str], str] | None = None,
) -> LoggedProfile:
    """Read a profile from CSV or Parquet; columns are named with their unit, e.g. ``("t_s", "s")``.

    Raises
    ------
    DataError
        If the file cannot be read, lacks a column, or a column holds text or gaps.
    """
    table = _read_table(path)
    t = _column(path, table, time[0]) * conversion_factor(time[1], "s", what="[stand] time")
    f = np.column_stack([_column(path, table, name) for name in force[0]])
    f *= conversion_factor(force[1], "m/s^2", what="[stand] force")
    rate = np.zeros_like(f)
    if base_rate is not None:
        rate = np.column_stack([_column(path, table, name) for name in base_rate[0]])
        rate *= conversion_factor(base_rate[1], "rad/s", what="[stand] base_rate")
    return LoggedProfile(t, f, rate)


def _read_table(path: Path) -> pa.Table:
    from pyarrow import ArrowInvalid, csv, parquet

    try:
        return parquet.read_table(path) if path.suffix == ".parquet" else csv.read_csv(path)
    except (OSError, ArrowInvalid) as error:
        raise DataError(f"{path}: cannot be read: {error}", remedy="give a CSV or Parquet file") from None


def _column(path: Path, table: pa.Table, name: str) -> Array:
    if name not in table.column_names:
        raise DataError(f"{path}: has no column '{name}'", remedy=f"it has: {', '.join(table.column_names)}")
    column = table[name]
    try:
        values = np.asarray(column.cast("float64").to_numpy(zero_copy_only=False), dtype=float)
    except ValueError:
        raise DataError(
            f"{path}: column '{name}' does not hold numbers", remedy="name another column"
        ) from None
    if not np.all(np.isfinite(values)):
        row = int(np.flatnonzero(~np.isfinite(values))[0]) + 1
        raise DataError(f"{path}: column '{name}', row {row} is empty", remedy="repair the profile first")
    return values
