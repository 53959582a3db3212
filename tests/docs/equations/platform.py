"""Equations of docs/theory/platform.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.integrate import solve_ivp
from scipy.special import fresnel

from piga import earth
from piga._kernels.platform import Stepping, Triad, drift_triad, navigate_chunk
from piga.earth import EARTH_RATE
from piga.frames import axis_turn
from piga.platform import Perturbation, linear_errors, theory_lines, true_knowledge
from piga.platform.geometry import (
    KERNEL_EARTH,
    apparent_gyro,
    geodetic_to_earth,
    gravitation,
    local_axes,
    misalignment,
    nulled_attitude,
    small_angles,
    specific_force_at_rest,
)
from piga.platform.navigator import damping_gains
from piga.platform.scenario import Gyro, Harmonic, Place, PlatformScenario, Rotation
from tests.platform.conftest import published

from .registry import Pair, equation

M1, M2, C1, C2, ETA = 0.03, 0.02, 0.8, 2.1, 0.04
"""Misalignments [rad] as large as a degree, case angles and redundancy angle [rad]."""
POLAR, EQUATORIAL = Gyro(M1), Gyro(M2)


@equation("platform-drift")
def _drift() -> Iterator[Pair]:
    """Over a step of 0.1 s; what the second order of the turn adds is below 1e-15."""
    h, (w1x, w1y, w2y, w2z) = 0.1, (3e-8, -2e-8, 5e-8, 4e-8)
    w = np.array([w1x, w1y, w2z / np.cos(ETA) - w1x * np.tan(ETA)])
    start = axis_turn(1, 0.4) @ axis_turn(2, 1.1)
    turned = start.copy()
    eta = drift_triad(turned, np.array([w1x, w1y, w2y, w2z, 0, 0, 0, 0]), ETA, 0.0, 1.0, 0.0, 1.0, h)
    turn = turned @ start.T  # I - [w x] h
    yield w * h, np.array([turn[1, 2], turn[2, 0], turn[0, 1]]), 1e-15
    yield (w2y - w1y) * h, eta - ETA, 1e-16


def tips() -> tuple[np.ndarray, np.ndarray]:
    n1 = np.array([-np.sin(M1) * np.sin(C1), np.sin(M1) * np.cos(C1), np.cos(M1)])
    return n1, np.array([np.cos(M2), -np.sin(M2) * np.sin(C2), np.sin(M2) * np.cos(C2)])


@equation("platform-tips")
def _tips() -> Iterator[Pair]:
    """The momenta, h1 = z_G and h2 = cos(eta) x_G - sin(eta) z_G, lie along them."""
    attitude, ring = nulled_attitude(POLAR, EQUATORIAL, C1, C2, ETA)
    n1, n2 = tips()
    h2 = attitude[0] @ np.array([np.cos(ETA), 0.0, -np.sin(ETA)])
    yield n1, attitude[0][:, 2], 1e-15
    yield n2, axis_turn(1, ring[0]) @ h2, 1e-15


@equation("platform-ring")
def _ring() -> Iterator[Pair]:
    n1, n2 = tips()
    A, B = n1[0] * n2[0] + n1[2] * n2[2], n1[2] * n2[0] - n1[0] * n2[2]
    literal = np.arctan2(A, B) + np.arcsin((np.sin(ETA) + n1[1] * n2[1]) / np.hypot(A, B))
    yield literal, nulled_attitude(POLAR, EQUATORIAL, C1, C2, ETA)[1][0], 1e-15


@equation("platform-small-angles")
def _small() -> Iterator[Pair]:
    """Against the matrices of the library, and against the exact geometry to the second order."""
    for scale in (1.0, 1e-3):
        m1, m2, polar, equatorial = M1 * scale, M2 * scale, Gyro(M1 * scale), Gyro(M2 * scale)
        e = np.array(
            [
                m1 * np.cos(C1),
                m1 * np.sin(C1),
                m2 * np.sin(C2) / np.cos(ETA) - m1 * np.cos(C1) * np.tan(ETA),
            ]
        )
        Y = ETA + m2 * np.cos(C2) - m1 * np.sin(C1)
        angles, ring = small_angles(polar, equatorial, C1, C2, ETA)
        yield e, angles, 1e-17
        yield Y, ring, 1e-16
        attitude, exact = nulled_attitude(polar, equatorial, C1, C2, ETA)
        c = attitude[0]
        yield e, 0.5 * np.array([c[1, 2] - c[2, 1], c[2, 0] - c[0, 2], c[0, 1] - c[1, 0]]), 2 * m1**2
        yield Y, exact[0], 2 * m1**2


@equation("platform-wobble")
def _wobble() -> Iterator[Pair]:
    lines = ((1, 2e-4, 0.3), (2, 3e-4, 1.0), (3, 1e-4, 2.0))
    c = np.linspace(0.0, 2 * np.pi, 12)
    literal = M1 + sum(a * np.cos(k * c + p) for k, a, p in lines)
    yield literal, misalignment(Gyro(M1, 0.0, tuple(Harmonic(*line) for line in lines)), c), 1e-16


@equation("platform-apparent")
def _apparent() -> Iterator[Pair]:
    rate, drift = 0.013, (2e-6, -3e-6)
    literal = M1 - 1j * complex(*drift) / rate
    seen = apparent_gyro(Gyro(M1, 0.4, case_drift=drift), Rotation(rate))
    yield literal, seen.misalignment * np.exp(1j * (seen.phase - 0.4)), 1e-16


@equation("platform-step")
def _step() -> Iterator[Pair]:
    """One step of the navigator with ideal gyros and no damping."""
    h, D = 2.0, np.array([[0.3, -0.2, 19.0], [0.1, 0.4, 18.9], [-0.2, 0.1, 19.1]])
    r, v = np.array([4.0e6, 1.0e6, 4.9e6]), np.array([-70.0, 290.0, 3.0])
    g, g1, g2 = (gravitation(r - v * h * k) for k in range(3))
    r_next = r + h * v + h / 24 * (9 * D[0] + 4 * D[1] - D[2]) + h**2 / 24 * (19 * g - 10 * g1 + 3 * g2)
    v_next = v + D[0] + h / 24 * (9 * gravitation(r_next) + 19 * g - 5 * g1 + g2)
    state = np.zeros((9, 3))
    state[:7] = r, v, g, g1, g2, D[1], D[2]
    positions, velocities = np.empty((1, 3)), np.empty((1, 3))
    triad, stepping = Triad(np.eye(3), np.zeros(3)), Stepping(h, 1, np.zeros(2), KERNEL_EARTH)
    navigate_chunk(D[:1], np.zeros((1, 3)), triad, np.zeros(1), stepping, state, positions, velocities)
    yield r_next, positions[0], 2e-9
    yield v_next, velocities[0], 1e-12


def line_amplitudes(model: str, eta: float, eta0: float) -> tuple[dict[str, float], PlatformScenario]:
    """The library's lines of a day at whose middle the redundancy angle is ``eta``, ``eta0`` at the start."""
    scenario = published(redundancy=eta0)
    known = true_knowledge(scenario)
    times = np.full(2, (eta - eta0) / known.eta_rate)
    result = theory_lines(scenario, model, known, [slice(0, 2)], times)
    return {name: float(values[0]) for name, values in result.amplitude.items()}, scenario


