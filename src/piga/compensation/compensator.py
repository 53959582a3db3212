"""Compensation of live streams and of whole records: a record is pushed through the same compensator as a stream."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Samples
from piga._kernels.compensation.sample import Rows, compensate_record
from piga._kernels.compensation.terms import SUMS
from piga.compensation.model import (
    Limits,
    Model,
    Phase,
    age_flag,
    check_method,
    make_model,
    phases,
    velocity_variance,
    with_phase,
)
from piga.compensation.result import Compensated, notes_on, notes_on_samples
from piga.errors import ArgumentError, CalibrationError, DataError, PigaError
from piga.progress import Progress, report
from piga.records.arrays import empty, spans
from piga.records.calibration.calibration import Calibration
from piga.records.run import Run, begins_stretch
from piga.records.terms import harmonic
from piga.results import Array
from piga.text_files import LARGEST_SAMPLE

_NONE, _NO_RATES = np.zeros(0), np.zeros((0, 3))


def find_begins(state: Any, t: Array) -> NDArray[np.bool_]:
    """Mark the samples of a stream that begin a stretch; ``t`` (n,) [s] are the times after ``state``.

    If ``state`` contains no nominal interval yet, the first positive interval is stored in it.
    """
    steps = np.empty_like(t)
    steps[:1] = t[:1] - state["t"] if state["seen"][0] else 0.0
    np.subtract(t[1:], t[:-1], out=steps[1:])
    forward = steps[steps > 0.0]
    if state["nominal"][0] == 0.0 and forward.size:
        state["nominal"] = forward[0]
    return begins_stretch(steps, float(state["nominal"][0]))


def _empty_rows(n: int, uncertainty: bool) -> Rows:
    """Arrays for ``n`` rows; that of an uncertainty that is not wanted is empty."""
    return Rows(empty(n), empty(n), empty(n if uncertainty else 0), empty(n, np.int32), np.zeros(SUMS))


_SHAPES: dict[str, tuple[int, ...]] = {
    "t": (), "output": (), "f": (3,), "base_rate": (3,), "temperature": (), "angle": (), "vibration": ()
}  # fmt: skip
"""Columns of a chunk, and the shape of a row of each."""


class Compensator:
    """Compensate a stream of one instrument with a transverse reference.

    The result is that of :func:`piga.compensate` on the whole record. It is identical to the bit, however the
    stream is cut into chunks.

    Parameters
    ----------
    calibration:
        The coefficients.
    kind:
        What ``output`` is: ``"angle"`` psi [rad], unwrapped, or ``"rate"`` [rad/s]. Of a direct instrument its running count
        is the ``"angle"``.
    method:
        ``"exact"`` or ``"published"``; None: the method that matches the calibration's ``phase_source``.
    segment, phase:
        Segment whose phase is used (per-segment calibrations), or the phase itself.
    step:
        Nominal interval [s]. It is used to detect gaps and sets the noise of a rate sample that begins a stretch (nan
        without). None: gaps are detected with the first interval.
    uncertainty, limits, max_age_days:
        As for :func:`piga.compensate`. ``ax`` and ``dv`` do not depend on ``uncertainty``, to the bit.
    state:
        State of an earlier compensator, to continue from.

    Raises
    ------
    CalibrationError
        If the calibration does not contain the phase.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        kind: str = "angle",
        method: str | None = None,
        segment: str | None = None,
        phase: Phase | None = None,
        step: float | None = None,
        uncertainty: bool = True,
        limits: Limits | None = None,
        max_age_days: float | None = None,
        state: Any = None,
    ) -> None:
        if kind not in ("angle", "rate"):
            raise ArgumentError(
                f"kind: '{kind}' is neither 'angle' nor 'rate'",
                remedy="use 'angle' or 'rate'; convert counts to an angle",
            )
        self.method = check_method(method, calibration)
        self.serial, self.notes = calibration.serial, notes_on(calibration)
        self._kind, self._calibration = kind, with_phase(calibration, phase)
        typical = math.nan if step is None else step
        self._make = partial(make_model, self._calibration, method=self.method, limits=limits, typical=typical)
        self._uncertainty = uncertainty
        self._age = age_flag(calibration, max_age_days)
        self._models: dict[str | None, tuple[Model, Array]] = {}
        self.take_segment(segment)
        self._state = at.records(1, at.PAST) if state is None else state.copy()
        if step is not None:
            self._state["nominal"] = step

    @property
    def state(self) -> Any:
        """A copy of the state. Another compensator can continue from it."""
        return self._state.copy()

    def remarks(self) -> tuple[str, ...]:
        """What the samples so far showed: starts at which the output stands still, vibration near the Nyquist frequency."""
        return notes_on_samples(self._state, self._kind == "rate", self._calibration)

    def u_velocity(self) -> float:
        """Standard uncertainty of the sum of all ``dv`` so far [m/s]; nan without uncertainty (docs/theory/compensation)."""
        if not self._uncertainty:
            return math.nan
        return math.sqrt(velocity_variance(self._calibration, self._models.values()))

    def take_segment(self, segment: str | None) -> None:
        """Use the phase of another segment from the next sample on.

        Raises
        ------
        CalibrationError
            If the calibration does not contain it.
        """
        if segment not in self._models:
            self._models[segment] = self._make(segment=segment), np.zeros(SUMS)
        self.model, self._sums = self._models[segment]

    def push(self, chunk: Mapping[str, ArrayLike]) -> Compensated:
        """Compensate the next samples.

        Parameters
        ----------
        chunk:
            A mapping of columns in SI: ``t`` (n,) [s], ``output`` (n,), ``f`` (n, 3) [m/s^2]. Optional:
            ``base_rate`` (n, 3) [rad/s], ``temperature`` (n,) [K], ``angle`` (n,) [rad] recorded with a rate,
            ``vibration`` (n,) [m/s^2], ``begins`` (n,). Single samples may be plain numbers. Without ``begins``, a stretch
            begins where time goes back or leaves a gap (more than 1.5 nominal intervals), as in :func:`piga.read_run`.

        Raises
        ------
        ArgumentError
            If a column is missing, has another length, or contains a number that is not finite.
        CalibrationError
            If the calibration has terms of the temperature or the vibration, and its column is missing.
        """
        columns = _checked(chunk)
        self.model.check_logged(columns)
        if "begins" not in columns:
            columns["begins"] = find_begins(self._state, columns["t"])
        rows = _empty_rows(columns["t"].size, self._uncertainty)
        self.push_into(columns, rows)
        return Compensated(columns["t"], *rows[:4], self.serial, self.method, self.notes)

    def push_into(self, columns: Mapping[str, NDArray], rows: Rows) -> None:
        """Compensate the next samples, arrays of float64, into arrays that exist."""
        before, rows = self._state.copy(), rows._replace(sums=self._sums.copy())
        output, angle = columns["output"], columns.get("angle", _NONE)
        output = output if self.model.scale == 1.0 else self.model.scale * output
        psi, rate = (output, _NONE) if self._kind == "angle" else (angle, output)
        base, temperature = columns.get("base_rate", _NO_RATES), columns.get("temperature", _NONE)
        samples = Samples(
            columns["t"], psi[None], rate[None], np.ascontiguousarray(columns["f"][None, :, 1]),
            np.ascontiguousarray(columns["f"][None, :, 2]), columns["begins"], np.ascontiguousarray(base[None]),
            temperature[None], columns.get("vibration", _NONE)[None],
        )  # fmt: skip
        compensate_record(samples, self.model.instrument, self._age, self._state, at.records(1, at.ROW), rows)
        if not math.isfinite(rows.dv.sum()):
            self._state = before
            check_finite(columns)
            raise ArgumentError("chunk: its numbers are too large to compute with", remedy="check the units")
        self._sums[:] = rows.sums


