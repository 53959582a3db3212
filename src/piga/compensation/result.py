"""Compensated rows: their values, their resampling, and the files to which they are written chunk by chunk."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from piga.compensation.model import FLAGS, MEANING
from piga.errors import ArgumentError
from piga.progress import Progress, report
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import NO_REFERENCE
from piga.records.run import Run
from piga.results import Array, Plotted, Reported, Result
from piga.tables import Column, Tabular, arrow_table
from piga.units import G0, MICRO_G
from piga.upper import doors

if TYPE_CHECKING:
    from types import ModuleType


_FORMATS = {".parquet": "parquet", ".pq": "parquet", ".csv": "csv"}
"""Kind of file by suffix."""

GROUP_ROWS = 1 << 18
"""Rows that are written at a time: a row group of a Parquet file."""

Inputs = Sequence[tuple[str, str]]
"""Input files of a result: name, and SHA-256 of what was read."""


def _listed(inputs: Inputs) -> list[dict[str, str]]:
    return [{"file": name, "sha256": digest} for name, digest in inputs]


def format_of(path: Path) -> str:
    """``parquet`` or ``csv``, by the suffix."""
    file_format = _FORMATS.get(path.suffix.lower())
    if file_format is None:
        raise ArgumentError(
            f"{path}: piga does not write files of kind '{path.suffix}'",
            remedy="use a name that ends in .parquet or .csv",
        )
    return file_format


def _rows_table(
    columns: Mapping[str, Column], notes: tuple[str, ...] = (), inputs: Inputs = (), *, text: bool = False
) -> Any:
    """Columns of compensated rows as an Arrow table: a unit per column, the meaning of the flag bits, notes and inputs.

    ``text``: for CSV, where headings have the units, and a missing value is an empty cell.
    """
    metadata = {"piga.flags": json.dumps(FLAGS), "piga.flag_meanings": json.dumps(MEANING)}
    metadata["piga.units"] = json.dumps({name: column.unit for name, column in columns.items()})
    metadata |= {"piga.notes": json.dumps(notes)} if notes else {}
    metadata |= {"piga.inputs": json.dumps(_listed(inputs))} if inputs else {}
    if text:
        lacks = any(NO_REFERENCE in note for note in notes)
        columns = {
            name
            if name == "flags"
            else f"{name}{' (reference not included)' * (lacks and name.startswith('u_'))} "
            f"[{column.unit}]": column
            for name, column in columns.items()
        }
    return arrow_table(columns, metadata, empty_cells=text)


def _opened(path: Path, text: bool, schema: Any) -> Any:
    """A writer of tables with this schema."""
    from pyarrow import csv, parquet

    if text:
        quoting = csv.WriteOptions(quoting_style="none", quoting_header="none")
        return csv.CSVWriter(str(path), schema, write_options=quoting)
    options = {"use_dictionary": False, "write_statistics": False, "write_page_checksum": True}
    return parquet.ParquetWriter(str(path), schema, compression="none", **options)


def write_rows(
    result: Compensated | CompensatedSet,
    path: Path,
    kind: str | None = None,
    *,
    period: float | None = None,
    inputs: Inputs = (),
    progress: Progress | None = None,
) -> tuple[int, dict[str, int]]:
    """Write compensated rows to a file; returns the rows written, and how many of them have each flag.

    A missing value is an empty cell in CSV and nan in Parquet. Parquet has units, flag names, notes and inputs as metadata.

    Parameters
    ----------
    result, path, kind:
        The rows, and the file: ``"parquet"`` or ``"csv"``; None: by its suffix.
    period:
        Interval to which the rows are resampled [s]; None: as recorded.
    inputs:
        Input files of the result.
    progress:
        Called as ``progress(done, total, what)`` with the rows done; it returns False to stop (:mod:`piga.progress`).
    """
    text = (kind or format_of(path)) == "csv"
    resampler = None if period is None else Resampler(period)
    writer: Any = None
    rows, flagged = 0, dict.fromkeys(FLAGS, 0)
    try:
        for start in range(0, max(result.size, 1), GROUP_ROWS):
            part = result.rows(slice(start, min(start + GROUP_ROWS, result.size)))
            columns = _with_units(part.columns() if resampler is None else resampler.push_rows(part))
            table = _rows_table(columns, result.notes, inputs, text=text)
            writer = writer or _opened(path, text, table.schema)
            writer.write_table(table)
            rows += table.num_rows
            for name, bit in FLAGS.items():
                flagged[name] += int(np.count_nonzero(columns["flags"].values & bit))
            report(progress, start + part.size, result.size, "writing")
    except BaseException:
        with suppress(Exception):  # the error that ended the writing is the one to report
            if writer is not None:
                writer.close()
        raise
    writer.close()
    return rows, {name: count for name, count in flagged.items() if count}


def _with_units(columns: Mapping[str, NDArray]) -> dict[str, Column]:
    """Columns of compensated rows with their units: forces in m/s^2, increments (``dv...``) in m/s."""
    units = {"t": "s", "flags": "1"}
    return {
        name: Column(values, units.get(name, "m/s" if name.startswith("dv") else "m/s^2"))
        for name, values in columns.items()
    }


class _Rows(Result, Plotted, Tabular):
    """What the rows of one instrument and of a set share: times, flags, and the columns of the written file."""

    t: Array
    flags: NDArray[np.int32]

    def heading(self) -> str:
        """The first line in a notebook."""
        return "Compensated record"

    def _subject(self) -> ModuleType:
        return doors().shown_compensation()

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.t.size)

    def flagged(self, name: str) -> NDArray[np.bool_]:
        """Rows with the flag ``name`` (see :data:`piga.compensation.FLAGS`)."""
        return (self.flags & FLAGS[name]) != 0

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        raise NotImplementedError

    def table_columns(self) -> dict[str, Column]:
        """The columns of the written file with their units."""
        return _with_units(self.columns())


@dataclass(frozen=True, eq=False, repr=False)
class Compensated(_Rows, Reported):
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
        Bits, see :data:`piga.compensation.FLAGS`.
    serial, method:
        Serial number of the instrument, and ``"exact"`` or ``"published"``.
    notes:
        Notes that every display of ``u_ax`` must show, from :func:`notes_on` and :func:`notes_on_samples`; files contain
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
        raised = {name: int(np.count_nonzero(self.flagged(name))) for name in FLAGS}
        facts.append(("flags", ", ".join(f"{n} {name}" for name, n in raised.items() if n) or "none"))
        return facts + [("note", note) for note in self.notes]

    def rows(self, part: slice) -> Compensated:
        """Some rows."""
        columns = {name: getattr(self, name)[part] for name in ("t", "ax", "dv", "u_ax", "flags")}
        return replace(self, **columns, u_velocity=math.nan, made_from=None)

    def velocity(self) -> Array:
        """Running sum of ``dv`` [m/s]; it does not include the time between stretches."""
        return np.cumsum(self.dv)

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        return _columns_of(self.t, self.ax, self.dv, self.flags, self.u_ax)

    def table_notes(self) -> tuple[str, ...]:
        """The notes on ``u_ax``."""
        return self.notes

    def to_parquet(self, path: str | Path) -> None:
        """Write a Parquet file; its metadata contain units, flag names and notes."""
        write_rows(self, Path(path), "parquet")

    def to_csv(self, path: str | Path) -> None:
        """Write a CSV file with units in the header. If ``u_ax`` lacks the reference's uncertainty, its heading says so."""
        write_rows(self, Path(path), "csv")


