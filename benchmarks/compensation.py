"""Speed of compensation against a plain copy: ``python -m benchmarks.compensation [memory triad latency file] [--record]``.

The copy is measured in the same rounds, one pass of each after the other, everything warm; only ratios compare
between machines. In memory nothing is allocated inside the measured call. ``angle, rate`` are samples: columns t,
angle, rate, a_Y, a_Z; the copy moves five columns, the results beside them are not counted.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # as the command does

import numpy as np
from benchmarks.harness import put_down, rounds, seconds
from tests.compensation.twin_data import calibration_of

import piga
from piga._kernels.compensation.sample import Rows, Samples
from piga._kernels.compensation.terms import SUMS
from piga.compensation import Mounted, SetCompensator
from piga.compensation.compensator import NO_RATES, NONE, init_state, run_kernel
from piga.compensation.model import Model, make_model
from piga.compensation.result import write_rows
from piga.reading.columns import file_digest

ROWS = 2_000_000
ROUNDS = 41


def samples(rows: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    t = 0.01 * np.arange(rows)
    rate = np.full(rows, 0.888) + 1e-3 * rng.standard_normal(rows)
    return {
        "t": t, "psi": np.cumsum(0.01 * rate), "rate": rate, "y": 9.8 + rng.standard_normal(rows),
        "z": rng.standard_normal(rows),
    }  # fmt: skip


def in_memory() -> None:
    """Time of each kernel over that of a copy of 40 bytes a sample."""
    data = samples(ROWS)
    values = {"scale_factor": 0.8884, "tan_beta": 5e-3, "phi": 0.3}
    std = {"scale_factor": 1e-7, "tan_beta": 1e-6, "phi": 1e-4, "k0": 1e-6}
    plain = make_model(calibration_of(values, {}), typical=0.01)
    known = make_model(calibration_of({**values, "k0": 1e-3}, std), typical=0.01)
    source = [data[name] for name in ("t", "psi", "rate", "y", "z")]
    target = [np.empty(ROWS) for _ in source]
    ax, dv, u, flags = np.empty(ROWS), np.empty(ROWS), np.empty(ROWS), np.empty(ROWS, dtype=np.int32)

    def run(kind: str, full: bool, model: Model) -> Callable[[], object]:
        rate, marks = data["rate"] if kind == "rate" else NONE, np.zeros(ROWS, np.bool_)
        chunk = Samples(data["t"], data["psi"], rate, data["y"], data["z"], marks, NO_RATES, NONE, NONE)
        u_ax, row_flags = (u, flags) if full else (NONE, NONE.astype(np.int32))
        result = Rows(ax, dv, u_ax, row_flags, np.zeros(SUMS))
        return lambda: run_kernel(model, init_state(), chunk, result)

    works = {"copy": lambda: [np.copyto(b, a) for a, b in zip(source, target, strict=True)]}
    for title, kind, full in (
        ("angle, rate -> ax, dv", "rate", False), ("angle, rate -> ax, dv, u_ax, flags", "rate", True),
        ("angle -> ax, dv", "angle", False), ("angle -> ax, dv, u_ax, flags", "angle", True),
    ):  # fmt: skip
        works[title] = run(kind, full, plain)
        works[f"{title}; k0, 4 uncertain"] = run(kind, full, known)
    spent = rounds(works, ROUNDS)
    put_down("compensation-copy", {name: np.median(own / spent["copy"]) for name, own in spent.items()})
    put_down("compensation", {name: own.min() / ROWS * 1e9 for name, own in spent.items()})


def triad() -> None:
    """A stream of chunks of 65536 rows through three instruments, results allocated by the stream."""
    data = samples(ROWS)
    cal = calibration_of({"scale_factor": 0.8884, "tan_beta": 5e-3, "phi": 0.3}, {})
    mounted = [Mounted(cal, np.roll(np.eye(3), -i, axis=0)) for i in range(3)]
    cuts = [slice(start, start + (1 << 16)) for start in range(0, ROWS, 1 << 16)]
    chunks = [
        (data["t"][rows], np.tile(data["psi"][rows], (3, 1)), np.tile(data["rate"][rows], (3, 1)))
        for rows in cuts
    ]

    def work() -> None:
        stream = SetCompensator(mounted, sampled=True, uncertainty=False, flags=False)
        for times, angles, rates in chunks:
            stream.push(times, angles, rate=rates)

    spent = np.median(seconds(work, 15, time.process_time))
    put_down("compensation", {"triad, samples of angle and rate, one core": ROWS / spent / 1e6})


def latency() -> None:
    cal = calibration_of(
        {"scale_factor": 0.8884, "tan_beta": 5e-3, "phi": 0.3, "k0": 1e-3}, {"phi": 1e-4, "k0": 1e-6}
    )
    stream = piga.Compensator(cal)
    spent = []
    for i in range(20_000):
        sample = {"t": 0.01 * i, "output": 0.00888 * i, "f": (9.8, 1.0, 2.0)}
        start = time.perf_counter()
        stream.push(sample)
        spent.append(time.perf_counter() - start)
    late = np.array(spent[1000:]) * 1e6
    median, slowest = np.quantile(late, [0.5, 0.99])
    put_down("compensation", {
        "latency of one pushed sample, median": median, "latency of one pushed sample, 99 %": slowest,
    })  # fmt: skip


RUN_FILE = """
[instrument]
serial = "bench"
scale_factor = "0.8884 rad/s/g"
[data]
file = "data.parquet"
time = { column = "t", unit = "s" }
output = { column = "psi", kind = "angle", unit = "rad" }
reference = { columns = ["x", "y", "z"], unit = "m/s^2" }
"""


def write_data(path: Path) -> None:
    """The record that goes from file to file, uncompressed, in row groups of a million."""
    import pyarrow as pa
    from pyarrow import parquet

    with parquet.ParquetWriter(
        path / "data.parquet",
        pa.schema([(n, pa.float64()) for n in ["t", "psi", "x", "y", "z"]]),
        compression="none",
        use_dictionary=False,
    ) as writer:
        for start in range(0, ROWS, 1 << 20):
            rows = min(1 << 20, ROWS - start)
            t = 0.01 * np.arange(start, start + rows)
            ones = np.full(rows, 9.8)
            writer.write_table(pa.table({"t": t, "psi": 0.888 * t, "x": ones, "y": ones, "z": ones}))
    (path / "run.toml").write_text(RUN_FILE)


def copy_by_arrow(path: Path) -> None:
    """Read five columns and write as many as a compensation does, with the same options, by PyArrow alone."""
    import pyarrow as pa
    from pyarrow import parquet

    with parquet.ParquetFile(path / "data.parquet", page_checksum_verification=True) as file:
        read = file.read(use_threads=False)
    flags = pa.array(np.zeros(read.num_rows, np.int32))
    columns = {"t": read["t"], "ax": read["psi"], "dv": read["x"], "u_ax": read["y"], "flags": flags}
    options = {"compression": "none", "use_dictionary": False, "write_statistics": False}
    parquet.write_table(pa.table(columns), path / "copy.parquet", write_page_checksum=True, **options)


def file_to_file() -> None:
    """Processor time of a compensation from file to file over that of PyArrow for the same columns, in turn."""
    values = {"scale_factor": 0.8884, "tan_beta": 5e-3, "phi": 0.3, "k0": 1e-3}
    cal = calibration_of(values, {"scale_factor": 1e-7, "tan_beta": 1e-6, "phi": 1e-4, "k0": 1e-6})
    spent = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        write_data(path)
        for _ in range(10):
            times = [time.process_time()]
            copy_by_arrow(path)
            times.append(time.process_time())
            record = piga.read_run(path / "run.toml")
            times.append(time.process_time())
            file_digest(path / "data.parquet")
            times.append(time.process_time())
            result = piga.compensate(record, cal)
            times.append(time.process_time())
            write_rows(result, path / "out.parquet")
            times.append(time.process_time())
            spent.append(np.diff(times))
    copied, reading, digest, computing, writing = np.median(spent[1:], axis=0) / ROWS * 1e9
    whole = "Parquet to Parquet over reading and writing the same columns with PyArrow"
    put_down("compensation", {
        whole: (reading + computing + writing) / copied, "PyArrow alone": copied, "of that, compensating": computing,
        "of that, writing": writing, "of that, reading with all checks": reading, "of the reading, SHA-256 of the file": digest,
    })  # fmt: skip


TASKS = {"file": file_to_file, "memory": in_memory, "triad": triad, "latency": latency}

if __name__ == "__main__":
    for name in [name for name in TASKS if name in sys.argv] or TASKS:
        TASKS[name]()
