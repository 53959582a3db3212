"""Random calibration problems: coefficients, forces and noise drawn from a seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import piga
from piga.records.run_file import EstimationTable
from piga.units import G0


def problem(seed: int) -> tuple[piga.Run, dict[str, float]]:
    """Random coefficients, random plan of moving forces; 400 samples, noise levels known."""
    rng = np.random.default_rng([seed, 71])
    truth = {
        "tan_beta": 10.0 ** rng.uniform(-3.5, -2.0),
        "phi": rng.uniform(-np.pi, np.pi),
        "k0": rng.normal(0.0, 1e-3),
    }
    t = np.arange(400) * 0.04
    a = rng.uniform(0.3, 2.0, 3) * rng.choice([-1.0, 1.0], 3)
    w, p = rng.uniform(0.05, 0.8, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
    f = np.column_stack(
        [a[0] + 0.5 * np.sin(w[0] * t + p[0]), *(3.0 * a[i] * np.sin(w[i] * t + p[i]) for i in (1, 2))]
    )
    f *= G0
    inst = piga.Instrument(
        scale_factor="0.8884 rad/s/g", beta=float(np.arctan(truth["tan_beta"])), alpha0=truth["phi"]
    )
    alpha = piga.propagate(inst, t, f + np.array([truth["k0"] * G0, 0.0, 0.0]))
    output = alpha - truth["phi"] + 2e-5 * rng.standard_normal(t.size)
    run = piga.Run.from_arrays(
        t,
        output,
        f,
        uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
        scale_factor="0.8884 rad/s/g",
        units="SI",
    )
    known = EstimationTable(angle_rms="2e-5 rad", angle_random_walk="1e-8 rad/sqrt(s)")
    return replace(run, estimation=known), truth
