"""The register of equations, and the instrument and inputs that several of them are evaluated for."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from piga.units import G0
from tests.compensation.twin_data import K_G, TAN_BETA

Pair = tuple[object, object, float]
EQUATIONS: dict[str, Callable[[], Iterator[Pair]]] = {}

K = K_G / G0
PHI = 0.7
T = np.arange(0.0, 3.0, 0.01)
FORCE = G0 * np.column_stack([0.8 + 0.3 * np.sin(2 * T), 4 + np.cos(T), 1 + 0.2 * T])
TURN = np.column_stack([0.01 * np.sin(T), 0.02 + 0 * T, -0.01 * T])
F0 = G0 * np.array([0.6, 4.0, 3.0])
"""A constant force, running."""
LOCKED = G0 * np.array([0.01, 4.0, 3.0])


def equation(label: str) -> Callable[[Callable[[], Iterator[Pair]]], Callable[[], Iterator[Pair]]]:
    """Register an entry under its label."""

    def register(entry: Callable[[], Iterator[Pair]]) -> Callable[[], Iterator[Pair]]:
        EQUATIONS[label] = entry
        return entry

    return register


def rates(f: np.ndarray) -> tuple[float, float, float]:
    """``a, y, z`` [rad/s] of a constant force."""
    return K * f[0], TAN_BETA * K * f[1], TAN_BETA * K * f[2]


def matrix(a: float, y: float, z: float) -> np.ndarray:
    """``M`` of the Riccati equation."""
    return 0.5 * np.array([[y, a - z], [-(a + z), -y]])


def half_angles(alpha: float) -> np.ndarray:
    return np.array([np.sin(alpha / 2), np.cos(alpha / 2)])
