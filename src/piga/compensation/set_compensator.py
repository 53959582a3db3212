"""Compensation of a set of instruments: their mounting and their common solution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import data as at
from piga._kernels.compensation.data import Samples
from piga._kernels.compensation.set import SetRows, SetState, empty_state
from piga._kernels.compensation.set import compensate_set as set_kernel
from piga._kernels.compensation.terms import SUMS
from piga.compensation.compensator import check_finite, find_begins
from piga.compensation.model import Limits, Phase, age_flag, make_model, velocity_variance
from piga.compensation.result import CompensatedSet, notes_on, notes_on_samples
from piga.errors import ArgumentError
from piga.records.arrays import empty
from piga.records.calibration.calibration import Calibration
from piga.results import Array, Result

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
    uncertainty, flags:
        Whether these columns are computed.
    details:
        Whether misfits and flags of each instrument are kept (needs ``flags``).
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
        flags: bool = True,
        details: bool = False,
        limits: Limits | None = None,
        max_age_days: float | None = None,
        step: float | None = None,
    ) -> None:
        self._axes = np.array([rotation(item.axes, i) for i, item in enumerate(instruments)])
        _check_spread(self._axes)
        self._sampled, self._uncertainty, self._flags = sampled, uncertainty, flags
        self._details = details and flags
        self._models = [
            make_model(
                item.calibration,
                segment=item.segment,
                phase=item.phase,
                limits=limits,
                typical=math.nan if step is None else step,
            )
            for item in instruments
        ]
        self._scale = np.array([[model.scale] for model in self._models])
        self._flag = reduce(or_, (age_flag(item.calibration, max_age_days) for item in instruments), 0)
        self._count, self._calibrations = len(instruments), [item.calibration for item in instruments]
        self.notes = notes_on(*self._calibrations)
        self._instruments = at.records(self._count, at.INSTRUMENT)
        for i, model in enumerate(self._models):
            self._instruments[i] = model.instrument[0]
        self._instruments["axes"] = self._axes
        self._threshold = _fault_threshold(self._count - 3)
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
        n, u, marks = t.size, t.size if self._uncertainty else 0, t.size if self._flags else 0
        details = (self._count, n if self._details else 0)
        return CompensatedSet(
            t, empty((n, 3)), empty((n, 3)), empty((u, 3)), empty(n), empty(marks, np.int32),
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
        temperature:
            [K], (N, n).
        begins:
            True where a stretch begins; None: where time goes back or leaves a gap, as for one instrument.
        into:
            Rows that exist, to write the result to (:meth:`empty_rows`).
        """
        time = np.atleast_1d(np.asarray(t, dtype=float))
        n, count = time.size, self._count
        psi = self._scale * _shaped("output", output, (count, n))
        if self._sampled != (rate is not None):
            raise ArgumentError(
                "rate: needed for a set that is sampled, and not allowed for a set of angles",
                remedy="give rate, and create the set with sampled=True",
            )
        rates = np.zeros((count, 0)) if rate is None else self._scale * _shaped("rate", rate, (count, n))
        omega = np.zeros((count, 0, 3)) if base_rate is None else _shaped("base_rate", base_rate, (count, n, 3))
        warm = np.zeros((count, 0)) if temperature is None else _shaped("temperature", temperature, (count, n))
        if any(model.needs_vibration for model in self._models):
            raise ArgumentError(
                "a calibration has the term k2v, and a set has no column of the vibration",
                remedy="calibrate without k2v, or compensate each instrument by itself",
            )
        if temperature is None and any(model.needs_temperature for model in self._models):
            raise ArgumentError(
                "temperature: missing, and a calibration has temperature terms",
                remedy="give the temperature [K] of each instrument, shape (N, n)",
            )
        marks = (
            find_begins(self._state.past[:1], time) if begins is None else np.asarray(begins, dtype=np.bool_)
        )
        result = self.empty_rows(time) if into is None else into
        before, sums = SetState(*(array.copy() for array in self._state)), self._sums.copy()
        unknown = np.zeros((count, 0))
        set_kernel(
            Samples(time, psi, rates, unknown, unknown, marks, omega, warm, unknown),
            self._instruments, self._flag, self._threshold, self._state,
            SetRows(result.f, result.dv, result.u_f, result.residual, result.flags, result.misfit, result.each, sums),
        )  # fmt: skip
        last = psi[:, -1:].sum() + (result.f if self._sampled else result.dv).sum()
        if not math.isfinite(last):
            self._state = before
            check_finite({"output": psi, "rate": rates, "base_rate": omega, "temperature": warm})
        self._sums = sums
        return result


def _fault_threshold(freedom: int) -> float:
    """Weighted sum of squares that a sound set exceeds with probability ``_FAULT_PROBABILITY``."""
    if freedom < 1:
        return math.inf
    from scipy.special import chdtri

    return float(chdtri(freedom, _FAULT_PROBABILITY))


def _shaped(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    array = np.ascontiguousarray(np.asarray(values, dtype=float))
    if array.ndim == len(shape) - 1:
        array = array[:, None]
    if array.shape != shape:
        raise ArgumentError(
            f"{name}: shape {np.shape(values)} instead of {shape}", remedy="one row per instrument"
        )
    return array
