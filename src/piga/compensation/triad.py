"""A triad, or any set of three or more instruments: specific force without any other reference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels import compensate_layout as at
from piga._kernels.compensate_set import SET_STATE, SET_WORK
from piga._kernels.compensate_set_record import compensate_set as set_kernel
from piga.compensation.compensate import check_serial
from piga.compensation.flags import FLAGS
from piga.compensation.model import Model, Phase, make_model
from piga.compensation.validity import Limits, age_flag
from piga.errors import ArgumentError, DataError
from piga.records.calibration import Calibration
from piga.records.run import Run

Array = NDArray[np.float64]

FAULT_PROBABILITY = 1e-6
"""Chance that the flag ``fault`` is raised in a row of a sound set."""
ORTHOGONAL = 1e-6
"""Largest deviation of an axes matrix from a rotation that is taken for a rotation."""


@dataclass(frozen=True)
class Mounted:
    """An instrument in a set: its calibration and its axes.

    Attributes
    ----------
    calibration:
        Coefficients of the instrument.
    axes:
        Rows X0, Y0, Z0 of the instrument in the common frame, shape (3, 3), a rotation.
    phase:
        Phase of the output zero when it is not the calibration's.
    segment:
        Segment whose phase is used (per-segment calibrations).
    """

    calibration: Calibration
    axes: Array
    phase: Phase | None = None
    segment: str | None = None


@dataclass(frozen=True)
class CompensatedSet:
    """Specific force and velocity increments in the common frame; arrays share their length n.

    ``t`` [s]; ``f`` (n, 3) [m/s^2], ``dv`` (n, 3) [m/s], ``u_f`` (n, 3) [m/s^2] (or (0, 3)), ``residual``
    [m/s^2]: the root of the summed squared misfits of the instruments (0 for three); ``flags`` as for one
    instrument, set when they hold for any instrument.
    """

    t: Array
    f: Array
    dv: Array
    u_f: Array
    residual: Array
    flags: NDArray[np.int32]

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.t.size)

    def flagged(self, name: str) -> NDArray[np.bool_]:
        """Rows with the flag ``name``."""
        return (self.flags & FLAGS[name]) != 0

    def columns(self) -> dict[str, NDArray]:
        """The columns of the written file, in order."""
        found: dict[str, NDArray] = {"t": self.t}
        for prefix, values in (("f", self.f), ("dv", self.dv), ("u_f", self.u_f)):
            if values.shape[0]:
                found |= {prefix + axis: np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
        return found | {"residual": self.residual, "flags": self.flags}


class SetCompensator:
    """Compensate a stream of three or more instruments in any mounting.

    The effective input axes of all instruments at their output angles give the specific force at every row,
    by least squares when there are more than three; instruments in their dead zone weigh less.

    Parameters
    ----------
    instruments:
        At least three, input axes not in one plane.
    sampled:
        True when angle and rate are recorded: the force is that at the samples. False: angles only, the force
        is the mean over each interval.
    uncertainty, flags:
        Whether these columns are computed.
    max_age_days, limits:
        As for one instrument.

    Raises
    ------
    ArgumentError
        If there are fewer than three instruments, or axes are no rotation or lie in one plane.
    """

    def __init__(
        self,
        instruments: Sequence[Mounted],
        *,
        sampled: bool = False,
        uncertainty: bool = True,
        flags: bool = True,
        limits: Limits | None = None,
        max_age_days: float | None = None,
    ) -> None:
        self._axes = np.array([_rotation(item.axes, i) for i, item in enumerate(instruments)])
        _check_spread(self._axes)
        self._sampled, self._uncertainty, self._flags = sampled, uncertainty, flags
        models = [
            make_model(
                item.calibration,
                segment=item.segment,
                phase=item.phase,
                limits=limits,
            )
            for item in instruments
        ]
        self._models = models
        self._flag = 0
        for item in instruments:
            self._flag |= age_flag(item.calibration, max_age_days)
        self._count = len(models)
        self._arrays = _stacked(models)
        self._threshold = fault_threshold(self._count - 3)
        self._states = np.zeros((self._count, at.STATE))
        self._set_state = np.zeros(SET_STATE)
        self._weights = np.ones((self._count, at.STRIDE))
        self._scratch = np.zeros(at.BLOCK)
        self._work = np.zeros((self._count, at.WORK))
        self._common = np.zeros(SET_WORK)

    def push(
        self,
        t: ArrayLike,
        output: ArrayLike,
        *,
        rate: ArrayLike | None = None,
        base_rate: ArrayLike | None = None,
        temperature: ArrayLike | None = None,
        begins: NDArray[np.bool_] | None = None,
    ) -> CompensatedSet:
        """Compensate the next samples; N instruments, n samples.

        Parameters
        ----------
        t:
            Time [s], (n,).
        output, rate:
            Output angles psi [rad] and, for a sampled set, rates [rad/s], (N, n).
        base_rate:
            Inertial rate of every instrument in its own axes [rad/s], (N, n, 3).
        temperature:
            [K], (N, n).
        begins:
            True where a stretch begins.
        """
        time = np.atleast_1d(np.asarray(t, dtype=float))
        n, count = time.size, self._count
        psi = _shaped("output", output, (count, n))
        if self._sampled != (rate is not None):
            raise ArgumentError(
                "rate: a sampled set needs it, a set of angles does not take it", remedy="see sampled"
            )
        rates = np.zeros((count, 0)) if rate is None else _shaped("rate", rate, (count, n))
        omega = np.zeros((count, 0, 3)) if base_rate is None else _shaped("base_rate", base_rate, (count, n, 3))
        warm = np.zeros((count, 0)) if temperature is None else _shaped("temperature", temperature, (count, n))
        if temperature is None and any(model.needs_temperature for model in self._models):
            raise ArgumentError("temperature: a calibration has temperature terms", remedy="give it")
        marks = np.zeros(n, dtype=np.bool_) if begins is None else np.asarray(begins, dtype=np.bool_)
        u = np.empty((n if self._uncertainty else 0, 3))
        found = CompensatedSet(
            time,
            np.empty((n, 3)),
            np.empty((n, 3)),
            u,
            np.empty(n),
            np.zeros(n if self._flags else 0, np.int32),
        )
        before = self._states.copy(), self._set_state.copy()
        parameters, has_terms, orders, sines, cosines, codes, factors, limits = self._arrays
        set_kernel(
            time, psi, rates, marks, omega, warm, parameters, self._axes, has_terms, orders, sines, cosines,
            codes, factors, limits, self._flag, self._threshold, self._states, self._set_state, self._weights,
            self._scratch, self._work, self._common, found.f, found.dv, found.u_f, found.residual, found.flags,
        )  # fmt: skip
        last = psi[:, -1:].sum() + (found.f if self._sampled else found.dv).sum()
        if not math.isfinite(last):
            self._states, self._set_state = before
            _check_finite(output=psi, rate=rates, base_rate=omega, temperature=warm)
        return found


def compensate_triad(
    records: Sequence[Run],
    instruments: Sequence[Mounted],
    *,
    uncertainty: bool = True,
    limits: Limits | None = None,
    max_age_days: float | None = None,
    force: bool = False,
) -> CompensatedSet:
    """Specific force of whole records of three or more instruments, sampled at the same times.

    Records of angles give the mean over each interval; records of rates the force at the samples, the angles
    integrated from the rates.

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
    stream = SetCompensator(
        mounted, sampled=first.kind == "rate",
        uncertainty=uncertainty, limits=limits, max_age_days=max_age_days,
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


def integrated_rate(t: Array, rate: Array, begins: NDArray[np.bool_]) -> Array:
    """Angle from a rate [rad]: trapezoid with end correction, see :class:`RateAngle`."""
    follower = RateAngle()
    return np.concatenate((follower.push(t, rate, begins), follower.finish()))


class RateAngle:
    """Angle from a rate, chunk by chunk: trapezoid with end correction, slopes by central differences.

    A sample waits for the one behind it. The result does not depend on the chunks, to the bit.
    """

    def __init__(self) -> None:
        self._t, self._rate, self._begins = np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.bool_)
        self._angle, self._slope = 0.0, 0.0
        self._given = False

    def push(self, t: Array, rate: Array, begins: NDArray[np.bool_]) -> Array:
        """Angles [rad] of all samples but the last, and of the one that waited."""
        self._t, self._rate = np.concatenate((self._t, t)), np.concatenate((self._rate, rate))
        self._begins = np.concatenate((self._begins, begins))
        return self._go(self._t.size - 1)

    def finish(self) -> Array:
        """Angle of the sample that waits."""
        return self._go(self._t.size)

    def _go(self, stop: int) -> Array:
        """Angles of the samples up to ``stop`` that are not given yet; the one before them is kept, too."""
        first = 1 if self._given else 0
        if stop <= first:
            return np.zeros(0)
        slope = self._slopes()[:stop]
        if self._given:
            slope[0] = self._slope
        step = np.where(self._begins[1:stop], 0.0, np.diff(self._t[:stop]))
        rate = self._rate[:stop]
        turns = 0.5 * step * (rate[1:] + rate[:-1]) + step**2 / 12.0 * (slope[:-1] - slope[1:])
        angle = np.cumsum(np.concatenate(([self._angle], turns)))
        self._angle, self._slope, self._given = float(angle[-1]), float(slope[-1]), True
        self._t, self._rate, self._begins = (
            self._t[stop - 1 :],
            self._rate[stop - 1 :],
            self._begins[stop - 1 :],
        )
        return angle[first:]

    def _slopes(self) -> Array:
        """Slope at every sample, one-sided at both ends of a stretch."""
        step = np.diff(self._t)
        joined = ~self._begins[1:] & (step > 0.0)
        each = np.where(joined, np.diff(self._rate) / np.where(joined, step, 1.0), 0.0)
        left, right = np.concatenate(([0.0], each)), np.concatenate((each, [0.0]))
        before, behind = (
            np.concatenate(([0.0], np.where(joined, step, 0.0))),
            np.concatenate((np.where(joined, step, 0.0), [0.0])),
        )
        both = before + behind
        return np.where(both > 0.0, (left * behind + right * before) / np.where(both > 0.0, both, 1.0), 0.0)


