"""Compensate a whole record. It runs the same step as a live stream, piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice, pairwise

import numpy as np
from numpy.typing import NDArray

from piga.compensation.compensator import (
    NO_RATES,
    NONE,
    Chunk,
    Step,
    empty_step,
    init_state,
    run_kernel,
    work_array,
)
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
from piga.errors import CalibrationError
from piga.progress import Progress, report
from piga.records.calibration import Calibration
from piga.records.run import Run
from piga.records.spool import spans

Array = NDArray[np.float64]


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
        If the calibration is of another instrument, or lacks the phase of a segment.
    """
    plan = _plan(record, calibration, method, phase, limits, max_age_days, force)
    result = empty_step(record.size, uncertainty, flags)
    report(progress, 0, record.size, "compensating")
    for rows, _, _ in plan.run(lambda rows, _: _part(result, rows)):
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
    state: Array | None = None,
    done: int = 0,
) -> Iterator[tuple[str, Chunk, Compensated]]:
    """Compensate a record piece by piece. Yields the label of the segment, the samples and the compensated rows.

    Use it for records whose result does not fit in memory. Arguments and errors are those of :func:`compensate`. The
    rows are identical to the bit. ``state`` (:func:`init_state`) is updated with every piece. To continue after ``done`` pieces,
    pass the state as it was at that point.
    """
    plan = _plan(record, calibration, method, phase, limits, max_age_days, force)

    def room(_rows: slice, count: int) -> Step:
        return empty_step(count, uncertainty, flags=True)

    for rows, chunk, computed in plan.run(room, state, done):
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


def _part(result: Step, rows: slice) -> Step:
    return Step(result.ax[rows], result.dv[rows], result.u_ax[rows], result.flags[rows])


@dataclass(frozen=True)
class _Plan:
    record: Run
    calibration: Calibration
    method: str
    phase: Phase | None
    limits: Limits | None
    flag: int

    def run(
        self, room: Callable[[slice, int], Step], state: Array | None = None, done: int = 0
    ) -> Iterator[tuple[slice, Chunk, Step]]:
        """Compensate piece by piece. ``room`` gives the output arrays for some rows and their number."""
        state, work = init_state() if state is None else state, work_array()
        typical = self.record.median_step if self.record.kind == "rate" else 0.0
        for rows, model in islice(self._pieces(), done, None):
            chunk = _chunk(self.record, rows)
            computed = room(rows, chunk.t.size)
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
