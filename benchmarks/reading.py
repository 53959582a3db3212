"""Speed of reading CSV against PyArrow's own reader on the same clean file: ``python benchmarks/reading.py``."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pyarrow import csv

import piga
from piga.records.text_reader import read_text

ROWS = 2_000_000
PASSES = 5
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


def best(work: Callable[[], object]) -> float:
    found = []
    for _ in range(PASSES):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found)


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


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        path = write(Path(name))
        size = path.stat().st_size / 1e6
        own = best(lambda: csv.read_csv(path))
        mine = best(lambda: read_text(path, NAMES, None))
        whole = best(lambda: piga.read_run(path.with_name("run.toml")))
        print(f"{ROWS} rows, {size:.0f} MB")
        print(f"pyarrow.csv.read_csv   {own:.3f} s  {size / own:6.0f} MB/s")
        print(
            f"read_text              {mine:.3f} s  {size / mine:6.0f} MB/s  {own / mine:.2f} of PyArrow's speed"
        )
        print(
            f"read_run (all checks)  {whole:.3f} s  {size / whole:6.0f} MB/s  {own / whole:.2f} of PyArrow's speed"
        )


if __name__ == "__main__":
    main()
