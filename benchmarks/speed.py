"""Speed beside named baselines in the same run: ``python -m benchmarks.speed TASK ... [--record]``.

Tasks: ``motion``, ``platform``, ``calibration``, ``compensation``, ``reading``, ``memory [ROWS]`` and ``ledger [COUNT ...]``.
``--record`` puts the figures into ``docs/measured``. A time is the median of several calls after one for warm-up: processor
time of one thread. Ratios within one run say more than times.
"""

from __future__ import annotations

import datetime as dt
import json
import math
import os
import random
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pyarrow as pa
from benchmarks import measured
from pyarrow import csv, parquet
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

import piga
from piga import earth
from piga.compensation import Mounted, SetCompensator
from piga.compensation.result import write_rows
from piga.formats.text.reader import TextStream
from piga.instrument import Instrument, propagate_fleet, propagate_segments
from piga.ledger.store import Draft, DraftFile, open_store
from piga.platform import compare, compensator, simulate, true_knowledge
from piga.platform.navigator import inertial_states, true_start
from piga.platform.scenario import Gyro, Harmonic, Place, PlatformScenario, Sensors
from piga.reading.columns import file_digest
from piga.records.calibration.document import to_document
from piga.units import ARCSEC, G0

Array = np.ndarray
Values = dict[str, Any]


