"""Speed and accuracy of the exact motion, with named baselines in the same run.

Run: python -m benchmarks.motion [--record]; ``--record`` puts the figures into docs/measured/motion.json.

Every time is the median of several calls, with the smallest beside it (on a busy machine the better guide).
Baselines: a compiled Runge-Kutta of order 4, and SciPy's DOP853.
"""

from __future__ import annotations

import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import scipy
from benchmarks.harness import put_down, seconds
from scipy.integrate import solve_ivp

from piga.instrument import (
    Instrument,
    propagate,
    propagate_fleet,
    propagate_increments,
    propagate_rate,
    propagate_segments,
)
from piga.units import G0

INST = Instrument("0.8884 rad/s/g", "1000 arcsec", math.pi / 4)
K, TAN_BETA = INST.scale_factor, INST.tan_beta
W = 2.0 * math.pi * 2.0  # the 2 Hz vibration
RESULTS: dict[str, dict[str, Any]] = {}


def timed(work: Callable[[], object], per: int, repeats: int = 11) -> tuple[float, float]:
    """Median and smallest processor time of ``work`` [ns], divided by ``per``."""
    times = seconds(work, repeats, time.process_time) / per * 1e9
    return float(np.median(times)), float(times.min())


def show(name: str, value: tuple[float, float] | float, note: str = "") -> None:
    pair = value if isinstance(value, tuple) else (value, value)
    least = {} if pair[0] == pair[1] else {"least": pair[1]}
    RESULTS[name] = {"value": pair[0], **least} | ({"note": note} if note else {})


def force(t: np.ndarray) -> np.ndarray:
    """2 Hz vibration on all axes [m/s^2], shape (n, 3)."""
    x = (0.5 + 0.5 * np.sin(W * t)) * G0
    return np.stack([x, 5 * G0 * np.cos(W * t + 0.4), 2 * G0 * np.sin(W * t + 1.0)], axis=-1)


def force_integral(t: np.ndarray) -> np.ndarray:
    x = (0.5 * t - 0.5 * np.cos(W * t) / W) * G0
    return np.stack([x, 5 * G0 * np.sin(W * t + 0.4) / W, -2 * G0 * np.cos(W * t + 1.0) / W], axis=-1)


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def rk4(t, f, K, tan_beta, alpha0, parts, alpha):
    """Baseline: the classical Runge-Kutta method, ``parts`` steps between samples, input linear."""
    x = alpha0
    alpha[0] = x
    coupling = K * tan_beta
    for k in range(t.size - 1):
        h = (t[k + 1] - t[k]) / parts
        a0, y0, z0 = K * f[k, 0], coupling * f[k, 1], coupling * f[k, 2]
        da, dy, dz = K * f[k + 1, 0] - a0, coupling * f[k + 1, 1] - y0, coupling * f[k + 1, 2] - z0
        for j in range(parts):
            u, v, w = j / parts, (j + 0.5) / parts, (j + 1.0) / parts
            k1 = a0 + u * da + (y0 + u * dy) * math.sin(x) - (z0 + u * dz) * math.cos(x)
            a, y, z = a0 + v * da, y0 + v * dy, z0 + v * dz
            x2 = x + 0.5 * h * k1
            k2 = a + y * math.sin(x2) - z * math.cos(x2)
            x3 = x + 0.5 * h * k2
            k3 = a + y * math.sin(x3) - z * math.cos(x3)
            x4 = x + h * k3
            k4 = a0 + w * da + (y0 + w * dy) * math.sin(x4) - (z0 + w * dz) * math.cos(x4)
            x += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        alpha[k + 1] = x


def serial(n: int) -> None:
    t = np.arange(n) * 1e-3
    f = np.random.default_rng(2).normal(0.0, 10.0, (n, 3))
    dv, alpha = f[1:] * 1e-3, np.empty(n)
    linear = "between='linear'"
    for name, work, note in (
        ("rate output", lambda: propagate_rate(INST, t, f, between="linear"), linear),
        ("angle output", lambda: propagate(INST, t, f, between="linear"), linear),
        ("angle output, smooth between samples", lambda: propagate(INST, t, f), "the default"),
        ("angle and rate", lambda: propagate(INST, t, f, with_rate=True, between="linear"), linear),
        ("angle from increments", lambda: propagate_increments(INST, t, dv), ""),
    ):
        show(f"{name}, one core", timed(work, n), note)
    baseline = timed(lambda: rk4(t, f, K, TAN_BETA, INST.alpha0, 1, alpha), n, 5)
    show("baseline: compiled RK4, one step a sample", baseline)


def fleet(instruments: int, samples: int) -> None:
    """Many instruments under one input. Start it pinned to one core, to compare time per core."""
    t = np.arange(samples) * 1e-3
    f = np.random.default_rng(2).normal(0.0, 10.0, (samples, 3))
    motions = [Instrument(K * (1 + 1e-4 * i), 0.004 + 1e-5 * i, 0.01 * i) for i in range(instruments)]
    times = timed(lambda: propagate_fleet(motions, t, f, between="linear"), instruments * samples, 9)
    show(f"fleet of {instruments}, angle", times, "between='linear'")


