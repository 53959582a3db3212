"""Records of sets that are held in many attitudes and moved between them, with known truth."""

from __future__ import annotations

import numpy as np

G = 9.81
STEP = 0.02
LOWER = np.array([[400.0, 0.0, 0.0], [2.0, 410.0, 0.0], [-3.0, 5.0, 420.0]])
"""Sensitivities [count/(m/s^2)]."""
BIAS = np.array([100.0, -250.0, 40.0])


def directions(rng: np.random.Generator, count: int):
    """Directions all over the sphere, in random order."""
    vectors = rng.standard_normal((count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def record(rng: np.random.Generator, attitudes, matrix=LOWER, bias=BIAS, scatter=0.05, noise=2.0, dwell=3.0):
    """Time and outputs: each attitude held for ``dwell`` seconds, and half a second of motion before the next.

    ``scatter`` [count] is that of the bias from spell to spell, ``noise`` [count] white.
    """
    still, moving = int(dwell / STEP), int(0.5 / STEP)
    parts = []
    for direction in attitudes:
        base = matrix @ (G * direction) + bias + scatter * rng.standard_normal(len(bias))
        parts.append(np.tile(base, (still, 1)))
        wave = np.sin(np.linspace(0.0, 9.0, moving))[:, None] * rng.uniform(500.0, 1500.0, len(bias))
        parts.append(base + wave)
    outputs = np.concatenate(parts)
    return STEP * np.arange(len(outputs)), outputs + noise * rng.standard_normal(outputs.shape)
