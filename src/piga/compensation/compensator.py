"""Compensation of live streams and of whole records, step by step: state and chunk in, state and result out.

A whole record is compensated piece by piece, by the same step as a live stream.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import layout as at
from piga._kernels.compensation.record import RowArrays, Samples, Settings, compensate_record
from piga.compensation.model import (
    Limits,
    Model,
    Phase,
    age_flag,
    check_method,
    make_model,
    needs_phase,
    phases,
)
from piga.compensation.result import Compensated, notes_on
from piga.errors import ArgumentError, CalibrationError
from piga.progress import Progress, report
from piga.records.calibration import Calibration
from piga.records.limits import LARGEST_SAMPLE
from piga.records.run import Run, begins_stretch
from piga.records.spool import spans
from piga.results import Array, Result

NONE = np.zeros(0)
NO_RATES = np.zeros((0, 3))
NO_MARKS = np.zeros(0, dtype=np.bool_)


@dataclass(frozen=True, eq=False, repr=False)
class Chunk(Result):
    """Some samples in SI: ``t`` [s], ``output`` (psi [rad], or rate [rad/s]), ``a_Y``, ``a_Z`` [m/s^2].

    ``begins`` marks samples that begin a stretch; ``base_rate`` (n, 3) [rad/s] and ``temperature`` [K] may
    be empty. ``angle`` is the output angle [rad] recorded with a rate. If empty, it is integrated from the rate.
    All arrays are contiguous float64.
    """

    t: Array
    output: Array
    a_Y: Array
    a_Z: Array
    begins: NDArray[np.bool_]
    base_rate: Array
    temperature: Array
    angle: Array


@dataclass(frozen=True, eq=False, repr=False)
class Step(Result):
    """Result of one chunk: ``ax`` [m/s^2], ``dv`` [m/s], ``u_ax`` [m/s^2] and ``flags`` (empty if unwanted)."""

    ax: Array
    dv: Array
    u_ax: Array
    flags: NDArray[np.int32]


def init_state() -> Array:
    """The state before the first sample."""
    return np.zeros(at.STATE)


def find_begins(state: Array, t: Array) -> NDArray[np.bool_]:
    """Mark the samples of a stream that begin a stretch; ``t`` (n,) [s] are the times after ``state``.

    If ``state`` contains no nominal interval yet, the first positive interval is stored in it.
    """
    steps = np.empty_like(t)
    steps[:1] = t[:1] - state[at.S_TIME] if state[at.S_VALID] else 0.0
    np.subtract(t[1:], t[:-1], out=steps[1:])
    forward = steps[steps > 0.0]
    if state[at.S_NOMINAL] == 0.0 and forward.size:
        state[at.S_NOMINAL] = forward[0]
    return begins_stretch(steps, float(state[at.S_NOMINAL]))


def work_array() -> Array:
    """Scratch memory of the kernels; one per thread."""
    return np.zeros(at.WORK)


def empty_step(n: int, uncertainty: bool, flags: bool) -> Step:
    """Empty arrays for ``n`` rows."""
    marks = np.empty(n if flags else 0, dtype=np.int32)
    return Step(np.empty(n), np.empty(n), np.empty(n if uncertainty else 0), marks)


def step(
    model: Model,
    state: Array,
    chunk: Chunk,
    *,
    kind: str = "angle",
    typical_step: float = 1.0,
    uncertainty: bool = True,
    work: Array | None = None,
) -> tuple[Array, Step]:
    """Compensate a chunk.

    Parameters
    ----------
    model:
        The instrument, from :func:`piga.compensation.model.make_model`.
    state:
        From :func:`init_state` or from the previous step; not changed.
    chunk:
        The samples. They continue the stretch of the state or begin a new one.
    kind:
        ``"angle"`` or ``"rate"``.
    typical_step:
        Interval [s] that sets the noise of a rate sample at the beginning of a stretch.
    uncertainty:
        Whether ``u_ax`` is computed.
    work:
        Scratch memory (:func:`work_array`) to reuse; None: allocate it.

    Returns
    -------
    state, result:
        The state after the chunk, and one row per sample.
    """
    new = state.copy()
    result = empty_step(chunk.t.size, uncertainty, flags=True)
    run_kernel(model, new, chunk, kind, typical_step, work_array() if work is None else work, result)
    return new, result


def run_kernel(
    model: Model, state: Array, chunk: Chunk, kind: str, typical_step: float, work: Array, result: Step
) -> None:
    """Fill ``result`` and update ``state`` in place."""
    rate = chunk.output if kind == "rate" else None
    angle = chunk.angle if chunk.angle.size else None
    compensate_record(
        Samples(chunk.t, chunk.a_Y, chunk.a_Z, chunk.begins, chunk.base_rate, chunk.temperature),
        chunk.output if rate is None else angle,
        rate,
        model.instrument,
        Settings(model.has_terms, model.formula, model.base_flag, typical_step),
        state,
        work,
        RowArrays(result.ax, result.dv, result.u_ax, result.flags),
    )


ROW_KEYS = ("t", "output", "f", "base_rate", "temperature", "begins", "angle")


class Compensator:
    """Compensate a stream of one instrument with a transverse reference.

    The result is that of :func:`piga.compensate` on the whole record. It is identical to the bit, however the
    stream is cut into chunks.

    Parameters
    ----------
    calibration:
        The coefficients.
    kind:
        What ``output`` is: ``"angle"`` psi [rad], unwrapped, or ``"rate"`` [rad/s].
    method:
        ``"exact"`` or ``"published"``; None: the method that matches the calibration's ``phase_source``.
    segment, phase:
        Segment whose phase is used (per-segment calibrations), or the phase itself.
    step:
        Nominal interval [s]. It is used to detect gaps and sets the noise of a rate sample that begins a stretch (nan
        without). None: gaps are detected with the median interval of a :class:`piga.Run`, or else with the first interval.
    uncertainty, flags, limits, max_age_days:
        As for :func:`piga.compensate`. ``ax`` and ``dv`` do not depend on ``uncertainty`` and ``flags``, to the bit.
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
        flags: bool = True,
        limits: Limits | None = None,
        max_age_days: float | None = None,
        state: Array | None = None,
    ) -> None:
        if kind not in ("angle", "rate"):
            raise ArgumentError(
                f"kind: '{kind}' is neither 'angle' nor 'rate'",
                remedy="use 'angle' or 'rate'; convert counts to an angle",
            )
        self.method = check_method(method, calibration)
        self.serial, self.notes = calibration.serial, notes_on(calibration)
        self._kind = kind
        self._uncertainty, self._flags = uncertainty, flags
        self._model = make_model(
            calibration, method=self.method, segment=segment, phase=phase,
            limits=limits, flag=age_flag(calibration, max_age_days),
        )  # fmt: skip
        self._state = init_state() if state is None else np.array(state, dtype=float)
        self._typical = np.nan if step is None else step
        if step is not None:
            self._state[at.S_NOMINAL] = step
        self._work = work_array()

    @property
    def state(self) -> Array:
        """A copy of the state. Another compensator can continue from it."""
        return self._state.copy()

    def push(self, chunk: Mapping[str, ArrayLike] | Run | Chunk) -> Compensated:
        """Compensate the next samples.

        Parameters
        ----------
        chunk:
            A mapping of columns in SI: ``t`` (n,) [s], ``output`` (n,), ``f`` (n, 3) [m/s^2]. Optional:
            ``base_rate`` (n, 3) [rad/s], ``temperature`` (n,) [K], ``angle`` (n,) [rad] recorded with a rate,
            ``begins`` (n,). Single samples may be plain numbers. Or a :class:`piga.Run` that continues the previous
            one, or a checked :class:`Chunk`. Without ``begins``, a stretch begins where time goes back or leaves a
            gap (more than 1.5 nominal intervals), as in :func:`piga.read_run`.

        Raises
        ------
        ArgumentError
            If a column is missing, has another length, or contains a number that is not finite.
        """
        before = self._state.copy()
        samples = chunk if isinstance(chunk, Chunk) else self._samples(self._columns(chunk))
        n = samples.t.size
        result = empty_step(n, self._uncertainty, self._flags)
        if n:
            run_kernel(self._model, self._state, samples, self._kind, self._typical, self._work, result)
            if not math.isfinite(result.dv.sum()):
                self._state = before
                _check_finite(samples)
                raise ArgumentError(
                    "chunk: its numbers are too large to compute with", remedy="check the units"
                )
        return Compensated(
            samples.t, result.ax, result.dv, result.u_ax, result.flags, self.serial, self.method, self.notes
        )  # fmt: skip

    def _columns(self, chunk: Mapping[str, ArrayLike] | Run) -> Mapping[str, Any]:
        """Columns of a chunk. A record has its own stretches; only its first sample is checked against the stream."""
        if not isinstance(chunk, Run):
            return chunk
        if self._state[at.S_NOMINAL] == 0.0:
            self._state[at.S_NOMINAL] = chunk.median_step
        begins = chunk.begins.copy()
        begins[:1] = find_begins(self._state, chunk.t[:1])
        columns: dict[str, Any] = {"t": chunk.t, "output": chunk.output, "f": chunk.f, "begins": begins}
        columns |= {} if chunk.base_rate is None else {"base_rate": chunk.base_rate}
        return columns | ({} if chunk.temperature is None else {"temperature": chunk.temperature})

    def _samples(self, columns: Mapping[str, Any]) -> Chunk:
        unknown = [name for name in columns if name not in ROW_KEYS]
        missing = [name for name in ROW_KEYS[:3] if name not in columns]
        if unknown or missing:
            what = f"lacks '{missing[0]}'" if missing else f"has the unknown key '{unknown[0]}'"
            raise ArgumentError(f"chunk: {what}", remedy=f"keys: {', '.join(ROW_KEYS)}")
        t = np.atleast_1d(np.asarray(columns["t"], dtype=float))
        n = t.size
        output, force = _shaped(columns, "output", (n,)), _shaped(columns, "f", (n, 3))
        temperature = _shaped(columns, "temperature", (n,), NONE)
        if self._model.needs_temperature and not temperature.size:
            raise ArgumentError(
                "chunk: the key 'temperature' is missing, and the calibration has temperature terms",
                remedy="add 'temperature' [K], one value per time",
            )
        base_rate = _shaped(columns, "base_rate", (n, 3), NO_RATES)
        angle = _shaped(columns, "angle", (n,), NONE)
        given = columns.get("begins")
        y, z = np.ascontiguousarray(force[:, 1]), np.ascontiguousarray(force[:, 2])
        _check_finite(Chunk(t, output, y, z, NO_MARKS, base_rate, temperature, angle))
        begins = (
            find_begins(self._state, t) if given is None else np.atleast_1d(np.asarray(given, dtype=np.bool_))
        )
        return Chunk(t, output, y, z, begins, base_rate, temperature, angle)


