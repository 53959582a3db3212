r"""Exact motion of the outer gimbal: under constant input, and under a recorded one.

**Constant input.** With ``a = u_x`` and ``b = tan(beta) sqrt(u_Y^2 + u_Z^2)`` [rad/s], ``u = K f - Omega``, the motion is
Adler's equation ``theta' = a + b sin(theta)`` [Adler1946], ``theta = alpha - gamma``. [Wei2024] and [Wei2020] tell its four
regimes apart by the signs of ``a`` and ``a^2 - b^2``. ``sqrt((|a| - b)(|a| + b))`` keeps the digits that
``sqrt(a^2 - b^2)`` loses near the separatrix. Mean rate, period, locking and dead zone take scalars or arrays that broadcast.

The motion is one expression for all regimes, without a branch or a pole. With ``A = u_x t``, ``Y = tan(beta) u_Y t``,
``Z = tan(beta) u_Z t`` and ``x = (Y^2 + Z^2 - A^2)/4``,

.. math::

   \alpha = \alpha_0 + 2\,\mathrm{atan2}\!\left(\tfrac{S}{2}(A + Y\sin\alpha_0 - Z\cos\alpha_0),\;
   C - \tfrac{S}{2}(Y\cos\alpha_0 + Z\sin\alpha_0)\right), \quad
   C = \cosh\sqrt{x},\; S = \frac{\sinh\sqrt{x}}{\sqrt{x}}

The rate is ``alpha'(0)`` over the squared length of the same pair, so a decaying rate keeps its digits.

**Recorded input** is smooth or linear between sample times. Each step is the exponential of a matrix of sl(2, R) acting on
the half-angle pair; the Magnus expansion [Blanes2009] makes it fourth order for input that is linear between samples, and
exact where the ratio ``u_x : u_Y : u_Z`` is constant. Projective schemes of this kind: [Schiff1999]. Derived in
docs/theory/motion.

Arrays from users are checked here: one clear message with the index of the fault. Values are checked for nan and infinity
only after a kernel has stopped. So a clean record is read once, and only the output needs memory of its size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from piga._kernels.jit import config
from piga._kernels.motion import (
    GOOD,
    ROOM,
    TWO_PI_HIGH,
    TWO_PI_LOW,
    MotionSamples,
    constant_motions,
    propagate_samples,
    split_turns,
)
from piga.errors import ArgumentError
from piga.instrument.parameters import ErrorModel, Instrument
from piga.results import Array

Regime = Literal["zero", "critical", "locked", "running"]
Between = Literal["smooth", "linear"]
"""How force and base rate go between samples."""

_ROUNDING = 2.0 * float(np.finfo(np.float64).eps)


def _base_rate(given: ArrayLike | None) -> Array:
    omega = np.zeros(3) if given is None else np.asarray(given, dtype=float)
    if omega.shape != (3,):
        raise ArgumentError(
            f"base_rate: shape {omega.shape} instead of (3,)",
            remedy="give three rates [rad/s] along X0, Y0 and Z0",
        )
    return omega


def regime(
    inst: Instrument, a_x: float, a_Y: float, a_Z: float, *, base_rate: ArrayLike | None = None
) -> Regime:
    """Regime of the motion under constant input: ``zero``, ``critical``, ``locked`` or ``running``.

    ``zero``: there is no input along the axis. ``locked``: the output rate decays to zero although there is input.
    ``running``: the gimbal revolves. ``critical``: the border between the last two. ``a`` and ``b`` are compared as
    float64 numbers. Critical means that they agree within the rounding of their products (4.4e-16 of ``b``). So a
    force of ``a_t * tan_beta`` is critical, and one that differs by 1e-15 is not.

    Parameters
    ----------
    inst:
        The instrument.
    a_x, a_Y, a_Z:
        Constant specific force in base axes [m/s^2].
    base_rate:
        Inertial rate of the base in base axes, shape (3,) [rad/s].

    Raises
    ------
    ArgumentError
        If a value is not finite.

    Examples
    --------
    >>> inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec")
    >>> regime(inst, a_x=9.8, a_Y=49.0, a_Z=0.0)
    'running'
    """
    a, b, _ = (float(value) for value in _adler(inst, a_x, a_Y, a_Z, base_rate))
    if a == 0.0:
        return "zero"
    b = abs(b)
    if base_rate is None:
        a, b = a_x, abs(inst.tan_beta) * math.hypot(a_Y, a_Z)
    gap = abs(a) - b
    if abs(gap) <= _ROUNDING * b:
        return "critical"
    return "running" if gap > 0.0 else "locked"


def _adler(
    inst: Instrument, a_x: ArrayLike, a_Y: ArrayLike, a_Z: ArrayLike, base_rate: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """``a``, signed ``b`` (sign of beta) [rad/s] and ``gamma`` [rad]."""
    try:
        forces = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (a_x, a_Y, a_Z)))
    except ValueError:
        raise ArgumentError(
            "a_x, a_Y, a_Z: shapes do not fit together", remedy="give numbers, or arrays of one shape [m/s^2]"
        ) from None
    omega = _base_rate(base_rate)
    for name, value in (("a_x", forces[0]), ("a_Y", forces[1]), ("a_Z", forces[2]), ("base_rate", omega)):
        if not np.isfinite(value).all():
            raise ArgumentError(f"{name}: holds a value that is not a finite number", remedy="leave it out")
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
    """Angles [rad] at which the locked gimbal rests: the stable and the unstable one, in [-pi, pi].

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


