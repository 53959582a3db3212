"""A stream of three or more instruments, solved together without any other reference."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import layout as at
from piga._kernels.compensation.set import SET_STATE, SET_WORK, SetModels, SetRows, SetSamples, SetWork
from piga._kernels.compensation.set import compensate_set as set_kernel
from piga.compensation.model import Model, make_model
from piga.compensation.mounting import Mounted, check_spread, rotation
from piga.compensation.result import CompensatedSet
from piga.compensation.step import find_begins
from piga.compensation.validity import Limits, age_flag
from piga.errors import ArgumentError

Array = NDArray[np.float64]

FAULT_PROBABILITY = 1e-6
"""Chance that the flag ``fault`` is raised in a row of a sound set."""


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
    details:
        Whether misfits and flags of the single instruments are kept (with ``flags`` only).
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
        details: bool = False,
        limits: Limits | None = None,
        max_age_days: float | None = None,
    ) -> None:
        self._axes = np.array([rotation(item.axes, i) for i, item in enumerate(instruments)])
        check_spread(self._axes)
        self._sampled, self._uncertainty, self._flags = sampled, uncertainty, flags
        self._details = details and flags
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
        self._arrays = stacked(models, self._axes)
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
            True where a stretch begins; None: where time jumps back or leaves a gap, as for one instrument.
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
        before = self._states.copy(), self._set_state.copy()
        marks = find_begins(self._states[0], time) if begins is None else np.asarray(begins, dtype=np.bool_)
        u = np.empty((n if self._uncertainty else 0, 3))
        found = CompensatedSet(
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
            SetRows(found.f, found.dv, found.u_f, found.residual, found.flags, found.misfit, found.each),
        )  # fmt: skip
        last = psi[:, -1:].sum() + (found.f if self._sampled else found.dv).sum()
        if not math.isfinite(last):
            self._states, self._set_state = before
            _check_finite(output=psi, rate=rates, base_rate=omega, temperature=warm)
        return found


def fault_threshold(freedom: int) -> float:
    """Weighted sum of squares that a sound set exceeds with ``FAULT_PROBABILITY``."""
    if freedom < 1:
        return math.inf
    from scipy.special import chdtri

    return float(chdtri(freedom, FAULT_PROBABILITY))


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


def stacked(models: list[Model], axes: Array) -> SetModels:
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
    return SetModels(
        np.array([model.parameters for model in models]), axes, np.array([model.has_terms for model in models]),
        orders, sines, cosines, codes, factors, np.array([model.limits for model in models]),
    )  # fmt: skip


def set_work(count: int) -> SetWork:
    """Scratch memory for ``count`` instruments."""
    w, weights = np.zeros((count, at.WORK)), np.ones((count, at.STRIDE))
    return SetWork(w, weights, np.zeros(SET_WORK), np.zeros(at.BLOCK, dtype=np.int32), np.zeros((3, at.STRIDE)))
