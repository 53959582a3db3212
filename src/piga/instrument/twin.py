"""The servo twin: a PIGA whose float, gimbal and servo move as rigid bodies.

Its parameters have symbol, unit, plausible range and meaning. The presets are examples for study. They describe no real
instrument.

**Linear analysis.** Small tilts about pick-off null, outer-gimbal rate small against the nutation (own derivation)::

    P(s) = beta/M = H / ((B s^2 + c s + k_r)(J_x s + c_x) + H^2 s)
    C(s) = k_p + k_i/s + k_d s,      loop L = C P
    closed loop: s ((B s^2 + c s + k_r)(J_x s + c_x) + H^2 s) + H (k_d s^2 + k_p s + k_i) = 0

Beyond the quasi-steady model, to first order in the tilt (own derivation, docs/theory/twin.md): the torque on the outer axis,
``tau = H (u_Y cos(alpha) + u_Z sin(alpha))`` with ``u = K f - Omega``, ripples the tilt through the servo's compliance.
The tilt pulls the output rate directly, through damping and restoring torque about the inner axis, and through the transverse
input, which it rectifies.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.polynomial import polynomial as poly
from numpy.typing import ArrayLike, NDArray

from piga._kernels import servo
from piga._kernels.servo import ServoConstants
from piga.errors import ArgumentError, PigaError
from piga.instrument.motion import float_array, require_finite, require_increasing, time_array
from piga.results import Array, Result
from piga.units import G0, to_si

_INF = math.inf
Start = Literal["slow-manifold", "transient"]
_ACCURACY = 1e-12
"""Local error per step in alpha and beta [rad]."""
_Complex = NDArray[np.complex128]
Polynomial = NDArray[np.floating]


def _entry(default: float, symbol: str, unit: str, low: float, high: float, meaning: str) -> Any:
    metadata = {"symbol": symbol, "unit": unit, "range": (low, high), "meaning": meaning}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class TwinParameters:
    """Rotor, float, gimbal, pick-off, servo and torque motor of a PIGA, SI units.

    Each field's ``metadata`` holds symbol, unit, plausible range and meaning. The inertias are
    those about the pivot, pendulous mass included; rotor spin is in ``angular_momentum`` only.
    Construction refuses values outside the plausible range.
    """

    angular_momentum: float = _entry(0.1, "H", "kg m^2/s", 1e-3, 10, "rotor angular momentum")
    pendulosity: float = _entry(0.1 * 0.8884 / G0, "ml", "kg m", 1e-5, 1, "pendulosity of the float")
    outer_inertia: float = _entry(5e-5, "J_o", "kg m^2", 1e-7, 1, "outer gimbal inertia")
    float_inertia_x: float = _entry(5e-5, "A", "kg m^2", 1e-7, 1, "float about its x axis (input side)")
    float_inertia_y: float = _entry(5e-5, "B", "kg m^2", 1e-7, 1, "float about the inner-gimbal axis")
    float_inertia_z: float = _entry(
        5e-5, "C", "kg m^2", 1e-7, 1, "float about the rotor axis, without the rotor's spin"
    )
    product_of_inertia: float = _entry(
        0.0, "D", "kg m^2", -1e-2, 1e-2, "integral of x z dm over the float: the origin of k2"
    )
    damping: float = _entry(0.05, "c", "Nm s/rad", 0, 100, "damping of the float about the inner axis")
    restoring: float = _entry(0.0, "k_r", "Nm/rad", 0, 100, "elastic restoring torque about the inner axis")
    restoring_zero: float = _entry(
        0.0, "beta_r", "rad", -0.1, 0.1, "tilt at which the restoring torque vanishes"
    )
    viscous_friction: float = _entry(0.0, "c_x", "Nm s/rad", 0, 100, "viscous friction on the outer axis")
    coulomb_friction: float = _entry(0.0, "M_c", "Nm", 0, 10, "Coulomb friction on the outer axis")
    coulomb_rate: float = _entry(
        1e-3, "w_c", "rad/s", 1e-6, 1, "rate over which Coulomb friction changes sign: -M_c tanh(w/w_c)"
    )
    proportional_gain: float = _entry(30.0, "k_p", "Nm/rad", 0, 1e6, "servo gain on the pick-off")
    integral_gain: float = _entry(600.0, "k_i", "Nm/(rad s)", 0, 1e8, "servo gain on its integral")
    rate_gain: float = _entry(0.0, "k_d", "Nm s/rad", 0, 1e4, "servo gain on the tilt rate")
    pick_off_null: float = _entry(
        0.0, "beta_null", "rad", -0.1, 0.1, "tilt that the pick-off calls null: becomes beta"
    )
    pick_off_range: float = _entry(_INF, "e_max", "rad", 1e-6, _INF, "largest pick-off signal")
    torque_limit: float = _entry(_INF, "M_max", "Nm", 1e-9, _INF, "saturation of the torque motor")
    stop_angle: float = _entry(0.05, "beta_stop", "rad", 1e-4, 0.5, "tilt at which the float meets its stops")
    stop_stiffness: float = _entry(200.0, "k_stop", "Nm/rad", 0, 1e6, "stiffness of the stops")
    stop_damping: float = _entry(
        0.1, "c_stop", "s/rad", 0, 100, "relative rise of the stops' stiffness per tilt rate going in"
    )
    outer_torque: float = _entry(0.0, "M_x", "Nm", -10, 10, "constant torque on the outer axis")
    inner_torque: float = _entry(
        0.0, "M_y", "Nm", -10, 10, "constant torque on the inner axis: a bias of -M_y/ml"
    )
    pick_off_noise: float = _entry(0.0, "S_e", "rad sqrt(s)", 0, 1e-2, "one-sided pick-off noise density")
    torque_noise: float = _entry(0.0, "S_M", "Nm sqrt(s)", 0, 1, "one-sided noise density of the outer torque")
    hunting: float = _entry(0.0, "h_w", "1", 0, 0.1, "relative amplitude of wheel-speed hunting")
    hunting_frequency: float = _entry(1.0, "f_w", "Hz", 1e-4, 100, "frequency of wheel-speed hunting")
    hunting_phase: float = _entry(0.0, "phi_w", "rad", -7, 7, "phase of wheel-speed hunting at t = 0")
    spin_start: float = _entry(1.0, "s_0", "1", 0.05, 1.0, "wheel speed at t = 0 over its final value")
    spin_time: float = _entry(30.0, "t_s", "s", 1e-2, 1e5, "time constant of spin-up")
    alpha0: float = _entry(0.0, "alpha_0", "rad", -1e6, 1e6, "outer-gimbal angle at t = 0")

    def __post_init__(self) -> None:
        for entry in fields(self):
            value, (low, high) = getattr(self, entry.name), entry.metadata["range"]
            if not low <= value <= high:
                raise ArgumentError(
                    f"twin parameter {entry.name} ({entry.metadata['symbol']}) = {value:g} "
                    f"{entry.metadata['unit']} is outside its plausible range {low:g} to {high:g}",
                    remedy="check the value and its unit",
                )
        if self.float_inertia_x * self.float_inertia_z <= self.product_of_inertia**2:
            raise ArgumentError(
                "twin parameter product_of_inertia: D^2 must be smaller than A C",
                remedy="use a smaller product of inertia, or larger moments A and C",
            )

    @property
    def K(self) -> float:
        """Scale factor ``ml/H`` [(rad/s)/(m/s^2)]."""
        return self.pendulosity / self.angular_momentum

    @property
    def J_x(self) -> float:
        """Inertia about the outer axis at zero tilt, ``J_o + A`` [kg m^2]."""
        return self.outer_inertia + self.float_inertia_x

    @property
    def nutation(self) -> float:
        """Undamped nutation ``H/sqrt(J_x B)`` [rad/s]."""
        return self.angular_momentum / math.sqrt(self.J_x * self.float_inertia_y)

    def constants(self) -> ServoConstants:
        """The numbers that the kernel takes, by their symbols."""
        values = {entry.metadata["symbol"]: getattr(self, entry.name) for entry in fields(self)}
        return ServoConstants(**{symbol: values[symbol] for symbol in ServoConstants._fields})

    def with_scale_factor(self, K: float) -> TwinParameters:
        """The design with its pendulosity changed to give scale factor ``K``."""
        return replace(self, pendulosity=K * self.angular_momentum)


PRESETS: Mapping[str, TwinParameters] = {
    "example": TwinParameters(),
    "example-floated": TwinParameters(
        angular_momentum=0.2,
        pendulosity=0.2 * 0.6 / G0,
        outer_inertia=4e-4,
        float_inertia_x=1.2e-4,
        float_inertia_y=1.0e-4,
        float_inertia_z=1.1e-4,
        damping=0.3,
        restoring=1e-3,
        viscous_friction=1e-3,
        proportional_gain=60.0,
        integral_gain=1500.0,
        rate_gain=0.05,
        pick_off_range=0.01,
        torque_limit=0.5,
    ),
    "example-stiff": TwinParameters(proportional_gain=100.0, integral_gain=6000.0, damping=0.2, rate_gain=0.1),
}
"""Example designs by name; ``example`` is the stable example of the theory page."""


def twin_parameters(values: Mapping[str, str | float], *, where: str = "[twin]") -> TwinParameters:
    """Parameters from text or numbers of a scenario. They replace those of ``preset`` (default ``example``).

    Raises
    ------
    ArgumentError, UnitError
        If a name is unknown, a unit does not fit or a value is implausible; the message names the key.
    """
    chosen = dict(values)
    preset = str(chosen.pop("preset", "example"))
    if preset not in PRESETS:
        raise ArgumentError(f"{where} preset: '{preset}' is unknown", remedy=f"choose {', '.join(PRESETS)}")
    units = {entry.name: str(entry.metadata["unit"]) for entry in fields(TwinParameters)}
    unknown = sorted(set(chosen) - set(units))
    if unknown:
        raise ArgumentError(
            f"{where}: unknown key '{unknown[0]}'", remedy=f"known keys: preset, {', '.join(units)}"
        )
    numbers = {name: to_si(value, units[name], what=f"{where} {name}") for name, value in chosen.items()}
    try:
        return replace(PRESETS[preset], **numbers)
    except ArgumentError as error:
        raise ArgumentError(f"{where}: {error.message}", remedy=error.remedy) from None


# -- linear analysis ------------------------------------------------------------------------------------------


class UnstableDesignError(PigaError):
    """The servo loop has a pole in the right half-plane."""


@dataclass(frozen=True)
class _LoopAnalysis:
    """Linear figures of a design.

    ``poles`` [1/s] of the closed loop; ``nutation`` [rad/s] of the oscillating pole pair nearest ``H/sqrt(J_x B)`` (0 if none
    oscillates); ``gain_margin`` [1], ``phase_margin`` [rad], ``crossover`` [rad/s] of the open loop.
    """

    poles: _Complex
    nutation: float
    gain_margin: float
    phase_margin: float
    crossover: float

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


def loop_poles(p: TwinParameters) -> _Complex:
    """Poles of the closed loop [1/s] (the gimbal angle's own pole at zero left out)."""
    (plant_n, plant_d), (servo_n, servo_d) = _plant(p), _controller(p)
    closed = poly.polyadd(poly.polymul(plant_d, servo_d), poly.polymul(plant_n, servo_n))
    return np.asarray(poly.polyroots(poly.polytrim(closed)), dtype=complex)


def open_loop(p: TwinParameters, frequency: ArrayLike) -> _Complex:
    """Open-loop response ``C P`` at ``frequency`` [rad/s]."""
    (plant_n, plant_d), (servo_n, servo_d) = _plant(p), _controller(p)
    s = 1j * np.asarray(frequency, dtype=float)
    numerator, denominator = poly.polymul(plant_n, servo_n), poly.polymul(plant_d, servo_d)
    return np.asarray(poly.polyval(s, numerator) / poly.polyval(s, denominator))


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


def analyse_loop(p: TwinParameters) -> _LoopAnalysis:
    """Poles, nutation and margins of the design ``p``."""
    poles = loop_poles(p)
    oscillating = poles[poles.imag > 0.0]
    nutation = 0.0
    if oscillating.size:
        nutation = float(abs(oscillating[np.argmin(np.abs(np.abs(oscillating) - p.nutation))]))
    return _LoopAnalysis(poles, nutation, *_margins(p))


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


def servo_terms(
    scale_factor: float,
    pendulosity: float,
    integral_gain: float,
    proportional_gain: float = 0.0,
    rate_gain: float = 0.0,
    damping: float = 0.0,
    *,
    rate: float = 0.0,
) -> tuple[float, float]:
    r"""Predict the terms ``servo`` (s) and ``servo_damping`` (d) [1/(m/s^2)^2] from the parameters of the servo, SI.

    .. math::

       s = \frac{K\,ml}{2 k_i}, \qquad d = \frac{c K^2}{k_i}

    Parameters
    ----------
    scale_factor, pendulosity, integral_gain, proportional_gain, rate_gain, damping:
        K, ml, k_i, k_p, k_d and c of :class:`TwinParameters`. The integral gain must be positive.
    rate:
        Output rate [rad/s] at which the terms are taken: both are multiplied by ``k_i Im G(jw)/w``, which is
        1 at rate zero, ``G = 1/(k_i/(jw) + k_p + (k_d + ml/K) jw)``.

    Notes
    -----
    Derivation and terms of the next order: theory page "The servo in the model".
    """
    stiffness = integral_gain - (rate_gain + pendulosity / scale_factor) * rate**2
    compliance = stiffness / (stiffness**2 + (proportional_gain * rate) ** 2)
    return 0.5 * scale_factor * pendulosity * compliance, damping * scale_factor**2 * compliance


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


def predicted_k2(p: TwinParameters) -> float:
    """Coefficient k2 [1/(m/s^2)] from the float's inertia: ``(D - (C - A) beta) K^2/ml`` to first order.

    The product of inertia ``D`` gives a centrifugal torque ``D w^2`` about the inner axis; with a tilt, unequal
    inertias are a product of inertia about the outer axis. In g/g^2 it is the theory page's ``D K^2 g/ml``.
    """
    twice = 2.0 * p.pick_off_null
    unequal = 0.5 * (p.float_inertia_x - p.float_inertia_z) * math.sin(twice)
    return (p.product_of_inertia * math.cos(twice) + unequal) * p.K**2 / p.pendulosity


# -- motion --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class TwinMotion(Result):
    """Motion of the twin at the sample times.

    ``alpha`` and ``beta`` [rad], ``rate`` [rad/s], ``tilt_rate`` [rad/s], ``integral`` [rad s],
    ``torque`` [N m] of the motor, ``locked`` whether pick-off and torque motor are inside their limits.
    ``local_error`` [rad] is the sum of the integrator's own error estimates in alpha over all steps,
    an upper estimate of the global error. Errors do not grow, because the loop is stable.
    """

    t: Array
    alpha: Array
    beta: Array
    rate: Array
    tilt_rate: Array
    integral: Array
    torque: Array
    locked: NDArray[np.bool_]
    local_error: float
    steps: int

    def lock_changes(self) -> tuple[tuple[float, str], ...]:
        """Times [s] at which lock was lost or recovered."""
        turns = np.flatnonzero(np.diff(self.locked.astype(np.int8)))
        return tuple((float(self.t[i + 1]), "recovered" if self.locked[i + 1] else "lost") for i in turns)


def _tableau() -> servo.Method:
    """The eighth-order method of Dormand and Prince with its two error estimators, as in SciPy."""
    from scipy.integrate import DOP853

    parts = (DOP853.A, DOP853.B, DOP853.C, DOP853.E3, DOP853.E5)
    return servo.Method(*(np.ascontiguousarray(part, dtype=float) for part in parts))


def _quasi_steady_state(p: TwinParameters, t: float, alpha: float, f: Array, base_rate: Array) -> Array:
    """State with zero tilt rate in which all torques balance at gimbal angle ``alpha``, shape (5,).

    This is the first guess for the slow manifold. With integral gain the pick-off is at null. Without it the tilt is
    the one that the proportional gain needs to hold the outer-axis torque.
    """
    (a_x, a_Y, a_Z), (o_x, o_Y, o_Z) = f, base_rate
    H, _ = servo.wheel(p.constants(), t)
    c, s = math.cos(alpha), math.sin(alpha)
    load = p.pendulosity * (a_Y * c + a_Z * s) - H * (o_Y * c + o_Z * s) + p.outer_torque
    w = p.pendulosity / H * a_x - o_x
    load += servo.friction(p.constants(), w)
    if p.integral_gain > 0.0:
        return np.array([alpha, p.pick_off_null, w, 0.0, load / p.integral_gain])
    tilt = load / p.proportional_gain if p.proportional_gain > 0.0 else 0.0
    return np.array([alpha, p.pick_off_null + tilt, w, 0.0, 0.0])


def _slow_manifold(p: TwinParameters, t: float, alpha: float, f: Array, base_rate: Array) -> Array:
    """State at ``t`` on the slow manifold: no nutation and no servo transient, shape (5,).

    The manifold attracts. So the twin runs up to ``t`` with constant inputs and constant wheel speed, until the
    slowest loop pole has forgotten the first guess. The start angle is corrected until this run ends at ``alpha``.
    Own method.
    """
    slowest = -float(np.max(loop_poles(p).real))
    if slowest <= 0.0:
        raise PigaError("the loop is unstable: it has no slow manifold", remedy="use start = 'transient'")
    H, _ = servo.wheel(p.constants(), t)
    steady_wheel = replace(p, angular_momentum=H, hunting=0.0, spin_start=1.0)
    duration = 30.0 / slowest
    times = np.linspace(-duration, 0.0, max(2, math.ceil(duration * 50.0)))
    force, rate = (np.tile(v, (times.size, 1)) for v in (f, base_rate))
    state = _quasi_steady_state(steady_wheel, 0.0, alpha, f, base_rate)
    start = alpha - duration * state[2]
    for _ in range(20):
        first = _quasi_steady_state(steady_wheel, 0.0, start, f, base_rate)
        state = _integrate(steady_wheel, times, force, rate, np.zeros_like(force), first)[0][-1]
        start += alpha - state[0]
        if abs(alpha - state[0]) < 1e-10:
            break
    state[0] = alpha
    return state


def _integrate(
    p: TwinParameters, t: Array, f: Array, base_rate: Array, noise: Array, start: Array
) -> tuple[Array, float, int]:
    states, fast = np.empty((t.size, servo.STATES)), p.nutation
    step, tolerance = min(float(t[1] - t[0]), 0.5 / fast), _ACCURACY * np.array([1.0, 1.0, fast, fast, 1.0])
    nodes = np.hstack((f, base_rate, noise))
    error, steps, failed = servo.integrate(
        p.constants(), t, nodes, start.copy(), step, tolerance, _tableau(), states
    )
    if failed >= 0:
        raise PigaError(
            f"the twin's motion cannot be followed beyond t = {t[failed]:.6g} s: it is too fast",
            remedy="check the design with the linear analysis (piga.instrument.twin.analyse_loop): it is unstable or "
            "too stiff",
        )
    return states, float(error), int(steps)


def run_twin(
    p: TwinParameters,
    t: ArrayLike,
    f: ArrayLike,
    base_rate: ArrayLike | None = None,
    *,
    noise: ArrayLike | None = None,
    start: Start = "slow-manifold",
) -> TwinMotion:
    """Integrate the twin through sampled inputs.

    Parameters
    ----------
    p:
        Parameters of the instrument.
    t:
        Sample times [s], shape (n,), increasing.
    f, base_rate:
        Specific force [m/s^2] and inertial base rate [rad/s] in base axes, shape (n, 3), linear between
        samples.
    noise:
        Disturbing torque on the outer axis [N m], on the inner axis [N m], and pick-off noise [rad];
        shape (n, 3), held from a sample to the next.
    start:
        ``"slow-manifold"``: start without transient. ``"transient"``: start with the float at pick-off null and
        everything at rest.

    Raises
    ------
    ArgumentError
        If shapes do not fit or inputs are not finite.
    PigaError
        If the motion cannot be computed (unstable design).

    Notes
    -----
    Explicit Runge-Kutta method of order 8 with local error control (1e-12 rad) and substeps in each sample interval. The
    global error over 10 s is below 1e-9 rad.
    Nutation is resolved if it is excited, and otherwise only kept stable.
    """
    times = time_array("t", t, least=2)
    require_increasing("t", times)
    force = float_array("f", f, (times.size, 3))
    rate = np.zeros(force.shape) if base_rate is None else float_array("base_rate", base_rate, force.shape)
    torques = np.zeros(force.shape) if noise is None else float_array("noise", noise, force.shape)
    for name, array in (("f", force), ("base_rate", rate)):
        require_finite(name, array)
    if start not in ("slow-manifold", "transient"):
        raise ArgumentError(f"start: '{start}' is unknown", remedy="choose slow-manifold or transient")
    first = np.array([p.alpha0, p.pick_off_null, 0.0, 0.0, 0.0])
    if start == "slow-manifold":
        first = _slow_manifold(p, float(times[0]), p.alpha0, force[0], rate[0])
    states, error, steps = _integrate(p, times, force, rate, torques, first)
    signal = states[:, 1] - p.pick_off_null + torques[:, 2]
    e = np.clip(signal, -p.pick_off_range, p.pick_off_range)
    asked = -(p.proportional_gain * e + p.integral_gain * states[:, 4] + p.rate_gain * states[:, 3])
    locked = (np.abs(signal) <= p.pick_off_range) & (np.abs(asked) <= p.torque_limit)
    torque = np.clip(asked, -p.torque_limit, p.torque_limit)
    alpha, beta, rate, tilt_rate, integral = (np.ascontiguousarray(column) for column in states.T)
    return TwinMotion(times, alpha, beta, rate, tilt_rate, integral, torque, locked, error, steps)
