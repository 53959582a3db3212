"""The output angle from a recorded rate, and the phase of its zero, identified from a few revolutions at power-up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.compensation import layout as at
from piga._kernels.compensation.terms import SERVO, SERVO_DAMPING
from piga._kernels.estimation.noise import innovation_weights, whiten
from piga._kernels.estimation.regressors import coupling_columns
from piga.compensation.model import Model, Phase, make_model
from piga.errors import CalibrationError
from piga.records.calibration import Calibration
from piga.records.run import Run
from piga.records.spool import spans
from piga.results import Array


def integrated_rate(t: Array, rate: Array, begins: NDArray[np.bool_]) -> Array:
    """Angle [rad] from a rate: trapezoid with end correction; see :class:`RateAngle`."""
    follower = RateAngle()
    return np.concatenate((follower.push(t, rate, begins), follower.finish()))


class RateAngle:
    """Angle from a rate, chunk by chunk: trapezoid with end correction, slopes by central differences.

    The last sample is held back until the next one arrives. The result does not depend on the chunks, to the bit.
    """

    def __init__(self) -> None:
        self._t, self._rate, self._begins = np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.bool_)
        self._angle, self._slope = 0.0, 0.0
        self._given = False

    def push(self, t: Array, rate: Array, begins: NDArray[np.bool_]) -> Array:
        """Angles [rad] of the held-back sample and of all new samples but the last."""
        self._t, self._rate = np.concatenate((self._t, t)), np.concatenate((self._rate, rate))
        self._begins = np.concatenate((self._begins, begins))
        return self._go(self._t.size - 1)

    def finish(self) -> Array:
        """Angle of the held-back sample."""
        return self._go(self._t.size)

    def _go(self, stop: int) -> Array:
        """Angles of new samples up to ``stop``; the sample before ``stop`` is kept for the next slopes."""
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


@dataclass(frozen=True)
class PowerUpSettings:
    """Limits for a phase identified at power-up (own choices).

    Attributes
    ----------
    least_turn:
        Least turn of the output [rad] before a phase is given.
    servo_rounds:
        Iterations for the servo's stiffness. Each reduces the error of the phase by the ratio of stiffness to
        coupling, 1e-2 at most.
    useless:
        Largest standard uncertainty [rad] of a phase that is given.
    """

    least_turn: float = 2.0 * math.pi
    servo_rounds: int = 4
    useless: float = 0.5


POWER_UP = PowerUpSettings()


class PhaseFinder:
    """Find the phase online, chunk by chunk, while the instrument is at rest.

    The fit to the output angle has a constant rate, which takes up ``a_x``, bias and base rotation, and the two
    columns of the coupling, linear in ``cos(phi)`` and ``sin(phi)``. Increments are whitened with the noise levels of
    the calibration, so that the uncertainty is valid (docs/theory/compensation). The effect of the servo is known except
    for the phase: its damping is added to the columns of the coupling; its stiffness turns at twice the angle and is subtracted.

    Parameters
    ----------
    calibration:
        Provides the coupling ``K tan_beta``, first harmonics, servo terms and noise levels.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._model: Model = make_model(calibration, phase=Phase(0.0))
        p = self._model.parameters
        if self._model.tan_beta == 0.0 and p[at.P_OFFSET_Y] == 0.0 and p[at.P_OFFSET_Z] == 0.0:
            raise CalibrationError(
                "the calibration has no cross-coupling: there is no phase to find",
                remedy="leave --identify-phase out",
            )
        self._white, self._walk = max(float(p[at.P_WHITE]), 1e-24), float(p[at.P_WALK])
        self._normal = np.zeros((6, 6))
        self._whitener, self._variance = np.zeros(6), 0.0
        self._last: tuple[float, float, float, float] | None = None
        self._turned = 0.0

    def push(self, t: ArrayLike, output: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike) -> Phase | None:
        """Add samples: time [s], output angle psi [rad], transverse force [m/s^2], each (n,).

        Returns
        -------
        phase:
            The phase from all samples so far; None before one full revolution.
        """
        columns = [np.atleast_1d(np.asarray(c, dtype=float)) for c in (t, output, a_Y, a_Z)]
        if self._last is not None:
            columns = [np.concatenate(([before], c)) for before, c in zip(self._last, columns, strict=True)]
        time, psi, y, z = columns
        self._last = (float(time[-1]), float(psi[-1]), float(y[-1]), float(z[-1]))
        if time.size > 1:
            self._add(time, psi, y, z)
        return self.phase()

    def _add(self, t: Array, psi: Array, y: Array, z: Array) -> None:
        h, turn = np.diff(t), np.diff(psi)
        self._turned += float(np.abs(turn).sum())
        p = self._model.parameters
        coupling = p[at.P_K] * p[at.P_TAN_BETA]
        straight, spent = np.zeros(h.size), float(h.sum())
        v = float(turn.sum()) / (p[at.P_K] * spent) if spent > 0.0 else 0.0
        damping, stiffness = p[at.P_K] * p[SERVO_DAMPING] * v * v, p[at.P_K] * p[SERVO] * v
        rows, bows = np.empty((6, h.size)), np.zeros((2, h.size))
        rows[0], rows[5] = h, turn
        across = coupling * y + p[at.P_OFFSET_Y] - damping * z, coupling * z + p[at.P_OFFSET_Z] + damping * y
        coupling_columns(psi, *across, bows, h, straight, 1.0, rows[1:3])
        twice = stiffness * (y * y - z * z), stiffness * 2.0 * y * z
        coupling_columns(psi, *twice, bows, h, straight, 2.0, rows[3:5])
        carry, scale, white = np.empty(h.size), np.empty(h.size), np.empty_like(rows)
        self._variance = innovation_weights(h, self._white, self._walk, self._variance, carry, scale)
        whiten(rows, carry, scale, self._whitener, white)
        self._normal += white @ white.T

    def phase(self) -> Phase | None:
        """The phase from all samples so far; None before one full revolution."""
        if self._turned < POWER_UP.least_turn:
            return None
        # The rate column is h itself; the coupling columns carry K tan_beta a_t, so p and q are cos and sin.
        matrix = self._normal[:3, :3]
        size = np.sqrt(np.diag(matrix))
        if not size.min() > 0.0:
            return None
        covariance = np.linalg.inv(matrix / np.outer(size, size)) / np.outer(size, size)
        p, q = 1.0, 0.0
        for _ in range(POWER_UP.servo_rounds):  # cos and sin of twice the phase times what turns twice as fast
            twice = 2.0 * math.atan2(q, p)
            right = self._normal[:3] @ np.array([0, 0, 0, math.sin(twice), -math.cos(twice), 1.0])
            _, p, q = covariance @ right
        slope = np.array([0.0, -q, p]) / math.hypot(p, q)
        return Phase(math.atan2(q, p), float(np.sqrt(slope @ covariance @ slope)))


