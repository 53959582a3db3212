"""Linear analysis of the twin's servo loop: poles, nutation, margins, bandwidth, responses (SciPy).

Small tilts about pick-off null, outer-gimbal rate small against the nutation (own derivation)::

    P(s) = beta/M = H / ((B s^2 + c s + k_r)(J_x s + c_x) + H^2 s)
    C(s) = k_p + k_i/s + k_d s,      loop L = C P
    closed loop: s ((B s^2 + c s + k_r)(J_x s + c_x) + H^2 s) + H (k_d s^2 + k_p s + k_i) = 0
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike, NDArray

from piga.errors import PigaError
from piga.instrument.twin.parameters import TwinParameters

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Polynomial = NDArray[np.floating]


class UnstableDesignError(PigaError):
    """The servo loop has a pole in the right half-plane."""


@dataclass(frozen=True)
class LoopAnalysis:
    """Linear figures of a design.

    ``poles`` [1/s] of the closed loop; ``nutation`` [rad/s] and ``nutation_damping`` [1] of the
    oscillating pole pair nearest ``H/sqrt(J_x B)`` (0 and 1 if it does not oscillate); ``gain_margin``
    [1], ``phase_margin`` [rad], ``crossover`` [rad/s] of the open loop; ``bandwidth`` [rad/s] where the
    response of the rate to specific force falls by 3 dB.
    """

    poles: Complex
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


def loop_poles(p: TwinParameters) -> Complex:
    """Poles of the closed loop [1/s] (the gimbal angle's own pole at zero left out)."""
    return np.asarray(poly.polyroots(poly.polytrim(_closed(p))), dtype=complex)


def open_loop(p: TwinParameters, frequency: ArrayLike) -> Complex:
    """Open-loop response ``C P`` at ``frequency`` [rad/s]."""
    from scipy import signal

    (plant_n, plant_d), (servo_n, servo_d) = _plant(p), _controller(p)
    numerator, denominator = poly.polymul(plant_n, servo_n), poly.polymul(plant_d, servo_d)
    _, response = signal.freqs(numerator[::-1], denominator[::-1], np.asarray(frequency, dtype=float))
    return np.asarray(response)


def tilt_compliance(p: TwinParameters, frequency: ArrayLike) -> Complex:
    """Closed-loop tilt per outer-axis torque [rad/(N m)] at ``frequency`` [rad/s]."""
    from scipy import signal

    numerator = poly.polymul(_plant(p)[0], _controller(p)[1])
    _, response = signal.freqs(numerator[::-1], _closed(p)[::-1], np.asarray(frequency, dtype=float))
    return np.asarray(response)


def tilt_transfer(p: TwinParameters) -> tuple[tuple[Polynomial, Polynomial], tuple[Polynomial, Polynomial]]:
    """Closed loop from outer-axis torque to tilt, and to ``(B s^2 + c s + k_r)`` times tilt.

    Numerator and denominator each, descending powers of s.
    """
    tilt, closed = poly.polymul(_plant(p)[0], _controller(p)[1]), _closed(p)
    inner = np.array([p.restoring, p.damping, p.float_inertia_y])
    return (tilt[::-1], closed[::-1]), (poly.polymul(inner, tilt)[::-1], closed[::-1])


def _rate_response(p: TwinParameters) -> tuple[Polynomial, Polynomial]:
    """``w/(K a_x)`` as numerator and denominator, descending powers of s."""
    servo_n, servo_d = _controller(p)
    H = p.angular_momentum
    numerator = H * poly.polyadd(poly.polymul([0.0, H], servo_d), servo_n)
    return numerator[::-1], _closed(p)[::-1]


def rate_response(p: TwinParameters, frequency: ArrayLike) -> Complex:
    """Response of the output rate to specific force, over ``K`` [1], at ``frequency`` [rad/s]."""
    from scipy import signal

    _, response = signal.freqs(*_rate_response(p), np.asarray(frequency, dtype=float))
    return np.asarray(response)


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


def analyse_loop(p: TwinParameters) -> LoopAnalysis:
    """Poles, nutation, margins and bandwidth of the design ``p``."""
    poles = loop_poles(p)
    oscillating = poles[poles.imag > 0.0]
    nutation, damping = 0.0, 1.0
    if oscillating.size:
        pole = oscillating[np.argmin(np.abs(np.abs(oscillating) - p.nutation))]
        nutation, damping = float(abs(pole)), float(-pole.real / abs(pole))
    gain_margin, phase_margin, crossover = _margins(p)
    return LoopAnalysis(poles, nutation, damping, gain_margin, phase_margin, crossover, _bandwidth(p))


def require_stable(p: TwinParameters) -> LoopAnalysis:
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
        remedy="lower the gains, raise the damping or rate gain, or force the run",
    )
