"""Compensation of a set of instruments: their mounting, the exact solution and the published one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import layout as at
from piga._kernels.compensation.set import SET_STATE, SET_WORK, SetModels, SetRows, SetSamples, SetWork
from piga._kernels.compensation.set import compensate_set as set_kernel
from piga.compensation.compensator import find_begins, init_state
from piga.compensation.model import Limits, Model, Phase, age_flag, make_model
from piga.compensation.result import CompensatedSet
from piga.errors import ArgumentError
from piga.records.calibration import Calibration
from piga.results import Array, Result


@dataclass(frozen=True)
class SetSettings:
    """Settings of sets of instruments (own choices)."""

    orthogonal: float = 1e-6
    """Largest deviation from a rotation that an axes matrix may have."""
    fault_probability: float = 1e-6
    """Probability of the flag ``fault`` in a row of a sound set."""


SET = SetSettings()


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
    """Nearest exact rotation to the axes matrix of an instrument.

    Raises
    ------
    ArgumentError
        If the axes are not right-handed orthogonal unit vectors.
    """
    matrix = np.asarray(axes, dtype=float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ArgumentError(
            f"axes of instrument {index}: shape {matrix.shape}", remedy="rows X0, Y0, Z0 of 3 numbers each"
        )
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > SET.orthogonal or np.linalg.det(matrix) < 0.0:
        raise ArgumentError(
            f"axes of instrument {index}: the rows are not a right-handed set of orthogonal unit vectors",
            remedy="give X0, Y0, Z0 of the instrument in the common frame, to six digits or more",
        )
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def check_count(count: int) -> None:
    """Refuse fewer than three instruments.

    Raises
    ------
    ArgumentError
        In this case.
    """
    if count < 3:
        raise ArgumentError(
            f"a set of {count} instruments cannot give three components", remedy="use three or more instruments"
        )


def check_spread(axes: Array) -> None:
    """Refuse fewer than three instruments or coplanar input axes; ``axes`` has shape (N, 3, 3).

    Raises
    ------
    ArgumentError
        In both cases.
    """
    check_count(axes.shape[0])
    smallest = np.linalg.svd(axes[:, 0, :], compute_uv=False)[-1]
    if smallest < 0.05:
        raise ArgumentError(
            f"the input axes lie in one plane (smallest singular value {smallest:.3g})",
            remedy="check the first row of each axes: the input axes must span space",
        )


def _age_flags(instruments: Sequence[Mounted], max_age_days: float | None) -> int:
    return reduce(or_, (age_flag(item.calibration, max_age_days) for item in instruments), 0)


class PublishedSet:
    """Compensate a set by the published formula [Wei2024], for comparison.

    First, the indications of all instruments are combined into a force (least squares), as if each measured along its
    input axis. The components of this force across each instrument enter the published formula at the output angle.
    The corrected indications then give the force. The error is of second order in the coupling. It is of first order in
    all error terms except ``k0``, because these are not corrected.

    Parameters
    ----------
    instruments:
        As for :class:`piga.compensation.SetCompensator`.
    sampled:
        True when rates are recorded beside the angles.
    max_age_days:
        Older calibrations are flagged.

    Raises
    ------
    ArgumentError
        If there are fewer than three instruments.
    """

    def __init__(
        self, instruments: Sequence[Mounted], *, sampled: bool = False, max_age_days: float | None = None
    ) -> None:
        check_count(len(instruments))
        self._axes = np.array([np.asarray(item.axes, dtype=float) for item in instruments])
        self._solve = np.linalg.pinv(self._axes[:, 0, :])
        self._models = [
            make_model(item.calibration, method="published", segment=item.segment, phase=item.phase)
            for item in instruments
        ]
        self._sampled = sampled
        self._flag = _age_flags(instruments, max_age_days)
        self._clock = init_state()
        self._last: tuple[Array, Array, Array, Array] | None = None

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
        """Compensate the next samples. Arguments as for the exact set; ``temperature`` is not used."""
        del temperature
        time, psi = np.atleast_1d(np.asarray(t, dtype=float)), np.asarray(output, dtype=float)
        psi = psi.reshape(len(self._models), time.size)
        omega = np.zeros((*psi.shape, 3)) if base_rate is None else np.asarray(base_rate, dtype=float)
        marks = find_begins(self._clock, time) if begins is None else np.array(begins, dtype=np.bool_)
        if time.size == 0:
            return self._result(time, np.zeros((0, 3)), np.zeros((0, 3)), marks)
        if self._last is None:
            marks[0] = True
            self._last = time[:1], psi[:, :1], omega[:, :1], np.zeros((1, 3))
        before = self._last
        step = np.where(marks, 0.0, np.diff(time, prepend=before[0]))
        if self._sampled:
            force = self._force(psi, np.asarray(rate, dtype=float), omega)
            both = np.concatenate((before[3], force))
            dv = 0.5 * step[:, None] * (both[1:] + both[:-1])
        else:
            known, turning = (
                np.concatenate((before[1], psi), axis=1),
                np.concatenate((before[2], omega), axis=1),
            )
            with np.errstate(divide="ignore", invalid="ignore"):
                rates = np.where(step > 0.0, np.diff(known, axis=1) / step, np.nan)
            force = self._force(
                0.5 * (known[:, 1:] + known[:, :-1]), rates, 0.5 * (turning[:, 1:] + turning[:, :-1])
            )
            dv = np.where(step[:, None] > 0.0, force * step[:, None], 0.0)
        self._clock[at.S_VALID], self._clock[at.S_TIME] = 1.0, time[-1]
        self._last = time[-1:], psi[:, -1:], omega[:, -1:], force[-1:]
        return self._result(time, force, dv, step == 0.0)

    def _force(self, psi: Array, rate: Array, omega: Array) -> Array:
        """Force (n, 3) in the common frame from angles and rates (N, n)."""
        p = [model.instrument.parameters for model in self._models]
        indicated = [
            (rate[i] + omega[i, :, 0]) / q[at.P_K] - q[at.P_TERMS + at.TERMS.index("k0")]
            for i, q in enumerate(p)
        ]
        first = self._combined(indicated)
        corrected = []
        for i, q in enumerate(p):
            y, z = (sum(self._axes[i, row, k] * first[k] for k in range(3)) for row in (1, 2))
            K, tangent = q[at.P_K], q[at.P_TAN_BETA]
            Y = tangent * (K * y - omega[i, :, 1]) + q[at.P_OFFSET_Y]
            Z = tangent * (K * z - omega[i, :, 2]) + q[at.P_OFFSET_Z]
            alpha = q[at.P_PHI] + psi[i]
            corrected.append(indicated[i] - (Y * np.sin(alpha) - Z * np.cos(alpha)) / K)
        return np.stack(self._combined(corrected), axis=1)

    def _combined(self, along: list[Array]) -> list[Array]:
        """Components in the common frame from components along the input axes, added one by one."""
        return [np.asarray(sum(self._solve[k, i] * a for i, a in enumerate(along))) for k in range(3)]

    def _result(self, t: Array, force: Array, dv: Array, none: NDArray[np.bool_]) -> CompensatedSet:
        flags = np.where(none, at.NO_INCREMENT, 0).astype(np.int32) | np.int32(self._flag)
        return CompensatedSet(t, force, dv, np.zeros((0, 3)), np.full(t.size, np.nan), flags)


class SetCompensator:
    """Compensate a stream of three or more instruments in any mounting.

    The effective input axes of all instruments at their output angles determine the specific force of every row.
    With more than three instruments it is a least-squares solution. An instrument in its dead zone has less weight.

    Parameters
    ----------
    instruments:
        At least three; the input axes must not be coplanar.
    sampled:
        True: angle and rate are recorded, and the force is the value at the samples. False: angles only, and the
        force is the mean over each interval.
    uncertainty, flags:
        Whether these columns are computed.
    details:
        Whether misfits and flags of each instrument are kept (needs ``flags``).
    max_age_days, limits:
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
        flags: bool = True,
        details: bool = False,
        limits: Limits | None = None,
        max_age_days: float | None = None,
    ) -> None:
        self._axes = np.array([rotation(item.axes, i) for i, item in enumerate(instruments)])
        check_spread(self._axes)
        self._sampled, self._uncertainty, self._flags = sampled, uncertainty, flags
        self._details = details and flags
        self._models = [
            make_model(item.calibration, segment=item.segment, phase=item.phase, limits=limits)
            for item in instruments
        ]
        self._flag = _age_flags(instruments, max_age_days)
        self._count = len(instruments)
        self._arrays = stacked(self._models, self._axes)
        self._threshold = fault_threshold(self._count - 3)
        self._states = np.zeros((self._count, at.STATE))
        self._set_state = np.zeros(SET_STATE)
        self._work = set_work(self._count)

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
            True where a stretch begins; None: where time goes back or leaves a gap, as for one instrument.
        """
        time = np.atleast_1d(np.asarray(t, dtype=float))
        n, count = time.size, self._count
        psi = _shaped("output", output, (count, n))
        if self._sampled != (rate is not None):
            raise ArgumentError(
                "rate: needed for a set that is sampled, and not allowed for a set of angles",
                remedy="give rate, and create the set with sampled=True",
            )
        rates = np.zeros((count, 0)) if rate is None else _shaped("rate", rate, (count, n))
        omega = np.zeros((count, 0, 3)) if base_rate is None else _shaped("base_rate", base_rate, (count, n, 3))
        warm = np.zeros((count, 0)) if temperature is None else _shaped("temperature", temperature, (count, n))
        if temperature is None and any(model.needs_temperature for model in self._models):
            raise ArgumentError(
                "temperature: missing, and a calibration has temperature terms",
                remedy="give the temperature [K] of each instrument, shape (N, n)",
            )
        before = self._states.copy(), self._set_state.copy()
        marks = find_begins(self._states[0], time) if begins is None else np.asarray(begins, dtype=np.bool_)
        u = np.empty((n if self._uncertainty else 0, 3))
        result = CompensatedSet(
            time,
            np.empty((n, 3)),
            np.empty((n, 3)),
            u,
            np.empty(n),
            np.zeros(n if self._flags else 0, np.int32),
            np.empty((count, n if self._details else 0)),
            np.zeros((count, n if self._details else 0), np.int32),
        )
        set_kernel(
            SetSamples(time, marks, psi, rates, omega, warm, np.zeros(0)), self._arrays, self._flag, self._threshold,
            self._states, self._set_state, self._work,
            SetRows(result.f, result.dv, result.u_f, result.residual, result.flags, result.misfit, result.each),
        )  # fmt: skip
        last = psi[:, -1:].sum() + (result.f if self._sampled else result.dv).sum()
        if not math.isfinite(last):
            self._states, self._set_state = before
            _check_finite(output=psi, rate=rates, base_rate=omega, temperature=warm)
        return result


def fault_threshold(freedom: int) -> float:
    """Weighted sum of squares that a sound set exceeds with probability ``SET.fault_probability``."""
    if freedom < 1:
        return math.inf
    from scipy.special import chdtri

    return float(chdtri(freedom, SET.fault_probability))


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
                f"{name}{where} is not finite", remedy="leave such samples out for all instruments"
            )


def stacked(models: list[Model], axes: Array) -> SetModels:
    """Arrays of all instruments at one size. Padding: order 1 with amplitude 0, code of k0 with weight 0."""
    count, arrays = len(models), [model.instrument for model in models]
    harmonics = max(one.orders.size for one in arrays)
    size = max(one.codes.size for one in arrays)
    rank = max(one.factor.shape[0] for one in arrays)
    orders, sines, cosines = (
        np.ones((count, harmonics)),
        np.zeros((count, harmonics)),
        np.zeros((count, harmonics)),
    )
    codes, factors = np.full((count, size), at.P_TERMS, dtype=np.int64), np.zeros((count, rank, size))
    for i, one in enumerate(arrays):
        orders[i, : one.orders.size] = one.orders
        sines[i, : one.orders.size], cosines[i, : one.orders.size] = one.sines, one.cosines
        codes[i, : one.codes.size] = one.codes
        factors[i, : one.factor.shape[0], : one.codes.size] = one.factor
    return SetModels(
        np.array([one.parameters for one in arrays]), axes, np.array([model.has_terms for model in models]),
        orders, sines, cosines, codes, factors, np.array([one.limits for one in arrays]),
    )  # fmt: skip


def set_work(count: int) -> SetWork:
    """Scratch memory for ``count`` instruments."""
    w, weights = np.zeros((count, at.WORK)), np.ones((count, at.STRIDE))
    return SetWork(w, weights, np.zeros(SET_WORK), np.zeros(at.BLOCK, dtype=np.int32), np.zeros((3, at.STRIDE)))
