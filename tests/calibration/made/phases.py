"""Records with a phase of its own in each position, and whether the intervals of their calibrations contain the truth.

The motion is integrated by Runge and Kutta in NumPy; nothing of piga is in it. The counter starts anew at each position.
"""

from __future__ import annotations

import warnings

import numpy as np

import piga
from piga.units import G0

TERMS = ("scale_factor", "tan_beta", "k0", "m_Y")
TANGENTS = (0.0, 1e-5, 3e-5, 1e-3)
"""Couplings: their standard uncertainty is some 3e-6 if the phases are known to fit."""


def record(seed: int, tangent: float) -> tuple[piga.Run, dict[str, float]]:
    """Record of 12 to 16 positions with a counter that starts anew at each; the motion by Runge and Kutta, nothing of piga."""
    rng = np.random.default_rng(seed)
    positions, rate, inner = int(rng.integers(12, 17)), 10.0, 8
    seconds = rng.integers(20, 41, positions)
    angle = np.linspace(0.1, np.pi - 0.1, positions) + rng.uniform(-0.05, 0.05, positions)
    x, y = G0 * np.cos(angle), G0 * np.sin(angle) * rng.choice([-1.0, 1.0], positions)
    K, k0, m_Y = 0.0906 * (1.0 + 1e-4 * rng.standard_normal()), 1e-4 * G0 * rng.standard_normal(), 2e-4
    n, h = int(seconds.max() * rate) + 1, 1.0 / rate / inner
    alpha = np.empty((n, positions))
    alpha[0] = rng.uniform(-np.pi, np.pi, positions)

    def slope(at: np.ndarray) -> np.ndarray:
        return K * (x + k0 + m_Y * y + tangent * y * np.sin(at))

    for i in range(1, n):
        at = alpha[i - 1]
        for _ in range(inner):
            a = slope(at)
            b = slope(at + 0.5 * h * a)
            c = slope(at + 0.5 * h * b)
            at = at + h / 6.0 * (a + 2.0 * b + 2.0 * c + slope(at + h * c))
            at = at + 2e-5 * np.sqrt(h) * rng.standard_normal(positions)
        alpha[i] = at
    t, output, f, segment, start = [], [], [], [], 0.0
    for k, size in enumerate((seconds * rate + 1).astype(int)):
        t.append(start + np.arange(size) / rate)
        start = t[-1][-1] + 15.0
        output.append(alpha[:size, k] + rng.uniform(-50.0, 50.0) + 2.5e-5 * rng.standard_normal(size))
        f.append(np.tile([x[k], y[k], 0.0], (size, 1)))
        segment.append(np.full(size, k, dtype=np.int32))
    run = piga.Run.from_arrays(
        *map(np.concatenate, (t, output, f)),
        uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
        scale_factor="0.8884 rad/s/g",
        segment=np.concatenate(segment),
        units="SI",
    )
    return run, {"scale_factor": K * G0, "tan_beta": tangent, "k0": k0 / G0, "m_Y": m_Y}


def errors(tangent: float, records: int) -> dict[str, np.ndarray]:
    """Errors of the coefficients in expanded uncertainties, for each record."""
    result: dict[str, list[float]] = {name: [] for name in TERMS}
    for seed in range(records):
        run, truth = record(seed, tangent)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            calibration = piga.calibrate(run, list(TERMS), phases="per-segment")
        for name in TERMS:
            result[name].append((calibration[name].value - truth[name]) / calibration[name].expanded)
    return {name: np.array(one) for name, one in result.items()}
