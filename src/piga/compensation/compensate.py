"""Compensate a whole record: a loop over the same step that the stream takes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga.compensation.model import Model, Phase, check_method, make_model, needs_phase, phases
from piga.compensation.result import Compensated
from piga.compensation.step import NO_RATES, NONE, Chunk, Step, empty_step, init_state, run_kernel, work_array
from piga.compensation.validity import Limits, age_flag
from piga.errors import CalibrationError
from piga.records.calibration import Calibration
from piga.records.run import Run

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
) -> Compensated:
    """Specific force and velocity increments of a record, the errors of the instrument taken out.

    An angle (or count) record gives, for every interval, the velocity increment that the exact motion needs
    to turn the output as it was read (own derivation, docs/theory/compensation); a rate record gives the
    specific force at each sample from the effective input axis (physics.md, equation 6).

    Parameters
    ----------
    record:
        The record; its transverse reference is used, its reference along X0 is not.
    calibration:
        The coefficients.
    method:
        ``"exact"``, or ``"published"``: the output rate less the coupling at the phase ``int alpha' dt + phi``
        [Wei2024]. None takes the one that fits the calibration's ``phase_source``.
    phase:
        Phase of the output zero when it is not the calibration's, see :func:`piga.compensation.identify_phase`.
    uncertainty, flags:
        Whether ``u_ax`` and the flags are computed.
    limits, max_age_days:
        Range and age in which the calibration holds; rows outside are flagged. None: the range that the
        calibration itself states, any age.
    force:
        Use a calibration of another serial number.

    Raises
    ------
    CalibrationError
        If the calibration is of another instrument, or lacks the phase of a segment.
    """
    chosen = check_method(method, calibration)
    check_serial(record, calibration, force)
    check_phase_kept(record, calibration, phase)
    plan = _Plan(record, calibration, chosen, phase, limits, age_flag(calibration, max_age_days))
    result = empty_step(record.size, uncertainty, flags)
    state, work = init_state(), work_array()
    typical = typical_step(record.t, record.begins)
    for rows, model, chunk in plan.pieces():
        part = Step(result.ax[rows], result.dv[rows], result.u_ax[rows], result.flags[rows])
        run_kernel(model, state, chunk, record.kind, typical, work, part)
    return Compensated(record.t, result.ax, result.dv, result.u_ax, result.flags, record.serial, chosen)


def check_serial(record: Run, calibration: Calibration, force: bool) -> None:
    """Refuse the coefficients of another instrument.

    Raises
    ------
    CalibrationError
        Unless ``force``.
    """
    check_serial_names(record.serial, calibration.serial, force)


def check_serial_names(record: str, calibration: str, force: bool) -> None:
    """The same for the names alone."""
    if not force and record and calibration and record != calibration:
        raise CalibrationError(
            f"the record is of instrument '{record}', the calibration of '{calibration}'",
            remedy="take the calibration of this instrument, or use --force (force=True) if they are the same",
        )


def check_phase_kept(record: Run, calibration: Calibration, phase: Phase | None) -> None:
    """Refuse a shared phase for a record that lost the zero of its output angle on the way.

    Raises
    ------
    CalibrationError
        Naming the segment from which on the phase does not hold.
    """
    shared = phase is not None or None in phases(calibration)
    if not shared or not needs_phase(calibration) or len(set(record.phase_group)) < 2:
        return
    at = next(i for i, group in enumerate(record.phase_group) if group != record.phase_group[0])
    raise CalibrationError(
        f"{record.source}: the zero of the output angle was lost before segment '{record.labels[at]}' (the "
        "counter may have rolled over unseen in a gap): one phase cannot hold for the whole record",
        remedy="calibrate with phase = 'per-segment', or compensate the parts one by one, each with its phase",
    )


def typical_step(t: Array, begins: NDArray[np.bool_]) -> float:
    """Median interval inside stretches [s]; 1 when there is none."""
    steps = np.diff(t)[~begins[1:]]
    return float(np.median(steps)) if steps.size else 1.0


@dataclass(frozen=True)
class _Plan:
    record: Run
    calibration: Calibration
    method: str
    phase: Phase | None
    limits: Limits | None
    flag: int

    def pieces(self) -> Iterator[tuple[slice, Model, Chunk]]:
        """Row ranges with one phase, their model and samples."""
        record = self.record
        edges = np.concatenate(([0], np.flatnonzero(np.diff(record.segment)) + 1, [record.size]))
        models: dict[int, Model] = {}
        for start, stop in pairwise(edges):
            index = int(record.segment[start])
            if index not in models:
                models[index] = self._model(record.labels[index])
            rows = slice(int(start), int(stop))
            yield rows, models[index], _chunk(record, rows)

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
                "the calibration has temperature terms, the record has no temperature",
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
        base_rate=NO_RATES if record.base_rate is None else record.base_rate[rows],
        temperature=NONE if record.temperature is None else record.temperature[rows],
        angle=NONE,
    )
