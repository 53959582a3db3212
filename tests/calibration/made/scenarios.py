"""Simulated tests with a known truth, by name, whose motion shares no code with the estimator (``benchmarks/constant_force.py``).

``SCENARIOS`` are those of ``benchmarks/cases/coverage.toml``. ``joint`` is a head and a centrifuge of one instrument: the head
alone cannot separate k0, k2 and k_YY, the centrifuge alone knows nothing of k_YY and m_Y. ``EVERYWHERE`` shows every term.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from benchmarks.constant_force import PHI, SCALE, Array, ConstantForce, Joint
from benchmarks.intervals import scenarios

import piga
from piga.records.terms import si_factor
from piga.units import G0

Scenario = ConstantForce
SCENARIOS = {name: test for name, test in scenarios().items() if not name.startswith(("faint-", "other-"))}
JOINT = SCENARIOS["joint"]
assert isinstance(JOINT, Joint)
JOINT_TERMS = list(JOINT.terms)
COUPLED = ("scale_factor", "tan_beta", "k0")


def joint_test(
    rng: np.random.Generator, *, seconds: float = 20.0, rate: float = 10.0
) -> tuple[list[piga.Run], dict[str, float]]:
    """Dividing head (12 positions) and centrifuge (8 levels, 0.5 to 6 g), with the truth by coefficient key."""
    phases = rng.uniform(-np.pi, np.pi, 2)
    tests = [
        replace(test, seconds=seconds, rate=rate, phi=float(phase))
        for test, phase in zip(JOINT.runs, phases, strict=True)
    ]
    truth = {name: tests[0].true_value(name) for name in JOINT_TERMS}
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


def around(count: int = 18, levels: tuple[float, ...] = (0.5, 1.0)) -> Array:
    """Forces that point everywhere, at several levels [g]."""
    k = np.arange(count) + 0.5
    x, turn = 1.0 - 2.0 * k / count, k * np.pi * (3.0 - 5.0**0.5)
    side = np.sqrt(1.0 - x**2)
    one = np.stack([x, side * np.cos(turn), side * np.sin(turn)], axis=1)
    return np.vstack([level * one for level in levels])


EVERYWHERE = Scenario("everywhere", around(), white=2.5e-5, walk=2e-5, terms=COUPLED)


def with_term(run: piga.Run, name: str, size: float) -> piga.Run:
    """The record with a term of ``size`` (file units) added to the output, to first order."""
    x, y, z = run.f.T
    alpha, t = run.output + PHI, run.t - 0.5 * (run.t[0] + run.t[-1])
    values = {
        "k0": 1.0 + 0.0 * x, "k2": x**2, "k3": x**3, "k2o": x * np.abs(x), "k1a": np.abs(x), "m_Y": y, "m_Z": z, "k_XY": x * y,
        "k_XZ": x * z, "k_YY": y**2, "k_ZZ": z**2, "k_YZ": y * z, "k0_t": t, "s1": np.sin(alpha),
        "c2": np.cos(2.0 * alpha),
    }[name]  # fmt: skip
    step = np.diff(run.t, prepend=run.t[0])
    step[run.begins] = 0.0
    middle = 0.5 * (values + np.roll(values, 1))
    change = np.cumsum(SCALE / G0 * size * si_factor(name) * step * middle)
    return replace(run, output=run.output + change)
