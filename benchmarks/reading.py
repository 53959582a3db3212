"""Reading of records: speed against PyArrow's own reader on the same clean CSV file, and largest private memory.

Speed: ``python benchmarks/reading.py [--record]``. Memory of reading and of calibrating:
``python benchmarks/reading.py csv|parquet ROWS [--record]``. Pages of mapped files are not counted, because the system
takes them back.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pyarrow as pa
from harness import put_down, rounds
from pyarrow import csv, parquet

import piga
from piga.formats.text.reader import TextStream

ROWS = 2_000_000
PASSES = 9
NAMES = ("t", "n", "fx", "fy", "fz")
RUN = """\
[instrument]
serial = "bench"
scale_factor = "0.8884 rad/s/g"
counts_per_revolution = 72000
[data]
file = "run.csv"
time = { column = "t", unit = "s" }
output = { column = "n", kind = "counts" }
reference = { columns = ["fx", "fy", "fz"], unit = "g" }
"""
LONG = """\
[instrument]
serial = "bench"
scale_factor = "0.8884 rad/s/g"
[data]
file = "run.{kind}"
time = {{ column = "t", unit = "s" }}
output = {{ column = "psi", kind = "angle", unit = "rad" }}
reference = {{ columns = ["fx", "fy", "fz"], unit = "m/s^2" }}
[model]
terms = ["scale_factor", "k0"]
"""


def drain(stream: TextStream) -> None:
    for _ in stream.chunks():
        pass


def write(folder: Path) -> Path:
    t = np.arange(ROWS) / 1000.0
    wave = 1.0 + 0.1 * np.sin(t)
    body = np.column_stack([t, np.round(10179.0 * t), wave, 0.1 * wave, 0.2 * wave])
    path = folder / "run.csv"
    np.savetxt(
        path,
        body,
        fmt=["%.4f", "%d", "%.8f", "%.8f", "%.8f"],
        delimiter=",",
        header=",".join(NAMES),
        comments="",
    )
    (folder / "run.toml").write_text(RUN)
    return path


def speed() -> None:
    with tempfile.TemporaryDirectory() as name:
        path = write(Path(name))
        works = {
            "PyArrow's own `read_csv`": lambda: csv.read_csv(path),
            "every cell checked": lambda: drain(TextStream(path, NAMES, None)),
            "`read_run`: all checks, SHA-256, unwrapping, time base": lambda: piga.read_run(
                path.with_name("run.toml")
            ),
        }
        times = rounds(works, PASSES)
    values: dict[str, float] = {}
    for title, own in times.items():
        values[title] = float(np.median(own))
        values[f"{title.partition(':')[0]}: share of PyArrow's speed"] = float(
            np.median(times["PyArrow's own `read_csv`"] / own)
        )
    put_down("reading", values)


def private() -> float:
    """Memory without mapped files [MB]."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(status.partition("RssAnon:")[2].split()[0]) / 1000.0


def write_long(folder: Path, kind: str, rows: int) -> Path:
    t = np.arange(rows) / 1000.0
    f = 9.80665 * np.column_stack([np.cos(t / 400.0), np.sin(t / 400.0), np.full(rows, 0.01)])
    psi = np.cumsum(0.0906e-3 * f[:, 0]) + 2e-5 * np.random.default_rng(1).standard_normal(rows)
    table = pa.table({"t": np.round(t, 3), "psi": psi, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2]})
    (csv.write_csv if kind == "csv" else parquet.write_table)(table, folder / f"run.{kind}")
    (folder / "run.toml").write_text(LONG.format(kind=kind), encoding="utf-8")
    return folder / "run.toml"


def measure(path: Path) -> dict[str, float]:
    """The largest memory of each step [MB]."""
    peaks, step = {"read": 0.0, "calibrated": 0.0}, ["read"]

    def watch() -> None:
        while step:
            peaks[step[-1]] = max(peaks[step[-1]], private())
            time.sleep(0.01)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        run = piga.read_run(path)
        step.append("calibrated")
        piga.calibrate(run)
    finally:
        step.clear()
        thread.join()
    return peaks


def memory() -> None:
    kind, rows = sys.argv[1], int(sys.argv[2])
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory(dir="/var/tmp") as name:
        write_long(Path(name), kind, rows)
        pa.default_memory_pool().release_unused()
        size = (Path(name) / f"run.{kind}").stat().st_size / 1e6
        print(
            f"{kind} of {size:.0f} MB, {rows} rows, a column is {8e-6 * rows:.0f} MB; {private():.0f} MB before"
        )
        peaks = measure(Path(name) / "run.toml")
    again = f"python benchmarks/reading.py {kind} {rows}"
    values = {
        f"private memory, {kind} of {rows / 1e6:g} million rows: {step}": {"value": peak, "command": again}
        for step, peak in peaks.items()
    }
    put_down("reading", values)


if __name__ == "__main__":
    memory() if sys.argv[1:2] in (["csv"], ["parquet"]) else speed()
