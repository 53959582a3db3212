"""Equations of docs/theory/compensation.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import brentq

import piga
from piga._kernels.compensation.sample import solve_far, solve_small
from piga._kernels.compensation.terms import near_nyquist
from piga.units import G0
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, instrument, run_of

from .registry import F0, FORCE, LOCKED, PHI, K, Pair, T, equation, rates


def _interval(f: np.ndarray, h: float) -> tuple[float, float, float, float]:
    """``delta``, ``alpha_m``, ``Y``, ``Z`` of an interval of constant force."""
    end = float(piga.closed_form(instrument(PHI), h, *f)[0])
    _, y, z = rates(f)
    return (end - PHI) / 2, (end + PHI) / 2, y * h, z * h


@equation("inverse-interval")
def _inverse() -> Iterator[Pair]:
    for f, h in ((F0, 0.05), (F0, 2.0), (LOCKED, 0.5)):
        delta, middle, Y, Z = _interval(f, h)
        coupling = Y * np.sin(middle) - Z * np.cos(middle)

        def misfit(
            A: float, delta: float = delta, square: float = Y * Y + Z * Z, coupling: float = coupling
        ) -> float:
            q = np.sqrt(complex((A**2 - square) / 4))
            return A * np.cos(delta) - (2 * (q / np.tan(q)).real * np.sin(delta) - coupling)

        exact = K * f[0] * h
        literal = brentq(misfit, exact - 1e-2, exact + 1e-2, xtol=1e-16)
        yield literal, 2 * delta + solve_far(delta, Y * Y + Z * Z, coupling), 1e-13
        yield literal, exact, 1e-13


@equation("inverse-small")
def _inverse_small() -> Iterator[Pair]:
    delta, middle, Y, Z = _interval(F0, 0.05)
    coupling = Y * np.sin(middle) - Z * np.cos(middle)
    e, _ = solve_small(delta, Y * Y + Z * Z, coupling)
    d = delta**2
    w = d + delta * e + (e**2 - Y**2 - Z**2) / 4

    def c(x: float) -> float:
        return np.sqrt(x) / np.tan(np.sqrt(x))

    yield e * np.cos(delta) - 2 * np.sin(delta) * (c(w) - c(d)) + coupling, 0.0, 1e-16


@equation("inverse-axis")
def _inverse_axis() -> Iterator[Pair]:
    """To the second order of the coupling; the library is exact."""
    h = 0.05
    run = run_of(np.array([0.0, h, 2 * h]), np.vstack([F0] * 3), phi=PHI)
    calibration = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI})
    delta, middle, _, _ = _interval(F0, h)
    g = np.sin(delta) / delta
    known = 2 * delta / (K * h)
    literal = known - g * TAN_BETA * (F0[1] * np.sin(middle) - F0[2] * np.cos(middle))
    yield literal, piga.compensate(run, calibration).ax[1], (np.hypot(F0[1], F0[2]) * TAN_BETA) ** 2 * K * h


@equation("inverse-uncertainty")
def _uncertainty() -> Iterator[Pair]:
    r, q, u_k0, u_tan = 2e-6, 1e-6, 3e-6, 2e-7
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI, "k0": 0.0}
    calibration = calibration_of(values, {"k0": u_k0, "tan_beta": u_tan}, angle_rms=r, angle_random_walk=q)
    h = 0.01
    run = run_of(np.array([0.0, h, 2 * h]), np.vstack([F0] * 3), phi=PHI)
    _, middle, _, _ = _interval(F0, h)
    J = np.array([G0, F0[1] * np.sin(middle) - F0[2] * np.cos(middle)])
    Sigma = np.diag([u_k0**2, u_tan**2])
    literal = np.sqrt(J @ Sigma @ J + (2 * r**2 / h + q**2) / (h * K**2))
    yield literal, piga.compensate(run, calibration).u_ax[1], 1e-4 * literal


@equation("inverse-velocity")
def _velocity() -> Iterator[Pair]:
    """A bias and noise over two stretches; a force of zero in the dead zone alone."""
    r, q, u_k0, h = 2e-6, 1e-6, 3e-6, 0.01
    calibration = calibration_of(
        {"scale_factor": K_G, "k0": 0.0}, {"k0": u_k0}, angle_rms=r, angle_random_walk=q
    )
    t = np.concatenate((h * np.arange(6), 1.0 + h * np.arange(9)))
    columns = {"t": t, "output": K * F0[0] * t, "f": np.tile(F0, (t.size, 1))}
    stream = piga.Compensator(calibration)
    stream.push(columns)
    duration = 13 * h
    yield stream.u_velocity() ** 2, (u_k0 * G0 * duration) ** 2 + (2 * r**2 * 2 + q**2 * duration) / K**2, 1e-18
    locked = piga.Compensator(calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.0}))
    still = np.tile([0.0, G0, 0.0], (6, 1))
    locked.push({"t": h * np.arange(6), "output": np.zeros(6), "f": still})
    yield locked.u_velocity(), 5 * h * G0 * TAN_BETA / np.sqrt(3), 1e-12


@equation("inverse-published")
def _published() -> Iterator[Pair]:
    run = run_of(T, FORCE, phi=PHI)
    calibration = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI}, phase_source="input")
    force = piga.compensate(run, calibration).ax[1:]
    turned = np.concatenate([[0.0], np.cumsum(np.diff(run.output))])
    phase = 0.5 * (turned[1:] + turned[:-1]) + PHI
    rate, (_, a_Y, a_Z) = np.diff(run.output) / np.diff(T), 0.5 * (FORCE[1:] + FORCE[:-1]).T
    literal = rate / K - np.hypot(a_Y, a_Z) * TAN_BETA * np.sin(phase - np.arctan2(a_Z, a_Y))
    yield literal, force, 1e-11


@equation("inverse-bow")
def _bow() -> Iterator[Pair]:
    """A base rate that is a cubic of time, over uneven intervals: its mean is that of the integral."""
    t = np.array([0.0, 0.011, 0.02, 0.032])
    cubic = np.polynomial.Polynomial([0.02, 1.0, 30.0, 20.0])
    h2, h1, h0 = np.diff(t)
    x = cubic(t)

    def second(i: int) -> float:
        return (
            2
            * ((x[i] - x[i - 1]) / (t[i] - t[i - 1]) - (x[i - 1] - x[i - 2]) / (t[i - 1] - t[i - 2]))
            / (t[i] - t[i - 2])
        )

    ahead = (h0 + 2 * h1) / (2 * (h0 + h1 + h2))
    literal = (x[2] + x[3]) / 2 - h0**2 / 12 * (second(3) + ahead * (second(3) - second(2)))
    whole = cubic.integ()
    yield literal, (whole(t[3]) - whole(t[2])) / h0, 1e-14
    force, turn = np.tile([G0, 0.0, 0.0], (4, 1)), np.column_stack([x, 0 * x, 0 * x])
    columns = {"t": t, "output": K * G0 * t, "f": force, "begins": np.arange(4) == 0}
    compensator = [piga.Compensator(calibration_of({"scale_factor": K_G})) for _ in range(2)]
    with_rate, without = compensator[0].push({**columns, "base_rate": turn}), compensator[1].push(columns)
    yield literal / K, with_rate.ax[3] - without.ax[3], 1e-12


@equation("inverse-hidden")
def _hidden() -> Iterator[Pair]:
    """Long oscillations of ten to two samples a period, and a white series, seen by the differences of their samples."""
    series = [np.sin(2 * np.pi * np.arange(30000) / period) for period in (10.0, 4.4, 2.9, 2.1)]
    for x in (*series, np.random.default_rng(0).standard_normal(30000)):
        first, second = np.mean(np.diff(x) ** 2), np.mean(np.diff(x, 2) ** 2)
        literal = second / 6 * min(1, (second - first) / (2 * first))
        yield max(literal, 0.0), near_nyquist(first, second, 0.0), 1e-13
    yield literal, 1.0, 0.05


@equation("inverse-servo")
def _servo() -> Iterator[Pair]:
    """At a sample of angle and rate the two terms are taken off as they stand."""
    s, d = 1e-5, 2e-5
    alpha, rate, turn = PHI + 0.4, 0.6, np.array([0.0, 0.1, -0.2])
    columns = {"t": [0.0], "output": [rate], "angle": [alpha - PHI], "f": F0[None], "base_rate": turn[None]}
    values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI}
    plain, whole = (
        piga.Compensator(calibration_of({**values, **terms}), kind="rate", step=0.01).push(columns).ax[0]
        for terms in ({}, {"servo": s, "servo_damping": d})
    )
    v, (_, y, z) = rate / K, F0 - turn / K
    across, along = y * np.sin(alpha) - z * np.cos(alpha), y * np.cos(alpha) + z * np.sin(alpha)
    yield plain - whole, -(2 * s * v * across**2 + d * v**2 * along) / G0**2, 1e-14