def phasor(gyro: Gyro) -> complex:
    return gyro.misalignment * np.exp(1j * gyro.phase)


@equation("platform-line")
def _line() -> Iterator[Pair]:
    """Lines of the uncorrected platform: D is the amplitude of e_z."""
    result, scenario = line_amplitudes("none", ETA, 0.0)
    D = abs(-1j * phasor(scenario.equatorial) / np.cos(ETA) - phasor(scenario.polar) * np.tan(ETA))
    w, L = scenario.polar_rotation.rate, scenario.place.latitude
    w_s2 = earth.GM / earth.SEMI_MAJOR_AXIS**3
    g = np.linalg.norm(specific_force_at_rest(geodetic_to_earth(L, 0.0, 0.0)))
    S = w**2 / (w**2 - w_s2)
    east = g * D * S * np.cos(L) / w
    yield east, result["east_velocity"], 1e-12 * east
    north = 2 * EARTH_RATE * S * np.sin(L) / w * east
    yield north, result["north_velocity"], 1e-12 * north
    yield D * S * np.sin(L), result["heading"], 1e-12 * D
    yield D * S * np.cos(L), result["roll"], 1e-12 * D


@equation("platform-remainder")
def _remainder() -> Iterator[Pair]:
    eta0 = 0.01
    result, scenario = line_amplitudes("A", ETA, eta0)
    c = np.arange(64) * 2 * np.pi / 64
    c1, c2 = c + scenario.polar.phase, c + scenario.equatorial.phase
    d_r = scenario.equatorial.misalignment * np.sin(c2) * (1 / np.cos(ETA) - 1 / np.cos(eta0))
    d_r -= scenario.polar.misalignment * np.cos(c1) * (np.tan(ETA) - np.tan(eta0))
    amplitude = 2 * abs(np.mean(d_r * np.exp(-1j * c)))
    w = scenario.polar_rotation.rate
    S = w**2 / (w**2 - earth.GM / earth.SEMI_MAJOR_AXIS**3)
    yield amplitude, result["heading"] / (S * np.sin(scenario.place.latitude)), 1e-12 * amplitude