def notes_on(*calibrations: Calibration) -> tuple[str, ...]:
    """Notes on the uncertainties from these calibrations. With several calibrations each note names the serial number."""
    alone = [c.serial or f"instrument {n}" for n, c in enumerate(calibrations, 1) if c.type_a_only]
    if not alone:
        return ()
    return (NO_REFERENCE if len(calibrations) == 1 else f"{', '.join(alone)}: {NO_REFERENCE}",)


def notes_on_samples(past: Any, sampled: bool, *calibrations: Calibration) -> tuple[str, ...]:
    """Sentences on starts at which an output stands still, and on vibration near the Nyquist frequency.

    ``past``: the records :class:`piga._kernels.compensation.data.Past` of the instruments; a sentence is on the one that it
    concerns most. ``sampled``: the force is a value at the samples, not the mean over intervals.
    """
    notes, most = _note_on_vibration(past, sampled, *calibrations), int(np.argmax(past["stood"]))
    if past["stood"][most] == 0.0:
        return notes
    rows, first = int(past["stood"][most]), past["stood_from"][most]
    where = f"in {rows} rows, the first at t = {first:.9g} s (flag locked)"
    words = f"the output stands still from the start of a stretch on {where}: a_x is known only to a_t tan(beta) there"
    return (f"{words}; leave these rows out, or begin where |a_x| is larger", *notes)


def _note_on_vibration(past: Any, sampled: bool, *calibrations: Calibration) -> tuple[str, ...]:
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


