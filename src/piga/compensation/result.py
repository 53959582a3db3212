"""Compensated rows: their values, their resampling, and the files to which they are written chunk by chunk."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga import doors
from piga._kernels import arithmetic as kernels
from piga.compensation.model import FLAGS, MEANING
from piga.errors import ArgumentError
from piga.formats.columns import number_column
from piga.records.calibration import Calibration
from piga.records.calibration.coefficient import TYPE_A_ONLY
from piga.records.run import Run
from piga.results import Array, Column, Plotted, Reported, Result, Tabular
from piga.units import G0, MICRO_G

if TYPE_CHECKING:
    from types import ModuleType


WRITTEN_UNITS = {"t": "s", "residual": "m/s^2", "flags": "1"}
"""Unit of each column that is neither a force nor an increment."""

FORMATS = {".parquet": "parquet", ".pq": "parquet", ".csv": "csv"}
"""Kind of file by suffix."""

GROUP_ROWS = 1 << 16
"""Rows per row group of a Parquet file, whatever the size of the chunks."""


Inputs = Sequence[tuple[str, str]]
"""Input files of a result: name, and SHA-256 of what was read."""


def inputs_listed(inputs: Inputs) -> list[dict[str, str]]:
    """Inputs for JSON."""
    return [{"file": name, "sha256": digest} for name, digest in inputs]


def unit_of_column(name: str) -> str:
    """Unit of a column: forces in m/s^2, increments (``dv...``) in m/s."""
    if name in WRITTEN_UNITS:
        return WRITTEN_UNITS[name]
    return "m/s" if name.startswith("dv") else "m/s^2"


def format_of(path: Path) -> str:
    """``parquet`` or ``csv``, by the suffix.

    Raises
    ------
    ArgumentError
        For any other suffix.
    """
    file_format = FORMATS.get(path.suffix.lower())
    if file_format is None:
        raise ArgumentError(
            f"{path}: piga does not write files of kind '{path.suffix}'",
            remedy="use a name that ends in .parquet or .csv",
        )
    return file_format


def schema_of(
    columns: Mapping[str, NDArray],
    empty_cells: bool = False,
    notes: tuple[str, ...] = (),
    inputs: Inputs = (),
) -> Any:
    """Arrow schema: types, a unit per column, the meaning of the flag bits, notes and inputs.

    ``empty_cells``: True if cells may be empty.
    """
    import pyarrow as pa

    fields = [
        pa.field(
            name, pa.int32() if name == "flags" else pa.float64(), empty_cells, {"unit": unit_of_column(name)}
        )
        for name in columns
    ]
    metadata = {
        "piga.flags": json.dumps(FLAGS),
        "piga.flag_meanings": json.dumps(MEANING),
        "piga.units": json.dumps({name: unit_of_column(name) for name in columns}),
    }
    metadata |= {"piga.notes": json.dumps(notes)} if notes else {}
    metadata |= {"piga.inputs": json.dumps(inputs_listed(inputs))} if inputs else {}
    return pa.schema(fields, metadata=metadata)


class TableWriter:
    """Write rows to a Parquet or CSV file; a context manager.

    CSV columns are named ``name [unit]``. A missing value is an empty cell in CSV and nan in Parquet. ``notes`` come
    from :func:`piga.compensation.result.notes_on`. Parquet stores them as metadata; in CSV the uncertainties are named
    ``u_ax (Type A only) [m/s^2]``. ``inputs`` are stored in the metadata of Parquet only.
    """

    def __init__(
        self, path: Path, kind: str | None = None, notes: tuple[str, ...] = (), inputs: Inputs = ()
    ) -> None:
        self._path, self._notes, self._inputs = path, notes, tuple(inputs)
        self._kind = kind or format_of(path)
        self._writer: Any = None
        self._schema: Any = None
        self._held: Any = None
        self.rows = 0

    def write(self, columns: Mapping[str, NDArray]) -> None:
        """Append rows; every call must have the same columns."""
        import pyarrow as pa

        if self._writer is None:
            self._open(columns)
        arrays = [number_column(column, empty_cells=self._kind == "csv") for column in columns.values()]
        table = pa.Table.from_arrays(arrays, schema=self._schema)
        self.rows += table.num_rows
        self._held = table if self._held is None else pa.concat_tables((self._held, table))
        whole = self._held.num_rows // GROUP_ROWS * GROUP_ROWS
        if whole:
            self._writer.write_table(self._held.slice(0, whole), GROUP_ROWS)
            self._held = self._held.slice(whole)

    def _open(self, columns: Mapping[str, NDArray]) -> None:
        import pyarrow as pa
        from pyarrow import csv, parquet

        schema = schema_of(columns, self._kind == "csv", self._notes, self._inputs)
        if self._kind == "csv":
            names = [self._heading(name) for name in columns]
            self._schema = pa.schema([field.with_name(name) for field, name in zip(schema, names, strict=True)])
            options = csv.WriteOptions(quoting_style="none", quoting_header="none")
            self._writer = csv.CSVWriter(str(self._path), self._schema, write_options=options)
        else:
            self._schema = schema
            self._writer = parquet.ParquetWriter(
                str(self._path),
                schema,
                compression="none",
                use_dictionary=False,
                write_statistics=False,
                write_page_checksum=True,
            )

    def _heading(self, name: str) -> str:
        """Name of a CSV column."""
        if name == "flags":
            return name
        short = TYPE_A_ONLY.partition(";")[0]
        said = f" ({short})" if name.startswith("u_") and any(TYPE_A_ONLY in n for n in self._notes) else ""
        return f"{name}{said} [{unit_of_column(name)}]"

    def close(self, remarks: tuple[str, ...] = ()) -> None:
        """Finish the file. ``remarks``: notes that are known after the last row."""
        if self._writer is not None:
            if self._held.num_rows or self.rows == 0:
                self._writer.write_table(self._held, GROUP_ROWS)
            if remarks and self._kind == "parquet":
                self._writer.add_key_value_metadata({"piga.notes": json.dumps(self._notes + remarks)})
            self._writer.close()
            self._writer = self._held = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        elif self._writer is not None:
            with suppress(Exception):  # the error that ended the writing is the one to report
                self._writer.close()
            self._writer = self._held = None


def write_table(path: Path, columns: Mapping[str, NDArray], kind: str, notes: tuple[str, ...] = ()) -> None:
    """Write whole columns at once."""
    with TableWriter(path, kind, notes) as writer:
        rows = len(next(iter(columns.values())))
        for start in range(0, max(rows, 1), GROUP_ROWS):
            writer.write(
                {name: np.asarray(column)[start : start + GROUP_ROWS] for name, column in columns.items()}
            )


@dataclass(frozen=True, eq=False, repr=False)
class Compensated(Result, Plotted, Reported, Tabular):
    """Specific force and velocity increments of one instrument; arrays share their length.

    ``plot()`` shows specific force, correction and uncertainty against time.

    Attributes
    ----------
    t:
        Time [s].
    ax:
        Specific force along the input axis [m/s^2]. Angle (or count) record: mean over the interval that ends
        at ``t``. Rate record: value at ``t``. nan where no increment is formed.
    dv:
        Velocity increment since the previous row [m/s]; 0 where no increment is formed.
    u_ax:
        Standard uncertainty of ``ax`` [m/s^2] from coefficients and noise; empty if not requested.
    flags:
        Bits, see :data:`piga.compensation.FLAGS`; empty if not requested.
    serial, method:
        Serial number of the instrument, and ``"exact"`` or ``"published"``.
    notes:
        Notes that every display of ``u_ax`` must show, from :func:`notes_on` and :func:`note_on_vibration`; files contain
        them too.
    u_velocity:
        Standard uncertainty of the sum of ``dv`` [m/s]; nan for a part of a stream, and without uncertainty. That of a single
        ``dv`` is ``u_ax`` times the interval.
    made_from:
        The record and the calibration, for :meth:`plot` and :meth:`report`.
    """

    t: Array
    ax: Array
    dv: Array
    u_ax: Array
    flags: NDArray[np.int32]
    serial: str = ""
    method: str = "exact"
    notes: tuple[str, ...] = field(default=())
    u_velocity: float = math.nan
    made_from: tuple[Run, Calibration] | None = field(default=None, compare=False)

    def heading(self) -> str:
        """The first line in a notebook."""
        return "Compensated record"

    def _subject(self) -> ModuleType:
        return doors.shown_compensation()

    def in_brief(self) -> list[tuple[str, str]]:
        """What a notebook shows of the compensation."""
        facts = [
            ("instrument", self.serial or "not named"),
            ("method", self.method),
            ("rows", str(self.size)),
            ("velocity", f"{float(self.dv.sum()):.6g} m/s"),
        ]
        if math.isfinite(self.u_velocity):
            facts.append(("u of the velocity", f"{self.u_velocity:.2g} m/s"))
        if self.u_ax.size:
            facts.append(("u_ax, median", f"{float(np.nanmedian(self.u_ax)):.3g} m/s^2"))
        if self.flags.size:
            raised = {name: int(np.count_nonzero(self.flagged(name))) for name in FLAGS}
            facts.append(("flags", ", ".join(f"{n} {name}" for name, n in raised.items() if n) or "none"))
        return facts + [("note", note) for note in self.notes]

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.t.size)

    def flagged(self, name: str) -> NDArray[np.bool_]:
        """Rows with the flag ``name`` (see :data:`piga.compensation.FLAGS`)."""
        return (self.flags & FLAGS[name]) != 0

    def velocity(self) -> Array:
        """Running sum of ``dv`` [m/s]; it does not include the time between stretches."""
        return np.cumsum(self.dv)

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        columns = {"t": self.t, "ax": self.ax, "dv": self.dv}
        if self.u_ax.size:
            columns["u_ax"] = self.u_ax
        return columns | ({"flags": self.flags} if self.flags.size == self.size else {})

    def table_columns(self) -> dict[str, Column]:
        """The columns of the written file with their units."""
        return with_units(self.columns())

    def table_notes(self) -> tuple[str, ...]:
        """The notes on ``u_ax``."""
        return self.notes

    def to_parquet(self, path: str | Path) -> None:
        """Write a Parquet file; its metadata contain units, flag names and notes."""
        write_table(Path(path), self.columns(), "parquet", self.notes)

    def to_csv(self, path: str | Path) -> None:
        """Write a CSV file with units in the header. If ``u_ax`` is Type A only, its heading says so."""
        write_table(Path(path), self.columns(), "csv", self.notes)


def notes_on(*calibrations: Calibration) -> tuple[str, ...]:
    """Notes on the uncertainties from these calibrations. With several calibrations each note names the serial number."""
    alone = [c.serial or f"instrument {n}" for n, c in enumerate(calibrations, 1) if c.type_a_only]
    if not alone:
        return ()
    return (TYPE_A_ONLY if len(calibrations) == 1 else f"{', '.join(alone)}: {TYPE_A_ONLY}",)


def note_on_vibration(past: Any, sampled: bool, *calibrations: Calibration) -> tuple[str, ...]:
    """A sentence on vibration near the Nyquist frequency, for the instrument on which it acts most; none without one.

    ``past``: the records :class:`piga._kernels.compensation.data.Past` of the instruments. ``sampled``: the force is a value at
    the samples, not the mean over intervals.
    """
    time, square, velocity = past["shaken"], past["shaken_square"], past["rectified"]
    worst = int(np.argmax(np.where(velocity.any(), velocity, square)))
    if time[worst] == 0.0:
        return ()
    variance, size = square[worst] / time[worst] / G0**2, velocity[worst] / time[worst] / MICRO_G
    effect = f"an interval hides more of it, and moves the mean by {size:.2g} micro-g (standard uncertainty, part of u)"
    if sampled:
        effect = "the force between the samples is not known, and no uncertainty of dv contains it"
    elif size == 0.0:
        effect = f"an interval hides more of it: each micro-g/g^2 of k2, were it known, moves the mean by {variance:.2g} micro-g"
    named = f"{calibrations[worst].serial}: " if calibrations[worst].serial else ""
    seen = f"vibration of {math.sqrt(variance):.2g} g rms near the Nyquist frequency for {time[worst]:.3g} s"
    remedy = "sample faster, or state the rectification as [uncertainty] vibration of the calibration"
    return (f"{named}{seen} (flag vibration): {effect}; {remedy}",)


SHOWN_STARTS = 5
"""Most stretches whose rows are named in a sentence."""


class LockedStarts:
    """Rows in which the output stands still from the start of a stretch on; rows come chunk by chunk."""

    def __init__(self) -> None:
        self._size, self._open = 0, False
        self._rows: list[tuple[int, int]] = []

    def add(self, flags: NDArray[np.int32]) -> None:
        """Add the flags of the next rows."""
        locked = (flags & FLAGS["locked"]) != 0
        if flags.size and not locked.any():
            self._size, self._open = self._size + flags.size, bool(flags[-1] & FLAGS["no_increment"])
            return
        begins = (flags & FLAGS["no_increment"]) != 0
        row = np.arange(1, flags.size + 1)
        begun = np.maximum.accumulate(np.where(begins, row, 0 if self._open else -2))
        ended = np.maximum.accumulate(np.where(begins | locked, -1, row))
        still = begun > ended
        edges = np.flatnonzero(np.diff(still & locked, prepend=False, append=False)) + self._size
        for first, last in edges.reshape(-1, 2).tolist():
            joined = bool(self._rows) and self._rows[-1][1] == first
            self._rows.append((self._rows.pop()[0] if joined else first + 1, last))
        self._size, self._open = self._size + flags.size, bool(still[-1]) if flags.size else self._open

    def note(self) -> tuple[str, ...]:
        """A sentence that names the rows; none without one."""
        if not self._rows:
            return ()
        named = ", ".join(f"{first} to {last}" for first, last in self._rows[:SHOWN_STARTS])
        more = f" and {len(self._rows) - SHOWN_STARTS} more stretches" if len(self._rows) > SHOWN_STARTS else ""
        where = f"the output stands still from the start of a stretch on (flag locked) in rows {named}{more}"
        remedy = "leave these rows out, or begin where |a_x| is larger"
        return (f"{where}: a_x is known only to a_t tan(beta) there; {remedy}",)


@dataclass(frozen=True, eq=False, repr=False)
class CompensatedSet(Result, Plotted, Tabular):
    """Specific force and velocity increments in the common frame; arrays share their length n.

    ``plot()`` shows specific force in the common frame, and its uncertainty.

    ``t`` [s]; ``f`` (n, 3) [m/s^2], ``dv`` (n, 3) [m/s], ``u_f`` (n, 3) [m/s^2] (or (0, 3)). ``u_velocity`` (3,) or empty: standard
    uncertainty of the sum of ``dv`` [m/s]. ``residual``
    [m/s^2] is the root of the summed squared misfits of the instruments (0 for three). ``flags`` are those of one
    instrument; a flag is set if it is set for any instrument.
    """

    t: Array
    f: Array
    dv: Array
    u_f: Array
    residual: Array
    flags: NDArray[np.int32]
    misfit: Array = field(default_factory=lambda: np.zeros((0, 0)))
    each: NDArray[np.int32] = field(default_factory=lambda: np.zeros((0, 0), np.int32))
    notes: tuple[str, ...] = ()
    u_velocity: Array = field(default_factory=lambda: np.zeros(0))

    def _subject(self) -> ModuleType:
        return doors.shown_compensation()

    def heading(self) -> str:
        """The first line in a notebook."""
        return "Compensated record"

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.t.size)

    def flagged(self, name: str) -> NDArray[np.bool_]:
        """Rows with the flag ``name``."""
        return (self.flags & FLAGS[name]) != 0

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        columns: dict[str, NDArray] = {"t": self.t}
        for prefix, values in (("f", self.f), ("dv", self.dv), ("u_f", self.u_f)):
            if values.shape[0]:
                columns |= {prefix + axis: np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
        return columns | {"residual": self.residual, "flags": self.flags}

    def table_columns(self) -> dict[str, Column]:
        """The columns of the written file with their units."""
        return with_units(self.columns())


def with_units(columns: dict[str, NDArray]) -> dict[str, Column]:
    """Columns with the units of the written files."""
    return {name: Column(values, unit_of_column(name)) for name, values in columns.items()}


class Resampler:
    """Resample velocity increments to the times ``start + k period``, chunk by chunk.

    The running velocity is the sum of the increments. It is linear within each interval, because only the mean force
    is known there. A new increment is the running velocity at the new time less the sum of the increments already
    given out. Rounding errors therefore do not accumulate, and no velocity is lost. The result does not depend on
    the chunks, to the bit.

    Parameters
    ----------
    period:
        New interval [s].
    """

    def __init__(self, period: float) -> None:
        if not (period > 0.0 and math.isfinite(period)):
            raise ArgumentError(f"period: {period!r} s is not positive", remedy="e.g. 0.01")
        self._period = period
        self._state: Array | None = None
        self._marks = np.zeros(1, dtype=np.int32)

    @property
    def waiting(self) -> Array:
        """Velocity received but not yet given out [m/s], per component."""
        if self._state is None:
            return np.zeros(0)
        velocity, given = np.split(self._state[kernels.VELOCITY :], 2)
        return np.asarray(velocity - given)

    def push(self, t: ArrayLike, dv: ArrayLike) -> tuple[Array, Array]:
        """Add increments ``dv`` (n,) or (n, 3) [m/s] since the previous sample, at the times ``t`` (n,) [s].

        The first sample only sets the start. Its increment is added to the first new row.

        Returns
        -------
        t, dv:
            New times, and the increments since the previous new time.

        Raises
        ------
        ArgumentError
            If the times do not increase.
        """
        times, rows, _ = self._push(t, dv, None)
        return times, rows

    def push_rows(self, part: Compensated) -> Compensated:
        """Compensated rows at the new rate.

        ``ax`` is the mean force over the new interval. It is nan where no increment was formed. A row has the flags of
        all rows that it overlaps. There is no ``u_ax``, because the noise of neighbouring rows is correlated.
        """
        flags = part.flags if part.flags.size == part.size else None
        times, dv, flags = self._push(part.t, part.dv, flags)
        ax = np.where(flags & FLAGS["no_increment"], np.nan, dv / self._period)
        return Compensated(times, ax, dv, np.zeros(0), flags, part.serial, part.method)

    def push_set(self, part: CompensatedSet) -> dict[str, NDArray]:
        """Columns ``t, fx, fy, fz, dvx, dvy, dvz, flags`` of a set at the new rate, as in :meth:`push_rows`."""
        times, dv, flags = self._push(part.t, part.dv, part.flags)
        mean = np.where((flags & FLAGS["no_increment"])[:, None], np.nan, dv / self._period)
        columns: dict[str, NDArray] = {"t": times}
        for prefix, values in (("f", mean), ("dv", dv)):
            columns |= {prefix + axis: np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
        return columns | {"flags": flags}

    def _push(
        self, t: ArrayLike, dv: ArrayLike, flags: NDArray[np.int32] | None
    ) -> tuple[Array, Array, NDArray[np.int32]]:
        times = np.atleast_1d(np.asarray(t, dtype=float))
        values = np.ascontiguousarray(np.asarray(dv, dtype=float).reshape(times.size, -1))
        if self._state is None:
            self._state = np.zeros(kernels.VELOCITY + 2 * values.shape[1])
        known = self._state[kernels.VALID] != 0.0
        steps = np.diff(times, prepend=self._state[kernels.TIME] if known else -np.inf)
        if not (steps > 0.0).all():
            row = int(np.argmin(steps > 0.0))
            raise ArgumentError(
                f"t[{row}]: {times[row]:.9g} s is not after the time before",
                remedy="resample the parts between jumps of the clock separately",
            )
        start = self._state[kernels.START] if known else (times[0] if times.size else 0.0)
        end = times[-1] if times.size else start
        room = max(int((end - start) / self._period - self._state[kernels.INDEX]) + 2, 0)
        marks = np.zeros(times.size, dtype=np.int32) if flags is None else flags
        out = kernels.Increments(
            np.empty(room), np.empty((room, values.shape[1])), np.empty(room, dtype=np.int32)
        )
        given = kernels.Increments(times, values, marks)
        count = kernels.resample(given, self._period, self._state, self._marks, out)
        return out.t[:count], out.dv[:count].reshape(count, *np.shape(dv)[1:]), out.flags[:count]
