"""Synthetic records with known truth, made with the exact propagator (independent of the estimator)."""

from __future__ import annotations

import numpy as np

import piga
from piga.records.run_file import UncertaintyTable
from piga.units import G0

SCALE = "0.8884 rad/s/g"
BETA = 3.6e-4
PHI = 0.48
TRUTH = {"tan_beta": float(np.tan(BETA)), "phi": PHI, "k0": 1.6e-3, "k2": 2.0e-4, "m_Y": 2.4e-4}


def at_rest(**sources) -> UncertaintyTable:
    """The uncertainties of a simulated stand: no rotation of the Earth and no servo is in the record."""
    waived = {"earth_rate": "simulated at rest", "servo": "simulated without"}
    return UncertaintyTable(waived=waived, **sources)


def positions(count: int = 12, seconds: float = 40.0, rate: float = 20.0, levels: tuple[float, ...] = (1.0,)):
    """Tumble in one plane at several levels [g]: t, segment, f (m/s^2)."""
    n = int(seconds * rate)
    t, segment, f = [], [], []
    for level in levels:
        for k in range(count):
            angle = 2.0 * np.pi * k / count + 0.13
            index = len(t)
            t.append(index * (seconds + 5.0) + np.arange(n + 1) / rate)
            segment.append(np.full(n + 1, index, dtype=np.int32))
            f.append(np.tile(level * G0 * np.array([np.cos(angle), -np.sin(angle), 0.02]), (n + 1, 1)))
    return np.concatenate(t), np.concatenate(segment), np.vstack(f)


def record(
    rng: np.random.Generator,
    *,
    white: float = 2.5e-5,
    walk: float = 0.0,
    count_angle: float = 0.0,
    per_segment: bool = False,
    levels: tuple[float, ...] = (0.5, 1.0),
    seconds: float = 40.0,
    rate: float = 20.0,
    count: int = 12,
) -> piga.Run:
    """A run with the coefficients of ``TRUTH``; angle noise ``white`` [rad], random walk [rad/sqrt(s)]."""
    t, segment, f = positions(count, seconds, rate, levels)
    inst = piga.Instrument(scale_factor=SCALE, beta=BETA)
    feels = f.copy()
    feels[:, 0] += G0 * TRUTH["k0"] + TRUTH["k2"] / G0 * f[:, 0] ** 2 + TRUTH["m_Y"] * f[:, 1]
    output = np.empty(t.size)
    alpha = PHI
    for label in range(int(segment[-1]) + 1):
        part = segment == label
        if per_segment:
            alpha = rng.uniform(-np.pi, np.pi) if label else PHI
        start = piga.Instrument(scale_factor=inst.scale_factor, beta=BETA, alpha0=alpha)
        path = piga.propagate(start, t[part], feels[part], between="linear")
        steps = np.diff(t[part], prepend=t[part][0])
        path = path + walk * np.cumsum(np.sqrt(steps) * rng.standard_normal(path.size))
        output[part] = path - PHI
        alpha = float(path[-1]) + 1.0
    output = output + white * rng.standard_normal(t.size)
    if count_angle:
        output = np.round(output / count_angle) * count_angle
    return piga.Run.from_arrays(
        t,
        output,
        f,
        uncertainty=at_rest(),
        scale_factor=SCALE,
        segment=segment,
        resolution=count_angle,
        serial="synthetic",
        units="SI",
    )


TERMS = ["scale_factor", "tan_beta", "k0", "k2", "m_Y"]


def truth_of(key: str) -> float:
    """True value in file units of a coefficient."""
    return 0.8884 if key == "scale_factor" else TRUTH[key]


def errors(calibration: piga.Calibration) -> dict[str, float]:
    """Error over standard uncertainty of each coefficient (phases of segments left out)."""
    values = {}
    for coefficient in calibration.coefficients:
        if coefficient.segment is not None:
            continue
        error = coefficient.value - truth_of(coefficient.name)
        if coefficient.name == "phi":
            error = float(np.angle(np.exp(1j * error)))
        values[coefficient.name] = error / coefficient.std
    return values
