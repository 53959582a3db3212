"""The phase of the output zero, identified from a few revolutions at power-up."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from piga._kernels.estimation import coupling_columns, innovation_weights, whiten
from piga.compensation.model import Phase, make_model
from piga.errors import CalibrationError
from piga.records.arrays import integrated_rate
from piga.records.calibration.calibration import Calibration
from piga.records.run import Run
from piga.results import Array

_LEAST_TURN = 2.0 * math.pi
"""Least turn of the output [rad] before a phase is given (own choice, like the next two)."""
_SERVO_ROUNDS = 4
"""Iterations for the servo's stiffness. Each reduces the error of the phase by the ratio of stiffness to coupling, 1e-2 at most."""
_USELESS = 0.5
"""Largest standard uncertainty [rad] of a phase that is given."""


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
        calibration.require_gimbal("the phase at power-up")
        p = self._instrument = make_model(calibration, phase=Phase(0.0)).instrument[0]
        if p["tan_beta"] == 0.0 and p["offset_y"] == 0.0 and p["offset_z"] == 0.0:
            raise CalibrationError(
                "the calibration has no cross-coupling: there is no phase to find",
                remedy="leave --identify-phase out",
            )
        self._white, self._walk = max(float(p["white"]), 1e-24), float(p["walk"])
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
        p, K = self._instrument, float(self._instrument["K"])
        coupling = K * p["tan_beta"]
        straight, spent = np.zeros(h.size), float(h.sum())
        v = float(turn.sum()) / (K * spent) if spent > 0.0 else 0.0
        damping, stiffness = K * p["servo_damping"] * v * v, K * p["servo"] * v
        rows, bows = np.empty((6, h.size)), np.zeros((2, h.size))
        rows[0], rows[5] = h, turn
        across = coupling * y + p["offset_y"] - damping * z, coupling * z + p["offset_z"] + damping * y
        coupling_columns(psi, *across, bows, h, straight, 1.0, rows[1:3])
        twice = stiffness * (y * y - z * z), stiffness * 2.0 * y * z
        coupling_columns(psi, *twice, bows, h, straight, 2.0, rows[3:5])
        carry, scale, white = np.empty(h.size), np.empty(h.size), np.empty_like(rows)
        self._variance = innovation_weights(h, self._white, self._walk, self._variance, carry, scale)
        whiten(rows, carry, scale, self._whitener, white)
        self._normal += white @ white.T

    def phase(self) -> Phase | None:
        """The phase from all samples so far; None before one full revolution."""
        if self._turned < _LEAST_TURN:
            return None
        # The rate column is h itself; the coupling columns contain the factor K tan_beta a_t, so p and q are cos and sin.
        matrix = self._normal[:3, :3]
        size = np.sqrt(np.diag(matrix))
        if not size.min() > 0.0:
            return None
        covariance = np.linalg.inv(matrix / np.outer(size, size)) / np.outer(size, size)
        p, q = 1.0, 0.0
        for _ in range(_SERVO_ROUNDS):  # cos and sin of twice the phase times what turns twice as fast
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
    later = record.t > record.t[0] + duration
    some = slice(0, int(np.argmax(later)) + 1 if later.any() else record.size)
    t, output, begins = record.t[some], record.output[some], record.begins[some]
    y, z = record.f[some, 1], record.f[some, 2]
    rows = t <= t[0] + duration
    starts = np.flatnonzero(begins[1:]) + 1
    if starts.size:
        rows[starts[0] :] = False
    psi = integrated_rate(t, output, begins) if record.kind == "rate" else output
    finder = PhaseFinder(calibration)
    if not (y[rows].any() or z[rows].any()):
        raise CalibrationError(
            f"{record.source}: no transverse specific force in the first {duration:g} s",
            remedy="rest in a position with a_Y or a_Z; without them the coupling is zero",
        )
    phase = finder.push(t[rows], psi[rows], y[rows], z[rows])
    if phase is None:
        raise CalibrationError(
            f"{record.source}: the output does not turn once in the first {duration:g} s",
            remedy="take a longer time at rest",
        )
    if not phase.std < _USELESS:
        raise CalibrationError(
            f"{record.source}: the phase is known to {phase.std:.2g} rad only after {duration:g} s",
            remedy="take a longer time at rest, or an attitude with more transverse specific force",
        )
    return phase
