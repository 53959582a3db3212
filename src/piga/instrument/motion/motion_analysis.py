r"""What a constant input does in the long run: mean rate, period, locking, dead zone, separatrix.

With ``a = u_x`` and ``b = tan(beta) sqrt(u_Y^2 + u_Z^2)`` [rad/s], ``u = K f - Omega``, the motion is
Adler's equation ``theta' = a + b sin(theta)`` [Adler1946], ``theta = alpha - gamma``. All functions take
scalars or arrays that broadcast. ``sqrt((|a| - b)(|a| + b))`` keeps the digits that ``sqrt(a^2 - b^2)``
loses near the separatrix.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError
from piga.instrument.parameters import Instrument

Array = NDArray[np.float64]


def _adler(
    inst: Instrument, a_x: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike, base_rate: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """``a``, signed ``b`` (sign of beta) [rad/s] and ``gamma`` [rad]."""
    try:
        forces = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (a_x, a_Y, a_Z)))
    except ValueError:
        raise ArgumentError("a_x, a_Y, a_Z: shapes do not fit together") from None
    omega = np.zeros(3) if base_rate is None else np.asarray(base_rate, dtype=float)
    if omega.shape != (3,):
        raise ArgumentError(f"base_rate: shape {omega.shape} instead of (3,)")
    for name, value in (("a_x", forces[0]), ("a_Y", forces[1]), ("a_Z", forces[2]), ("base_rate", omega)):
        if not np.isfinite(value).all():
            raise ArgumentError(f"{name}: holds a value that is not a finite number")
    K = inst.scale_factor
    u_x, u_Y, u_Z = (K * force - rate for force, rate in zip(forces, omega, strict=True))
    return u_x, np.asarray(inst.tan_beta * np.hypot(u_Y, u_Z)), np.asarray(np.arctan2(u_Z, u_Y))


def _signed_square(a: Array, b: Array) -> Array:
    """``a^2 - b^2`` without cancellation."""
    return np.asarray((np.abs(a) - np.abs(b)) * (np.abs(a) + np.abs(b)))


def mean_rate(
    inst: Instrument, a_x: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike, *, base_rate: ArrayLike | None = None
) -> Array:
    """Mean rate over whole revolutions [rad/s]: ``sign(a) sqrt(a^2 - b^2)``, and 0 when locked."""
    a, b, _ = _adler(inst, a_x, a_Y, a_Z, base_rate)
    return np.asarray(np.sign(a) * np.sqrt(np.maximum(_signed_square(a, b), 0.0)))


def revolution_period(
    inst: Instrument, a_x: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike, *, base_rate: ArrayLike | None = None
) -> Array:
    """Time of one revolution [s], ``2 pi / |mean rate|``; infinite when the gimbal does not revolve."""
    rate = np.abs(mean_rate(inst, a_x, a_Y, a_Z, base_rate=base_rate))
    with np.errstate(divide="ignore"):
        return np.asarray(2.0 * np.pi / rate)


def fixed_points(
    inst: Instrument, a_x: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike, *, base_rate: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Angles [rad] where the locked gimbal rests: the stable and the unstable one, in [-pi, pi].

    ``sin(alpha - gamma) = -a/b``; the rate falls with the angle at the stable one. On the separatrix they
    coincide; NaN where the gimbal revolves, or nothing acts on it.
    """
    a, b, gamma = _adler(inst, a_x, a_Y, a_Z, base_rate)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(-_signed_square(a, b))
        turned = np.where(b == 0.0, np.nan, np.sign(b))
        stable = np.arctan2(-a * turned, -root * turned) + gamma
        unstable = np.arctan2(-a * turned, root * turned) + gamma
    return _wrapped(stable), _wrapped(unstable)


def _wrapped(angle: Array) -> Array:
    return np.asarray(angle - 2.0 * np.pi * np.rint(angle / (2.0 * np.pi)))


def locking_time(
    inst: Instrument, a_x: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike, *, base_rate: ArrayLike | None = None
) -> Array:
    """Time constant [s] with which the rate decays near the stable point, ``1/sqrt(b^2 - a^2)``.

    Infinite on the separatrix, where the decay is algebraic; NaN where the gimbal revolves.
    """
    a, b, _ = _adler(inst, a_x, a_Y, a_Z, base_rate)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(1.0 / np.sqrt(-_signed_square(a, b)))


def dead_zone(
    inst: Instrument, a_Y: ArrayLike, a_Z: ArrayLike, *, base_rate: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Interval of ``a_x`` [m/s^2] in which the gimbal locks: lower and upper limit.

    ``Omega_x/K -+ b/K``; without base rate ``-+ a_t tan(beta)``.
    """
    a, b, _ = _adler(inst, 0.0, a_Y, a_Z, base_rate)
    K = inst.scale_factor
    return np.asarray((-a - np.abs(b)) / K), np.asarray((-a + np.abs(b)) / K)


def separatrix_distance(
    inst: Instrument, a_x: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike, *, base_rate: ArrayLike | None = None
) -> Array:
    """Input beyond the dead zone, ``(|a| - |b|)/K`` [m/s^2]: positive when running, negative when locked."""
    a, b, _ = _adler(inst, a_x, a_Y, a_Z, base_rate)
    return np.asarray((np.abs(a) - np.abs(b)) / inst.scale_factor)