def identify_phase(record: Run, calibration: Calibration, duration: float) -> Phase:
    """Phase of a record from its first ``duration`` seconds, or until a new stretch begins. The instrument must be at rest.

    Raises
    ------
    CalibrationError
        If the output does not complete one turn in that time, or the coupling is too weak to determine the phase.
    """
    end = next((part.stop for part in spans(record.size) if record.t[part][-1] > record.t[0] + duration), 0)
    some = slice(0, end + 1 if end else record.size)
    t, output, begins = record.t[some], record.output[some], record.begins[some]
    y, z = record.f[some, 1], record.f[some, 2]
    rows = t <= t[0] + duration
    starts = np.flatnonzero(begins[1:]) + 1
    if starts.size:
        rows[starts[0] :] = False
    psi = integrated_rate(t, output, begins) if record.kind == "rate" else output
    finder = PhaseFinder(calibration)
    phase = finder.push(t[rows], psi[rows], y[rows], z[rows])
    if phase is None:
        raise CalibrationError(
            f"{record.source}: the output does not turn once in the first {duration:g} s",
            remedy="take a longer time at rest",
        )
    if not phase.std < POWER_UP.useless:
        raise CalibrationError(
            f"{record.source}: the phase is known to {phase.std:.2g} rad only after {duration:g} s",
            remedy="take a longer time at rest, or an attitude with more transverse specific force",
        )
    return phase