def constant_motion(
    inst: Instrument, t: ArrayLike, f: ArrayLike, base_rate: ArrayLike, *, onward: bool
) -> Array:
    """Rows turns, rest [rad] in [-pi, pi], rate [rad/s] (3, n) after times (n,) of constant input; ``onward``: one after the other.

    Turns and rest lose nothing after 1e9 revolutions, where one float64 resolves 1e-6 rad.
    """
    times, result = float_array("t", t), np.empty((3, np.size(t)))
    inputs = float_array("f", f), float_array("base_rate", base_rate)
    constant_motions(
        times, *inputs, inst.scale_factor, inst.tan_beta, *split_turns(inst.alpha0), onward, result
    )
    return result


def _angle_and_rate(motion: Array) -> tuple[Array, Array]:
    """Angle [rad] and rate [rad/s] of the rows of :func:`constant_motion`."""
    turns, rest, rate = motion
    return np.asarray(turns * TWO_PI_HIGH + (turns * TWO_PI_LOW + rest)), rate


def closed_form(
    inst: Instrument,
    t: ArrayLike,
    a_x: float,
    a_Y: float,
    a_Z: float,
    *,
    base_rate: ArrayLike | None = None,
) -> tuple[Array, Array]:
    """Angle and rate under constant input, in any regime and on its borders.

    Equation (4) of docs/theory/motion. The float64 inputs are taken as exact. The phase is computed in double-double.
    So the number of revolutions is exact, and no digits are lost near the separatrix.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t = 0``.
    t:
        Time since the start [s], scalar or any shape; negative times run backwards.
    a_x, a_Y, a_Z:
        Constant specific force in base axes [m/s^2].
    base_rate:
        Constant inertial rate of the base in base axes, shape (3,) [rad/s]; None: none.

    Returns
    -------
    alpha:
        Unwrapped outer-gimbal angle [rad], the shape of ``t``.
    rate:
        Its derivative [rad/s], the shape of ``t``.

    Raises
    ------
    ArgumentError
        If a value is not finite, or ``t`` is empty.

    Examples
    --------
    >>> inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0="45 deg")
    >>> alpha, rate = closed_form(inst, 10.0, 9.80665, 49.03325, 0.0)
    >>> round(float(alpha), 9), round(float(rate), 9)
    (9.707147027, 0.882399502)
    """
    times = np.asarray(t, dtype=float)
    if times.size == 0:
        raise ArgumentError("t: empty", remedy="give at least one time")
    require_finite("t", times.ravel())
    _adler(inst, a_x, a_Y, a_Z, base_rate)  # checks the values
    rows = constant_motion(inst, times.ravel(), [[a_x, a_Y, a_Z]], _base_rate(base_rate)[None], onward=False)
    return _angle_and_rate(rows.reshape((3, *times.shape)))


def propagate_segments(
    inst: Instrument, durations: ArrayLike, f: ArrayLike, base_rate: ArrayLike | None = None
) -> tuple[Array, Array]:
    """Outer-gimbal angle and rate at the ends of segments of constant specific force, any length each.

    Each segment is one closed-form step (see :func:`piga.closed_form`). A segment of hours takes as long to compute
    as one of milliseconds, and its revolutions are counted exactly.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at the start of the first segment.
    durations:
        Lengths of the segments [s], shape (n,), none negative.
    f:
        Specific force in each segment [m/s^2], base axes, shape (n, 3).
    base_rate:
        Inertial rate of the base in each segment [rad/s], base axes, shape (n, 3).

    Returns
    -------
    alpha, rate:
        Unwrapped angle [rad] and rate [rad/s] at the end of each segment, shape (n,) each.

    Raises
    ------
    ArgumentError
        If a shape does not fit, a value is not finite, or a duration is negative; names the index.
    """
    lengths = time_array("durations", durations)
    force = float_array("f", f, (lengths.size, 3))
    omega = np.zeros(force.shape) if base_rate is None else base_rate
    omega = float_array("base_rate", omega, force.shape)
    for name, array in (("durations", lengths), ("f", force), ("base_rate", omega)):
        require_finite(name, array)
    if lengths.min() < 0.0:
        k = int(np.argmax(lengths < 0.0))
        raise ArgumentError(
            f"durations: {lengths[k]} s at index {k} is negative", remedy="use durations of zero or more"
        )
    return _angle_and_rate(constant_motion(inst, lengths, force, omega, onward=True))


