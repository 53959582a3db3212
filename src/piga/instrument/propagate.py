r"""Exact motion under recorded input: specific force samples, linear between sample times.

Each step is the exponential of a matrix of sl(2, R) acting on the half-angle pair; the Magnus
expansion [Blanes2009] makes it fourth order for input that is linear between samples, and exact
where the ratio ``u_x : u_Y : u_Z`` is constant. Projective schemes of this kind: [Schiff1999].
Derived in docs/theory/motion.
"""

from __future__ import annotations

from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga._kernels.motion import propagate_samples, split_turns
from piga.errors import ArgumentError
from piga.instrument.parameters import ErrorModel, Instrument

Array = NDArray[np.float64]
_EMPTY = np.empty(0)
_EMPTY_VECTORS = np.empty((0, 3))


def checked_times(t: ArrayLike) -> Array:
    """Sample times as a float64 array; they must be finite and increase.

    Raises
    ------
    ArgumentError
        Naming the first index at fault.
    """
    times = np.asarray(t, dtype=float)
    if times.ndim != 1 or times.size == 0:
        raise ArgumentError(
            f"t: shape {times.shape} instead of (n,) with n >= 1", remedy="give one time per sample"
        )
    if not np.isfinite(times).all():
        index = int(np.flatnonzero(~np.isfinite(times))[0])
        raise ArgumentError(f"t: {times[index]} at index {index} is not a finite number")
    steps = np.diff(times)
    if steps.size and not steps.min() > 0.0:
        index = int(np.flatnonzero(~(steps > 0.0))[0]) + 1
        raise ArgumentError(
            f"t: {times[index]} s at index {index} is not after {times[index - 1]} s at index {index - 1}",
            remedy="sort the samples by time and drop repeated ones",
        )
    return times


def checked_samples(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """``values`` as a float64 array of ``shape``, all finite.

    Raises
    ------
    ArgumentError
        Naming the shape met, or the first index at fault.
    """
    array = np.asarray(values, dtype=float)
    if array.shape != shape:
        raise ArgumentError(
            f"{name}: shape {array.shape} instead of {shape}", remedy="give one row per sample time"
        )
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ArgumentError(
            f"{name}: {array[index]} at index {index if len(index) > 1 else index[0]} is not a finite number",
            remedy="repair or leave out the samples that are missing",
        )
    return array


def _error_rates(
    K: float, model: ErrorModel, t: Array, f: Array, temperature: ArrayLike | None
) -> tuple[Array, Array]:
    """Error rate ``K e`` [rad/s] at the samples (n,), and what its mean over a step has beyond the trapezoid.

    Simpson's rule with the force halfway between samples: exact for the quadratic and cubic terms
    of a force that is linear between samples (but for ``k2o`` in a step where ``a_x`` changes sign).
    """
    if model.needs_temperature and temperature is None:
        raise ArgumentError(
            "temperature: missing although the error model has k0_T or k1_T",
            remedy="give the temperature [K] at each sample time",
        )
    kelvin = None if temperature is None else checked_samples("temperature", temperature, t.shape)
    at_samples = K * model.specific_force(t, f, kelvin)
    middle_kelvin = None if kelvin is None else 0.5 * (kelvin[1:] + kelvin[:-1])
    middle = K * model.specific_force(0.5 * (t[1:] + t[:-1]), 0.5 * (f[1:] + f[:-1]), middle_kelvin)
    return at_samples, (2.0 / 3.0) * (middle - 0.5 * (at_samples[1:] + at_samples[:-1]))


@overload
def propagate(
    inst: Instrument,
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = ...,
    with_rate: Literal[False] = ...,
    *,
    error_model: ErrorModel | None = ...,
    temperature: ArrayLike | None = ...,
) -> Array: ...


@overload
def propagate(
    inst: Instrument,
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = ...,
    *,
    with_rate: Literal[True],
    error_model: ErrorModel | None = ...,
    temperature: ArrayLike | None = ...,
) -> tuple[Array, Array]: ...


def propagate(
    inst: Instrument,
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = None,
    with_rate: bool = False,
    *,
    error_model: ErrorModel | None = None,
    temperature: ArrayLike | None = None,
) -> Array | tuple[Array, Array]:
    r"""Outer-gimbal angle under a recorded specific force, equation (2) of docs/theory/motion.

    .. math:: \alpha' = u_x + \tan\beta\,(u_Y\sin\alpha - u_Z\cos\alpha) + K e, \qquad u = K f - \Omega

    Fourth order in the sample interval for input that is linear between samples, exact where its
    direction is constant. Turns are counted exactly, also for steps of many revolutions.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t[0]``.
    t:
        Sample times [s], shape (n,), increasing, any spacing.
    f:
        Specific force in base axes at the sample times [m/s^2], shape (n, 3); linear between.
    base_rate:
        Inertial rate of the base in base axes at the sample times [rad/s], shape (n, 3), or (3,) for
        a constant one; linear between. None: the base does not turn.
    with_rate:
        Return the rate as well.
    error_model:
        Errors of a real instrument; None: none.
    temperature:
        Temperature at the sample times [K], shape (n,); needed by ``k0_T`` and ``k1_T``.

    Returns
    -------
    alpha:
        Unwrapped angle at the sample times [rad], shape (n,); ``alpha[0] = inst.alpha0``.
    rate:
        Only with ``with_rate``: its derivative at the sample times [rad/s], shape (n,).

    Raises
    ------
    ArgumentError
        If an input is empty, has another shape, is not finite, or times do not increase; the
        message names the index.

    Examples
    --------
    >>> import numpy as np
    >>> inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0="45 deg")
    >>> t = np.linspace(0.0, 10.0, 101)
    >>> alpha = propagate(inst, t, np.tile([9.80665, 49.03325, 0.0], (101, 1)))
    >>> round(float(alpha[-1]), 9)
    9.707147027
    """
    times = checked_times(t)
    force = checked_samples("f", f, (times.size, 3))
    omega = _EMPTY_VECTORS
    if base_rate is not None:
        given = np.asarray(base_rate, dtype=float)
        omega = np.broadcast_to(given, force.shape).copy() if given.shape == (3,) else given
        omega = checked_samples("base_rate", omega, force.shape)
    extra = extra_mean = _EMPTY
    offset_y = offset_z = 0.0
    if error_model is not None:
        K = inst.scale_factor
        extra, extra_mean = _error_rates(K, error_model, times, force, temperature)
        offset_y, offset_z = K * error_model.s1, -K * error_model.c1
    alpha = np.empty(times.size)
    rate = np.empty(times.size if with_rate else 0)
    propagate_samples(
        times, force, omega, extra, extra_mean,
        inst.scale_factor, inst.tan_beta, offset_y, offset_z,
        np.array(split_turns(inst.alpha0)), alpha, rate,
    )  # fmt: skip
    return (alpha, rate) if with_rate else alpha
