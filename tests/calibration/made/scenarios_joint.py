"""A dividing head and a centrifuge of one instrument, each with its own power-up and noise: the scenario ``joint``.

The dividing head alone cannot separate k0, k2 and k_YY; the centrifuge alone knows nothing of k_YY and m_Y.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import piga
from tests.calibration.made.scenarios import SCENARIOS, Joint

JOINT = SCENARIOS["joint"]
assert isinstance(JOINT, Joint)
TERMS = list(JOINT.terms)


def joint_test(
    rng: np.random.Generator, *, seconds: float = 20.0, rate: float = 10.0
) -> tuple[list[piga.Run], dict[str, float]]:
    """Dividing head (12 positions) and centrifuge (8 levels, 0.5 to 6 g), with the truth by coefficient key."""
    phases = rng.uniform(-np.pi, np.pi, 2)
    tests = [
        replace(test, seconds=seconds, rate=rate, phi=float(phase))
        for test, phase in zip(JOINT.runs, phases, strict=True)
    ]
    truth = {name: tests[0].true_value(name) for name in TERMS}
    truth |= {f"phi[run {k}]": test.phi for k, test in enumerate(tests, start=1)}
    return [test.record(rng) for test in tests], truth


def scores(calibration: piga.Calibration, truth: dict[str, float]) -> dict[str, float]:
    """Error over standard uncertainty of every coefficient."""
    values = {}
    for c in calibration.coefficients:
        error = c.value - truth[c.key]
        if c.name == "phi":
            error = float(np.angle(np.exp(1j * error)))
        values[c.key] = error / c.std
    return values
