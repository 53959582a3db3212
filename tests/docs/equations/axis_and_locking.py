"""Equations of docs/understanding/cross-coupling.md and docs/understanding/locking.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import piga
from piga.instrument import dead_zone, fixed_points, locking_time, mean_rate, revolution_period
from piga.studies.constant import published_closed_form
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, instrument, run_of

from .registry import F0, FORCE, LOCKED, PHI, TURN, K, Pair, T, equation


@equation("axis-definition")
def _axis() -> Iterator[Pair]:
    alpha, rate = piga.propagate(instrument(PHI), T, FORCE, TURN, with_rate=True, between="linear")
    n = np.column_stack([np.ones_like(alpha), TAN_BETA * np.sin(alpha), -TAN_BETA * np.cos(alpha)])
    yield (n * FORCE).sum(axis=1), (rate + (n * TURN).sum(axis=1)) / K, 1e-12


@equation("axis-single")
def _single() -> Iterator[Pair]:
    run = run_of(T, FORCE, phi=PHI, kind="rate")
    calibration = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHI})
    alpha, rate = piga.propagate(instrument(PHI), T, FORCE, with_rate=True, between="linear")
    literal = rate / K - TAN_BETA * (FORCE[:, 1] * np.sin(alpha) - FORCE[:, 2] * np.cos(alpha))
    yield literal, piga.compensate(run, calibration).ax, 1e-11
    yield literal, FORCE[:, 0], 1e-12


@equation("axis-drift")
def _drift() -> Iterator[Pair]:
    """Over whole revolutions, to the second order of r."""
    period = float(revolution_period(instrument(PHI), *F0))
    V, r = F0[0] * 40 * period, np.hypot(F0[1], F0[2]) * TAN_BETA / F0[0]
    turned = piga.closed_form(instrument(PHI), 40 * period, *F0)[0] - PHI
    yield K * V * r**2 / 2, K * V - turned, K * V * r**4


def _ab(f: np.ndarray) -> tuple[float, float]:
    return K * f[0], K * np.hypot(f[1], f[2]) * TAN_BETA


@equation("locking-period")
def _period() -> Iterator[Pair]:
    for sign in (1.0, -1.0):
        f = F0 * (sign, 1.0, 1.0)
        a, b = _ab(f)
        yield 2 * np.pi / np.sqrt(a**2 - b**2), revolution_period(instrument(PHI), *f), 1e-13
        yield np.sign(a) * np.sqrt(a**2 - b**2), mean_rate(instrument(PHI), *f), 1e-15


@equation("locking-time")
def _time() -> Iterator[Pair]:
    a, b = _ab(LOCKED)
    yield 1 / np.sqrt(b**2 - a**2), locking_time(instrument(PHI), *LOCKED), 1e-12


@equation("locking-dead-zone")
def _zone() -> Iterator[Pair]:
    limit = np.hypot(F0[1], F0[2]) * TAN_BETA
    yield (-limit, limit), dead_zone(instrument(PHI), *F0[1:]), 1e-15
    assert piga.regime(instrument(PHI), limit * 0.999, *F0[1:]) == "locked"
    assert piga.regime(instrument(PHI), limit * 1.001, *F0[1:]) == "running"


@equation("locking-rest")
def _rest() -> Iterator[Pair]:
    a, b = _ab(LOCKED)
    resting = np.arctan2(-a / b, -np.sqrt(1 - a**2 / b**2)) + np.arctan2(LOCKED[2], LOCKED[1])
    yield np.exp(1j * resting), np.exp(1j * float(fixed_points(instrument(PHI), *LOCKED)[0])), 1e-14
    yield np.exp(1j * resting), np.exp(1j * float(piga.closed_form(instrument(PHI), 1e5, *LOCKED)[0])), 1e-12


@equation("locking-running-form")
def _running_form() -> Iterator[Pair]:
    gamma, r = np.arctan2(F0[2], F0[1]), np.hypot(F0[1], F0[2]) * TAN_BETA / F0[0]
    p0, V = np.tan((PHI - gamma) / 2), F0[0] * 3.0
    C0 = 2 / np.sqrt(1 - r**2) * np.arctan((p0 + r) / np.sqrt(1 - r**2))
    p = np.sqrt(1 - r**2) * np.tan(np.sqrt(1 - r**2) / 2 * (K * V + C0)) - r
    literal = np.exp(1j * (gamma + 2 * np.arctan(p)))
    yield literal, np.exp(1j * published_closed_form(4, instrument(PHI), 3.0, *F0)[0]), 1e-13
    yield literal, np.exp(1j * piga.closed_form(instrument(PHI), 3.0, *F0)[0]), 1e-13