def jax_scan(instruments: int, samples: int) -> None:
    """The fleet by JAX: the same step in ``vmap`` of ``lax.scan``, float64, pinned to one core; left out without JAX."""
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        return
    jax.config.update("jax_enable_x64", True)
    t = np.arange(samples) * 1e-3
    f = np.random.default_rng(2).normal(0.0, 10.0, (samples, 3))

    def one(K, tan_beta, alpha0):
        a, y, z = K * f[:, 0], K * tan_beta * f[:, 1], K * tan_beta * f[:, 2]
        h, pairs = jnp.diff(t), [(v[:-1], v[1:]) for v in (a, y, z)]
        (a0, a1), (y0, y1), (z0, z1) = pairs
        A = h / 2 * (a0 + a1) + h**2 / 12 * (y0 * z1 - z0 * y1)
        Y = h / 2 * (y0 + y1) + h**2 / 12 * (a0 * z1 - z0 * a1)
        Z = h / 2 * (z0 + z1) - h**2 / 12 * (a0 * y1 - y0 * a1)
        x = (Y * Y + Z * Z - A * A) / 4
        c = x * (1 / 2 + x * (1 / 24 + x * (1 / 720 + x / 40320)))
        s = 0.5 * (1 + x * (1 / 6 + x * (1 / 120 + x * (1 / 5040 + x / 362880))))

        def step(state, row):
            turns, p, q = state
            pp, pq, qp, qq = row
            p1, q1 = p + (pp * p + pq * q), q + (qp * p + qq * q)
            turned = q1 < 0
            turns = turns + jnp.where(turned, jnp.where(p1 > 0, 1.0, -1.0), 0.0)
            scale = jnp.where(turned, -1.0, 1.0) / jnp.sqrt(p1 * p1 + q1 * q1)
            p1, q1 = p1 * scale, q1 * scale
            return (turns, p1, q1), 2 * jnp.pi * turns + 2 * jnp.arctan2(p1, q1)

        start = (0.0, jnp.sin(alpha0 / 2), jnp.cos(alpha0 / 2))
        return jax.lax.scan(step, start, (c + s * Y, s * (A - Z), -s * (A + Z), c - s * Y))[1]

    k = np.arange(instruments)
    motions, run = (K * (1 + 1e-4 * k), np.tan(0.004 + 1e-5 * k), 0.01 * k), jax.jit(jax.vmap(one))
    fleet = [Instrument(K * (1 + 1e-4 * i), 0.004 + 1e-5 * i, 0.01 * i) for i in k[:2]]
    ours = propagate_fleet(fleet, t, f, between="linear")[:, 1:]
    off = float(np.abs((np.asarray(run(*motions))[:2] - ours + np.pi) % (2 * np.pi) - np.pi).max())
    times = timed(lambda: run(*motions).block_until_ready(), instruments * samples, 5)
    mine = RESULTS[f"fleet of {instruments}, angle"]["value"]
    note = f"JAX {jax.__version__}, `vmap` of `lax.scan`, float64, on one core: {times[0]:.3g} ns; angles {off:.0e} rad apart"
    show("JAX's scan over fleet", times[0] / mine, note)


def interpolated(at: np.ndarray, t: np.ndarray, f: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, t, f[:, k]) for k in range(3)], axis=-1)


def dop853_sampled(t: np.ndarray, f: np.ndarray, rtol: float) -> tuple[float, float]:
    """DOP853 restarted at every sample (the input has a kink there): angle and seconds."""
    rows, times = f.tolist(), t.tolist()
    start, x = time.process_time(), [INST.alpha0]
    for k in range(len(times) - 1):
        t0, h = times[k], times[k + 1] - times[k]
        (a0, y0, z0), (a1, y1, z1) = rows[k], rows[k + 1]

        def slope(s, x, t0=t0, h=h, a0=a0, a1=a1, y0=y0, y1=y1, z0=z0, z1=z1):
            w = (s - t0) / h
            pull = (y0 + w * (y1 - y0)) * math.sin(x[0]) - (z0 + w * (z1 - z0)) * math.cos(x[0])
            return [K * (a0 + w * (a1 - a0) + TAN_BETA * pull)]

        run = solve_ivp(slope, (t0, t0 + h), x, method="DOP853", rtol=rtol, atol=rtol, first_step=h)
        x = [run.y[0, -1]]
    return x[0], time.process_time() - start


