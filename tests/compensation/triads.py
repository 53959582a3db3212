"""Mountings of several instruments, and records of all of them under one force."""

from __future__ import annotations

import numpy as np

from piga.compensation import Mounted
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, run_of

SKEWED = [(0.3, -0.2, 0.5), (0.4, 1.2, -0.3), (-1.3, 0.2, 2.0), (2.0, -0.6, 1.2)]
PHASES = (0.3, -1.1, 2.0, 0.9)


def rotation(angles) -> np.ndarray:
    a, b, c = angles
    x = np.array([[1, 0, 0], [0, np.cos(a), np.sin(a)], [0, -np.sin(a), np.cos(a)]])
    y = np.array([[np.cos(b), 0, -np.sin(b)], [0, 1, 0], [np.sin(b), 0, np.cos(b)]])
    z = np.array([[np.cos(c), np.sin(c), 0], [-np.sin(c), np.cos(c), 0], [0, 0, 1]])
    return x @ y @ z


def orthogonal() -> list[np.ndarray]:
    return [np.roll(np.eye(3), -i, axis=0) for i in range(3)]


def made(t, f, axes, kind="angle", errors=None, base=None, std=None):
    """Records and mounted instruments of a set that feels ``f`` in the common frame."""
    runs, mounted = [], []
    for i, matrix in enumerate(axes):
        omega = None if base is None else np.broadcast_to(base, (t.size, 3)) @ matrix.T
        runs.append(run_of(t, f @ matrix.T, phi=PHASES[i], kind=kind, errors=errors, base_rate=omega))
        values = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": PHASES[i], **(errors or {})}
        mounted.append(Mounted(calibration_of(values, std, angle_rms=1e-6), matrix))
    return runs, mounted