def fault_threshold(freedom: int) -> float:
    """Weighted sum of squares that a sound set exceeds with ``FAULT_PROBABILITY``."""
    if freedom < 1:
        return math.inf
    from scipy.special import chdtri

    return float(chdtri(freedom, FAULT_PROBABILITY))


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


def _rotation(axes: ArrayLike, index: int) -> Array:
    matrix = np.asarray(axes, dtype=float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ArgumentError(
            f"axes of instrument {index}: shape {matrix.shape}", remedy="rows X0, Y0, Z0 of 3 numbers each"
        )
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ORTHOGONAL or np.linalg.det(matrix) < 0.0:
        raise ArgumentError(
            f"axes of instrument {index}: the rows are no right-handed set of orthogonal unit vectors",
            remedy="give X0, Y0, Z0 of the instrument in the common frame, to six digits or more",
        )
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def _check_spread(axes: Array) -> None:
    if axes.shape[0] < 3:
        raise ArgumentError(
            f"a set of {axes.shape[0]} instruments cannot give three components",
            remedy="use three or more instruments",
        )
    smallest = np.linalg.svd(axes[:, 0, :], compute_uv=False)[-1]
    if smallest < 0.05:
        raise ArgumentError(
            f"the input axes lie in one plane (smallest singular value {smallest:.3g})",
            remedy="check axes, first rows",
        )


def _shaped(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.ascontiguousarray(np.asarray(values, dtype=float))
    if array.ndim == len(shape) - 1:
        array = array[:, None]
    if array.shape != shape:
        raise ArgumentError(
            f"{name}: shape {np.shape(values)} instead of {shape}", remedy="one row per instrument"
        )
    return array


def _check_finite(**columns: Array) -> None:
    for name, array in columns.items():
        if not np.isfinite(array).all():
            where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
            raise ArgumentError(
                f"{name}{where} is not finite", remedy="leave such samples out of all instruments"
            )


def _stacked(models: list[Model]) -> tuple[NDArray, ...]:
    """Arrays of all instruments, padded to one size: order 1 and amplitude 0, code of k0 and weight 0."""
    count = len(models)
    harmonics = max(model.orders.size for model in models)
    size = max(model.codes.size for model in models)
    rank = max(model.factor.shape[0] for model in models)
    orders, sines, cosines = (
        np.ones((count, harmonics)),
        np.zeros((count, harmonics)),
        np.zeros((count, harmonics)),
    )
    codes, factors = np.full((count, size), at.P_TERMS, dtype=np.int64), np.zeros((count, rank, size))
    for i, model in enumerate(models):
        orders[i, : model.orders.size] = model.orders
        sines[i, : model.orders.size], cosines[i, : model.orders.size] = model.sines, model.cosines
        codes[i, : model.codes.size] = model.codes
        factors[i, : model.factor.shape[0], : model.codes.size] = model.factor
    return (
        np.array([model.parameters for model in models]), np.array([model.has_terms for model in models]),
        orders, sines, cosines, codes, factors, np.array([model.limits for model in models]),
    )  # fmt: skip
