"""Stands as machines: dividing head, centrifuge and rate table, which turn in the gravity field, and the vibration table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from piga.earth import EARTH_RATE, Site
from piga.errors import ArgumentError
from piga.frames import axis_turn, rotation_vector_to_matrix
from piga.results import Array
from piga.stand.profile import NONE, Imperfections, Segment, plan, plan_holds
from piga.units import to_si


def turned(vector: Array, angle: Array) -> Array:
    """Components of ``vector``, (3,) or (3, n), in axes turned by ``angle`` (n,) [rad] about z, (n, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vector
    return np.column_stack([c * x + s * y, c * y - s * x, np.full(angle.shape, z)])


def _in_axes(matrix: Array, *motion: Array) -> tuple[Array, Array]:
    """Rows of force and rate (n, 3) multiplied by ``matrix`` (3, 3).

    The product is written out: the rounding of a matrix product may depend on the number of rows, and the result at one
    time must not depend on the other times of the call.
    """
    force, rate = (
        np.column_stack([row[0] * x + row[1] * y + row[2] * z for row in matrix])
        for x, y, z in (vectors.T for vectors in motion)
    )
    return force, rate


def _up_and_earth(site: Site, errors: Imperfections, azimuth: float | None) -> tuple[Array, Array]:
    """Up and Earth rate [rad/s] in the axes of a stand with its levelling error. Its third axis is the one about which it turns.

    ``azimuth`` [rad] from north is that of a horizontal axis z, with axes (up, z x up, z). None: axes (north, west, up).
    """
    north, up = EARTH_RATE * math.cos(site.latitude), EARTH_RATE * math.sin(site.latitude)
    if azimuth is None:
        tilt, axes = (*errors.levelling, 0.0), ([0.0, 0.0, 1.0], [north, 0.0, up])
    else:
        across, along = -math.sin(azimuth) * north, math.cos(azimuth) * north
        tilt, axes = (0.0, *errors.levelling[::-1]), ([1.0, 0.0, 0.0], [up, across, along])
    turn = rotation_vector_to_matrix(np.array(tilt)).T
    return turn @ np.array(axes[0]), turn @ np.array(axes[1])


def _turned_field(
    site: Site, errors: Imperfections, azimuth: float | None, angle: Array, rate: Array
) -> tuple[Array, Array]:
    """Gravity [m/s^2] and inertial rate [rad/s] in axes that turn with a stand, (n, 3) each, at its ``angle`` and ``rate``."""
    up, earth = _up_and_earth(site, errors, azimuth)
    inertial = turned(earth, angle)
    inertial[:, 2] += rate
    return (site.local_gravity + errors.gravity) * turned(up, angle), inertial


_ALONG_Z = {
    "Z0": np.eye(3),
    "X0": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "Y0": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}


def mount(axis: str, what: str = "mount") -> Array:
    """Matrix from stand axes to base axes when base ``axis`` lies along the stand's z axis, (3, 3).

    ``axis`` is ``X0``, ``Y0`` or ``Z0``, with ``-`` for the opposite direction; another name is an ArgumentError.
    """
    name = axis.removeprefix("-")
    if name not in _ALONG_Z:
        raise ArgumentError(f"{what}: '{axis}' is not a base axis", remedy="use X0, Y0, Z0, -X0, -Y0 or -Z0")
    flip = axis_turn(0, math.pi).round() if axis.startswith("-") else np.eye(3)
    return _ALONG_Z[name] @ flip


@dataclass(frozen=True)
class DividingHead:
    """A horizontal axis with the instrument's input axis across it.

    At position angle ``x`` the specific force is ``g (cos x, -sin x, 0)`` (with ``roll = 0``): the base is
    turned by ``+x`` about ``Z0``, which lies along the head's axis.

    ``positions`` [rad] in test order; the head turns by the plain difference between them. ``dwell`` and ``move`` [s]:
    recorded time in a position, and time of a move. ``roll`` [rad]: rotation of the instrument about its input axis.
    ``azimuth`` [rad]: direction of the head's axis from north over east. ``settling_time`` [s]: time constant of the
    imperfection ``settling``.
    """

    site: Site
    positions: tuple[float, ...]
    dwell: float = 60.0
    move: float = 30.0
    roll: float = 0.0
    azimuth: float = 0.0
    settling_time: float = 5.0

    kind = "dividing-head"
    accepted = ("gravity", "levelling", "angle_error", "angle_harmonics", "settling")

    def __post_init__(self) -> None:
        if not self.positions:
            raise ArgumentError("dividing-head positions: none given", remedy="e.g. '0:360:15 deg'")
        if self.dwell <= 0.0 or self.move <= 0.0 or self.settling_time <= 0.0:
            raise ArgumentError(
                "dividing-head dwell, move and settling_time must be positive", remedy="give times above 0 s"
            )

    @property
    def fastest(self) -> float:
        """Step [s] that resolves a move."""
        return self.move / 100.0

    def segments(self) -> tuple[Segment, ...]:
        """Positions ``0, 1, ...`` are recorded. The moves between them are not."""
        return plan_holds(len(self.positions), self.dwell, "move", self.move)

    def angle(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Angle [rad] and rate [rad/s] of the head at ``t`` [s], (n,)."""
        x = np.array(self.positions)
        x = x + errors.angle_error + sum(a * np.sin(n * x + phase) for n, a, phase in errors.angle_harmonics)
        residue = np.where(np.arange(x.size) > 0, errors.settling, 0.0)
        cycle = self.dwell + self.move
        k = np.clip(np.floor(t / cycle).astype(int), 0, x.size - 1)
        inside = t - k * cycle
        decay = residue[k] * np.exp(-np.minimum(inside, self.dwell) / self.settling_time)
        following = np.minimum(k + 1, x.size - 1)
        start = x[k] + decay
        way = x[following] + residue[following] - start
        w = 2.0 * math.pi * np.clip((inside - self.dwell) / self.move, 0.0, 1.0)  # a cycloid
        moving = (inside > self.dwell) & (following > k)
        angle = np.where(moving, start + way * ((w - np.sin(w)) / (2.0 * math.pi)), start)
        rate = np.where(moving, way * (1.0 - np.cos(w)) / self.move, -decay / self.settling_time)
        return angle, rate

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        angle, rate = self.angle(t, errors)
        force, base_rate = _turned_field(self.site, errors, self.azimuth, angle, rate)
        return _in_axes(axis_turn(0, self.roll), force, base_rate)


def angles_of_range(text: str, what: str, example: str) -> tuple[float, ...]:
    """Angles [rad] of a text ``"start:stop:step unit"``, without ``stop``: a full circle does not repeat its start.

    ``what`` and ``example`` are for messages.
    """
    numbers, _, unit = text.strip().partition(" ")
    parts = numbers.split(":")
    if len(parts) != 3:
        raise ArgumentError(f"{what}: '{text}' is not a range", remedy=f"write e.g. '{example}'")
    first, last, step = (to_si(f"{part} {unit}", "rad", what=what) for part in parts)
    count = round((last - first) / step) if step != 0.0 else 0
    if count < 1:
        raise ArgumentError(f"{what}: the range is empty", remedy=f"write start:stop:step, e.g. '{example}'")
    return tuple(first + step * k for k in range(count))


@dataclass(frozen=True)
class SpinPlan:
    """Rates [rad/s] held for ``dwell`` [s], with cosine ramps of ``ramp`` [s] between them."""

    rates: tuple[float, ...]
    dwell: float
    ramp: float

    def __post_init__(self) -> None:
        if not self.rates:
            raise ArgumentError("rates: none given", remedy="give a list of angular rates")
        if self.dwell <= 0.0 or self.ramp <= 0.0:
            raise ArgumentError("dwell and ramp must be positive", remedy="give times above 0 s")

    def at(self, t: Array, errors: Imperfections) -> tuple[Array, Array, Array]:
        """Angle [rad], rate [rad/s] and angular acceleration [rad/s^2], (n,), with ``rate_error`` and ``rate_ripple``."""
        rates = np.array(self.rates)
        steps = np.diff(rates, append=rates[-1])
        cycle = self.dwell + self.ramp
        per_cycle = rates * cycle + 0.5 * steps * self.ramp
        before = np.concatenate([[0.0], np.cumsum(per_cycle)[:-1]])
        k = np.clip(np.floor(t / cycle).astype(int), 0, rates.size - 1)
        inside = t - k * cycle
        u = np.clip((inside - self.dwell) / self.ramp, 0.0, 1.0)
        ramped = steps[k] * self.ramp * (0.5 * u - np.sin(math.pi * u) / (2.0 * math.pi))
        scale, ripple = 1.0 + errors.rate_error, errors.rate_ripple
        angle = scale * (before[k] + rates[k] * inside + ramped)
        rate = scale * (rates[k] + 0.5 * steps[k] * (1.0 - np.cos(math.pi * u)))
        acceleration = scale * (0.5 * steps[k] * np.sin(math.pi * u) * math.pi / self.ramp)
        swing = 1.0 + ripple * np.cos(angle)
        return (
            angle + ripple * np.sin(angle),
            rate * swing,
            acceleration * swing - ripple * rate**2 * np.sin(angle),
        )


class _Spinning:
    """Base of stands that turn by a :class:`SpinPlan`."""

    spin: SpinPlan

    @property
    def fastest(self) -> float:
        """Step [s] that resolves a ramp (1/100 of it) and a revolution (1/200 of it)."""
        fastest = max(abs(rate) for rate in self.spin.rates)
        return min(self.spin.ramp / 100.0, 2.0 * math.pi / max(fastest, 1e-9) / 200.0)

    def segments(self) -> tuple[Segment, ...]:
        """Constant rates or levels ``0, 1, ...`` (recorded) and the ramps between them (not recorded)."""
        return plan_holds(len(self.spin.rates), self.spin.dwell, "ramp", self.spin.ramp)


@dataclass(frozen=True)
class Centrifuge(_Spinning):
    """A vertical spindle with an arm; the input axis points to the spindle (or away from it).

    On the arm (``counter_rotating`` false): ``X0`` inward, ``Z0`` up, ``Y0`` against the motion for
    positive rates; the specific force is ``(r w^2, -r w', g)`` plus the Coriolis force of the Earth's
    rotation. The base turns with the arm. On a counter-rotating platform the base keeps its
    direction at angle 0, and the specific force turns in the base.

    ``radius`` [m] of the arm at rest; ``stretch`` [s^2/rad^2]: its known relative growth per squared rate.
    ``counter_rotating``: the instrument is on a platform that rotates against the arm. ``outward``: ``X0`` points away
    from the spindle, so the specific force is negative. ``roll`` [rad]: rotation of the instrument about its input axis.
    """

    site: Site
    radius: float
    spin: SpinPlan
    stretch: float = 0.0
    counter_rotating: bool = False
    outward: bool = False
    roll: float = 0.0

    kind = "centrifuge"
    accepted = ("gravity", "levelling", "arm_radius", "arm_stretch", "rate_error", "rate_ripple")

    def __post_init__(self) -> None:
        if self.radius <= 0.0:
            raise ArgumentError(f"centrifuge radius: {self.radius:g} m is not positive", remedy="e.g. '2.5 m'")

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        angle, speed, acceleration = self.spin.at(t, errors)
        force, rate = _turned_field(self.site, errors, None, angle, speed)
        earth = _up_and_earth(self.site, errors, None)[1]
        squared = speed**2
        radius = (self.radius + errors.arm_radius) * (1.0 + (self.stretch + errors.arm_stretch) * squared)
        coriolis = 2.0 * radius * speed
        force[:, 0] += radius * squared + coriolis * earth[2]
        force[:, 1] -= radius * acceleration
        force[:, 2] -= coriolis * rate[:, 0]
        if self.counter_rotating:
            force, rate = turned(force.T, -angle), np.tile(earth, (t.size, 1))
        turn = axis_turn(0, self.roll) @ axis_turn(2, math.pi if self.outward else 0.0)
        return _in_axes(turn, force, rate)


def rates_for_levels(levels: tuple[float, ...], radius: float, stretch: float = 0.0) -> tuple[float, ...]:
    """Rates [rad/s] that give centripetal specific forces ``levels`` [m/s^2] at ``radius`` [m].

    Solves ``r (1 + stretch w^2) w^2 = a``.
    """
    rates = []
    for level in levels:
        if level < 0.0:
            raise ArgumentError(
                f"centrifuge levels: {level:g} m/s^2 is negative",
                remedy="give its size, and outward = true for the other direction",
            )
        ratio = level / radius
        root = math.sqrt(1.0 + 4.0 * stretch * ratio)
        rates.append(math.sqrt(2.0 * ratio / (1.0 + root)))
    return tuple(rates)


@dataclass(frozen=True)
class RateTable(_Spinning):
    """A table turning about one axis.

    With a vertical axis, gravity is constant in the base and the rate adds to it: the term ``-Omega_x`` of the
    output can be measured alone. With a horizontal axis, gravity turns in the base.

    ``along``: base axis that lies along the table's axis: ``X0``, ``Y0``, ``Z0``, or with ``-``. ``horizontal``: the
    table's axis is horizontal, at ``azimuth`` [rad] from north; else it points up. ``offset`` [m]: distance of the
    instrument from the axis, along the table's own first axis.
    """

    site: Site
    spin: SpinPlan
    along: str = "X0"
    horizontal: bool = False
    azimuth: float = 0.0
    offset: float = 0.0

    kind = "rate-table"
    accepted = ("gravity", "levelling", "arm_radius", "rate_error", "rate_ripple")

    def __post_init__(self) -> None:
        mount(self.along, "rate-table along")

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        angle, speed, acceleration = self.spin.at(t, errors)
        azimuth = self.azimuth if self.horizontal else None
        force, rate = _turned_field(self.site, errors, azimuth, angle, speed)
        arm = self.offset + errors.arm_radius
        force[:, 0] -= arm * speed**2
        force[:, 1] += arm * acceleration
        return _in_axes(mount(self.along), force, rate)


# -- vibration table: sine dwells, sweeps and random vibration along one axis ------------------------------

_LINES = 256


@dataclass(frozen=True)
class Drive:
    """One stretch of vibration.

    ``shape``: ``rest``, ``sine`` (at ``frequency``), ``sweep`` (``frequency`` to ``last_frequency``, logarithmic), or
    ``random`` (flat between the two frequencies: a sum of 256 lines with phases from ``seed``). ``duration`` [s],
    ``frequency`` and ``last_frequency`` [Hz]. ``amplitude`` [m/s^2]: peak of sine and sweep, root mean square of random
    vibration. ``taper`` [s]: time in which the drive rises at the start and falls at the end.
    """

    shape: Literal["rest", "sine", "sweep", "random"]
    duration: float
    frequency: float = 1.0
    last_frequency: float = 1.0
    amplitude: float = 0.0
    taper: float = 0.5
    seed: int = 1

    def __post_init__(self) -> None:
        if self.duration <= 0.0 or self.frequency <= 0.0 or self.last_frequency <= 0.0 or self.taper < 0.0:
            raise ArgumentError(
                "vibration drive: duration, frequency or last_frequency is not positive, or taper is negative",
                remedy='e.g. duration = "20 s", frequency = "8 Hz", taper = "0.5 s"',
            )
        if 2.0 * self.taper > self.duration and self.shape != "rest":
            raise ArgumentError(
                f"vibration drive: taper {self.taper:g} s does not fit twice into {self.duration:g} s",
                remedy="use a shorter taper or a longer duration",
            )
        if self.shape == "random" and self.last_frequency <= self.frequency:
            raise ArgumentError(
                f"vibration drive: random from {self.frequency:g} Hz to {self.last_frequency:g} Hz",
                remedy="give a last_frequency above frequency",
            )

    def acceleration(self, t: Array) -> tuple[Array, Array]:
        """Acceleration [m/s^2] and its rate of change [m/s^3] at ``t`` [s] since the start of the drive."""
        wave, rate = np.zeros(t.size), np.zeros(t.size)
        if self.shape == "random":
            edges = np.linspace(self.frequency, self.last_frequency, _LINES + 1)
            phases = np.random.default_rng(self.seed).uniform(0.0, 2.0 * math.pi, _LINES)
            scale = math.sqrt(2.0 / _LINES)
            for w, phase in zip(math.pi * (edges[1:] + edges[:-1]), phases, strict=True):
                wave += scale * np.sin(w * t + phase)
                rate += scale * w * np.cos(w * t + phase)
        elif self.shape == "sweep" and self.last_frequency != self.frequency:
            growth = math.log(self.last_frequency / self.frequency) / self.duration
            w = 2.0 * math.pi * self.frequency * np.exp(growth * t)
            phase = (w - 2.0 * math.pi * self.frequency) / growth
            wave, rate = np.sin(phase), w * np.cos(phase)
        elif self.shape != "rest":
            w = 2.0 * math.pi * self.frequency
            wave, rate = np.sin(w * t), w * np.cos(w * t)
        if self.taper == 0.0:
            return self.amplitude * wave, self.amplitude * rate
        up, down = np.clip(t / self.taper, 0.0, 1.0), np.clip((self.duration - t) / self.taper, 0.0, 1.0)
        u, sign = np.minimum(up, down), np.where(up < down, 1.0, -1.0)
        ease, slope = 0.5 * (1.0 - np.cos(math.pi * u)), sign * 0.5 * math.pi / self.taper * np.sin(math.pi * u)
        return self.amplitude * ease * wave, self.amplitude * (ease * rate + slope * wave)


@dataclass(frozen=True)
class VibrationTable:
    """A table that vibrates along a base axis in the gravity field.

    ``drives`` are the stretches of vibration in order; each is a recorded segment. ``axis`` is the base axis along which the
    table moves, ``up`` the one that points up.
    """

    site: Site
    drives: tuple[Drive, ...]
    axis: str = "X0"
    up: str = "X0"

    kind = "vibration-table"
    accepted = ("gravity", "levelling", "transverse_motion", "rocking")

    def __post_init__(self) -> None:
        mount(self.axis, "vibration-table axis")
        mount(self.up, "vibration-table up")
        if not self.drives:
            raise ArgumentError("vibration-table drives: none given", remedy="add a [[stand.drives]] table")

    @property
    def fastest(self) -> float:
        """Step [s]: 40 samples per period of the highest frequency."""
        moving = [drive.last_frequency for drive in self.drives if drive.shape in ("sweep", "random")]
        return 1.0 / (40.0 * max([*moving, *(drive.frequency for drive in self.drives)]))

    def segments(self) -> tuple[Segment, ...]:
        """Drives ``0, 1, ...``."""
        return plan([(str(k), drive.duration, True) for k, drive in enumerate(self.drives)])

    def motion(self, t: Array, errors: Imperfections) -> tuple[Array, Array]:
        """Specific force and base rate in base axes, (n, 3) each."""
        starts = np.array([s.start for s in self.segments()])
        index = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, starts.size - 1)
        wave, wave_rate, peak = np.zeros(t.size), np.zeros(t.size), np.ones(t.size)
        for k, drive in enumerate(self.drives):
            rows = index == k
            wave[rows], wave_rate[rows] = drive.acceleration(np.clip(t[rows] - starts[k], 0.0, drive.duration))
            peak[rows] = drive.amplitude or 1.0
        to_base = (
            mount(self.up) @ _ALONG_Z["Y0"] @ rotation_vector_to_matrix(np.array([0.0, *errors.levelling])).T
        )
        up, earth = (to_base @ vector for vector in _up_and_earth(self.site, NONE, 0.0))
        along, across = mount(self.axis)[:, 2], mount(self.axis)[:, 0]
        gravity = (self.site.local_gravity + errors.gravity) * up
        force = gravity + np.outer(wave, along + errors.transverse_motion * across)
        pivot = np.cross(along, mount(self.up)[:, 2])
        pivot = pivot if np.any(pivot) else across
        force -= np.outer(errors.rocking * wave / peak, np.cross(pivot, gravity))
        rate = earth + np.outer(errors.rocking * wave_rate / peak, pivot)
        return force, rate
