"""A short record; the fixtures ``run`` and ``cal`` are it and its calibration."""

from __future__ import annotations

import pickle

import numpy as np

import piga
from piga.units import G0

SCALE = "0.8884 rad/s/g"
TERMS = ["scale_factor", "tan_beta", "k0"]


def a_run(**settings) -> piga.Run:
    """Two segments of 400 samples with counting noise."""
    t = np.arange(800) * 0.05
    f = G0 * np.column_stack([0.8 + 0.3 * np.sin(0.7 * t), 0.5 * np.cos(0.4 * t), 0.2 + 0 * t])
    inst = piga.Instrument(scale_factor=SCALE, beta="1000 arcsec", alpha0=0.4)
    psi = piga.propagate(inst, t, f, between="linear") + 1e-5 * np.random.default_rng(1).standard_normal(t.size)
    settings.setdefault("segment", np.repeat([0, 1], 400))
    return piga.Run.from_arrays(t, psi, f, scale_factor=SCALE, serial="T-1", **settings, units="SI")


def pickled(value):
    """The value after a journey as bytes."""
    return pickle.loads(pickle.dumps(value))  # noqa: S301 - our own bytes