def _error_rates(
    K: float, model: ErrorModel, t: Array, f: Array, temperature: ArrayLike | None
) -> tuple[Array, Array]:
    """Error rate ``K e`` [rad/s] at the samples (n,), and the difference of its mean over a step from the trapezoid.

    Simpson's rule with the force halfway between samples: exact for the quadratic and cubic terms
    of a force that is linear between samples (but for ``k2o`` and ``k1a`` in a step where ``a_x`` changes sign).
    """
    if model.needs_temperature and temperature is None:
        raise ArgumentError(
            "temperature: missing although the error model has k0_T or k1_T",
            remedy="give the temperature [K] at each sample time",
        )
    kelvin = None if temperature is None else float_array("temperature", temperature, t.shape)
    if kelvin is not None:
        require_finite("temperature", kelvin)
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
    between: Between = ...,
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
    between: Between = ...,
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
    between: Between = "smooth",
) -> Array | tuple[Array, Array]:
    r"""Outer-gimbal angle under a recorded specific force, equation (2) of docs/theory/motion.

    .. math:: \alpha' = u_x + \tan\beta\,(u_Y\sin\alpha - u_Z\cos\alpha) + K e, \qquad u = K f - \Omega

    The result is of fourth order in the sample interval. It is exact where the direction of the input is constant.
    Revolutions are counted exactly, also in steps of many revolutions. No memory is needed besides input and output (an
    error model needs two vectors of the length of the record).

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t[0]``.
    t:
        Sample times [s], shape (n,), increasing, any spacing. The gimbal keeps turning in a gap.
        A compensation forms no increment across a gap. :func:`propagate_segments` starts a new segment.
    f:
        Specific force in base axes at the sample times [m/s^2], shape (n, 3).
    base_rate:
        Inertial rate of the base in base axes at the sample times [rad/s], shape (n, 3), or (3,) for
        a constant one. None: the base does not turn.
    with_rate:
        Return the rate as well.
    error_model:
        Errors of a real instrument; None: none.
    temperature:
        Temperature at the sample times [K], shape (n,); needed by ``k0_T`` and ``k1_T``.
    between:
        How force and base rate go between samples. ``"smooth"``: like the cubic through the four samples around an interval, as
        :func:`piga.calibrate` takes them. ``"linear"``: straight. The two differ by ``h^2/12`` of the second derivative.

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
    if between not in ("smooth", "linear"):
        raise ArgumentError(f"between: {between!r} is not known", remedy="use 'smooth' or 'linear'")
    times = time_array("t", t)
    force, K = float_array("f", f, (times.size, 3)), inst.scale_factor
    omega = float_array("base_rate", np.empty((0, 3)))
    if base_rate is not None:
        constant = np.shape(base_rate) == (3,)
        given = np.broadcast_to(base_rate, force.shape) if constant else base_rate
        omega = float_array("base_rate", given, force.shape)
    extra, extra_mean, offset_y, offset_z = np.empty(0), np.empty(0), 0.0, 0.0
    if error_model is not None:
        extra, extra_mean = _error_rates(K, error_model, times, force, temperature)
        offset_y, offset_z = K * error_model.s1, -K * error_model.c1
    errors = float_array("error", extra), float_array("error", extra_mean)
    smooth = between == "smooth"
    record = MotionSamples(times, force, omega, *errors, K, inst.tan_beta, offset_y, offset_z, smooth)
    if times.size == 1:
        for name, array in (("t", times), ("f", force), ("base_rate", omega)):
            require_finite(name, array)
    turns, rest = split_turns(inst.alpha0)
    state = np.array([turns, math.sin(0.5 * rest), math.cos(0.5 * rest)])
    alpha, rate = np.empty(times.size), np.empty(times.size if with_rate else 0)
    with np.errstate(all="ignore"):
        status = propagate_samples(state, alpha, rate, record, np.zeros(ROOM))
    if status != GOOD:
        require_finite("t", times)
        require_increasing("t", times)
        require_finite("f", force)
        require_finite("base_rate", omega)
        raise ArgumentError(
            f"f or base_rate: too large at index {status} or {status + 1}",
            remedy="specific force is in m/s^2, rates in rad/s",
        )
    alpha[0] = inst.alpha0
    return (alpha, rate) if with_rate else alpha


def propagate_fleet(
    instruments: Instrument | Sequence[Instrument],
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = None,
    *,
    output: Literal["angle", "rate"] = "angle",
    between: Between = "smooth",
) -> Array:
    """Angle or rate of many motions over the same times: row i is :func:`piga.propagate` for motion i.

    Many instruments with one input, one instrument with many inputs, or pairs. ``NUMBA_NUM_THREADS`` threads share the
    motions, by default one per core.

    Parameters
    ----------
    instruments:
        m instruments, or one for all inputs.
    t:
        Sample times [s], shape (n,), increasing; common to all.
    f:
        Specific force [m/s^2], base axes: shape (n, 3) for one input, (m, n, 3) for many.
    base_rate:
        Inertial rate of the base [rad/s], base axes: shape (3,), (n, 3) or (m, n, 3).
    output:
        ``"angle"`` [rad] or ``"rate"`` [rad/s].
    between:
        As in :func:`piga.propagate`.

    Returns
    -------
    result:
        Shape (m, n).

    Raises
    ------
    ArgumentError
        If the numbers of instruments and inputs differ, a shape does not fit, a value is not finite,
        or times do not increase; names the motion and the index.
    """
    if output not in ("angle", "rate"):
        raise ArgumentError(f"output: {output!r} is not known", remedy="use 'angle' or 'rate'")
    times, forces = time_array("t", t), float_array("f", f)
    rates = None if base_rate is None else float_array("base_rate", base_rate)
    fleet = [instruments] if isinstance(instruments, Instrument) else list(instruments)
    counts = {} if isinstance(instruments, Instrument) else {"instruments": len(fleet)}
    for name, array in (("f", forces), ("base_rate", rates)):
        counts |= {} if array is None or array.ndim < 3 else {name: len(array)}
    m = max(counts.values(), default=1)
    if m == 0 or any(count != m for count in counts.values()):
        raise ArgumentError(
            f"instruments and inputs: their numbers do not match: {counts}",
            remedy="give the same number of each, or one for all",
        )
    result = np.empty((m, times.size))

    def row(i: int) -> None:
        inst = fleet[i if len(fleet) > 1 else 0]
        force = forces if forces.ndim < 3 else forces[i]
        omega = rates if rates is None or rates.ndim < 3 else rates[i]
        try:
            if output == "angle":
                result[i] = propagate(inst, times, force, omega, between=between)
            else:
                result[i] = propagate(inst, times, force, omega, with_rate=True, between=between)[1]
        except ArgumentError as error:
            raise ArgumentError(f"motion {i}: {error.message}", remedy=error.remedy) from None

    with ThreadPoolExecutor(config.NUMBA_NUM_THREADS) as pool:
        list(pool.map(row, range(m)))
    return result


# -- arrays from users -------------------------------------------------------------------------------------


def float_array(name: str, values: ArrayLike, shape: tuple[int, ...] | None = None) -> Array:
    """``values`` as contiguous float64, a read-only view if they already are.

    Kernels are compiled for read-only input, so that any array finds the compiled code.
    """
    try:
        array = np.ascontiguousarray(values, dtype=np.float64).reshape(np.shape(values))
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"{name}: not an array of numbers ({error})", remedy="give numbers, or an array of them"
        ) from None
    if shape is not None and array.shape != shape:
        raise ArgumentError(
            f"{name}: shape {array.shape} instead of {shape}", remedy="give one row per sample time"
        )
    view = array.view()
    view.flags.writeable = False
    return view


def time_array(name: str, values: ArrayLike, least: int = 1) -> Array:
    """Times as a float64 vector of at least ``least`` entries; order is checked by the kernels."""
    times = float_array(name, values)
    if times.ndim != 1 or times.size < least:
        raise ArgumentError(
            f"{name}: shape {times.shape} instead of (n,) with n >= {least}", remedy="give one time per sample"
        )
    return times


def require_finite(name: str, array: Array) -> None:
    """Refuse a value that is not a finite number."""
    if np.isfinite(array).all():
        return
    index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
    at = index if len(index) > 1 else index[0]
    raise ArgumentError(
        f"{name}: {array[index]} at index {at} is not a finite number",
        remedy="repair or leave out the samples that are missing",
    )


def require_increasing(name: str, times: Array) -> None:
    """Refuse times that do not increase."""
    stuck = np.flatnonzero(~(np.diff(times) > 0.0))
    if stuck.size:
        k = int(stuck[0]) + 1
        raise ArgumentError(
            f"{name}: {times[k]} s at index {k} is not after {times[k - 1]} s at index {k - 1}",
            remedy="sort the samples by time and drop repeated ones",
        )