def spent(works: dict[str, Callable[[], object]], count: int = 7) -> dict[str, Array]:
    """Seconds of each work in each round, one after the other. The first round is not counted."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(count + 1):
        for name, work in works.items():
            start = time.process_time()
            work()
            times[name].append(time.process_time() - start)
    return {name: np.array(values[1:]) for name, values in times.items()}


def seconds(work: Callable[[], object], count: int = 7) -> float:
    """Median of a work [s]."""
    return float(np.median(spent({"": work}, count)[""]))


# --- motion -------------------------------------------------------------------------------------------

INST = Instrument("0.8884 rad/s/g", "1000 arcsec", math.pi / 4)
K, TAN_BETA = INST.scale_factor, INST.tan_beta
W = 2.0 * math.pi * 2.0
"""Angular frequency of the vibration, 2 Hz [rad/s]."""


def vibration(t: Array) -> Array:
    """Force on all axes (n, 3) [m/s^2]."""
    x, y, z = 0.5 + 0.5 * np.sin(W * t), 5.0 * np.cos(W * t + 0.4), 2.0 * np.sin(W * t + 1.0)
    return G0 * np.stack([x, y, z], axis=-1)


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


def motion(_: list[int]) -> tuple[str, Values]:
    """Exact motion of a sample, beside Runge-Kutta and DOP853 of the same error."""
    n, values = 1_000_000, {}
    t, f = np.arange(n) * 1e-3, np.random.default_rng(2).normal(0.0, 10.0, (n, 3))
    alpha = np.empty(n)
    for name, work in {
        "angle output, one core": lambda: piga.propagate(INST, t, f, between="linear"),
        "angle output, smooth between samples, one core": lambda: piga.propagate(INST, t, f),
        "angle and rate, one core": lambda: piga.propagate(INST, t, f, with_rate=True, between="linear"),
        "baseline: compiled RK4, one step a sample": lambda: rk4(t, f, K, TAN_BETA, INST.alpha0, 1, alpha),
    }.items():
        values[name] = seconds(work, 9) / n * 1e9
    fleet, some = [Instrument(K * (1 + 1e-4 * i), 0.004 + 1e-5 * i, 0.01 * i) for i in range(256)], 20_000
    own = seconds(lambda: propagate_fleet(fleet, t[:some], f[:some], between="linear"), 9)
    values["fleet of 256, angle"] = own / some / len(fleet) * 1e9
    values["constant stretch of 1e6 s, one step"] = (
        seconds(lambda: propagate_segments(INST, np.array([1e6]), np.array([[G0, 5 * G0, 0.0]])), 11) * 1e6
    )
    return "motion", values | sampled_vibration() | smooth_vibration()


def sampled_vibration() -> Values:
    """A vibration sampled at 100 Hz, input linear between samples: Runge-Kutta to 1e-9 rad."""
    n = 10_001
    t, fine = np.linspace(0.0, 100.0, n), np.linspace(0.0, 100.0, (n - 1) * 64 + 1)
    f, alpha, parts = vibration(t), np.empty(n), 1
    dense = np.stack([np.interp(fine, t, f[:, k]) for k in range(3)], axis=-1)
    reference = piga.propagate(INST, fine, dense, between="linear")[::64]
    rk4(t, f, K, TAN_BETA, INST.alpha0, parts, alpha)
    while np.abs(alpha - reference).max() >= 1e-9:
        parts += 1
        rk4(t, f, K, TAN_BETA, INST.alpha0, parts, alpha)
    exact = seconds(lambda: piga.propagate(INST, t, f, between="linear"), 11)
    smooth = seconds(lambda: piga.propagate(INST, t, f), 11)
    base = seconds(lambda: rk4(t, f, K, TAN_BETA, INST.alpha0, parts, alpha), 11)
    return {
        "sampled vibration: exact motion": exact / n * 1e9,
        "sampled vibration: compiled RK4": base / n * 1e9,
        "sampled vibration: RK4 over exact motion": base / exact,
        "sampled vibration: RK4 over smooth motion": base / smooth,
    }


def smooth_vibration() -> Values:
    """The same vibration as a formula, 100 s: DOP853 at its best, without kinks."""

    def slope(t: float, x: Array) -> list[float]:
        y, z = 5.0 * math.cos(W * t + 0.4), 2.0 * math.sin(W * t + 1.0)
        pull = y * math.sin(x[0]) - z * math.cos(x[0])
        return [K * G0 * (0.5 + 0.5 * math.sin(W * t) + TAN_BETA * pull)]

    grid = np.linspace(0.0, 100.0, 14_001)
    f = vibration(grid)
    base = seconds(lambda: solve_ivp(slope, (0.0, 100.0), [INST.alpha0], "DOP853", rtol=1e-9, atol=1e-9), 5)
    own = seconds(lambda: piga.propagate(INST, grid, f), 11)
    return {
        "smooth vibration: SciPy DOP853": base * 1e3,
        "smooth vibration: exact motion at 140 Hz": own * 1e3,
        "smooth vibration: DOP853 over exact motion": base / own,
    }


# --- platform -----------------------------------------------------------------------------------------


def ten_days(days: float = 10.0) -> PlatformScenario:
    """The published case with wobble and readout noise."""
    wobble = (Harmonic(2, 18.0 * ARCSEC, 1.0), Harmonic(3, 3.0 * ARCSEC, 2.0))
    turning = 2.0 * math.pi / 480.0
    return PlatformScenario(
        Place(math.radians(40.0), math.radians(116.0)),
        days * 86400.0,
        polar_rotation=turning,
        equatorial_rotation=turning,
        polar=Gyro(240.0 * ARCSEC, 0.35, wobble),
        equatorial=Gyro(240.0 * ARCSEC, 1.3, wobble, drift=(math.radians(0.01) / 3600.0, 0.0)),
        sensors=Sensors(gimbal_noise=ARCSEC, pickoff_noise=ARCSEC, velocity_random_walk=1e-5),
    )


@numba.njit(cache=True, error_model="numpy")
def leapfrog(dv, position, velocity, h, gm, j2a2, positions, velocities):
    """Baseline: kick-drift leapfrog under J2, nothing compensated, nothing damped."""
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


def platform(_: list[int]) -> tuple[str, Values]:
    """A step of navigation with each model beside the plain leapfrog, and the whole chain."""
    run = simulate(ten_days())
    start, dv = true_start(run.truth), run.readouts.increments
    rows = np.empty_like(dv), np.empty_like(dv)
    plain = (1.0, earth.GM, 1.5 * earth.J2 * earth.SEMI_MAJOR_AXIS**2, *rows)
    base = seconds(lambda: leapfrog(dv, start.position, start.velocity, *plain))
    values = {"plain J2 leapfrog": base / len(dv) * 1e9}
    for model, name in (("none", "no model"), ("A", "model A"), ("B", "model B"), ("C", "model C")):
        middles = compensator(model, true_knowledge(run.scenario), run.readouts).middles
        own = seconds(lambda angles=middles: inertial_states(start, 1.0, dv, angles, np.zeros(1)))
        values[f"navigation, {name}"] = own / len(dv) * 1e9
    values["ten days at 1 Hz, whole chain, four models"] = seconds(lambda: compare(ten_days()), 3)
    hour = simulate(ten_days(1.0 / 24.0))
    middles = compensator("B", true_knowledge(hour.scenario), hour.readouts).middles
    fine = [np.repeat(v, 100, axis=0) for v in (hour.readouts.increments / 100.0, middles)]

    def hundred_hertz() -> None:
        for _ in range(240):
            inertial_states(true_start(hour.truth), 0.01, *fine, np.zeros(1), every=100)

    values["ten days at 100 Hz, navigation with model B"] = seconds(hundred_hertz, 1)
    return "platform", values


# --- records on disk ----------------------------------------------------------------------------------

TERMS = ["scale_factor", "tan_beta", "k0", "k2", "m_Y", "k_XY"]
RUN_FILE = """\
[instrument]
serial = "bench"
scale_factor = "0.8884 rad/s/g"
counts_per_revolution = 72000
[data]
file = "run.{kind}"
time = {{ column = "t", unit = "s" }}
output = {{ column = "n", kind = "counts" }}
reference = {{ columns = ["fx", "fy", "fz"], unit = "g" }}
[model]
terms = {terms}
[uncertainty.waived]
earth_rate = "simulated at rest"
servo = "simulated without"
"""


@contextmanager
def record(kind: str, rows: int) -> Iterator[Path]:
    """Run file of a record of a slowly moving input, counts of 72 000 a turn, beside its data."""
    t = np.round(np.arange(rows) * 0.01, 2)
    f = np.column_stack([1.0 + 0.5 * np.sin(0.126 * t), 3.0 * np.cos(0.09 * t), 2.0 * np.sin(0.21 * t)]).round(
        8
    )
    instrument = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=0.5)
    alpha = piga.propagate(instrument, t, G0 * (f + np.array([1e-3, 0.0, 0.0])), between="linear")
    alpha += 1e-5 * np.random.default_rng(1).standard_normal(rows)
    columns = {"t": t, "n": np.round(alpha * 72000 / (2.0 * np.pi)).astype(np.int64)}
    table = pa.table(columns | {axis: f[:, i] for i, axis in enumerate(("fx", "fy", "fz"))})
    with tempfile.TemporaryDirectory(dir="/var/tmp") as name:
        folder = Path(name)
        if kind == "csv":
            csv.write_csv(table, folder / "run.csv")
        else:
            parquet.write_table(table, folder / "run.parquet", compression="none", use_dictionary=False)
        (folder / "run.toml").write_text(RUN_FILE.format(kind=kind, terms=TERMS), encoding="utf-8")
        yield folder / "run.toml"


CHILD = """
import sys
from piga.cli.main import main
try:
    main()
