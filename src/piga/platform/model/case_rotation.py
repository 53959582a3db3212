"""Case-rotation schedules: the case angle against time, steady or with reversal, and what it averages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.platform.model.scenario import Gyro, Rotation

Array = NDArray[np.float64]


def encoder_angle(rotation: Rotation, times: ArrayLike) -> Array:
    """Angle of the case encoder [rad] at ``times`` [s]: ``rate t``, folded back every ``turns`` turns."""
    angle = rotation.rate * np.asarray(times, dtype=float)
    if rotation.turns <= 0:
        return angle
    span = 2.0 * np.pi * rotation.turns
    within = np.mod(angle, 2.0 * span)
    return np.where(within <= span, within, 2.0 * span - within)


def phasor(rotation: Rotation, times: ArrayLike) -> Array:
    """Cosine and sine of the encoder angle, shape (n, 2)."""
    angle = encoder_angle(rotation, times)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def apparent_gyro(gyro: Gyro, rotation: Rotation) -> Gyro:
    """The gyro as identification sees it: a case-fixed drift looks like misalignment under steady rotation.

    Drift ``w`` in case axes [rad/s] drives the momentum round a circle, ``w exp(ic) / (i rate)``, which
    turns with the case as the misalignment ``m exp(ic)`` does: only ``m - i w / rate`` shows, and only
    that has to be compensated. Reversal would tell them apart. Own derivation, docs/platform.md section 4.
    """
    if rotation.rate == 0.0 or rotation.turns > 0 or not any(gyro.case_drift):
        return gyro
    seen = complex(gyro.misalignment, 0.0) - 1j * complex(*gyro.case_drift) / rotation.rate
    return replace(gyro, misalignment=abs(seen), phase=gyro.phase + float(np.angle(seen)))


def averaged_drift(rotation: Rotation, case_drift: tuple[float, float], duration: float) -> float:
    """Largest angle [rad] by which a case-fixed drift [rad/s] turns the momentum over ``duration`` [s].

    At rest ``w t``; turning steadily ``2 w / rate`` (the momentum runs round a small circle); with
    reversal the tip comes back to the start after every full turn, so the bound is the same.
    Own derivation, docs/platform.md section 4.
    """
    drift = float(np.hypot(*case_drift))
    if rotation.rate == 0.0:
        return drift * duration
    return drift * min(duration, 2.0 / rotation.rate)