def _columns_of(run: Run, rows: slice) -> dict[str, Any]:
    """Columns of some rows of a record."""
    whole = {name: getattr(run, name) for name in (*_SHAPES, "begins") if name != "angle"}
    return {name: column[rows] for name, column in whole.items() if column is not None}


def _checked(chunk: Mapping[str, Any]) -> dict[str, Any]:
    """The columns of a chunk as contiguous arrays with a row for each time; those that are None are left out."""
    unknown = [name for name in chunk if name not in (*_SHAPES, "begins")]
    missing = [name for name in ("t", "output", "f") if name not in chunk]
    if unknown or missing:
        what = f"lacks '{missing[0]}'" if missing else f"has the unknown key '{unknown[0]}'"
        raise ArgumentError(f"chunk: {what}", remedy=f"keys: {', '.join((*_SHAPES, 'begins'))}")
    columns: dict[str, Any] = {}
    for name, row in _SHAPES.items():
        if chunk.get(name) is None:
            continue
        values = np.asarray(chunk[name], dtype=float)
        columns[name] = np.ascontiguousarray(np.atleast_2d(values) if row else np.atleast_1d(values))
        shape = (columns["t"].size, *row)
        if columns[name].shape != shape:
            raise ArgumentError(
                f"chunk['{name}']: shape {columns[name].shape} instead of {shape}",
                remedy=f"one {'row' if row else 'value'} per time",
            )
    check_finite(columns)
    begins = chunk.get("begins")
    if begins is not None:
        columns["begins"] = np.atleast_1d(np.asarray(begins, dtype=np.bool_))
    return columns


