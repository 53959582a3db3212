"""The published compensation of a set of instruments [Wei2024], for comparison with the exact one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.compensation.compensator import find_begins, init_state
from piga.compensation.model import FLAGS, make_model
from piga.compensation.result import CompensatedSet
from piga.compensation.sets.set_compensator import Mounted, check_count
from piga.results import Array


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

    Raises
    ------
    ArgumentError
        If there are fewer than three instruments.
    """

    def __init__(self, instruments: Sequence[Mounted], *, sampled: bool = False) -> None:
        check_count(len(instruments))
        self._axes = np.array([np.asarray(item.axes, dtype=float) for item in instruments])
        self._solve = np.linalg.pinv(self._axes[:, 0, :])
        self._models = [
            make_model(item.calibration, method="published", segment=item.segment, phase=item.phase)
            for item in instruments
        ]
        self._sampled = sampled
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
        """Compensate the next samples. Arguments as for :class:`piga.compensation.SetCompensator`."""
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
        self._clock["seen"], self._clock["t"] = 1.0, time[-1]
        self._last = time[-1:], psi[:, -1:], omega[:, -1:], force[-1:]
        return self._result(time, force, dv, step == 0.0)

    def _force(self, psi: Array, rate: Array, omega: Array) -> Array:
        """Force (n, 3) in the common frame from angles and rates (N, n)."""
        p = [model.instrument[0] for model in self._models]
        indicated = [(rate[i] + omega[i, :, 0]) / q["K"] - q["k0"] for i, q in enumerate(p)]
        first = self._combined(indicated)
        corrected = []
        for i, q in enumerate(p):
            y, z = (sum(self._axes[i, row, k] * first[k] for k in range(3)) for row in (1, 2))
            K, tangent = q["K"], q["tan_beta"]
            Y = tangent * (K * y - omega[i, :, 1]) + q["offset_y"]
            Z = tangent * (K * z - omega[i, :, 2]) + q["offset_z"]
            alpha = q["phi"] + psi[i]
            corrected.append(indicated[i] - (Y * np.sin(alpha) - Z * np.cos(alpha)) / K)
        return np.stack(self._combined(corrected), axis=1)

    def _combined(self, along: list[Array]) -> list[Array]:
        """Components in the common frame from components along the input axes, added one by one."""
        return [np.asarray(sum(self._solve[k, i] * a for i, a in enumerate(along))) for k in range(3)]

    def _result(self, t: Array, force: Array, dv: Array, none: NDArray[np.bool_]) -> CompensatedSet:
        flags = np.where(none, FLAGS["no_increment"], 0).astype(np.int32)
        return CompensatedSet(t, force, dv, np.zeros((0, 3)), np.full(t.size, np.nan), flags)
