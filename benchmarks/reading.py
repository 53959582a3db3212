"""Reading of records: speed against PyArrow's own reader on the same clean CSV file, and largest private memory.

Speed: ``python -m benchmarks.reading [--record]``. Memory of ``piga calibrate`` and ``piga compensate``:
``python -m benchmarks.reading csv|parquet ROWS [--record]``. Pages of mapped files are not counted, because the system
takes them back.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
from benchmarks.harness import put_down, rounds
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


def private(process: int) -> float:
    """Memory without mapped files [MB]; 0 after the end of the process."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    return int((status.partition("RssAnon:")[2].split() or ["0"])[0]) / 1000.0


def write_long(folder: Path, kind: str, rows: int) -> Path:
    t = np.arange(rows) / 1000.0
    f = 9.80665 * np.column_stack([np.cos(t / 400.0), np.sin(t / 400.0), np.full(rows, 0.01)])
    psi = np.cumsum(0.0906e-3 * f[:, 0]) + 2e-5 * np.random.default_rng(1).standard_normal(rows)
    table = pa.table({"t": np.round(t, 3), "psi": psi, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2]})
    (csv.write_csv if kind == "csv" else parquet.write_table)(table, folder / f"run.{kind}")
    (folder / "run.toml").write_text(LONG.format(kind=kind), encoding="utf-8")
    return folder / "run.toml"


def largest(*command: str | Path) -> float:
    """The largest private memory of one ``piga`` command [MB]."""
    peak = 0.0
    with subprocess.Popen([sys.executable, "-m", "piga", *command], stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, private(process.pid))
            time.sleep(0.01)
    if process.returncode:
        sys.exit(f"piga {command[0]} ended with {process.returncode}")
    return peak


def memory() -> None:
    kind, rows = sys.argv[1], int(sys.argv[2])
    with tempfile.TemporaryDirectory(dir="/var/tmp") as name:
        run, out = write_long(Path(name), kind, rows), Path(name) / "out"
        size = (Path(name) / f"run.{kind}").stat().st_size / 1e9
        print(f"{size:.1f} GB, a column is {8e-6 * rows:.0f} MB")
        own = ["--calibration", out / "calibration.json", "--out", Path(name) / f"ax.{kind}"]
        peaks = {
            "calibrate": largest("calibrate", run, "--out", out),
            "compensate": largest("compensate", run, *own),
        }
    again = f"python -m benchmarks.reading {kind} {rows}"
    values = {
        f"private memory, {kind} of {rows / 1e6:g} million rows: `piga {step}`": {
            "value": peak,
            "command": again,
        }
        for step, peak in peaks.items()
    }
    put_down("reading", values)


if __name__ == "__main__":
    memory() if sys.argv[1:2] in (["csv"], ["parquet"]) else speed()
