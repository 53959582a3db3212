"""Three servo twins in a skewed mounting on a slowly moving input, with and without compensation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga.compensation import Mounted, SetCompensator, compensate
from piga.instrument.twin.electronics import random_walk
from piga.instrument.twin.linear import predicted_k2
from piga.instrument.twin.parameters import PRESETS, TwinParameters
from piga.instrument.twin.run import run_twin
from piga.records import Run
from piga.units import G0
from tests.compensation.twin_data import calibration_of

Array = NDArray[np.float64]

STEP = 0.01
ANGLE_NOISE = 1e-6
"""White noise of the encoder [rad]."""
WALK = 1e-5
"""Angle random walk [rad/sqrt(s)]."""
TILTS = (4.8e-3, -4.0e-3, 3.0e-3)
PHASES = (0.3, -1.1, 2.0)
DESIGN = PRESETS["example-stiff"]


@dataclass(frozen=True)
class TwinTriad:
    """Errors along the input axis of the first instrument [m/s^2] per row; ``psi`` its angle [rad]."""

    psi: Array
    before: Array
    after: Array
    noise: Array


def mounting() -> Array:
    """Input axes on a cone of 35 degrees about the vertical, each instrument rolled by another angle."""
    rows = []
    for i in range(3):
        turn, roll = 2.0 * np.pi * i / 3.0 + 0.2, 0.5 + 1.3 * i
        x = np.array([np.sin(0.61) * np.cos(turn), np.sin(0.61) * np.sin(turn), np.cos(0.61)])
        y = np.cross([0.0, 0.0, 1.0], x)
        y /= np.linalg.norm(y)
        z = np.cross(x, y)
        rows.append([x, np.cos(roll) * y + np.sin(roll) * z, -np.sin(roll) * y + np.cos(roll) * z])
    return np.array(rows)


def calibrated(twin: TwinParameters) -> dict[str, float]:
    """Coefficients of a design from a run without noise at rest: what the servo adds to order 1 is in them."""
    t = np.arange(8001) * STEP
    f = np.tile(np.array([0.8, 0.5, 0.3]) * G0, (t.size, 1))
    psi = run_twin(twin, t, f).alpha - twin.alpha0
    record = Run.from_arrays(t, psi, f, scale_factor=twin.K, units="SI")
    values = {
        "scale_factor": twin.K * G0, "tan_beta": np.tan(twin.pick_off_null), "phi": twin.alpha0,
        "k2": predicted_k2(twin) * G0,
    }  # fmt: skip
    for _ in range(2):
        result = compensate(record, calibration_of(values), uncertainty=False).ax[1:] - f[1:, 0]
        alpha = values["phi"] + 0.5 * (psi[1:] + psi[:-1])
        turned = np.array([np.sin(alpha), np.cos(alpha)])
        by_tan = f[0, 1] * turned[0] - f[0, 2] * turned[1]
        by_phi = values["tan_beta"] * (f[0, 1] * turned[1] + f[0, 2] * turned[0])
        columns = np.column_stack([by_tan, by_phi, np.ones(alpha.size), np.sin(2 * alpha), np.cos(2 * alpha)])
        step = np.linalg.lstsq(columns, result, rcond=None)[0]
        values["tan_beta"] += step[0]
        values["phi"] += step[1]
    return values


def run(seconds: float, seed: int = 4) -> TwinTriad:
    """Angles of the twins with noise, compensated with coefficients calibrated on each, against the truth."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds / STEP) + 1) * STEP
    swing = 0.05 * np.sin(2.0 * np.pi * 0.01 * t[:, None] + np.array([0.0, 1.0, 2.0]))
    f = G0 * (np.array([0.1, -0.05, 1.0]) + swing)
    axes, angles, noises, full, bare = mounting(), [], [], [], []
    for matrix, tilt, phase in zip(axes, TILTS, PHASES, strict=True):
        twin = replace(DESIGN, pick_off_null=tilt, alpha0=phase)
        angles.append(run_twin(twin, t, f @ matrix.T).alpha - phase)
        noises.append(random_walk(rng, t.size, STEP, WALK) + ANGLE_NOISE * rng.standard_normal(t.size))
        full.append(Mounted(calibration_of(calibrated(twin)), matrix))
        bare.append(Mounted(calibration_of({"scale_factor": twin.K * G0}), matrix))
    mean = 0.5 * (f[1:] + f[:-1])
    x = axes[0, 0]
    measured = np.array(angles) + np.array(noises)
    result = {
        name: (SetCompensator(mounted, uncertainty=False).push(t, measured).f[1:] - mean) @ x
        for name, mounted in (("before", bare), ("after", full))
    }
    noise = np.diff(noises[0]) / (STEP * DESIGN.K)
    return TwinTriad(measured[0], result["before"], result["after"], noise)


def spectrum(psi: Array, error: Array, orders: Array) -> Array:
    """Amplitude of the error [m/s^2] at revolution orders, under a raised cosine over the turns."""
    middle = 0.5 * (psi[1:] + psi[:-1])
    turned = np.diff(psi)
    window = turned * (1.0 - np.cos(2.0 * np.pi * (middle - psi[0]) / (psi[-1] - psi[0])))
    centred = error - np.sum(window * error) / window.sum()
    return (
        np.array([2.0 * abs(np.sum(window * centred * np.exp(-1j * n * middle))) for n in orders])
        / window.sum()
    )
