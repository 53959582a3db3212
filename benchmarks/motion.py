"""Speed, accuracy and memory of the exact motion, with named baselines in the same run.

Run: python benchmarks/motion.py [--out FILE.json] [--quick]

Every time is the median of at least five repetitions (and the smallest, on a busy machine the better
guide), per sample. Baselines: numpy.sin and a memory copy for the machine, a compiled Runge-Kutta of
order 4, SciPy's DOP853. The table of docs/benchmarks-motion.md is the output of one run.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
import numpy as np
import scipy
from scipy.integrate import solve_ivp

from piga.instrument import (
    Instrument,
    propagate,
    propagate_fleet,
    propagate_function,
    propagate_increments,
    propagate_rate,
    propagate_segments,
    sensitivities,
)
from piga.instrument.fleet import available_cores
from piga.units import G0

INST = Instrument("0.8884 rad/s/g", "1000 arcsec", math.pi / 4)
RESULTS: list[dict[str, Any]] = []


def timed(work: Callable[[], Any], samples: int, repeats: int = 9) -> tuple[float, float]:
    """Median and smallest time [ns per sample] of ``work``, run once before."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times)) / samples * 1e9, min(times) / samples * 1e9


def report(name: str, ns: tuple[float, float], note: str = "", **more: float) -> None:
    RESULTS.append({"name": name, "median_ns": ns[0], "min_ns": ns[1], "note": note, **more})
    print(f"{name:58s} {ns[0]:12.2f} {ns[1]:12.2f}   {note}", flush=True)


@numba.njit(cache=True, error_model="numpy")
def rk4(t, f, K, tan_beta, alpha0, parts, alpha):
    """Baseline: the classical Runge-Kutta method, ``parts`` steps between samples, input linear."""
    x = alpha0
    alpha[0] = x
    for k in range(t.size - 1):
        h = (t[k + 1] - t[k]) / parts
        for j in range(parts):
            w = np.array([j / parts, (j + 0.5) / parts, (j + 1.0) / parts])
            a = K * (f[k, 0] + w * (f[k + 1, 0] - f[k, 0]))
            y = K * tan_beta * (f[k, 1] + w * (f[k + 1, 1] - f[k, 1]))
            z = K * tan_beta * (f[k, 2] + w * (f[k + 1, 2] - f[k, 2]))
            k1 = a[0] + y[0] * math.sin(x) - z[0] * math.cos(x)
            x2 = x + 0.5 * h * k1
            k2 = a[1] + y[1] * math.sin(x2) - z[1] * math.cos(x2)
            x3 = x + 0.5 * h * k2
            k3 = a[1] + y[1] * math.sin(x3) - z[1] * math.cos(x3)
            x4 = x + h * k3
            k4 = a[2] + y[2] * math.sin(x4) - z[2] * math.cos(x4)
            x += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        alpha[k + 1] = x