@equation("platform-errors")
def _errors() -> Iterator[Pair]:
    """The equation integrated by SciPy with the gradient by differences, in inertial axes."""
    place, span, phi0, drift = Place(0.7, 0.3, 100.0), 900.0, (2e-5, -1e-5, 3e-5), (1e-9, 2e-9, -1e-9)
    bias, height = np.array([1e-5, -2e-5, 1e-5]), 2.0
    r0, axes = geodetic_to_earth(place.latitude, place.longitude, place.height), local_axes(0.7, 0.3)
    f0, (k1, k2) = specific_force_at_rest(r0), damping_gains(100.0)

    def slope(t: float, x: np.ndarray) -> np.ndarray:
        turn = axis_turn(2, -EARTH_RATE * t)
        r, f, n, delta, d = turn @ r0, turn @ f0, -(turn @ axes)[:, 2], x[:3], 100.0
        gradient = np.column_stack(
            [(gravitation(r + d * e) - gravitation(r - d * e)) / (2 * d) for e in np.eye(3)]
        )
        phi = np.array(phi0) + np.array(drift) * t
        above = n @ delta - height
        return np.r_[x[3:] - k1 * n * above, gradient @ delta + np.cross(phi, f) + bias - k2 * n * above]

    end = solve_ivp(slope, (0.0, span), np.zeros(6), rtol=1e-10, atol=1e-9).y[:, -1]
    back = axis_turn(2, EARTH_RATE * span)
    literal = axes.T @ (back @ end[:3])
    put_in = Perturbation(attitude=phi0, drift=drift, bias=tuple(bias), height=height)
    result = linear_errors(place, put_in, span, step=5.0)[-1]
    yield literal, result[1:4], 1e-8 * np.abs(literal).max()


@equation("platform-passage")
def _passage() -> Iterator[Pair]:
    """The integral over many times the width of the stationary phase, at its worst starting angle."""
    width, K, s = 3.5e-3, 0.0906, 7e-4
    x = 1e6
    S, C = fresnel(x)
    integral = 2 * width * np.sqrt(np.pi / (K * s)) * np.hypot(C, S)
    yield integral, width * np.sqrt(2 * np.pi / (K * s)), 1e-6 * integral
