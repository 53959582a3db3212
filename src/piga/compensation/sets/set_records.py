"""Whole records of a set: three or more instruments on one base."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from piga.compensation.compensate import check_phase_kept, check_serial
from piga.compensation.model import COMPENSATION_METHODS, Limits
from piga.compensation.phase import integrated_rate
from piga.compensation.result import CompensatedSet
from piga.compensation.sets.set_compensator import Mounted, PublishedSet, SetCompensator
from piga.errors import ArgumentError, DataError
from piga.progress import Progress, report
from piga.records.run import Run
from piga.records.spool import spans

Array = NDArray[np.float64]

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
    method: str = "exact",
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
    check_together(records)
    if len(records) != len(instruments):
        raise ArgumentError(
            f"{len(records)} records for {len(instruments)} instruments",
            remedy="give one record for each instrument",
        )
    for record, item in zip(records, instruments, strict=True):
        check_member(record, item, force)
    first = records[0]
    begins = np.logical_or.reduce([record.begins for record in records])
    mounted = mounted_on(records, instruments)
    sampled = first.kind == "rate"
    stream = set_stream(
        mounted, method, sampled=sampled, uncertainty=uncertainty, limits=limits, max_age_days=max_age_days,
        details=details,
    )  # fmt: skip
    turned = [integrated_rate(r.t, r.output, begins) for r in records] if sampled else None
    moves = any(record.base_rate is not None for record in records)
    warm = all(record.temperature is not None for record in records)
    report(progress, 0, first.size, "compensating")
    parts = []
    for rows in spans(first.size):
        still = np.zeros((rows.stop - rows.start, 3))
        output = np.array([record.output[rows] for record in records])
        parts.append(
            stream.push(
                first.t[rows],
                output if turned is None else np.array([angle[rows] for angle in turned]),
                rate=output if sampled else None,
                base_rate=[still if r.base_rate is None else r.base_rate[rows] for r in records]
                if moves
                else None,
                temperature=[r.temperature[rows] for r in records if r.temperature is not None]
                if warm
                else None,
                begins=begins[rows],
            )
        )
        report(progress, rows.stop, first.size, "compensating")
    return joined_set(parts)


def joined_set(parts: Sequence[CompensatedSet]) -> CompensatedSet:
    """Compensated rows that follow one another, as one result."""
    if len(parts) == 1:
        return parts[0]
    lengths = {"misfit": 1, "each": 1}
    return CompensatedSet(
        **{
            field.name: np.concatenate(
                [getattr(part, field.name) for part in parts], axis=lengths.get(field.name, 0)
            )
            for field in fields(CompensatedSet)
        }
    )


def set_stream(
    mounted: Sequence[Mounted], method: str, *, sampled: bool, uncertainty: bool, limits: Limits | None = None,
    max_age_days: float | None = None, details: bool = False,
) -> SetCompensator | PublishedSet:  # fmt: skip
    """The compensator of a set for a method.

    Raises
    ------
    ArgumentError
        For an unknown method.
    """
    if method not in COMPENSATION_METHODS:
        raise ArgumentError(
            f"method: '{method}' is not known", remedy=f"one of: {', '.join(COMPENSATION_METHODS)}"
        )
    if method == "published":
        return PublishedSet(mounted, sampled=sampled, max_age_days=max_age_days)
    return SetCompensator(
        mounted, sampled=sampled, uncertainty=uncertainty, limits=limits, max_age_days=max_age_days,
        details=details,
    )  # fmt: skip


def mounted_on(records: Sequence[Run], instruments: Sequence[Mounted]) -> list[Mounted]:
    """The instruments, each with the segment that gives the phase of its record: the first one, unless one is named."""
    return [
        replace(item, segment=item.segment or record.labels[0])
        for record, item in zip(records, instruments, strict=True)
    ]


def check_member(record: Run, item: Mounted, force: bool) -> None:
    """Refuse a record for which the calibration of its instrument is not valid.

    Raises
    ------
    CalibrationError
        If the record is of another instrument (unless ``force``), or lost the zero of its angle. In a set one phase must
        be valid for the whole record.
    """
    check_serial(record, item.calibration, force)
    check_phase_kept(record, item.calibration, item.phase, alone=False)


def check_together(records: Sequence[Run]) -> None:
    """Refuse records that were not sampled at the same times.

    Raises
    ------
    DataError
        If the records differ in their times or in the kind of output.
    """
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
        for part in spans(min(record.size, first.size)):
            differs = np.abs(record.t[part] - first.t[part]) > apart
            if differs.any():
                at = part.start + int(np.argmax(differs))
                raise DataError(
                    f"{name}: row {record.row[at]}, t = {record.t[at]:.9g} s: the times are not those of {other}",
                    remedy="sample all instruments together, or interpolate them to common times first",
                )
        if record.size != first.size:
            raise DataError(
                f"{name}: has {record.size} rows that can be used, {other} has {first.size}",
                remedy="sample all instruments together, and cut the records to the time they share",
            )
