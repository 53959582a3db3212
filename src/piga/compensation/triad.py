"""Whole records of a triad, or of any set of three or more instruments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from piga.compensation.compensate import check_serial
from piga.compensation.model import METHODS
from piga.compensation.mounting import Mounted
from piga.compensation.published_set import PublishedSet
from piga.compensation.rate_angle import integrated_rate
from piga.compensation.result import CompensatedSet
from piga.compensation.set_compensator import SetCompensator
from piga.compensation.validity import Limits
from piga.errors import ArgumentError, DataError
from piga.records.run import Run

Array = NDArray[np.float64]


def compensate_triad(
    records: Sequence[Run],
    instruments: Sequence[Mounted],
    *,
    uncertainty: bool = True,
    limits: Limits | None = None,
    max_age_days: float | None = None,
    force: bool = False,
    method: str = "exact",
    details: bool = False,
) -> CompensatedSet:
    """Specific force of whole records of three or more instruments, sampled at the same times.

    Records of angles give the mean over each interval; records of rates the force at the samples, the angles
    integrated from the rates. ``details`` keeps misfits and flags of the single instruments, too.

    Raises
    ------
    DataError
        If the records have not the same times, or hold different kinds of output.
    CalibrationError, ArgumentError
        As :class:`SetCompensator`, and for calibrations of other instruments unless ``force``.
    """
    _check_records(records)
    for record, item in zip(records, instruments, strict=True):
        check_serial(record, item.calibration, force)
    first = records[0]
    begins = np.logical_or.reduce([record.begins for record in records])
    mounted = [
        replace(item, segment=item.segment or record.labels[0])
        for record, item in zip(records, instruments, strict=True)
    ]
    sampled = first.kind == "rate"
    stream = set_stream(
        mounted, method, sampled=sampled, uncertainty=uncertainty, limits=limits, max_age_days=max_age_days,
        details=details,
    )  # fmt: skip
    outputs = np.array([record.output for record in records])
    base, warm = [r.base_rate for r in records], [r.temperature for r in records]
    return stream.push(
        first.t,
        outputs
        if first.kind == "angle"
        else np.array([integrated_rate(r.t, r.output, begins) for r in records]),
        rate=None if first.kind == "angle" else outputs,
        base_rate=None
        if all(b is None for b in base)
        else [np.zeros((first.size, 3)) if b is None else b for b in base],
        temperature=None if any(w is None for w in warm) else [w for w in warm if w is not None],
        begins=begins,
    )


def set_stream(
    mounted: Sequence[Mounted], method: str, *, sampled: bool, uncertainty: bool, limits: Limits | None = None,
    max_age_days: float | None = None, details: bool = False,
) -> SetCompensator | PublishedSet:  # fmt: skip
    """The compensator of a set by its method.

    Raises
    ------
    ArgumentError
        For an unknown method.
    """
    if method not in METHODS:
        raise ArgumentError(f"method: '{method}' is not known", remedy=f"one of: {', '.join(METHODS)}")
    if method == "published":
        return PublishedSet(mounted, sampled=sampled, max_age_days=max_age_days)
    return SetCompensator(
        mounted, sampled=sampled, uncertainty=uncertainty, limits=limits, max_age_days=max_age_days,
        details=details,
    )  # fmt: skip


def _check_records(records: Sequence[Run]) -> None:
    first = records[0]
    for index, record in enumerate(records[1:], start=1):
        if record.kind != first.kind:
            raise DataError(
                f"{record.source or index}: holds {record.kind}, {first.source or 0}: {first.kind}",
                remedy="log one kind",
            )
        same = record.size == first.size
        apart = (
            np.abs(record.t - first.t) > 1e-6 * (first.t[1] - first.t[0]) if same else np.ones(1, dtype=bool)
        )
        if apart.any():
            row = record.row[int(np.argmax(apart))] if same else record.row[-1]
            raise DataError(
                f"{record.source or index}: row {row}: the times are not those of {first.source or 'record 0'}",
                remedy="sample all instruments together, or bring them to common times first",
            )