except SystemExit as done:
    if done.code:
        raise
print(next(x for x in open("/proc/self/status").read().splitlines() if x.startswith("VmHWM")).split()[1], file=sys.stderr)
"""
"""A command, and the largest resident memory of its process as Linux counts it."""


def command(*words: str | Path) -> tuple[float, float]:
    """Processor time [s] and largest resident memory [MB] of a command in a fresh process with compiled kernels."""
    start = os.times()
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *map(str, words)], capture_output=True, text=True, check=True
    )
    end = os.times()
    return sum(end[2:4]) - sum(start[2:4]), int(done.stderr.split()[-1]) / 1024.0


def scipy_fit(run: piga.Run) -> None:
    """The same model as a nonlinear fit of the angle: trapezoid integrals, [K, tan_beta, phi, k0, k2, m_Y, k_XY]."""
    x, y, z = run.f.T / G0
    h = np.diff(run.t)

    def residual(p: Array) -> Array:
        alpha = run.output + p[2]
        rate = (
            x + p[1] * (y * np.sin(alpha) - z * np.cos(alpha)) + p[3] + p[4] * x * x + p[5] * y + p[6] * x * y
        )
        integral = np.concatenate(([0.0], np.cumsum(0.5 * h * (rate[1:] + rate[:-1]))))
        return run.output - run.output[0] - p[0] * integral

    least_squares(residual, [0.888, 4.5e-3, 0.1, 0, 0, 0, 0], x_scale=[1, 1e-3, 1, 1e-3, 1e-3, 1e-3, 1e-3])


def calibration(_: list[int]) -> tuple[str, Values]:
    """A million rows: the library beside SciPy's fit, and the whole command."""
    with record("parquet", 1_000_000) as path:
        run = piga.read_run(path)
        own, fit = seconds(lambda: piga.calibrate(run)), seconds(lambda: scipy_fit(run), 3)
        cold = [command("calibrate", path, "--force")[0] for _ in range(6)]
    return "calibration", {
        "calibrate, warm": own,
        "SciPy least_squares, same record (trapezoid, no whitening)": fit,
        "SciPy least_squares over calibrate": fit / own,
        "whole cold command from Parquet, with report: processor time": float(np.median(cold[1:])),
    }


