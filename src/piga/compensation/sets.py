"""Compensation of a set of instruments: mounting and common solution, the records of a set on one base, the files of a set."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import or_
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Samples
from piga._kernels.compensation.set import SetRows, SetState, empty_state
from piga._kernels.compensation.set import compensate_set as set_kernel
from piga._kernels.compensation.terms import SUMS
from piga.compensation.compensator import check_finite, check_phase_kept, check_serial, find_begins
from piga.compensation.model import Limits, Phase, age_flag, make_model, velocity_variance, with_phase
from piga.compensation.result import CompensatedSet, notes_on, notes_on_samples
from piga.errors import ArgumentError, DataError, RunFileError
from piga.progress import Progress, report
from piga.records import read_toml
from piga.records.arrays import empty, integrated_rate
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.document import read_with_digest
from piga.records.run import Run
from piga.records.run_file import Quantity
from piga.results import Array, Result
from piga.stand.run_reference import read_run
from piga.text_files import toml_bytes, toml_document
from piga.units import to_si

_ORTHOGONAL = 1e-6
"""Largest deviation from a rotation that an axes matrix may have (own choice)."""
_FAULT_PROBABILITY = 1e-6
"""Probability of the flag ``fault`` in a row of a sound set (own choice)."""


@dataclass(frozen=True, eq=False, repr=False)
class Mounted(Result):
    """An instrument in a set: its calibration and its axes.

    Attributes
    ----------
    calibration:
        Coefficients of the instrument.
    axes:
        Rows X0, Y0, Z0 of the instrument in the common frame, shape (3, 3), a rotation.
    phase:
        Phase of the output zero, if it differs from the calibration's.
    segment:
        Segment whose phase is used (per-segment calibrations).
    """

    calibration: Calibration
    axes: Array
    phase: Phase | None = None
    segment: str | None = None


def rotation(axes: ArrayLike, index: int) -> Array:
    """Nearest exact rotation to the axes matrix of an instrument."""
    matrix = np.asarray(axes, dtype=float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ArgumentError(
            f"axes of instrument {index}: shape {matrix.shape}", remedy="rows X0, Y0, Z0 of 3 numbers each"
        )
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(matrix) < 0.0:
        raise ArgumentError(
            f"axes of instrument {index}: the rows are not a right-handed set of orthogonal unit vectors",
            remedy="give X0, Y0, Z0 of the instrument in the common frame, to six digits or more",
        )
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def _check_spread(axes: Array) -> None:
    """Refuse fewer than three instruments or coplanar input axes; ``axes`` has shape (N, 3, 3)."""
    if len(axes) < 3:
        raise ArgumentError(
            f"a set of {len(axes)} instruments cannot give three components",
            remedy="use three or more instruments",
        )
    smallest = np.linalg.svd(axes[:, 0, :], compute_uv=False)[-1]
    if smallest < 0.05:
        raise ArgumentError(
            f"the input axes lie in one plane (smallest singular value {smallest:.3g})",
            remedy="check the first row of each axes: the input axes must span space",
        )


class SetCompensator:
    """Compensate a stream of three or more instruments in any mounting; direct instruments and gyro accelerometers may be mixed.

    The effective input axes of all instruments at their output angles determine the specific force of every row.
    With more than three instruments it is a least-squares solution. An instrument in its dead zone has less weight.

    Parameters
    ----------
    instruments:
        At least three; the input axes must not be coplanar.
    sampled:
        True: angle and rate are recorded, and the force is the value at the samples. False: angles only, and the
        force is the mean over each interval.
    uncertainty:
        Whether it is computed.
    details:
        Whether misfits and flags of each instrument are kept.
    max_age_days, limits, step:
        As for one instrument.

    Raises
    ------
    ArgumentError
        If there are fewer than three instruments, axes are not a rotation, or input axes are coplanar.
    """

    def __init__(
        self,
        instruments: Sequence[Mounted],
        *,
        sampled: bool = False,
        uncertainty: bool = True,
        details: bool = False,
        limits: Limits | None = None,
        max_age_days: float | None = None,
        step: float | None = None,
    ) -> None:
        self._axes = np.array([rotation(item.axes, i) for i, item in enumerate(instruments)])
        _check_spread(self._axes)
        self._sampled, self._uncertainty, self._details = sampled, uncertainty, details
        self._calibrations = [with_phase(item.calibration, item.phase) for item in instruments]
        typical = math.nan if step is None else step
        self._models = [
            make_model(calibration, segment=item.segment, limits=limits, typical=typical)
            for calibration, item in zip(self._calibrations, instruments, strict=True)
        ]
        self._scale = np.array([[model.scale] for model in self._models])
        self._flag = reduce(or_, (age_flag(item.calibration, max_age_days) for item in instruments), 0)
        self._count = len(instruments)
        self.notes = notes_on(*self._calibrations)
        self._instruments = at.records(self._count, at.INSTRUMENT)
        for i, model in enumerate(self._models):
            self._instruments[i] = model.instrument[0]
        self._instruments["axes"] = self._axes
        self._threshold = math.inf
        if self._count > 3:
            from scipy.special import chdtri

            self._threshold = float(chdtri(self._count - 3, _FAULT_PROBABILITY))
        self._state = empty_state(self._count)
        self._sums = np.zeros((self._count, 3, SUMS))

    def remarks(self) -> tuple[str, ...]:
        """What the samples so far showed: starts at which an output stands still, vibration near the Nyquist frequency."""
        return notes_on_samples(self._state.past, self._sampled, *self._calibrations)

    def u_velocity(self) -> Array:
        """Standard uncertainty of the sum of all ``dv`` so far [m/s], (3,); empty without uncertainty."""
        each = zip(self._calibrations, self._models, self._sums, strict=True)
        if not self._uncertainty:
            return np.zeros(0)
        variances = [[velocity_variance(c, [(model, one)]) for one in sums] for c, model, sums in each]
        return np.sqrt(np.sum(variances, axis=0))

    def empty_rows(self, t: Array) -> CompensatedSet:
        """Rows at the times ``t`` (n,) [s] with undefined values."""
        n, u, details = (
            t.size,
            t.size if self._uncertainty else 0,
            (self._count, t.size if self._details else 0),
        )
        return CompensatedSet(
            t, empty((n, 3)), empty((n, 3)), empty((u, 3)), empty(n), empty(n, np.int32),
            empty(details), empty(details, np.int32),
        )  # fmt: skip

    def push(
        self,
        t: ArrayLike,
        output: ArrayLike,
        *,
        rate: ArrayLike | None = None,
        base_rate: ArrayLike | None = None,
        temperature: ArrayLike | None = None,
        begins: NDArray[np.bool_] | None = None,
        into: CompensatedSet | None = None,
        vibration: ArrayLike | None = None,
    ) -> CompensatedSet:
        """Compensate the next samples; N instruments, n samples.

        Parameters
        ----------
        t:
            Time [s], (n,).
        output, rate:
            Output angles psi [rad] and, for a sampled set, rates [rad/s], (N, n). Of a direct instrument its running count
            and its output.
        base_rate:
            Inertial rate of every instrument in its own axes [rad/s], (N, n, 3).
        temperature, vibration:
            [K], and [m/s^2] (rms), (N, n).
        begins:
            True where a stretch begins; None: where time goes back or leaves a gap, as for one instrument.
        into:
            Rows that exist, to write the result to.
        """
        time = np.atleast_1d(np.asarray(t, dtype=float))
        n, count = time.size, self._count
        if self._sampled != (rate is not None):
            raise ArgumentError(
                "rate: needed for a set that is sampled, and not allowed for a set of angles",
                remedy="give rate, and create the set with sampled=True",
            )
        given = {"output": output, "rate": rate, "base_rate": base_rate, "temperature": temperature}
        columns: dict[str, Array] = {}
        for name, values in (given | {"vibration": vibration}).items():
            row = (3,) if name == "base_rate" else ()
            if values is not None:
                columns[name] = _shaped(name, values, (count, n, *row))
        for model in self._models:
            model.check_logged(columns)
        for name in ("output", "rate")[: 1 + self._sampled]:
            columns[name] = self._scale * columns[name]
        marks = (
            find_begins(self._state.past[:1], time) if begins is None else np.asarray(begins, dtype=np.bool_)
        )
        result = self.empty_rows(time) if into is None else into
        before, sums = SetState(*(array.copy() for array in self._state)), self._sums.copy()
        none, still = np.zeros((count, 0)), np.zeros((count, 0, 3))
        set_kernel(
            Samples(
                time, columns["output"], columns.get("rate", none), none, none, marks, columns.get("base_rate", still),
                columns.get("temperature", none), columns.get("vibration", none),
            ),
            self._instruments, self._flag, self._threshold, self._state,
            SetRows(result.f, result.dv, result.u_f, result.residual, result.flags, result.misfit, result.each, sums),
        )  # fmt: skip
        last = columns["output"][:, -1:].sum() + (result.f if self._sampled else result.dv).sum()
        if not math.isfinite(last):
            self._state = before
            check_finite(columns)
        self._sums = sums
        return result


def _shaped(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.ascontiguousarray(np.asarray(values, dtype=float))
    if array.ndim == len(shape) - 1:
        array = array[:, None]
    if array.shape != shape:
        raise ArgumentError(
            f"{name}: shape {np.shape(values)} instead of {shape}", remedy="one row per instrument"
        )
    return array


APART = 1e-6
"""Largest difference between the times of one row in the records of a set, as a share of the first interval."""


def compensate_set(
    records: Sequence[Run],
    instruments: Sequence[Mounted],
    *,
    uncertainty: bool = True,
    limits: Limits | None = None,
    max_age_days: float | None = None,
    force: bool = False,
    details: bool = False,
    progress: Progress | None = None,
) -> CompensatedSet:
    """Specific force of whole records of three or more instruments, sampled at the same times.

    Records of angles give the mean over each interval. Records of rates give the force at the samples; their angles
    are integrated from the rates. ``details`` keeps misfits and flags of each instrument. ``progress`` is called as
    ``progress(done, total, what)`` with the rows done; it returns False to stop (:mod:`piga.progress`).

    Raises
    ------
    DataError
        If the records differ in their times or in the kind of output.
    CalibrationError, ArgumentError
        As :class:`SetCompensator`, and for calibrations of other instruments unless ``force``.
    """
    _check_together(records)
    if len(records) != len(instruments):
        raise ArgumentError(
            f"{len(records)} records for {len(instruments)} instruments",
            remedy="give one record for each instrument",
        )
    for record, item in zip(records, instruments, strict=True):
        check_serial(record, item.calibration, force)
        check_phase_kept(record, item.calibration, alone=False)
    first, rates = records[0], records[0].kind == "rate"
    stream = SetCompensator(
        [replace(item, segment=item.segment or r.labels[0]) for r, item in zip(records, instruments, strict=True)],
        sampled=rates, uncertainty=uncertainty, limits=limits, max_age_days=max_age_days, details=details,
        step=(first.median_step or 1.0) if rates else None,
    )  # fmt: skip
    begins = np.logical_or.reduce([record.begins for record in records])
    angles = [integrated_rate(r.t, r.output, begins) if rates else r.output for r in records]
    columns: dict[str, list[Array]] = {"output": angles}
    if rates:
        columns["rate"] = [record.output for record in records]
    if any(record.base_rate is not None for record in records):
        still = np.broadcast_to(0.0, (first.size, 3))
        columns["base_rate"] = [still if record.base_rate is None else record.base_rate for record in records]
    for name in ("temperature", "vibration"):
        logged = [column for record in records if (column := getattr(record, name)) is not None]
        if len(logged) == len(records):
            columns[name] = logged
    whole = stream.empty_rows(first.t)
    report(progress, 0, first.size, "compensating")
    step = max(_READINGS // len(records), 1)
    for start in range(0, first.size, step):
        part = slice(start, min(start + step, first.size))
        chunk = {name: np.array([one[part] for one in each]) for name, each in columns.items()}
        stream.push(np.ascontiguousarray(first.t[part]), **chunk, begins=begins[part], into=whole.rows(part))
        report(progress, part.stop, first.size, "compensating")
    return replace(whole, notes=stream.notes + stream.remarks(), u_velocity=stream.u_velocity())


def _check_together(records: Sequence[Run]) -> None:
    """Refuse records that were not sampled at the same times."""
    if not records:
        raise DataError("a set without a record", remedy="give the records of three or more instruments")
    first = records[0]
    apart = APART * (first.t[1] - first.t[0])
    for index, record in enumerate(records[1:], start=1):
        name, other = record.source or f"record {index}", first.source or "record 0"
        if record.kind != first.kind:
            raise DataError(
                f"{name}: the output is of kind '{record.kind}', that of {other} is '{first.kind}'",
                remedy="log the same kind with all instruments",
            )
        both = slice(min(record.size, first.size))
        differs = np.abs(record.t[both] - first.t[both]) > apart
        if differs.any():
            at = int(np.argmax(differs))
            raise DataError(
                f"{name}: row {record.row[at]}, t = {record.t[at]:.9g} s: the times are not those of {other}",
                remedy="sample all instruments together, or interpolate them to common times first",
            )
        if record.size != first.size:
            raise DataError(
                f"{name}: has {record.size} rows that can be used, {other} has {first.size}",
                remedy="sample all instruments together, and cut the records to the time they share",
            )


Row = tuple[float, float, float]


class TriadInstrument(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``[[triad.instrument]]``: run, calibration and axes (rows X0, Y0, Z0 in the common frame)."""

    run: str
    calibration: str
    axes: tuple[Row, Row, Row]
    phase: Quantity | None = None


class TriadTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``[triad]``."""

    instrument: tuple[TriadInstrument, ...]


class TriadFile(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A whole triad file."""

    triad: TriadTable


def is_triad_file(path: Path) -> bool:
    """True if a TOML file has a table ``[triad]``. Errors of an unreadable file are left to its reader."""
    try:
        return "triad" in toml_document(path)
    except RunFileError:
        return False


def read_triad(path: str | Path) -> tuple[list[Path], list[Mounted], list[tuple[str, str]]]:
    """Run files and mounted instruments of a triad file; file names are relative to it.

    The last result lists the triad file and the calibrations, each with its name and the SHA-256 of what was read.
    """
    path = Path(path)
    raw = toml_bytes(path)
    file = read_toml(path, TriadFile, raw)
    items = file.triad.instrument
    if len(items) < 3:
        raise RunFileError(
            f"{path}: [[triad.instrument]] occurs {len(items)} times", remedy="write it three times or more"
        )
    read = [read_with_digest(path.parent / item.calibration) for item in items]
    mounted = [
        Mounted(
            calibration,
            np.array(item.axes),
            None if item.phase is None else Phase(to_si(item.phase, "rad", what=f"{path}: phase")),
        )
        for item, (calibration, _) in zip(items, read, strict=True)
    ]
    named = [Path(item.calibration).name for item in items]
    inputs = [(path.name, hashlib.sha256(raw).hexdigest()), *zip(named, (d for _, d in read), strict=True)]
    return [path.parent / item.run for item in items], mounted, inputs


_READINGS = 1 << 15
"""Number of instruments times rows processed at once."""


def read_member(path: Path) -> Run:
    """The record of an instrument, without the columns that a set does not need."""
    record = read_run(path, need_reference=False)
    return replace(record, f=np.zeros((0, 3)), segment_index=record.segment_index[:0])
