"""Simulated records that hold a term the model may lack, and forces that show every term."""

from dataclasses import replace

import numpy as np

from piga.records.terms import si_factor
from piga.units import G0
from tests.calibration.made.scenarios import PHI, SCALE

TERMS = ("scale_factor", "tan_beta", "k0")


def around(count=18, levels=(0.5, 1.0)):
    """Forces that point everywhere, at several levels [g]."""
    k = np.arange(count) + 0.5
    x, turn = 1.0 - 2.0 * k / count, k * np.pi * (3.0 - 5.0**0.5)
    side = np.sqrt(1.0 - x**2)
    one = np.stack([x, side * np.cos(turn), side * np.sin(turn)], axis=1)
    return np.vstack([level * one for level in levels])


def with_term(run, name, size):
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