def check_finite(columns: Mapping[str, Any]) -> None:
    """Refuse a sample that is not finite or so large that the result would not be finite; the message names it."""
    for name, values in columns.items():
        fits = np.abs(values) <= LARGEST_SAMPLE
        if name == "f":
            fits[:, 0] = True  # the force along X0 is not used
        if not fits.all():
            at = [int(i) for i in np.argwhere(~fits)[0]]
            what = "too large" if math.isfinite(values[tuple(at)]) else "not finite"
            raise ArgumentError(
                f"{name}{at} is {what}", remedy="leave such samples out; in a set, of all instruments"
            )


def compensate(
    record: Run,
    calibration: Calibration,
    *,
    method: str | None = None,
    phase: Phase | None = None,
    uncertainty: bool = True,
    limits: Limits | None = None,
    max_age_days: float | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Compensated:
    """Specific force and velocity increments of a record, corrected for the errors of the instrument.

    An angle (or count) record gives one velocity increment per interval. It is the increment for which the exact
    motion turns the output as recorded (own derivation, docs/theory/compensation). A rate record gives the
    specific force at each sample, from the effective input axis (docs/understanding/cross-coupling).

    Parameters
    ----------
    record:
        The record. Its transverse reference is used; its reference along X0 is not.
    calibration:
        The coefficients.
    method:
        ``"exact"``, or ``"published"``: the output rate less the coupling at the phase ``int alpha' dt + phi``
        [Wei2024]. None: the method that matches the calibration's ``phase_source``.
    phase:
        Phase of the output zero. Needed if it differs from the calibration's; see :func:`piga.compensation.identify_phase`.
    uncertainty:
        Whether ``u_ax`` is computed.
    limits, max_age_days:
        Range and age in which the calibration is valid. Rows outside are flagged. None: the range that the
        calibration states, and any age.
    force:
        Accept a calibration of another serial number.
    progress:
        Called as ``progress(done, total, what)`` with the rows done; it returns False to stop (:mod:`piga.progress`).

    Raises
    ------
    CalibrationError
        If the calibration is of another instrument, or if the phase of a segment is missing.
    """
    check_serial(record, calibration, force)
    check_phase_kept(record, with_phase(calibration, phase))
    typical = (record.median_step or 1.0) if record.kind == "rate" else None
    stream = Compensator(
        calibration, kind="rate" if record.kind == "rate" else "angle", method=method, phase=phase,
        segment=record.labels[int(record.segment_index[0])], step=typical, uncertainty=uncertainty,
        limits=limits, max_age_days=max_age_days,
    )  # fmt: skip
    stream.model.check_logged(_columns_of(record, slice(0)))
    rows = _empty_rows(record.size, uncertainty)
    report(progress, 0, record.size, "compensating")
    for start, stop in pairwise(record.segment_edges().tolist()):
        stream.take_segment(record.labels[int(record.segment_index[start])])
        for span in spans(stop - start):
            part = slice(start + span.start, start + span.stop)
            some = Rows(rows.ax[part], rows.dv[part], rows.u[part], rows.flags[part], rows.sums)
            stream.push_into(_columns_of(record, part), some)
            report(progress, part.stop, record.size, "compensating")
    notes, made_from = stream.notes + stream.remarks(), (record, calibration)
    u_velocity = stream.u_velocity()
    return Compensated(record.t, *rows[:4], record.serial, stream.method, notes, u_velocity, made_from)


def check_serial(record: Run, calibration: Calibration, force: bool) -> None:
    """Refuse what is not a record and a calibration, the coefficients of another instrument (unless ``force``) or output."""
    if not all(map(isinstance, (record, calibration), (Run, Calibration))):
        raise ArgumentError(
            "a record and a calibration are needed, not the names of their files",
            remedy="pass piga.read_run('run.toml') and piga.Calibration.from_json('calibration.json')",
        )
    if record.unit != calibration.unit:
        raise CalibrationError(
            f"the output of the record is in {record.unit}, that of the calibration in {calibration.unit}",
            remedy="take the calibration of this output",
        )
    if not force and record.serial and calibration.serial and record.serial != calibration.serial:
        raise CalibrationError(
            f"the record is of instrument '{record.serial}', the calibration of '{calibration.serial}'",
            remedy="take the calibration of this instrument, or use --other-serial (force=True) if they are the same",
        )


def check_phase_kept(record: Run, calibration: Calibration, *, alone: bool = True) -> None:
    """Refuse a shared phase for a record that lost the zero of its output angle.

    A record of a set (``alone`` False) must always have one phase.
    """
    shared = not alone or None in phases(calibration)
    turning = any(c.name == "tan_beta" or harmonic(c.name) for c in calibration.coefficients)
    if not shared or not turning or len(set(record.phase_group)) < 2:
        return
    at = next(i for i, group in enumerate(record.phase_group) if group != record.phase_group[0])
    raise CalibrationError(
        f"{record.source}: the zero of the output angle was lost before segment '{record.labels[at]}' "
        "(the counter may have rolled over unseen in a gap): one phase cannot be valid for the whole "
        "record",
        remedy="calibrate with phases = 'per-segment', or compensate each part by itself, with its own phase",
    )


_FORCE, _RATE = ("fx", "fy", "fz"), ("wx", "wy", "wz")
_NEEDED = ("t", "output", *_FORCE)
_KNOWN = (*_NEEDED, *_RATE, "temperature", "angle", "vibration")
_MAX_LINE = 1 << 16
"""Longest line [characters]; a row of eleven numbers has about 250."""
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


def compensate_lines(source: IO[str], sink: IO[str], stream: Compensator) -> int:
    """Compensate comma-separated lines. The first line names the columns; every other line is answered at once.

    Columns are in SI: ``t, output, fx, fy, fz`` and optionally ``wx, wy, wz, temperature, angle, vibration``. Those of the answer
    are ``t, ax, dv, u_ax, flags``. A number consists of the digits 0 to 9, a point and an exponent. Other notations are refused.

    Returns
    -------
    rows:
        Lines compensated.
    """
    header = [name.strip() for name in _line(source, 1).split(",")]
    _check_names(header)
    rows, number = 0, 1
    while line := _line(source, number := number + 1):
        if not line.strip():
            continue
        row = _row(line, header, number)
        chunk: dict[str, Any] = {name: value for name, value in row.items() if name not in (*_FORCE, *_RATE)}
        chunk |= {"f": [row[name] for name in _FORCE]}
        chunk |= {"base_rate": [row[name] for name in _RATE]} if _RATE[0] in row else {}
        try:
            columns = stream.push(chunk).columns()
        except PigaError as error:
            raise DataError(f"standard input: line {number}: {error.message}", remedy=error.remedy) from None
        if rows == 0:
            sink.write(",".join(columns) + "\n")
        sink.write(",".join(repr(column[0].item()) for column in columns.values()) + "\n")
        sink.flush()
        rows += 1
    return rows


def _line(source: IO[str], number: int) -> str:
    """The next line; empty at the end."""
    line = source.readline(_MAX_LINE)
    if line and not line.endswith("\n"):
        long = len(line) >= _MAX_LINE
        what = f"is longer than {_MAX_LINE} characters" if long else "has no end: the stream was cut off"
        raise DataError(f"standard input: line {number} {what}", remedy="end every line with a line feed")
    return line


def _row(line: str, header: list[str], number: int) -> dict[str, float]:
    cells = [cell.strip() for cell in line.split(",")]
    values = [float(cell) if _NUMBER.fullmatch(cell) else math.nan for cell in cells]
    if len(cells) != len(header) or not all(map(math.isfinite, values)):
        raise DataError(
            f"standard input: line {number}: '{line.strip()[:60]}' is not a row of {len(header)} numbers",
            remedy="send finite numbers separated by commas",
        )
    return dict(zip(header, values, strict=True))


def _check_names(names: list[str]) -> None:
    needed = (*_NEEDED, *(_RATE if set(_RATE) & set(names) else ()))
    for name in (*needed, *names):
        if name not in names:
            what = "there is no column"
        elif name not in _KNOWN:
            what = "unknown column"
        elif names.count(name) > 1:
            what = "twice the column"
        else:
            continue
        raise DataError(f"standard input: {what} '{name[:60]}'", remedy=f"columns in SI: {', '.join(_KNOWN)}")