def equal_accuracy_sampled(seconds: float) -> None:
    """A 2 Hz vibration sampled at 100 Hz, input linear between samples: 1e-9 rad at the end."""
    n = round(seconds * 100) + 1
    t = np.linspace(0.0, seconds, n)
    f = force(t)
    fine = np.linspace(0.0, seconds, (n - 1) * 64 + 1)
    reference = propagate(INST, fine, interpolated(fine, t, f), between="linear")[::64]
    error = float(np.abs(propagate(INST, t, f, between="linear") - reference).max())
    ours = timed(lambda: propagate(INST, t, f, between="linear"), 1)
    show("sampled vibration: exact motion", (ours[0] / n, ours[1] / n), f"error {error:.1e} rad")
    alpha = np.empty(n)
    parts = 1
    while True:
        rk4(t, f, K, TAN_BETA, INST.alpha0, parts, alpha)
        error = float(np.abs(alpha - reference).max())
        if error < 1e-9:
            break
        parts += 1
    base = timed(lambda: rk4(t, f, K, TAN_BETA, INST.alpha0, parts, alpha), 1)
    note = f"error {error:.1e} rad, {parts} step(s) a sample"
    show("sampled vibration: compiled RK4", (base[0] / n, base[1] / n), note)
    show("sampled vibration: RK4 over exact motion", (base[0] / ours[0], base[1] / ours[1]))
    smooth = timed(lambda: propagate(INST, t, f), 1)
    show("sampled vibration: RK4 over smooth motion", (base[0] / smooth[0], base[1] / smooth[1]))
    end, wall = dop853_sampled(t, f, 1e-9)
    note = f"error {abs(end - reference[-1]):.1e} rad, restarted at each sample"
    show("sampled vibration: SciPy DOP853", wall / n * 1e9, note)
    show("sampled vibration: DOP853 over exact motion", wall * 1e9 / ours[0])


def equal_accuracy_smooth(seconds: float) -> None:
    """The same vibration as a formula: DOP853 at its best, without kinks."""

    def slope(t: float, x: list[float]) -> list[float]:
        y, z = 5 * G0 * math.cos(W * t + 0.4), 2 * G0 * math.sin(W * t + 1.0)
        pull = y * math.sin(x[0]) - z * math.cos(x[0])
        return [K * ((0.5 + 0.5 * math.sin(W * t)) * G0 + TAN_BETA * pull)]

    fine = np.linspace(0.0, seconds, round(seconds * 2000) + 1)
    reference = propagate_increments(INST, fine, np.diff(force_integral(fine), axis=0))[-1]

    def dop853() -> float:
        run = solve_ivp(slope, (0.0, seconds), [INST.alpha0], method="DOP853", rtol=1e-9, atol=1e-9)
        return float(run.y[0, -1])

    base = timed(dop853, 1, 5)
    show("smooth vibration: SciPy DOP853", base[1] * 1e-6, f"error {abs(dop853() - reference):.1e} rad")
    grid = np.linspace(0.0, seconds, round(seconds * 140) + 1)
    dv = np.diff(force_integral(grid), axis=0)
    error = abs(propagate_increments(INST, grid, dv)[-1] - reference)
    ours = timed(lambda: propagate_increments(INST, grid, dv), 1)
    show("smooth vibration: increments at 140 Hz", ours[1] * 1e-6, f"error {error:.1e} rad")
    show("smooth vibration: DOP853 over increments", (base[0] / ours[0], base[1] / ours[1]))


def constant_stretch() -> None:
    length, f = np.array([1e6]), np.array([[G0, 5 * G0, 0.0]])
    ns = timed(lambda: propagate_segments(INST, length, f), 1)
    show("constant stretch of 1e6 s, one step", (ns[0] * 1e-3, ns[1] * 1e-3), "call and checks included")


FIRST_CALL = """
import time; a = time.perf_counter()
import numpy as np
b = time.perf_counter()
import piga; inst = piga.Instrument(0.09, 0.005); piga.propagate
c = time.perf_counter()
piga.propagate(inst, np.arange(5.0), np.ones((5, 3)))
d = time.perf_counter()
piga.propagate(inst, np.arange(5.0), np.ones((5, 3)))
e = time.perf_counter()
print(c - b, d - c, e - d)
"""


def start_up() -> None:
    runs = []
    for _ in range(6):
        run = subprocess.run([sys.executable, "-c", FIRST_CALL], capture_output=True, text=True, check=True)
        runs.append([float(x) * 1e3 for x in run.stdout.split()])
    imports, first, second = np.median(np.array(runs[1:]), axis=0)
    show("start-up: import of piga.instrument (Numba)", imports, "NumPy imported before")
    show("start-up: first call, warm cache", first, "nothing is compiled (tests/_kernels)")
    show("start-up: second call", second)


def main() -> None:
    serial(1_000_000)
    fleet(256, 20_000)
    jax_scan(256, 20_000)
    equal_accuracy_sampled(100.0)
    equal_accuracy_smooth(100.0)
    constant_stretch()
    start_up()
    versions = f"Python {platform.python_version()}, NumPy {np.__version__}, Numba {numba.__version__}"
    put_down("motion", RESULTS, conditions=f"{versions}, SciPy {scipy.__version__}; {os.cpu_count()} cores")


if __name__ == "__main__":
    main()