def compensation(_: list[int]) -> tuple[str, Values]:
    """From file to file beside PyArrow alone for the same columns; a triad; a pushed sample."""
    with record("parquet", 2_000_000) as path:
        data, run = path.with_name("run.parquet"), piga.read_run(path)
        cal = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"])
        result = piga.compensate(run, cal)

        def copy() -> None:
            with parquet.ParquetFile(data, page_checksum_verification=True) as file:
                read = file.read(use_threads=False)
            flags = pa.array(np.zeros(read.num_rows, np.int32))
            columns = {"t": read["t"], "ax": read["fx"], "dv": read["fy"], "u_ax": read["fz"], "flags": flags}
            parquet.write_table(
                pa.table(columns), path.with_name("copy.parquet"), compression="none", use_dictionary=False,
                write_statistics=False, write_page_checksum=True,
            )  # fmt: skip

        times = spent(
            {
                "PyArrow alone": copy,
                "of that, reading with all checks": lambda: piga.read_run(path),
                "of the reading, SHA-256 of the file": lambda: file_digest(data),
                "of that, compensating": lambda: piga.compensate(run, cal),
                "of that, writing": lambda: write_rows(result, path.with_name("out.parquet")),
            },
            9,
        )
    values = {name: float(np.median(own)) / run.size * 1e9 for name, own in times.items()}
    whole = sum(values[f"of that, {step}"] for step in ("reading with all checks", "compensating", "writing"))
    ratio = "Parquet to Parquet over reading and writing the same columns with PyArrow"
    return "compensation", {ratio: whole / values["PyArrow alone"]} | values | triad(run, cal) | latency(cal)


def triad(run: piga.Run, cal: piga.Calibration) -> Values:
    """A stream of chunks of 65 536 rows through three instruments."""
    mounted = [Mounted(cal, np.roll(np.eye(3), -i, axis=0)) for i in range(3)]
    rate = np.gradient(run.output, run.t)
    chunks = [
        (run.t[rows], np.tile(run.output[rows], (3, 1)), np.tile(rate[rows], (3, 1)))
        for rows in (slice(start, start + (1 << 16)) for start in range(0, run.size, 1 << 16))
    ]

    def work() -> None:
        stream = SetCompensator(mounted, sampled=True, uncertainty=False)
        for times, angles, rates in chunks:
            stream.push(times, angles, rate=rates)

    return {"triad, samples of angle and rate, one core": run.size / seconds(work) / 1e6}


def latency(cal: piga.Calibration) -> Values:
    """Microseconds of one pushed sample."""
    stream, late = piga.Compensator(cal), []
    for i in range(20_000):
        sample = {"t": 0.01 * i, "output": 0.00888 * i, "f": (9.8, 1.0, 2.0)}
        start = time.perf_counter()
        stream.push(sample)
        late.append(1e6 * (time.perf_counter() - start))
    median, slowest = np.quantile(late[1000:], [0.5, 0.99])
    name = "latency of one pushed sample"
    return {f"{name}, median": median, f"{name}, 99 %": slowest}


def reading(_: list[int]) -> tuple[str, Values]:
    """CSV of two million rows: PyArrow's own reader beside ours."""
    with record("csv", 2_000_000) as path:
        data = path.with_name("run.csv")

        def checked() -> None:
            for _ in TextStream(data, ("t", "n", "fx", "fy", "fz"), None).chunks():
                pass

        times = spent(
            {
                "PyArrow's own `read_csv`": lambda: csv.read_csv(
                    data, read_options=csv.ReadOptions(use_threads=False)
                ),
                "every cell checked": checked,
                "`read_run`: all checks, SHA-256, unwrapping, time base": lambda: piga.read_run(path),
            },
            9,
        )
    base, cells, whole = times.values()
    return "reading", {name: float(np.median(own)) for name, own in times.items()} | {
        "every cell checked: share of PyArrow's speed": float(np.median(base / cells)),
        "`read_run`: share of PyArrow's speed": float(np.median(base / whole)),
    }


