"""Speed of reading CSV against PyArrow's own reader on the same clean file: ``python benchmarks/reading.py [--record]``."""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import measured
import numpy as np
from pyarrow import csv

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


def timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


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


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        path = write(Path(name))
        size = path.stat().st_size / 1e6
        works = {
            "PyArrow's own `read_csv`": lambda: csv.read_csv(path),
            "every cell checked": lambda: drain(TextStream(path, NAMES, None)),
            "`read_run`: all checks, SHA-256, unwrapping, time base": lambda: piga.read_run(
                path.with_name("run.toml")
            ),
        }
        passes = [[timed(work) for work in works.values()] for _ in range(PASSES + 1)][1:]
        print(f"{ROWS} rows, {size:.0f} MB, median of {PASSES} passes, each after the other in one run")
        kept: dict[str, float] = {}
        for index, title in enumerate(works):
            own = statistics.median(times[index] for times in passes)
            ratio = statistics.median(times[0] / times[index] for times in passes)
            kept[title] = round(own, 3)
            if index:
                kept[f"{title.partition(':')[0]}: share of PyArrow's speed"] = round(ratio, 2)
            print(f"{title:56s} {own:.3f} s  {size / own:6.0f} MB/s  {ratio:.2f} of PyArrow's speed")
        if "--record" in sys.argv:
            measured.record("reading", kept)


if __name__ == "__main__":
    main()
