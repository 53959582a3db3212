"""One synthetic joint test: a dividing head and a centrifuge, each with its own power-up and noise.

The dividing head alone cannot separate k0, k2 and k_YY; the centrifuge alone knows nothing of k_YY and m_Y.
"""

from __future__ import annotations

import numpy as np

import piga
from piga.units import G0

SCALE = "0.8884 rad/s/g"
TRUE_SCALE = 0.8886
TRUTH = {
    "scale_factor": TRUE_SCALE,
    "tan_beta": 3.6e-4,
    "k0": 1.6e-3,
    "k2": 2.0e-4,
    "k_YY": -1.1e-4,
    "m_Y": 2.4e-4,
}
"""Coefficients in file units; the phases of each test are drawn."""
TERMS = list(TRUTH)


def joint_test(
    rng: np.random.Generator,
    *,
    seconds: float = 20.0,
    rate: float = 10.0,
    white: tuple[float, float] = (2.5e-5, 6e-5),
    walk: tuple[float, float] = (1e-5, 2e-5),
) -> tuple[list[piga.Run], dict[str, float]]:
    """Dividing head (12 positions) and centrifuge (8 levels, 0.5 to 6 g), with the truth by coefficient key."""
    angles = 2.0 * np.pi * np.arange(12) / 12.0 + 0.13
    head = [G0 * np.array([np.cos(x), -np.sin(x), 0.02]) for x in angles]
    levels = (0.5, 1.0, -1.5, 2.0, -3.0, 4.0, -5.0, 6.0)
    spun = [G0 * np.array([level, 0.3, 1.0]) for level in levels]
    phases = rng.uniform(-np.pi, np.pi, 2)
    names = ("run 1", "run 2")
    runs = [
        _run(rng, forces, phase, white=w, walk=q, seconds=seconds, rate=rate)
        for forces, phase, w, q in zip((head, spun), phases, white, walk, strict=True)
    ]
    return runs, TRUTH | {f"phi[{name}]": float(phase) for name, phase in zip(names, phases, strict=True)}


def _run(
    rng: np.random.Generator,
    forces: list[np.ndarray],
    phase: float,
    *,
    white: float,
    walk: float,
    seconds: float,
    rate: float,
) -> piga.Run:
    n = int(seconds * rate) + 1
    t = np.concatenate([k * (seconds + 5.0) + np.arange(n) / rate for k in range(len(forces))])
    segment = np.repeat(np.arange(len(forces), dtype=np.int32), n)
    f = np.repeat(np.array(forces), n, axis=0)
    feels = f.copy()
    feels[:, 0] += G0 * TRUTH["k0"] + TRUTH["m_Y"] * f[:, 1]
    feels[:, 0] += (TRUTH["k2"] * f[:, 0] ** 2 + TRUTH["k_YY"] * f[:, 1] ** 2) / G0
    output = np.empty(t.size)
    alpha = phase
    for k in range(len(forces)):
        part = segment == k
        start = piga.Instrument(
            scale_factor=f"{TRUE_SCALE} rad/s/g", beta=float(np.arctan(TRUTH["tan_beta"])), alpha0=alpha
        )
        path = piga.propagate(start, t[part], feels[part], between="linear")
        output[part] = path - phase + walk / np.sqrt(rate) * np.cumsum(rng.standard_normal(n))
        alpha = float(output[part][-1]) + phase + 1.0
    output += white * rng.standard_normal(t.size)
    return piga.Run.from_arrays(
        t,
        output,
        f,
        uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
        scale_factor=SCALE,
        segment=segment,
        serial="synthetic",
        units="SI",
    )


def scores(calibration: piga.Calibration, truth: dict[str, float]) -> dict[str, float]:
    """Error over standard uncertainty of every coefficient."""
    values = {}
    for c in calibration.coefficients:
        error = c.value - truth[c.key]
        if c.name == "phi":
            error = float(np.angle(np.exp(1j * error)))
        values[c.key] = error / c.std
    return values