def memory(rows: list[int]) -> tuple[str, Values]:
    """Largest memory of both commands on a long CSV file, without mapped files."""
    (count,) = rows or [132_000_000]
    with record("csv", count) as path:
        out = path.with_name("out")
        own = ("--calibration", out / "calibration.json", "--out", path.with_name("ax.csv"))
        peaks = {
            "calibrate": private_memory("calibrate", path, "--out", out),
            "compensate": private_memory("compensate", path, *own),
        }
    named = f"private memory, csv of {count / 1e6:g} million rows"
    again = f"python -m benchmarks.speed memory {count}"
    return "reading", {
        f"{named}: `piga {step}`": {"value": peak, "command": again} for step, peak in peaks.items()
    }


def private_memory(*words: str | Path) -> float:
    """Largest memory of a command [MB]; the pages of mapped files are left out, because the system takes them back."""
    peak = 0
    with subprocess.Popen([sys.executable, "-m", "piga", *words], stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            status = Path(f"/proc/{process.pid}/status").read_text(encoding="utf-8")
            peak = max(peak, int((status.partition("RssAnon:")[2].split() or ["0"])[0]))
            time.sleep(0.01)
    if process.returncode:
        sys.exit(f"piga {words[0]} ended with {process.returncode}")
    return peak / 1000.0


def ledger(counts: list[int]) -> tuple[str, Values]:
    """Commands at several sizes of the store: one instrument with up to 3000 records, the rest of others."""
    kept: Values = {}
    with tempfile.TemporaryDirectory(dir="/var/tmp") as name:
        document = json.loads(json.dumps(to_document(piga.calibrate(piga.example_run()))))
        small = {
            key: value
            for key, value in document.items()
            if key not in ("segments", "uncertainty_budget", "diagnostics")
        }
        for count in counts or [1000, 3000, 10_000, 100_000]:
            store = Path(name) / f"{count}.sqlite"
            fill(store, count, document, small)
            command(
                "records", "trend", "--serial", "A", "--store", store
            )  # compiled kernels are kept from here on
            for words in ("list --serial A", "show 7", "trend --serial A", "list", "verify"):
                used, peak = command("records", *words.split(), "--store", store)
                kept |= {f"{words}, {count}: time": used, f"{words}, {count}: memory": round(peak)}
    return "ledger", kept


def fill(path: Path, count: int, whole: dict[str, Any], small: dict[str, Any]) -> None:
    """A store with ``count`` records of a calibration on different days."""
    chance = random.Random(1)
    with open_store(path, create=True) as store:
        for number in range(count):
            document, serial = (whole, "A") if number < 3000 else (small, f"B-{number // 100}")
            coefficients = [
                {k: v for k, v in c.items() if k != "interval"}
                | {"value": c["value"] + chance.gauss(0.0, c["std"])}
                for c in document["coefficients"]
            ]
            own = {
                "coefficients": coefficients,
                "instrument": document["instrument"] | {"serial": serial},
            }
            files = (
                DraftFile("run", "run.toml", b"# run\n"),
                DraftFile("calibration", "results/c.json", json.dumps(document | own, indent=1).encode()),
            )
            day = dt.date(2000, 1, 1) + dt.timedelta(days=number % 3000)
            draft = Draft(serial, "A. Meyer", f"number {number}", files, measured=str(day))
            store.append(draft)


TASKS = (motion, platform, calibration, compensation, reading, memory, ledger)


def main() -> None:
    """Run the tasks that are named."""
    words = [word for word in sys.argv[1:] if word != "--record"]
    numbers = [int(word) for word in words if word.isdigit()]
    warnings.simplefilter("ignore")
    numba.set_num_threads(1)
    threadpool_limits(1)
    tasks = {task.__name__: task for task in TASKS}
    for word in [word for word in words if not word.isdigit()] or sys.exit(__doc__):
        table, values = tasks[word](numbers)
        for name, value in values.items():
            print(f"{name:72s} {value['value'] if isinstance(value, dict) else value:.4g}")
        if "--record" in sys.argv:
            measured.record(
                table, {k: v if isinstance(v, dict) else measured.rounded(v) for k, v in values.items()}
            )


if __name__ == "__main__":
    main()
