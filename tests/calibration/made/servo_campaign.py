"""Do the intervals of K hold where the servo is not stiff? Many twin records of a dividing head.

Run as ``python -m tests.calibration.made.servo_campaign --tests 1000 [--record]``: figures of the model with the servo's
terms and of the model without. Every record has a servo, a coupling, a bias and starting angles of its own; the motion of
``DESIGNS`` records is integrated by the twin (equal to SciPy's rigid body: ``test_servo_truth.py``) and used again with new
noise. The noise is that of the shipped record: 5.2 arcsec white (a count of 18 arcsec), walk of 1 arcsec/sqrt(s).
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from benchmarks import measured

import piga
from piga.instrument.twin import PRESETS, TwinParameters, run_twin, servo_terms
from piga.units import G0

DESIGNS = 25
POSITIONS, SECONDS, INTERVAL = 24, 60.0, 0.5
WHITE, WALK = 2.52e-5, 4.8e-6
WITHOUT = ("scale_factor", "tan_beta", "k0", "k2", "m_Y")
WITH = (*WITHOUT, "servo", "servo_damping")


@dataclass(frozen=True)
class Motion:
    """A head test without noise: the twin, its bias [m/s^2], and angle, force and base rate per row."""

    twin: TwinParameters
    k0: float
    t: np.ndarray
    segment: np.ndarray
    alpha: np.ndarray
    force: np.ndarray
    base_rate: np.ndarray

    def truth(self) -> dict[str, float]:
        """True coefficients in file units."""
        p = self.twin
        servo, damping = servo_terms(p.K, p.pendulosity, p.integral_gain, damping=p.damping)
        return {
            "scale_factor": self.twin.K * G0,
            "tan_beta": math.tan(self.twin.pick_off_null),
            "phi": 0.0,
            "k0": self.k0 / G0,
            "k2": 0.0,
            "m_Y": 0.0,
            "servo": servo * G0**2,
            "servo_damping": damping * G0**2,
        }


@lru_cache(maxsize=DESIGNS)
def motion(
    seed: int, positions: int = POSITIONS, seconds: float = SECONDS, interval: float = INTERVAL
) -> Motion:
    """The test of design ``seed``: k_i from 1500 to 6000 N m/(rad s), the shift of K from 26 to 6 ppm of s g^2."""
    rng = np.random.default_rng([seed, 2028])
    p = replace(
        PRESETS["example"],
        integral_gain=float(np.exp(rng.uniform(math.log(1500.0), math.log(6000.0)))),
        damping=rng.uniform(0.03, 0.1),
        pick_off_null=rng.uniform(2e-4, 1e-3),
    ).with_scale_factor(rng.uniform(0.8, 0.9) / G0)
    k0, first, earth = rng.uniform(-2e-3, 2e-3) * G0, rng.uniform(0.0, 0.1), 7.292115e-5
    step = np.arange(round(seconds / interval) + 1) * interval
    parts, forces, rates = [], [], []
    for x in first + 2.0 * math.pi * np.arange(positions) / positions:
        f = 9.8 * np.array([math.cos(x), -math.sin(x), 0.0])
        omega = earth * np.array([0.64 * math.cos(x), -0.64 * math.sin(x), 0.77])
        felt = np.tile(f + np.array([k0, 0.0, 0.0]), (step.size, 1))
        turned = replace(p, alpha0=rng.uniform(0.0, 2.0 * math.pi))
        parts.append(run_twin(turned, step, felt, np.tile(omega, (step.size, 1))).alpha)
        forces.append(f)
        rates.append(omega)
    segment = np.repeat(np.arange(positions, dtype=np.int32), step.size)
    t = np.tile(step, positions) + segment * (seconds + 30.0)
    return Motion(p, k0, t, segment, np.concatenate(parts), np.array(forces)[segment], np.array(rates)[segment])


def record(path: Motion, rng: np.random.Generator) -> piga.Run:
    """The motion as a lab would read it."""
    walk = WALK * math.sqrt(path.t[1] - path.t[0]) * rng.standard_normal(path.t.size)
    output = path.alpha + np.cumsum(walk) + WHITE * rng.standard_normal(path.t.size)
    return piga.Run.from_arrays(
        path.t,
        output,
        path.force,
        uncertainty={"waived": {"earth_rate": "simulated at rest"}},
        scale_factor=0.85 / G0,
        base_rate=path.base_rate,
        segment=path.segment,
        serial="twin",
        units="SI",
    )


def one_test(seed: int, terms: tuple[str, ...], **options: float) -> dict[str, tuple[float, float, float]]:
    """Error, standard uncertainty and half-width of the 95 % interval by coefficient, file units."""
    path = motion(seed % DESIGNS, **options)
    calibration = piga.calibrate(record(path, np.random.default_rng([seed, 2027])), terms)
    truth = path.truth()
    return {c.name: (c.value - truth[c.name], c.std, c.expanded) for c in calibration.coefficients}


def figures(results: list[dict[str, tuple[float, float, float]]]) -> dict[str, dict[str, float]]:
    """Per coefficient: coverage, rms error, mean standard uncertainty."""
    table = {}
    for name in results[0]:
        error, std, half = np.array([row[name] for row in results]).T
        table[name] = {
            "coverage": float(np.mean(np.abs(error) <= half)),
            "rms_error": float(np.sqrt(np.mean(error**2))),
            "mean_u": float(std.mean()),
        }
    return table


MODELS = {"with `servo`, `servo_damping`": WITH, "with neither": WITHOUT}
GROUPS = {"tan_beta": "tan_beta", "phi": "phi", "servo": "servo terms", "servo_damping": "servo terms"}


def values(table: dict[str, dict[str, float]], tests: int) -> dict[str, measured.Value]:
    """Coverage, and the errors of K, by the columns of the table in the documentation."""
    held: dict[str, list[float]] = {}
    for coefficient, one in table.items():
        if coefficient != "scale_factor":
            held.setdefault(GROUPS.get(coefficient, "others"), []).append(round(100.0 * one["coverage"], 1))
    k, ppm = table["scale_factor"], 1e6 / 0.85  # K was drawn from 0.8 to 0.9 rad/s/g
    return {
        "records": tests,
        "coverage of K": round(100.0 * k["coverage"], 1),
        "rms error of K": float(f"{ppm * k['rms_error']:.2g}"),
        "mean u of K": float(f"{ppm * k['mean_u']:.2g}"),
    } | {kind: (min(shares), max(shares)) for kind, shares in held.items()}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tests", type=int, default=1000)
    parser.add_argument("--record", action="store_true", help="put the figures into docs/measured")
    chosen = parser.parse_args()
    known = {figure["name"] for figure in measured.load("servo-intervals")[1]}
    for model, terms in MODELS.items():
        table = figures([one_test(seed, terms) for seed in range(chosen.tests)])
        kept = {f"{model}: {name}": value for name, value in values(table, chosen.tests).items()}
        sys.stdout.write("".join(f"{name}: {value}\n" for name, value in kept.items()))
        if chosen.record:
            measured.record("servo-intervals", {name: value for name, value in kept.items() if name in known})


if __name__ == "__main__":
    main()