@dataclass(frozen=True, eq=False, repr=False)
class CompensatedSet(_Rows):
    """Specific force and velocity increments in the common frame; arrays share their length n.

    ``plot()`` shows specific force in the common frame, and its uncertainty.

    ``t`` [s]; ``f`` (n, 3) [m/s^2], ``dv`` (n, 3) [m/s], ``u_f`` (n, 3) [m/s^2] (or (0, 3)). ``u_velocity`` (3,) or empty: standard
    uncertainty of the sum of ``dv`` [m/s]. ``residual`` [m/s^2] is the root of the summed squared misfits of the instruments (0
    for three). A flag is set if it is set for any instrument.
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

    def rows(self, part: slice) -> CompensatedSet:
        """Some rows."""
        columns = {name: getattr(self, name)[part] for name in ("t", "f", "dv", "u_f", "residual", "flags")}
        each = {name: getattr(self, name)[:, part] for name in ("misfit", "each")}
        return replace(self, **columns, **each, u_velocity=np.zeros(0))

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        columns = _columns_of(self.t, self.f, self.dv, self.flags, self.u_f)
        return columns | {"residual": self.residual, "flags": columns.pop("flags")}


def _columns_of(
    t: Array, force: Array, dv: Array, flags: NDArray[np.int32], u: Array | None = None
) -> dict[str, NDArray]:
    """The columns of compensated rows in order: force, increment and uncertainty (n,), or (n, 3) of a set; empty: none."""
    columns: dict[str, NDArray] = {"t": t}
    names = ("ax", "dv", "u_ax") if force.ndim == 1 else ("f", "dv", "u_f")
    for name, values in zip(names, (force, dv, u), strict=True):
        if values is not None and (values.shape[0] or t.size == 0):
            each = [values] if values.ndim == 1 else [np.ascontiguousarray(column) for column in values.T]
            columns |= {
                name + axis: column
                for axis, column in zip("xyz" if len(each) == 3 else [""], each, strict=True)
            }
    return columns | {"flags": flags}


class Resampler:
    """Resample velocity increments to the times ``start + k period``, chunk by chunk.

    The running velocity is the sum of the increments. It is linear within each interval, because only the mean force
    is known there. A new increment is its change; what lies behind the last new time goes on to the next one. So no velocity
    is lost.

    Parameters
    ----------
    period:
        New interval [s].
    """

    def __init__(self, period: float) -> None:
        if not (period > 0.0 and math.isfinite(period)):
            raise ArgumentError(f"period: {period!r} s is not positive", remedy="e.g. 0.01")
        self._period, self._start, self._count = period, math.nan, 0
        self._left: list[NDArray] = []

    def push_rows(self, part: Compensated | CompensatedSet) -> dict[str, NDArray]:
        """Columns of the next compensated rows at the new rate.

        The force (``ax``, or ``fx``, ``fy``, ``fz``) is the mean over the new interval. It is nan where no increment was formed.
        A row has the flags of all rows that it overlaps. There is no uncertainty, because the noise of neighbouring rows is
        correlated. The first row only sets the start; its increment is added to the first new row.

        Raises
        ------
        ArgumentError
            If the times do not increase.
        """
        if part.size == 0:
            return _columns_of(part.t, part.dv, part.dv, part.flags)
        rows: list[NDArray] = [part.t, part.dv.reshape(part.size, -1), part.flags]
        before = len(self._left[0]) if self._left else 0
        if before:
            rows = [np.concatenate(both) for both in zip(self._left, rows, strict=True)]
        t, dv, flags = rows
        late = np.flatnonzero(np.diff(t) <= 0.0) + 1 - before
        if late.size:
            raise ArgumentError(
                f"t[{late[0]}]: {part.t[late[0]]:.9g} s is not after the time before",
                remedy="resample the parts between jumps of the clock separately",
            )
        if self._count == 0:
            self._start = float(t[0])
        limits = t * (1.0 + 1e-15)
        ahead = math.ceil((t[-1] - self._start) / self._period) + 1
        times = self._start + np.arange(self._count + 1.0, ahead + 1.0) * self._period
        times = times[times <= limits[-1]]
        velocity = np.cumsum(dv, axis=0)
        reached = np.column_stack([np.interp(times, t, one) for one in velocity.T])
        last = np.searchsorted(limits, times)  # the interval in which each new time lies
        first = np.append(1, last + (times >= t[last]))  # of those that overlap each new row, and of the rest
        edges = np.column_stack((first[:-1], last + 1)).ravel()
        seen = np.bitwise_or.reduceat(np.append(flags, 0), edges)[::2]
        kept = first[-1] - 1
        rest = dv[kept:].copy()
        rest[0] = velocity[kept] - (reached[-1] if times.size else 0.0)
        self._left, self._count = [t[kept:], rest, flags[kept:]], self._count + times.size
        new = np.diff(reached, axis=0, prepend=np.zeros((1, dv.shape[1])))
        none = (seen & FLAGS["no_increment"]) != 0
        mean, shape = np.where(none[:, None], np.nan, new / self._period), (times.size, *part.dv.shape[1:])
        return _columns_of(times, mean.reshape(shape), new.reshape(shape), seen.astype(np.int32))


def summary_of(
    result: Compensated | CompensatedSet,
    records: Sequence[Run],
    written: tuple[int, dict[str, int]],
    inputs: Inputs,
) -> dict[str, Any]:
    """What the command says of a compensation, for JSON: rows and flags ``written``, velocity, findings while reading."""
    repairs: dict[str, int] = {}
    for record in records:
        for event in record.quality.events:
            repairs[event.kind] = repairs.get(event.kind, 0) + event.count
    u = np.asarray(result.u_velocity)
    return {
        "rows": written[0],
        "velocity_m_s": result.dv.sum(axis=0).tolist(),
        "u_velocity_m_s": None if np.isnan(u).any() else u.tolist(),
        "flags": written[1],
        "repairs": repairs,
        "notes": result.notes,
        "inputs": _listed(inputs),
    }
