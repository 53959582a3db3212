"""The record that most tests calibrate: a tumble in one plane at two levels, simulated without piga's motion."""

from __future__ import annotations

import numpy as np
from benchmarks.constant_force import PHI, ConstantForce, tumble

import piga
from piga.calibration.model.solution import Layout
from piga.records.run_file import UncertaintyTable

SCALE = "0.8884 rad/s/g"
BETA = 3.6e-4
TERMS = ["scale_factor", "tan_beta", "k0", "k2", "m_Y"]
TRUTH = {"tan_beta": float(np.tan(BETA)), "phi": PHI, "k0": 1.6e-3, "k2": 2.0e-4, "m_Y": 2.4e-4}


def layout_of(coupled: bool, orders: tuple[int, ...], terms: tuple[str, ...], groups: int = 1) -> Layout:
    """The layout of one run: every shared term is one parameter in all ``groups``."""
    keys = tuple((name, None) for name in terms)
    return Layout(coupled, orders, keys, (np.arange(len(keys)),) * groups)


def at_rest(**sources) -> UncertaintyTable:
    """The uncertainties of a simulated stand: no rotation of the Earth and no servo is in the record."""
    waived = {"earth_rate": "simulated at rest", "servo": "simulated without"}
    return UncertaintyTable(waived=waived, **sources)


def record(
    rng: np.random.Generator,
    *,
    white: float = 2.5e-5,
    walk: float = 0.0,
    count_angle: float = 0.0,
    levels: tuple[float, ...] = (0.5, 1.0),
    seconds: float = 40.0,
    rate: float = 20.0,
    count: int = 12,
) -> piga.Run:
    """A run with the coefficients of ``TRUTH``; angle noise ``white`` [rad], random walk [rad/sqrt(s)]."""
    test = ConstantForce(
        "synthetic", tumble(count, levels), seconds, rate, white, walk, count_angle, TRUTH["tan_beta"],
        {name: TRUTH[name] for name in TERMS[2:]},
    )  # fmt: skip
    return test.record(rng)


def errors(calibration: piga.Calibration) -> dict[str, float]:
    """Error over standard uncertainty of each coefficient (phases of segments left out)."""
    values = {}
    for c in calibration.coefficients:
        if c.segment is None:
            error = c.value - (TRUTH | {"scale_factor": 0.8884})[c.name]
            values[c.name] = (float(np.angle(np.exp(1j * error))) if c.name == "phi" else error) / c.std
    return values
