"""Linear analysis of the twin: poles, nutation, margins, responses (SciPy), and the effect of its tilt on the output.

Small tilts about pick-off null, outer-gimbal rate small against the nutation (own derivation)::

    P(s) = beta/M = H / ((B s^2 + c s + k_r)(J_x s + c_x) + H^2 s)
    C(s) = k_p + k_i/s + k_d s,      loop L = C P
    closed loop: s ((B s^2 + c s + k_r)(J_x s + c_x) + H^2 s) + H (k_d s^2 + k_p s + k_i) = 0

Beyond the quasi-steady model, to first order in the tilt (own derivation, docs/theory/twin.md): the torque on the outer axis,
``tau = H (u_Y cos(alpha) + u_Z sin(alpha))`` with ``u = K f - Omega``, ripples the tilt through the servo's compliance
``G(s)``. The tilt pulls the output rate directly, through damping and restoring torque about the inner axis, and
through the transverse input, which it rectifies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike, NDArray

from piga.errors import ArgumentError, PigaError
from piga.instrument.twin.parameters import TwinParameters
from piga.results import Array

_Complex = NDArray[np.complex128]
Polynomial = NDArray[np.floating]


class UnstableDesignError(PigaError):
    """The servo loop has a pole in the right half-plane."""


@dataclass(frozen=True)
class _LoopAnalysis:
    """Linear figures of a design.

    ``poles`` [1/s] of the closed loop; ``nutation`` [rad/s] and ``nutation_damping`` [1] of the
    oscillating pole pair nearest ``H/sqrt(J_x B)`` (0 and 1 if it does not oscillate); ``gain_margin``
    [1], ``phase_margin`` [rad], ``crossover`` [rad/s] of the open loop; ``bandwidth`` [rad/s] where the
    response of the rate to specific force falls by 3 dB.
    """

    poles: _Complex
    nutation: float
    nutation_damping: float
    gain_margin: float
    phase_margin: float
    crossover: float
    bandwidth: float

    @property
    def stable(self) -> bool:
        """Whether all poles lie in the left half-plane."""
        return bool(np.max(self.poles.real) < 0.0)


def _plant(p: TwinParameters) -> tuple[Polynomial, Polynomial]:
    """Numerator and denominator of beta/M, ascending powers of s."""
    inner = np.array([p.restoring, p.damping, p.float_inertia_y])
    denominator = poly.polyadd(poly.polymul(inner, [p.viscous_friction, p.J_x]), [0.0, p.angular_momentum**2])
    return np.array([p.angular_momentum]), denominator


def _controller(p: TwinParameters) -> tuple[Polynomial, Polynomial]:
    if p.integral_gain > 0.0:
        return np.array([p.integral_gain, p.proportional_gain, p.rate_gain]), np.array([0.0, 1.0])
    return np.array([p.proportional_gain, p.rate_gain]), np.array([1.0])


def _closed(p: TwinParameters) -> Polynomial:
    (plant_n, plant_d), (servo_n, servo_d) = _plant(p), _controller(p)
    return poly.polyadd(poly.polymul(plant_d, servo_d), poly.polymul(plant_n, servo_n))


def loop_poles(p: TwinParameters) -> _Complex:
    """Poles of the closed loop [1/s] (the gimbal angle's own pole at zero left out)."""
    return np.asarray(poly.polyroots(poly.polytrim(_closed(p))), dtype=complex)


def open_loop(p: TwinParameters, frequency: ArrayLike) -> _Complex:
    """Open-loop response ``C P`` at ``frequency`` [rad/s]."""
    (plant_n, plant_d), (servo_n, servo_d) = _plant(p), _controller(p)
    return _response(poly.polymul(plant_n, servo_n)[::-1], poly.polymul(plant_d, servo_d)[::-1], frequency)


def _response(numerator: Polynomial, denominator: Polynomial, frequency: ArrayLike) -> _Complex:
    """Response of polynomials in descending powers of s."""
    from scipy import signal

    _, response = signal.freqs(numerator, denominator, np.asarray(frequency, dtype=float))
    return np.asarray(response)


def tilt_compliance(p: TwinParameters, frequency: ArrayLike) -> _Complex:
    """Closed-loop tilt per outer-axis torque [rad/(N m)] at ``frequency`` [rad/s]."""
    return _response(poly.polymul(_plant(p)[0], _controller(p)[1])[::-1], _closed(p)[::-1], frequency)


def _rate_response(p: TwinParameters) -> tuple[Polynomial, Polynomial]:
    """``w/(K a_x)`` as numerator and denominator, descending powers of s."""
    servo_n, servo_d = _controller(p)
    H = p.angular_momentum
    numerator = H * poly.polyadd(poly.polymul([0.0, H], servo_d), servo_n)
    return numerator[::-1], _closed(p)[::-1]


def rate_response(p: TwinParameters, frequency: ArrayLike) -> _Complex:
    """Response of the output rate to specific force, over ``K`` [1], at ``frequency`` [rad/s]."""
    return _response(*_rate_response(p), frequency)


def step_response(p: TwinParameters, t: ArrayLike) -> Array:
    """Output rate over ``K a_x`` after a step of specific force at ``t = 0`` [1]."""
    from scipy import signal

    _, response = signal.step(signal.lti(*_rate_response(p)), T=np.asarray(t, dtype=float))
    return np.asarray(response, dtype=float)


def _grid(p: TwinParameters) -> Array:
    """Frequencies that span all poles of the loop [rad/s]."""
    sizes = np.abs(loop_poles(p))
    sizes = sizes[sizes > 0.0]
    return np.geomspace(1e-3 * sizes.min(), 1e2 * max(sizes.max(), p.nutation), 20001)


def _crossings(x: Array, y: Array) -> Array:
    """Places where ``y`` changes sign, by linear interpolation."""
    i = np.flatnonzero(np.signbit(y[:-1]) != np.signbit(y[1:]))
    return np.asarray(x[i] - y[i] * (x[i + 1] - x[i]) / (y[i + 1] - y[i]))


def _margins(p: TwinParameters) -> tuple[float, float, float]:
    """Gain margin, phase margin and gain crossover: the smallest over all crossings."""
    grid = _grid(p)
    response = open_loop(p, grid)
    log_grid = np.log(grid)
    crossover = np.exp(_crossings(log_grid, np.log(np.abs(response))))
    wrapped = np.abs(np.angle(-open_loop(p, crossover))) if crossover.size else np.array([])
    index = int(np.argmin(wrapped)) if wrapped.size else 0
    imaginary = _crossings(log_grid, response.imag)
    at_half_turn = open_loop(p, np.exp(imaginary)).real if imaginary.size else np.array([])
    gains = -1.0 / at_half_turn[at_half_turn < 0.0] if imaginary.size else np.array([])
    above = gains[gains > 1.0]
    gain_margin = float(above.min()) if above.size else math.inf
    if not wrapped.size:
        return gain_margin, math.inf, 0.0
    return gain_margin, float(wrapped[index]), float(crossover[index])


def _bandwidth(p: TwinParameters) -> float:
    grid = _grid(p)
    places = _crossings(np.log(grid), np.abs(rate_response(p, grid)) - math.sqrt(0.5))
    return float(np.exp(places[0])) if places.size else math.inf


def analyse_loop(p: TwinParameters) -> _LoopAnalysis:
    """Poles, nutation, margins and bandwidth of the design ``p``."""
    poles = loop_poles(p)
    oscillating = poles[poles.imag > 0.0]
    nutation, damping = 0.0, 1.0
    if oscillating.size:
        pole = oscillating[np.argmin(np.abs(np.abs(oscillating) - p.nutation))]
        nutation, damping = float(abs(pole)), float(-pole.real / abs(pole))
    gain_margin, phase_margin, crossover = _margins(p)
    return _LoopAnalysis(poles, nutation, damping, gain_margin, phase_margin, crossover, _bandwidth(p))


def require_stable(p: TwinParameters) -> _LoopAnalysis:
    """Analysis of a stable design.

    Raises
    ------
    UnstableDesignError
        If a pole lies in the right half-plane; the message names it and the gain to change.
    """
    analysis = analyse_loop(p)
    if analysis.stable:
        return analysis
    worst = analysis.poles[int(np.argmax(analysis.poles.real))]
    oscillates = f", oscillating at {abs(worst.imag) / (2 * math.pi):.4g} Hz" if worst.imag else ""
    raise UnstableDesignError(
        f"the servo loop is unstable: closed-loop pole {worst:.4g} 1/s{oscillates} (nutation "
        f"{p.nutation / (2 * math.pi):.4g} Hz, k_p = {p.proportional_gain:g}, k_i = {p.integral_gain:g}, "
        f"c = {p.damping:g})",
        remedy="lower the gains, or raise the damping or the rate gain; --unstable simulates it all the same",
    )


_INTEGRATES = "give a positive integral gain: the servo terms are those of a servo that integrates"


@dataclass(frozen=True)
class ServoParameters:
    """Parameters of the servo terms, SI units. Symbols as in :class:`~piga.instrument.twin.parameters.TwinParameters`.

    ``scale_factor`` K [(rad/s)/(m/s^2)], ``pendulosity`` ml [kg m], ``integral_gain`` k_i [N m/(rad s)],
    ``proportional_gain`` k_p [N m/rad], ``rate_gain`` k_d [N m s/rad], ``damping`` c of the float [N m s/rad].

    Raises
    ------
    ArgumentError
        If K, ml or k_i is not positive, or another one is negative; names the parameter.
    """

    scale_factor: float
    pendulosity: float
    integral_gain: float
    proportional_gain: float = 0.0
    rate_gain: float = 0.0
    damping: float = 0.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value, least = getattr(self, entry.name), "positive" if entry.default != 0.0 else "zero or more"
            if not (value > 0.0 or (value == 0.0 and least != "positive")) or not math.isfinite(value):
                remedy = "correct the value" if "integral" not in entry.name else _INTEGRATES
                raise ArgumentError(f"servo {entry.name} = {value:g}: must be {least}", remedy=remedy)

    @classmethod
    def of_twin(cls, p: TwinParameters) -> ServoParameters:
        """The servo parameters of a twin."""
        return cls(p.K, p.pendulosity, p.integral_gain, p.proportional_gain, p.rate_gain, p.damping)


class ServoTerms(NamedTuple):
    """Coefficients of the terms ``servo`` and ``servo_damping``, both in 1/(m/s^2)^2."""

    servo: float
    servo_damping: float


def servo_terms(p: TwinParameters | ServoParameters, *, rate: float = 0.0) -> ServoTerms:
    r"""Predict the terms ``servo`` (s) and ``servo_damping`` (d) from the parameters of the servo.

    .. math::

       s = \frac{K\,ml}{2 k_i}, \qquad d = \frac{c K^2}{k_i}

    Parameters
    ----------
    p:
        A twin, or the numbers alone.
    rate:
        Output rate [rad/s] at which the terms are taken: both are multiplied by ``k_i Im G(jw)/w``, which is
        1 at rate zero, ``G = 1/(k_i/(jw) + k_p + (k_d + ml/K) jw)``.

    Notes
    -----
    Derivation and terms of the next order: theory page "The servo in the model".
    """
    q = ServoParameters.of_twin(p) if isinstance(p, TwinParameters) else p
    stiffness = q.integral_gain - (q.rate_gain + q.pendulosity / q.scale_factor) * rate**2
    compliance = stiffness / (stiffness**2 + (q.proportional_gain * rate) ** 2)
    return ServoTerms(
        0.5 * q.scale_factor * q.pendulosity * compliance, q.damping * q.scale_factor**2 * compliance
    )


def servo_force(
    servo: float, servo_damping: float, K: float, alpha: Array, f: Array, base_rate: Array
) -> Array:
    """Specific force [m/s^2] that the terms ``servo`` and ``servo_damping`` add to the indicated one, (n,).

    With ``u = K f - Omega``:
    ``-2 s (u_x/K) ((u_Y sin(alpha) - u_Z cos(alpha))/K)^2 - d (u_x/K)^2 (u_Y cos(alpha) + u_Z sin(alpha))/K``.

    Parameters
    ----------
    servo, servo_damping:
        The coefficients s and d [1/(m/s^2)^2].
    K:
        Scale factor [(rad/s)/(m/s^2)].
    alpha:
        Gimbal angle [rad], (n,).
    f, base_rate:
        Specific force [m/s^2] and inertial base rate [rad/s] in base axes, (n, 3).
    """
    x, y, z = (f - base_rate / K).T
    sine, cosine = np.sin(alpha), np.cos(alpha)
    return np.asarray(
        -2.0 * servo * x * (y * sine - z * cosine) ** 2 - servo_damping * x**2 * (y * cosine + z * sine)
    )


def predicted_rectification(p: TwinParameters, a_t: float, rate: float) -> float:
    """Shift of the mean output rate by finite servo stiffness [rad/s].

    ``-K a_t^2 ml Im G(j w)/2``. For strong integral action ``G = j w/k_i``: the theory page's
    ``-K a_t^2 ml w/(2 k_i)``.
    """
    compliance = tilt_compliance(p, [abs(rate)])[0]
    return float(-0.5 * p.K * a_t**2 * p.pendulosity * compliance.imag * np.sign(rate))


def predicted_second_harmonic(p: TwinParameters, a_t: float, rate: float) -> float:
    """Amplitude of the rate at twice the gimbal angle, by finite servo stiffness [rad/s]."""
    return float(0.5 * p.K * a_t**2 * p.pendulosity * abs(tilt_compliance(p, [abs(rate)])[0]))


def predicted_k2(p: TwinParameters) -> float:
    """Coefficient k2 [1/(m/s^2)] from the float's inertia: ``(D - (C - A) beta) K^2/ml`` to first order.

    The product of inertia ``D`` gives a centrifugal torque ``D w^2`` about the inner axis; with a tilt, unequal
    inertias are a product of inertia about the outer axis. In g/g^2 it is the theory page's ``D K^2 g/ml``.
    """
    twice = 2.0 * p.pick_off_null
    unequal = 0.5 * (p.float_inertia_x - p.float_inertia_z) * math.sin(twice)
    return (p.product_of_inertia * math.cos(twice) + unequal) * p.K**2 / p.pendulosity
