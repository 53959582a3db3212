"""The picture of large files: ``python -m tests.workbench.size [--record]``.

A real ``piga ui`` reads a CSV file of ten million rows and a Parquet file of a hundred million. Measured are the time
until the first picture once the envelopes are there, and the longest of many zooms (each the best of five, HTTP included).
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from benchmarks import measured
from numpy.typing import NDArray

from tests.memory import kilobytes
from tests.workbench.conftest import Client, Server

SIZES = {"csv": 10_000_000, "parquet": 100_000_000}
"""Rows by kind of file."""
CHUNK = 1 << 20
STEP, SEGMENTS, SCALE = 0.005, 24, 0.8884
WIDTH = 1300
ZOOMS = 40
"""Widths of zoom; each is asked for every picture of the page."""
RUN = f"""\
[instrument]
serial = "large"
scale_factor = "{SCALE} rad/s/g"
[data]
file = "large.KIND"
time = {{ column = "t", unit = "s" }}
output = {{ column = "a", kind = "angle", unit = "rad" }}
segment = "s"
reference = {{ columns = ["x", "y", "z"], unit = "g" }}
"""


def columns(rows: int) -> Iterator[dict[str, NDArray[np.float64] | NDArray[np.int64]]]:
    """A tumble test of 24 positions, chunk by chunk."""
    angle = 0.0
    for first in range(0, rows, CHUNK):
        row = np.arange(first, min(first + CHUNK, rows))
        segment = row * SEGMENTS // rows
        head = 2.0 * np.pi * segment / SEGMENTS
        x = np.cos(head)
        a = angle + np.cumsum(SCALE * x * STEP)
        angle = float(a[-1])
        yield {"t": STEP * row, "a": a, "s": segment, "x": x, "y": np.sin(head), "z": np.zeros(row.size)}


def write(folder: Path, kind: str, rows: int) -> None:
    """The file and its run file."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    path, writer = folder / f"large.{kind}", None
    for part in columns(rows):
        table = pa.table(part)
        if writer is None:
            writer = (
                pyarrow.csv.CSVWriter(path, table.schema)
                if kind == "csv"
                else pyarrow.parquet.ParquetWriter(path, table.schema)
            )
        writer.write_table(table)
    assert writer is not None
    writer.close()
    (folder / "large.toml").write_text(RUN.replace("KIND", kind), encoding="utf-8")


def memory(pid: int) -> float:
    """Memory of a process without mapped files [MB]; 0 if it has ended."""
    try:
        return kilobytes("RssAnon", pid) / 1000.0
    except (OSError, KeyError):
        return 0.0


def ask(client: Client, keys: str, first: float, last: float) -> float:
    """Seconds that a picture takes."""
    started = time.perf_counter()
    path = f"/signal-data/large.toml?keys={keys}&from={first}&to={last}&width={WIDTH}"
    status, _, body = client.ask(path)
    seconds = time.perf_counter() - started
    assert status == 200
    assert len(body) >= 48
    return seconds


def measure(folder: Path, kind: str, rows: int) -> dict[str, float]:
    """Write a file, open it, zoom; what was measured, by its name."""
    write(folder, kind, rows)
    server = Server(folder)
    try:
        client = server.client
        client.enter()
        started = time.perf_counter()
        client.page("/record/large.toml")  # a page that is opened later would begin a fit
        while client.ask("/signal-data/large.toml?keys=output&from=0&to=1&width=10")[0] == 204:
            time.sleep(0.2)
        reading = time.perf_counter() - started
        started = time.perf_counter()
        duration, pictures = STEP * (rows - 1), ["output", "difference", "fX,fY,fZ"]
        for keys in pictures:
            ask(client, keys, 0.0, duration)
        first = time.perf_counter() - started
        longest = 0.0
        rng = np.random.default_rng(1)
        for share in np.geomspace(0.9, 1e-6, ZOOMS):
            begin = rng.uniform(0.0, (1.0 - share) * duration)
            for keys in pictures:
                longest = max(
                    longest, min(ask(client, keys, begin, begin + share * duration) for _ in range(5))
                )
        return {"reading": reading, "first": first, "zoom": longest}
    finally:
        assert server.end() == (0, "")


COLUMNS = {
    "reading": ("read and envelopes made", "s"),
    "first": ("first picture", "s"),
    "zoom": ("longest zoom", "s"),
}
"""Names and units of what is measured, as the page shows them."""


def main() -> None:
    """Measure both files."""
    rows = {}
    for kind, size in SIZES.items():
        with tempfile.TemporaryDirectory() as name:
            result = measure(Path(name), kind, size)
        sys.stdout.write(f"{kind}, {size} rows: {result}\n")
        words = f"{'CSV' if kind == 'csv' else 'Parquet'}, {size // 1_000_000} million rows"
        rows[words] = {title: measured.rounded(result[key]) for key, (title, _) in COLUMNS.items()}
    if "--record" in sys.argv:
        measured.write(
            "workbench",
            "file",
            rows,
            dict(COLUMNS.values()),
            command="python -m tests.workbench.size --record",
            conditions=(
                "six columns, two busy cores; pictures of all signals, 1300 pixels wide, with HTTP, not drawn; zoom: the longest "
                "of 80, each the best of five"
            ),
        )


if __name__ == "__main__":
    main()
