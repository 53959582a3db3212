"""Navigation in inertial axes: specific force of a space-stable platform to position, velocity and attitude.

Form after [Britting1971]; written out in docs/theory/platform.md section 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from piga import earth
from piga._kernels.platform import Stepping, Triad, follow, navigate_chunk
from piga.frames import rotation_vector_to_matrix
from piga.platform import geometry
from piga.platform.scenario import Gyro, Model, Place, PlatformScenario
from piga.platform.simulate import Readouts, Truth
from piga.results import Array, Result


@dataclass(frozen=True)
class Knowledge:
    """The misalignments of the two gyros and the redundancy angle, from identification or truth.

    ``polar, equatorial``: misalignment, phase, harmonics; ``eta0`` [rad] at the start of the run (the
    value 'at calibration' that model A holds), ``eta_rate`` [rad/s].
    """

    polar: Gyro
    equatorial: Gyro
    eta0: float
    eta_rate: float


def true_knowledge(scenario: PlatformScenario) -> Knowledge:
    """The true values of the simulation."""
    rate = scenario.equatorial.drift[0] - scenario.polar.drift[1]
    return Knowledge(scenario.polar, scenario.equatorial, scenario.redundancy, rate)


@dataclass(frozen=True, eq=False, repr=False)
class CaseCompensator(Result):
    """One model over a run: small angles [rad] of the platform against the triad, redundancy angle ``eta`` [rad].

    ``nodes`` (n + 1, 3) at the times of the readouts, ``middles`` (n, 3) in the middle of each step, or (1, 3) if all
    are zero; ``eta`` (n + 1,) or (1,).
    """

    model: Model
    nodes: Array
    middles: Array
    eta: Array


def compensator(
    model: Model, knowledge: Knowledge, readouts: Readouts, *, redundancy: str = "pick-off"
) -> CaseCompensator:
    """Prepare a model.

    ``model``: ``none``; ``A`` redundancy angle held at ``knowledge.eta0``; ``B`` followed; ``C`` followed and with the
    harmonics of the misalignments [He2014 for A and B; C is this project's own]. ``readouts`` of the run give the pick-off
    and the times. ``redundancy``: source of the redundancy angle for B and C: ``pick-off`` or ``drift-model``
    (``eta0 + rate t``).
    """
    if model == "none":
        return CaseCompensator(model, np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1))
    p, e = knowledge.polar, knowledge.equatorial
    if model != "C":
        p, e = (Gyro(gyro.misalignment, gyro.phase) for gyro in (p, e))
    c1, c2 = readouts.encoder1 + p.phase, readouts.encoder2 + e.phase
    if model == "A":
        eta = np.array([knowledge.eta0])
    elif redundancy == "drift-model":
        eta = knowledge.eta0 + knowledge.eta_rate * readouts.times
    else:
        eta = _follow_redundancy(readouts, geometry.small_angles(p, e, c1, c2, 0.0)[1], knowledge)
    angles, _ = geometry.small_angles(p, e, geometry.halved(c1), geometry.halved(c2), geometry.halved(eta))
    nodes, middles = (np.ascontiguousarray(angles[first::2]) for first in (0, 1))
    return CaseCompensator(model, nodes, middles, eta)


def _follow_redundancy(readouts: Readouts, expected: Array, knowledge: Knowledge) -> Array:
    """Redundancy angle (n + 1,) [rad] from the pick-off minus ``expected = m2 cos c2 - m1 sin c1``, smoothed without lag.

    The filter is a critically damped second-order tracker. Its time constant is four case turns (eight minutes
    if the cases rest), so errors of the model at the case-rotation period are averaged out.
    """
    h = readouts.step
    turned = np.abs(np.diff(readouts.encoder1[:3])).max() / h
    constant = 4.0 * 2.0 * np.pi / turned if turned > 0.0 else 480.0
    decay, eta = np.exp(-h / constant), np.empty(len(expected))
    gains = 1.0 - decay * decay, (1.0 - decay) ** 2 / h
    follow(readouts.pickoff, expected, knowledge.eta0, knowledge.eta_rate, h, *gains, eta)
    return eta


_SCHULER2 = earth.GM / earth.SEMI_MAJOR_AXIS**3
_SHOWN = 8192
"""Rows shown at a time: they stay in the processor's cache."""
_LARGEST_TURN = 1e-5
"""Drift [rad] up to which the triad's turn is taken as linear inside one kernel call."""


@dataclass(frozen=True, eq=False, repr=False)
class Start(Result):
    """Start: inertial position [m], velocity [m/s], triad ``C_G^i`` (3, 3), drift (3,) [rad/s]."""

    position: Array
    velocity: Array
    triad: Array
    drift: Array


def inertial_states(
    start: Start, step: float, increments: Array, angles: Array, altitude: Array, *, every: int = 1,
    damping_time: float = 100.0,
) -> tuple[Array, Array]:  # fmt: skip
    """Inertial positions [m] and velocities [m/s] after every ``every``-th ``step`` [s].

    The step is of fourth order and takes every one of the ``increments`` (n, 3) [m/s] in full. ``angles`` (n, 3) or (1, 3) are
    ``CaseCompensator.middles``; ``altitude`` (n,) or (1,) [m] is that at the ends of the steps. ``damping_time`` [s]: time
    constant of the critically damped altitude loop; 0 leaves the vertical channel free (it then grows by e in about 570 s).
    """
    n, h, r, v, drift = len(increments), step, start.position, start.velocity, np.array(start.drift)
    first = start.triad @ increments[0]
    slope = start.triad @ (increments[min(1, n - 1)] - increments[0])
    acceleration = first / h + geometry.gravitation(
        r
    )  # past gravitation and increments: the motion run backwards
    back = [geometry.gravitation(r - k * h * v + 0.5 * (k * h) ** 2 * acceleration) for k in (0.0, 1.0, 2.0)]
    past = first - slope, first - 2.0 * slope
    state = np.array([r, v, *back, *past, np.zeros(3), r / np.linalg.norm(r)])
    positions, velocities = np.empty((n // every, 3)), np.empty((n // every, 3))
    rate = float(np.linalg.norm(drift))
    block = n if rate == 0.0 else max(every, int(_LARGEST_TURN / (rate * h)) // every * every)
    stepping = Stepping(h, every, damping_gains(damping_time), geometry.KERNEL_EARTH)
    for at in range(0, n, block):
        part, rows = slice(at, at + block), slice(at // every, (at + block) // every)
        triad = Triad(start.triad @ rotation_vector_to_matrix(drift * (at * h)), drift)
        navigate_chunk(
            increments[part], _cut(angles, part), triad, _cut(altitude, part), stepping, state, positions[rows],
            velocities[rows],
        )  # fmt: skip
    return positions, velocities


def damping_gains(damping_time: float) -> Array:
    """Gains on position [1/s] and velocity [1/s^2] that put both poles of the height loop at -1/T."""
    if damping_time <= 0.0:
        return np.zeros(2)
    return np.array([2.0 / damping_time, 1.0 / damping_time**2 + 2.0 * _SCHULER2])


def _cut(values: Array, part: slice) -> Array:
    return values[part] if len(values) > 1 else values


@dataclass(frozen=True, eq=False, repr=False)
class Navigation(Result):
    """What the navigator shows, row k at ``times[k]`` [s].

    ``table`` (n, 9): latitude, longitude [rad], height [m], velocity north, east, down [m/s], roll,
    pitch, heading [rad]; ``position``, ``velocity`` (n, 3): inertial [m], [m/s].
    """

    model: str
    times: Array
    table: Array
    position: Array
    velocity: Array


@dataclass(frozen=True, eq=False, repr=False)
class Errors(Result):
    """Navigator less truth, rows at ``times`` (n,) [s].

    ``north, east, up`` (n,) [m]; ``velocity`` (n, 3) north, east, down [m/s]; ``attitude`` (n, 3) roll,
    pitch, heading [rad].
    """

    times: Array
    north: Array
    east: Array
    up: Array
    velocity: Array
    attitude: Array

    @property
    def horizontal(self) -> Array:
        """Horizontal position error [m]."""
        return np.hypot(self.north, self.east)


def navigate(readouts: Readouts, compensator: CaseCompensator, start: Start, *, damping_time: float = 100.0,
             every: int = 1) -> Navigation:  # fmt: skip
    """Navigate a whole record of readouts; a row for every ``every``-th step (the rest at the end is left out).

    Gyro accelerometers read the platform's own turn; what the model knows of it is added back.
    """
    n = len(readouts.increments) // every * every
    node, middle = slice(every, n + 1, every), slice(0, n)
    increments, angles = readouts.increments, compensator.nodes
    if readouts.turn_sensitivity > 0.0 and len(angles) > 1:
        increments = increments + np.diff(angles, axis=0) * readouts.turn_sensitivity
    altitude = readouts.altitude[1:] if len(readouts.altitude) > 1 else readouts.altitude
    steps = increments[middle], _cut(compensator.middles, middle), _cut(altitude, middle)
    position, velocity = inertial_states(start, readouts.step, *steps, every=every, damping_time=damping_time)
    times = readouts.times[node]
    gimbals, angles, table = readouts.gimbals[node], _cut(angles, node), np.empty((len(times), 9))
    for first in range(0, len(times), _SHOWN):
        rows = slice(first, first + _SHOWN)
        states = position[rows], velocity[rows], times[rows], gimbals[rows]
        table[rows] = _shown(*states, _cut(angles, rows), start)
    return Navigation(compensator.model, times, table, position, velocity)


def _shown(
    position: Array, velocity: Array, times: Array, gimbals: Array, angles: Array, start: Start
) -> Array:
    """The table of a :class:`Navigation` from inertial states, gimbal angles and small angles of the platform.

    A plane of two axes is that of complex numbers, which turn by a factor.
    """
    back = np.exp(-1j * earth.EARTH_RATE * times)
    plane = (position[:, 0] + 1j * position[:, 1]) * back
    latitude, longitude, height = geometry.earth_to_geodetic(
        np.stack((plane.real, plane.imag, position[:, 2]), axis=-1)
    )
    sine, cosine, outward = np.sin(latitude), np.cos(latitude), plane / np.abs(plane)
    level = ((velocity[:, 0] + 1j * velocity[:, 1]) * back - 1j * earth.EARTH_RATE * plane) * outward.conj()
    north = cosine * velocity[:, 2] - sine * level.real
    down = -cosine * level.real - sine * velocity[:, 2]
    # north, east and down in inertial axes, then in those of triad, platform and base
    c, s = (outward / back).real, (outward / back).imag
    axes = np.array(((-sine * c, -sine * s, cosine), (-s, c, 0.0 * s), (-cosine * c, -cosine * s, -sine)))
    x, y, z = np.einsum("kj,vkn->jvn", start.triad, axes)
    if rate := float(np.linalg.norm(start.drift)):
        (a, b, d), c, s = start.drift / rate, np.cos(rate * times), -np.sin(rate * times)
        along = (a * x + b * y + d * z) * (1.0 - c)
        x, y, z = (
            c * x + s * (b * z - d * y) + along * a,
            c * y + s * (d * x - a * z) + along * b,
            c * z + s * (a * y - b * x) + along * d,
        )
    a, b, d = angles.T
    x, y, z = x - b * z + d * y, y - d * x + a * z, z - a * y + b * x
    outer, middle, inner = np.exp(1j * gimbals.T)
    turned = (x + 1j * y) * inner
    side = (turned.real + 1j * z) * middle.conj()
    turned, z = (side.real + 1j * turned.imag) * outer, side.imag
    x, y = turned.real, turned.imag
    roll, pitch = np.arctan2(y[2], z[2]), np.arctan2(-x[2], np.hypot(y[2], z[2]))
    heading = np.arctan2(x[1], x[0])
    return np.column_stack((latitude, longitude, height, north, level.imag, down, roll, pitch, heading))


def errors(navigation: Navigation, truth: Truth, readouts: Readouts) -> Errors:
    """Error of the navigator against the true base motion."""
    times, shown = navigation.times, navigation.table
    every = round((times[1] - times[0]) / readouts.step) if len(times) > 1 else 1
    node = slice(every, every * len(times) + 1, every)
    motion = truth.motion
    place, velocity, attitude = (_cut(v, node) for v in (motion.place, motion.velocity, motion.attitude))
    latitude, height = place[:, 0], place[:, 2]
    root = np.sqrt(1.0 - earth.ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    prime = earth.SEMI_MAJOR_AXIS / root
    meridian = prime * (1.0 - earth.ECCENTRICITY_SQUARED) / root**2
    return Errors(
        times=times,
        north=(shown[:, 0] - latitude) * (meridian + height),
        east=geometry.wrapped(shown[:, 1] - place[:, 1]) * (prime + height) * np.cos(latitude),
        up=shown[:, 2] - height,
        velocity=shown[:, 3:6] - velocity,
        attitude=geometry.wrapped(shown[:, 6:9] - attitude),
    )


def true_start(truth: Truth) -> Start:
    """Start from the true position and velocity and the true attitude of the triad; no drift taken out."""
    (latitude, longitude, height), velocity = truth.motion.place[0], truth.motion.velocity[0]
    start = site_start(Place(latitude, longitude, height), truth.triad_start.T.copy(), np.zeros(3))
    return replace(start, velocity=geometry.local_axes(latitude, longitude) @ velocity + start.velocity)


def site_start(place: Place, triad: Array, drift: Array) -> Start:
    """Start of a base at rest at a known place, with the triad ``C_G^i`` and its drift [rad/s] to take out."""
    position = geometry.geodetic_to_earth(place.latitude, place.longitude, place.height)
    return Start(position, np.cross([0.0, 0.0, earth.EARTH_RATE], position), triad, drift)
