"""Speed of the calibration: ratios against named baselines in one run.

Run with ``python -m benchmarks.calibration [--record]``; prints a table.
``--record`` puts it into docs/measured. Baseline: a nonlinear fit of the same record with SciPy.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from benchmarks.harness import put_down, seconds

import piga
from piga.units import G0

ROWS = 1_000_000
TERMS = ["scale_factor", "tan_beta", "k0", "k2", "m_Y", "k_XY"]


def synthetic() -> piga.Run:
    """One million rows of a slowly moving input, counts of 72000 a turn."""
    rng = np.random.default_rng(1)
    t = np.arange(ROWS) * 0.01
    f = G0 * np.column_stack([1.0 + 0.5 * np.sin(0.126 * t), 3.0 * np.cos(0.09 * t), 2.0 * np.sin(0.21 * t)])
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=0.5)
    alpha = piga.propagate(inst, t, f + np.array([1e-3 * G0, 0.0, 0.0]), between="linear")
    count = 2.0 * np.pi / 72000
    output = np.round((alpha + 1e-5 * rng.standard_normal(ROWS)) / count) * count
    return piga.Run.from_arrays(
        t,
        output,
        f,
        uncertainty={"waived": {"earth_rate": "simulated at rest", "servo": "simulated without"}},
        scale_factor="0.8884 rad/s/g",
        resolution=count,
        units="SI",
    )


def scipy_fit(run: piga.Run) -> None:
    """The same model as a nonlinear fit of the angle: trapezoid integrals, [K, tan_beta, phi, k0, k2, m_Y, k_XY]."""
    from scipy.optimize import least_squares

    x, y, z = run.f.T / G0
    h = np.diff(run.t)

    def integral(values: np.ndarray) -> np.ndarray:
        return np.concatenate(([0.0], np.cumsum(0.5 * h * (values[1:] + values[:-1]))))

    def residual(p: np.ndarray) -> np.ndarray:
        alpha = run.output + p[2]
        rate = (
            x + p[1] * (y * np.sin(alpha) - z * np.cos(alpha)) + p[3] + p[4] * x * x + p[5] * y + p[6] * x * y
        )
        return run.output - run.output[0] - p[0] * integral(rate)

    least_squares(
        residual, [0.888, 4.5e-3, 0.1, 0.0, 0.0, 0.0, 0.0], x_scale=[1, 1e-3, 1, 1e-3, 1e-3, 1e-3, 1e-3]
    )


def cold_command(run: piga.Run, *options: str) -> float:
    """Processor seconds of the whole command from Parquet, in a fresh process with one thread.

    Kernels and bytecode are there already, as after an installation and a first run.
    """
    import pyarrow as pa
    from pyarrow import parquet

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        columns = {"t": run.t, "n": np.round(run.output / run.resolution).astype(np.int64)}
        columns |= {axis: run.f[:, i] / G0 for i, axis in enumerate(("fx", "fy", "fz"))}
        parquet.write_table(pa.table(columns), folder / "run.parquet")
        (folder / "run.toml").write_text(
            '[instrument]\nserial = "b"\nscale_factor = "0.8884 rad/s/g"\ncounts_per_revolution = 72000\n'
            '[data]\nfile = "run.parquet"\ntime = { column = "t", unit = "s" }\n'
            'output = { column = "n", kind = "counts" }\nreference = { columns = ["fx", "fy", "fz"], unit = "g" }\n'
            f"[model]\nterms = {TERMS}\n"
        )
        command = [
            sys.executable,
            "-c",
            "from piga.cli.main import main; main()",
            "calibrate",
            str(folder / "run.toml"),
        ]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        times = []
        for _ in range(8):
            start = os.times()
            subprocess.run([*command, *options, "--force"], check=True, capture_output=True, env=environment)
            end = os.times()
            times.append(sum(end[2:4]) - sum(start[2:4]))
        print(f"{' '.join(options)}: best {min(times[1:]):.2f} s of {len(times) - 1}")
        return statistics.median(times[1:])


SHIPPED = """
import pathlib, resource, statistics, tempfile, warnings
import piga
from piga.data import copy_example
warnings.simplefilter("ignore")
run = piga.read_run(copy_example(pathlib.Path(tempfile.mkdtemp())))
piga.calibrate(run)
spent = lambda: sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
times = []
for _ in range(5):
    before = spent()
    piga.calibrate(run)
    times.append(spent() - before)
print(statistics.median(times))
"""


def shipped(threads: str | None) -> float:
    """Processor time of one warm calibration of the shipped record, with this number of threads in the environment."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    environment = {name: value for name, value in os.environ.items() if name not in names}
    environment |= dict.fromkeys(names, threads) if threads else {}
    done = subprocess.run(
        [sys.executable, "-c", SHIPPED], capture_output=True, text=True, check=True, env=environment
    )
    return float(done.stdout)


def main() -> None:
    run = synthetic()
    ours = float(np.median(seconds(lambda: piga.calibrate(run, TERMS))))
    fit = float(np.median(seconds(lambda: scipy_fit(run), 5)))
    cold = "whole cold command from Parquet"
    put_down("calibration", {
        "calibrate, warm": ours,
        "SciPy least_squares, same record (trapezoid, no whitening)": fit,
        "SciPy least_squares over calibrate": fit / ours,
        f"{cold}, with report: processor time": cold_command(run),
        f"{cold}, without report: processor time": cold_command(run, "--no-report"),
        "shipped record, warm, default threads: processor time": shipped(None),
        "shipped record, warm, OMP_NUM_THREADS=1: processor time": shipped("1"),
    })  # fmt: skip


if __name__ == "__main__":
    main()