def _shaped(
    columns: Mapping[str, Any], name: str, shape: tuple[int, ...], missing: Array | None = None
) -> Array:
    """A column of this shape; ``missing`` if it may be left out and is."""
    if missing is not None and columns.get(name) is None:
        return missing
    rows = len(shape) > 1
    given = np.asarray(columns[name], dtype=float)
    values = np.ascontiguousarray(np.atleast_2d(given) if rows else np.atleast_1d(given))
    if values.shape != shape:
        raise ArgumentError(
            f"chunk['{name}']: shape {values.shape} instead of {shape}",
            remedy=f"one {'row' if rows else 'value'} per time",
        )
    return values


def _check_finite(samples: Chunk) -> None:
    """Refuse a sample that is not finite or so large that the result would not be finite; the message names it."""
    named = {
        "t": samples.t,
        "output": samples.output,
        "f": np.maximum(np.abs(samples.a_Y), np.abs(samples.a_Z)),
    }
    named |= {"base_rate": samples.base_rate, "temperature": samples.temperature, "angle": samples.angle}
    for name, values in named.items():
        if values.size == 0:
            continue
        fits = np.abs(values) <= LARGEST_SAMPLE
        if not fits.all():
            index = int(np.argwhere(~fits)[0][0])
            what = "too large" if np.isfinite(values[index]).all() else "not finite"
            raise ArgumentError(f"chunk['{name}'][{index}] is {what}", remedy="leave such samples out")


