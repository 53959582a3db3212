r"""Exact motion under recorded input: one instrument or a fleet.

Specific force is smooth or linear between sample times. Each step is the exponential of a matrix of sl(2, R) acting on the
half-angle pair; the Magnus expansion [Blanes2009] makes it fourth order for input that is linear between samples, and
exact where the ratio ``u_x : u_Y : u_Z`` is constant. Projective schemes of this kind: [Schiff1999]. Velocity
increments use the same expansion; a constant segment is one step whatever its length. Derived in docs/theory/motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from piga._kernels.jit import config
from piga._kernels.motion.samples import ROOM, MotionSamples, propagate_samples
from piga._kernels.motion.step import GOOD, TWO_PI_HIGH, TWO_PI_LOW, split_turns
from piga.errors import ArgumentError
from piga.instrument.constant_input import constant_motion, explain, float_array, require_finite, time_array
from piga.instrument.parameters import ErrorModel, Instrument
from piga.results import Array

Between = Literal["smooth", "linear"]
"""How force and base rate go between samples."""

_EMPTY = float_array("empty", np.empty(0))
_EMPTY_VECTORS = float_array("empty", np.empty((0, 3)))
_NO_OUTPUT = np.empty(0)


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


def _sampled_input(
    inst: Instrument,
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = None,
    error_model: ErrorModel | None = None,
    temperature: ArrayLike | None = None,
    between: Between = "linear",
) -> MotionSamples:
    """Check shapes and prepare the input of :func:`propagate`; nothing is copied that is float64, C-order."""
    if between not in ("smooth", "linear"):
        raise ArgumentError(f"between: {between!r} is not known", remedy="use 'smooth' or 'linear'")
    times = time_array("t", t)
    force = float_array("f", f, (times.size, 3))
    omega = _EMPTY_VECTORS
    if base_rate is not None:
        constant = np.shape(base_rate) == (3,)
        omega = float_array(
            "base_rate", np.broadcast_to(base_rate, force.shape) if constant else base_rate, force.shape
        )
    extra, extra_mean, offset_y, offset_z = _EMPTY, _EMPTY, 0.0, 0.0
    if error_model is not None:
        K = inst.scale_factor
        at_samples, mean = _error_rates(K, error_model, times, force, temperature)
        extra, extra_mean = float_array("error", at_samples), float_array("error", mean)
        offset_y, offset_z = K * error_model.s1, -K * error_model.c1
    if times.size == 1:
        for name, array in (("t", times), ("f", force), ("base_rate", omega)):
            require_finite(name, array)
    return MotionSamples(
        t=times,
        f=force,
        base_rate=omega,
        extra=extra,
        extra_mean=extra_mean,
        K=inst.scale_factor,
        tan_beta=inst.tan_beta,
        offset_y=offset_y,
        offset_z=offset_z,
        smooth=between == "smooth",
    )


def _run_samples(
    record: MotionSamples, alpha0: float, alpha: Array, rate: Array, names: tuple[str, str] = ("f", "base_rate")
) -> None:
    """Fill ``alpha`` and ``rate`` (each (n,) or empty). A fault of the input is named by the ``names`` of its arguments."""
    turns, rest = split_turns(alpha0)
    state = np.array([turns, math.sin(0.5 * rest), math.cos(0.5 * rest)])
    with np.errstate(all="ignore"):
        status = propagate_samples(state, alpha, rate, record, np.zeros(ROOM))
    if status != GOOD:
        explain(record.t, status, **dict(zip(names, (record.f, record.base_rate), strict=True)))
    alpha[:1] = alpha0


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
    record = _sampled_input(inst, t, f, base_rate, error_model, temperature, between)
    alpha = np.empty(record.t.size)
    rate = np.empty(record.t.size if with_rate else 0)
    _run_samples(record, inst.alpha0, alpha, rate)
    return (alpha, rate) if with_rate else alpha


def propagate_rate(
    inst: Instrument,
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = None,
    *,
    error_model: ErrorModel | None = None,
    temperature: ArrayLike | None = None,
    between: Between = "smooth",
) -> Array:
    """Rate of the outer gimbal [rad/s] at the sample times, shape (n,), without its angle.

    Arguments and errors as in :func:`propagate`. It is faster, because no angle is computed.
    """
    record = _sampled_input(inst, t, f, base_rate, error_model, temperature, between)
    rate = np.empty(record.t.size)
    _run_samples(record, inst.alpha0, _NO_OUTPUT, rate)
    return rate


def propagate_increments(
    inst: Instrument, t: ArrayLike, dv: ArrayLike, base_angle: ArrayLike | None = None
) -> Array:
    """Outer-gimbal angle from velocity increments of a counting or integrating reference.

    The result is exact where the direction of the specific force is constant. It is of fourth order in the interval
    where the force varies smoothly. The slope over an interval comes from the neighbouring increments. For force that
    jumps between intervals use :func:`propagate_segments`.

    Parameters
    ----------
    inst:
        The instrument; ``inst.alpha0`` is the angle at ``t[0]``.
    t:
        Interval limits [s], shape (n + 1,), increasing.
    dv:
        Integral of the specific force over each interval [m/s], base axes, shape (n, 3).
    base_angle:
        Integral of the base's inertial rate over each interval [rad], base axes, shape (n, 3).

    Returns
    -------
    alpha:
        Unwrapped angle at the interval limits [rad], shape (n + 1,).

    Raises
    ------
    ArgumentError
        If a shape does not fit, a value is not finite, or times do not increase; names the index.
    """
    times = time_array("t", t, least=2)
    force = float_array("dv", dv, (times.size - 1, 3))
    turning = _EMPTY_VECTORS if base_angle is None else float_array("base_angle", base_angle, force.shape)
    alpha = np.empty(times.size)
    steps = MotionSamples(
        times, force, turning, _EMPTY, _EMPTY, inst.scale_factor, inst.tan_beta, 0.0, 0.0, smooth=False
    )
    _run_samples(steps, inst.alpha0, alpha, _NO_OUTPUT, ("dv", "base_angle"))
    return alpha


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
    turns, rest, rate = constant_motion(inst, lengths, force, omega, onward=True)
    return turns * TWO_PI_HIGH + (turns * TWO_PI_LOW + rest), rate


def propagate_fleet(
    instruments: Instrument | Sequence[Instrument],
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = None,
    *,
    output: str = "angle",
    between: Between = "smooth",
) -> Array:
    """Angle or rate of many motions over the same times: the batch form of :func:`piga.propagate`.

    It computes many instruments with one input, one instrument with many inputs, or pairs. Row i is the
    result of :func:`piga.propagate` for motion i. The motions are shared among ``NUMBA_NUM_THREADS`` threads, by
    default one per core.

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
        raise ArgumentError(f"output: {output!r} is not 'angle' or 'rate'", remedy="use 'angle' or 'rate'")
    given = {"f": float_array("f", f)}
    given |= {} if base_rate is None else {"base_rate": float_array("base_rate", base_rate)}
    fleet = [instruments] if isinstance(instruments, Instrument) else list(instruments)
    counts = {} if isinstance(instruments, Instrument) else {"instruments": len(fleet)}
    counts |= {name: len(array) for name, array in given.items() if array.ndim == 3}
    m = max(counts.values(), default=1)
    if not fleet or any(count != m for count in counts.values()):
        raise ArgumentError(
            f"instruments and inputs: their numbers do not match: {counts}",
            remedy="give the same number of each, or one for all",
        )
    fleet = fleet * m if len(fleet) < m else fleet
    run = propagate if output == "angle" else propagate_rate

    def row(i: int) -> Array:
        own = {name: array[i] if array.ndim == 3 else array for name, array in given.items()}
        try:
            return run(fleet[i], t, own["f"], own.get("base_rate"), between=between)
        except ArgumentError as error:
            raise ArgumentError(f"motion {i}: {error.message}", remedy=error.remedy) from None

    with ThreadPoolExecutor(config.NUMBA_NUM_THREADS) as pool:
        return np.stack(list(pool.map(row, range(m))))
