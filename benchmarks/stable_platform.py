"""Speed of the platform chain against named baselines, in one run.

Run: python -m benchmarks.stable_platform [--record]; ``--record`` puts the figures into docs/measured/platform.json.

Baselines: a plain J2 leapfrog in inertial axes (compiled here, nothing but the motion), and pyins
(PyPI ``python-ins``), a strapdown navigator: its job is harder (attitude from gyro increments with coning,
local-level axes) and it keeps every attitude matrix; ours takes the attitude from the platform. Both get
velocity increments of a base at rest and give back every state.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import numba
import numpy as np
from benchmarks.harness import put_down, seconds

from piga import earth
from piga.platform import Navigator, compare, compensator, simulate, true_knowledge
from piga.platform.navigator import true_start
from piga.platform.scenario import Gyro, Harmonic, Place, PlatformScenario, Rotation, Sensors

DAY = 86400.0
DEG = math.pi / 180.0
ARCSEC = DEG / 3600.0


def scenario(days: float) -> PlatformScenario:
    """The published case with wobble and readout noise."""
    wobble = (Harmonic(2, 18.0 * ARCSEC, 1.0), Harmonic(3, 3.0 * ARCSEC, 2.0))
    turning = Rotation(2.0 * math.pi / 480.0)
    return PlatformScenario(
        Place(40.0 * DEG, 116.0 * DEG), days * DAY, polar_rotation=turning, equatorial_rotation=turning,
        polar=Gyro(240.0 * ARCSEC, 0.35, wobble),
        equatorial=Gyro(240.0 * ARCSEC, 1.3, wobble, drift=(0.01 * DEG / 3600.0, 0.0)),
        sensors=Sensors(gimbal_noise=ARCSEC, pickoff_noise=ARCSEC, velocity_random_walk=1e-5),
    )  # fmt: skip


@numba.njit(cache=True, error_model="numpy")
def leapfrog(dv, position, velocity, h, gm, j2a2, positions, velocities):
    """Plain kick-drift leapfrog under J2, nothing compensated, nothing damped."""
    x, y, z = position
    u, v, w = velocity
    for i in range(dv.shape[0]):
        r2 = x * x + y * y + z * z
        inverse = 1.0 / math.sqrt(r2)
        s = 5.0 * z * z / r2
        q = j2a2 / r2
        g = -gm * inverse / r2
        u += dv[i, 0] + h * g * x * (1.0 + q * (1.0 - s))
        v += dv[i, 1] + h * g * y * (1.0 + q * (1.0 - s))
        w += dv[i, 2] + h * g * z * (1.0 + q * (3.0 - s))
        x, y, z = x + h * u, y + h * v, z + h * w
        positions[i, 0], positions[i, 1], positions[i, 2] = x, y, z
        velocities[i, 0], velocities[i, 1], velocities[i, 2] = u, v, w


def shortest(job: Callable[[], object], repeats: int = 5) -> float:
    """Shortest of a few runs [s]."""
    return float(seconds(job, repeats).min())


def navigation_inputs(days: float, model: str):
    """Start, and the navigator's inputs for a simulated run."""
    run = simulate(scenario(days))
    made = compensator(model, true_knowledge(run.scenario), run.readouts)
    return true_start(run.truth), run.readouts.increments, made.middles, np.zeros(1)


def navigation(days: float, model: str) -> float:
    """Nanoseconds per step of navigation alone at 1 Hz, every state kept."""
    start, *inputs = navigation_inputs(days, model)
    return shortest(lambda: Navigator(start, 1.0).push(*inputs)) / len(inputs[0]) * 1e9


def plain(days: float) -> float:
    """Nanoseconds per step of the plain leapfrog on the same increments."""
    start, dv, *_ = navigation_inputs(days, "none")
    rows = np.empty_like(dv), np.empty_like(dv)
    arguments = (1.0, earth.GM, 1.5 * earth.J2 * earth.SEMI_MAJOR_AXIS**2, *rows)
    return shortest(lambda: leapfrog(dv, start.position, start.velocity, *arguments)) / len(dv) * 1e9


def hundred_hertz(days: int) -> float:
    """Seconds to navigate ten days at 100 Hz with model B, an hour at a time, one state a second kept."""
    start, dv, angles, altitude = navigation_inputs(1.0 / 24.0, "B")
    fine = [np.repeat(values, 100, axis=0) for values in (dv / 100.0, angles)]

    def run() -> None:
        navigator = Navigator(start, 0.01)
        for _ in range(24 * days):
            navigator.push(*fine, altitude, 100)

    run()
    begun = time.perf_counter()
    run()
    return time.perf_counter() - begun


def whole_chain() -> float:
    """Seconds for ten days at 1 Hz: simulated, identified, aligned, navigated with four models, fitted."""
    return shortest(lambda: compare(scenario(10.0)), 3)


def strapdown(steps: int) -> tuple[float, float] | None:
    """pyins: nanoseconds per step of its Integrator, and of its kernel alone; None when it is not installed."""
    try:
        import pandas as pd
        from pyins import strapdown as pyins_strapdown
        from pyins._numba_integrate import integrate
    except ImportError:
        return None
    columns = ["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"]
    rate = earth.EARTH_RATE
    row = [1.0, rate * math.cos(40 * DEG), 0.0, -rate * math.sin(40 * DEG), 0.0, 0.0, -9.8017]
    increments = pd.DataFrame(
        np.tile(row, (steps, 1)), index=np.arange(1, steps + 1, dtype=float), columns=columns
    )
    names = ["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"]
    pva = pd.Series([40.0, 116.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], index=names, name=0.0)
    whole = shortest(lambda: pyins_strapdown.Integrator(pva).integrate(increments), 3)
    keep = pyins_strapdown.Integrator(pva)
    place, velocity = np.tile(keep.lla[0], (steps + 1, 1)), np.zeros((steps + 1, 3))
    attitude = np.tile(np.eye(3), (steps + 1, 1, 1))
    theta, dv = np.ascontiguousarray(increments.iloc[:, 1:4]), np.ascontiguousarray(increments.iloc[:, 4:])
    kernel = shortest(lambda: integrate(np.ones(steps), place, velocity, attitude, theta, dv, 0, True), 3)
    return whole / steps * 1e9, kernel / steps * 1e9


def main() -> None:
    pyins = strapdown(86400)
    rows = {
        "plain J2 leapfrog": plain(10.0),
        "navigation, no model": navigation(10.0, "none"),
        "navigation, model A": navigation(10.0, "A"),
        "navigation, model B": navigation(10.0, "B"),
        "navigation, model C": navigation(10.0, "C"),
        "pyins Integrator, strapdown": pyins[0] if pyins else None,
        "pyins kernel alone, strapdown": pyins[1] if pyins else None,
        "ten days at 1 Hz, whole chain, four models": whole_chain(),
        "ten days at 100 Hz, navigation with model B": hundred_hertz(10),
    }
    put_down("platform", {name: value for name, value in rows.items() if value is not None})


if __name__ == "__main__":
    main()