def compensate(
    record: Run,
    calibration: Calibration,
    *,
    method: str | None = None,
    phase: Phase | None = None,
    uncertainty: bool = True,
    flags: bool = True,
    limits: Limits | None = None,
    max_age_days: float | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Compensated:
    """Specific force and velocity increments of a record, corrected for the errors of the instrument.

    An angle (or count) record gives one velocity increment per interval. It is the increment for which the exact
    motion turns the output as recorded (own derivation, docs/theory/compensation). A rate record gives the
    specific force at each sample, from the effective input axis (docs/theory/effective-axis).

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
    uncertainty, flags:
        Whether ``u_ax`` and the flags are computed.
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
    plan = _plan(record, calibration, method, phase, limits, max_age_days, force)
    result = empty_step(record.size, uncertainty, flags)
    report(progress, 0, record.size, "compensating")

    def room(rows: slice) -> Step:
        return Step(result.ax[rows], result.dv[rows], result.u_ax[rows], result.flags[rows])

    for rows, _, _ in plan.run(room):
        report(progress, rows.stop, record.size, "compensating")
    return Compensated(
        record.t, result.ax, result.dv, result.u_ax, result.flags, record.serial, plan.method, notes_on(calibration),
        (record, calibration),
    )  # fmt: skip


def compensate_in_pieces(
    record: Run,
    calibration: Calibration,
    *,
    method: str | None = None,
    phase: Phase | None = None,
    uncertainty: bool = True,
    limits: Limits | None = None,
    max_age_days: float | None = None,
    force: bool = False,
) -> Iterator[tuple[str, Chunk, Compensated]]:
    """Compensate a record piece by piece. Yields the label of the segment, the samples and the compensated rows.

    Use it for records whose result does not fit in memory. Arguments and errors are those of :func:`compensate`. The
    rows are identical to the bit.
    """
    plan = _plan(record, calibration, method, phase, limits, max_age_days, force)

    def room(rows: slice) -> Step:
        return empty_step(rows.stop - rows.start, uncertainty, flags=True)

    for rows, chunk, computed in plan.run(room):
        part = Compensated(
            chunk.t, computed.ax, computed.dv, computed.u_ax, computed.flags, record.serial, plan.method
        )  # fmt: skip
        yield record.labels[int(record.segment_index[rows.start])], chunk, part


def check_serial(record: Run, calibration: Calibration, force: bool) -> None:
    """Refuse the coefficients of another instrument.

    Raises
    ------
    CalibrationError
        Unless ``force``.
    """
    if not force and record.serial and calibration.serial and record.serial != calibration.serial:
        raise CalibrationError(
            f"the record is of instrument '{record.serial}', the calibration of '{calibration.serial}'",
            remedy="take the calibration of this instrument, or use --other-serial (force=True) if they are the same",
        )


def check_phase_kept(record: Run, calibration: Calibration, phase: Phase | None, *, alone: bool = True) -> None:
    """Refuse a shared phase for a record that lost the zero of its output angle.

    A record of a set (``alone`` False) must always have one phase.

    Raises
    ------
    CalibrationError
        Names the first segment for which the phase is not valid.
    """
    shared = not alone or phase is not None or None in phases(calibration)
    if not shared or not needs_phase(calibration) or len(set(record.phase_group)) < 2:
        return
    at = next(i for i, group in enumerate(record.phase_group) if group != record.phase_group[0])
    raise CalibrationError(
        f"{record.source}: the zero of the output angle was lost before segment '{record.labels[at]}' "
        "(the counter may have rolled over unseen in a gap): one phase cannot be valid for the whole "
        "record",
        remedy="calibrate with phases = 'per-segment', or compensate each part by itself, with its own phase",
    )


def _plan(
    record: Run, calibration: Calibration, method: str | None, phase: Phase | None, limits: Limits | None,
    max_age_days: float | None, force: bool,
) -> _Plan:  # fmt: skip
    chosen = check_method(method, calibration)
    check_serial(record, calibration, force)
    check_phase_kept(record, calibration, phase)
    return _Plan(record, calibration, chosen, phase, limits, age_flag(calibration, max_age_days))


@dataclass(frozen=True)
class _Plan:
    record: Run
    calibration: Calibration
    method: str
    phase: Phase | None
    limits: Limits | None
    flag: int

    def run(self, room: Callable[[slice], Step]) -> Iterator[tuple[slice, Chunk, Step]]:
        """Compensate piece by piece. ``room`` gives the output arrays for some rows."""
        state, work = init_state(), work_array()
        typical = self.record.median_step if self.record.kind == "rate" else 0.0
        for rows, model in self._pieces():
            chunk = _chunk(self.record, rows)
            computed = room(rows)
            run_kernel(model, state, chunk, self.record.kind, typical or 1.0, work, computed)
            yield rows, chunk, computed

    def _pieces(self) -> Iterator[tuple[slice, Model]]:
        """Row ranges with one phase, and their model."""
        edges = self.record.segment_edges()
        models: dict[int, Model] = {}
        for start, stop in pairwise(edges.tolist()):
            index = int(self.record.segment_index[start])
            if index not in models:
                models[index] = self._model(self.record.labels[index])
            for part in spans(stop - start):
                yield slice(start + part.start, start + part.stop), models[index]

    def _model(self, label: str) -> Model:
        model = make_model(
            self.calibration,
            method=self.method,
            segment=label,
            phase=self.phase,
            limits=self.limits,
            flag=self.flag,
        )
        if model.needs_temperature and self.record.temperature is None:
            raise CalibrationError(
                "the calibration has temperature terms, but the record has no temperature",
                remedy="add [data] temperature = { column = '...', unit = 'degC' }",
            )
        return model


def _chunk(record: Run, rows: slice) -> Chunk:
    return Chunk(
        t=record.t[rows],
        output=record.output[rows],
        a_Y=np.ascontiguousarray(record.f[rows, 1]),
        a_Z=np.ascontiguousarray(record.f[rows, 2]),
        begins=record.begins[rows],
        base_rate=NO_RATES if record.base_rate is None else np.ascontiguousarray(record.base_rate[rows]),
        temperature=NONE if record.temperature is None else record.temperature[rows],
        angle=NONE,
    )
