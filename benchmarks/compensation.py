"""Speed of compensation against a plain copy of as many bytes: ``python benchmarks/compensation.py [--record]``.

The copy is measured in the same rounds, one pass of each after the other, everything warm; only ratios compare
between machines. In memory nothing is allocated inside the measured call. ``angle, rate`` are samples: columns t,
angle, rate, a_Y, a_Z; the copy moves five columns, the results ax and dv beside them are not counted. Where ``u_ax``
and flags are written besides (12 bytes per sample), the second ratio is that to a copy of as many bytes: two columns
more.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # as the command does

import numpy as np
from harness import put_down, rounds

import piga
from piga._kernels.compensation.sample import Rows
from piga._kernels.compensation.terms import SUMS
from piga.compensation import Mounted, SetCompensator
from piga.compensation.compensator import (
    NO_RATES,
    NONE,
    Chunk,
    init_state,
    run_kernel,
)
from piga.compensation.model import Model, make_model
from piga.compensation.result import write_rows
from piga.records import Calibration, Coefficient, Provenance, Quality
from piga.records.calibration import Diagnostics
from piga.records.terms import unit_of

ROWS = 2_000_000
COPIES: dict[str, float] = {}
FIGURES: dict[str, float] = {}
FILE_ROWS = 2_000_000
ROUNDS = 41


def calibration(values: dict[str, float], std: dict[str, float]) -> Calibration:
    result = tuple(Coefficient(name, v, std.get(name, 0.0), unit_of(name)) for name, v in values.items())
    return Calibration(
        "bench", 0.8884 / 9.80665, tuple(n for n in values if n != "phi"), "shared", "output", "information",
        result, np.diag([c.std**2 for c in result]), 1.0, 1e-5, 0.0, 0.0, 0.0, 0.0, 0.0, Quality(1, 1, 0), 1.0,
        (), (), Diagnostics(), (),
        Provenance({}, "bench", "2026-01-01T00:00:00Z"),
    )  # fmt: skip


def on_threads(works: list[Callable[[], object]]) -> Callable[[], object]:
    pool = ThreadPoolExecutor(len(works))
    return lambda: [future.result() for future in [pool.submit(work) for work in works]]


def samples(rows: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    t = 0.01 * np.arange(rows)
    rate = np.full(rows, 0.888) + 1e-3 * rng.standard_normal(rows)
    return {
        "t": t, "psi": np.cumsum(0.01 * rate), "rate": rate, "y": 9.8 + rng.standard_normal(rows),
        "z": rng.standard_normal(rows),
    }  # fmt: skip


def single(threads: int) -> None:
    data = samples(ROWS)
    values = {"scale_factor": 0.8884, "tan_beta": 5e-3, "phi": 0.3}
    std = {"scale_factor": 1e-7, "tan_beta": 1e-6, "phi": 1e-4, "k0": 1e-6}
    plain = make_model(calibration(values, {}), typical=0.01)
    known = make_model(calibration({**values, "k0": 1e-3}, std), typical=0.01)
    share = ROWS // threads
    ax, dv, u, flags = np.empty(ROWS), np.empty(ROWS), np.empty(ROWS), np.empty(ROWS, dtype=np.int32)
    source = [data[name] for name in ("t", "psi", "rate", "y", "z")]
    target = [np.empty(ROWS) for _ in source]
    spare, marks, marks_none = np.ones(ROWS), np.ones(ROWS, dtype=np.int32), np.zeros(ROWS, np.bool_)

    def copy(k: int) -> Callable[[], object]:
        rows = slice(k * share, (k + 1) * share)
        return lambda: [np.copyto(b[rows], a[rows]) for a, b in zip(source, target, strict=True)]

    def copy_more(k: int) -> Callable[[], object]:
        rows = slice(k * share, (k + 1) * share)
        pairs = [*zip(source, target, strict=True), (spare, u), (marks, flags)]
        return lambda: [np.copyto(b[rows], a[rows]) for a, b in pairs]

    def run(k: int, kind: str, full: bool, model: Model) -> Callable[[], object]:
        rows = slice(k * share, (k + 1) * share)
        output, angle = (data["rate"], data["psi"][rows]) if kind == "rate" else (data["psi"], NONE)
        chunk = Chunk(
            data["t"][rows],
            output[rows],
            data["y"][rows],
            data["z"][rows],
            marks_none[rows],
            NO_RATES,
            NONE,
            angle,
        )
        result = Rows(
            ax[rows],
            dv[rows],
            u[rows] if full else NONE,
            flags[rows] if full else NONE.astype(np.int32),
            np.zeros(SUMS),
        )
        return lambda: run_kernel(model, init_state(), chunk, kind, result)

    works = {"copy": on_threads([copy(k) for k in range(threads)])}
    works["copy of 52 bytes"] = on_threads([copy_more(k) for k in range(threads)])
    for title, kind, full in (
        ("angle, rate -> ax, dv", "rate", False), ("angle, rate -> ax, dv, u_ax, flags", "rate", True),
        ("angle -> ax, dv", "angle", False), ("angle -> ax, dv, u_ax, flags", "angle", True),
    ):  # fmt: skip
        works[title] = on_threads([run(k, kind, full, plain) for k in range(threads)])
        works[f"{title}; k0, 4 uncertain"] = on_threads([run(k, kind, full, known) for k in range(threads)])
    spent = rounds(works, ROUNDS)
    print(f"{threads} core(s), ns per sample: median, least; ratio to the copy of 40 bytes in the same round")
    for title, seconds in spent.items():
        each = seconds / ROWS * 1e9
        print(
            f"  {title:52s} {np.median(each):6.2f} {each.min():6.2f}   {times(seconds, spent['copy'])}", end=""
        )
        if threads == 1:
            COPIES[title] = float(f"{np.median(seconds / spent['copy']):.2g}")
        print(f"; of 52 bytes {times(seconds, spent['copy of 52 bytes'])}" if "flags" in title else "")


def times(seconds: np.ndarray, copy: np.ndarray) -> str:
    """Median of the ratios of each round, ratio of the least."""
    return f"x {np.median(seconds / copy):4.2f}, least {seconds.min() / copy.min():4.2f}"


def triad() -> None:
    rows = 2_000_000
    data = samples(rows)
    cal = calibration({"scale_factor": 0.8884, "tan_beta": 5e-3, "phi": 0.3}, {})
    mounted = [Mounted(cal, np.roll(np.eye(3), -i, axis=0)) for i in range(3)]
    psi, rate = np.tile(data["psi"], (3, 1)), np.tile(data["rate"], (3, 1))
    works = {}
    for title, sampled, flags in (
        ("samples of angle and rate", True, False), ("the same with flags", True, True),
        ("angles", False, False),
    ):  # fmt: skip
        works[title] = on_chunks(data["t"], psi, rate, mounted, sampled, flags)
    for title, seconds in rounds(works, 15, time.process_time).items():
        FIGURES[f"triad, {title}, one core"] = round(rows / np.median(seconds) / 1e6, 1)
        print(
            f"triad of {title}: {rows / np.median(seconds) / 1e6:.1f} million rows per second on one core, "
            f"at best {rows / seconds.min() / 1e6:.1f}"
        )


def on_chunks(
    t: np.ndarray, psi: np.ndarray, rate: np.ndarray, mounted: list[Mounted], sampled: bool, flags: bool
) -> Callable[[], object]:
    """A stream of chunks of 65536 rows, results allocated by the stream."""
    cuts = range(0, t.size, 1 << 16)
    chunks = [
        (t[c : c + (1 << 16)], psi[:, c : c + (1 << 16)].copy(), rate[:, c : c + (1 << 16)].copy())
        for c in cuts
    ]

    def work() -> None:
        stream = SetCompensator(mounted, sampled=sampled, uncertainty=False, flags=flags)
        for times, angles, rates in chunks:
            stream.push(times, angles, rate=rates if sampled else None)

    return work


def latency() -> None:
    cal = calibration(
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
    FIGURES["latency of one pushed sample, median"] = round(float(np.median(late)))
    FIGURES["latency of one pushed sample, 99 %"] = round(float(np.quantile(late, 0.99)))
    print(
        f"latency of one sample: median {np.median(late):.1f}, 99 % {np.quantile(late, 0.99):.1f} microseconds"
    )


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
        for start in range(0, FILE_ROWS, 1 << 20):
            rows = min(1 << 20, FILE_ROWS - start)
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
    cal = calibration(values, {"scale_factor": 1e-7, "tan_beta": 1e-6, "phi": 1e-4, "k0": 1e-6})
    spent = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        subprocess.run([sys.executable, __file__, "write", folder], check=True)
        for _ in range(10):
            times = [time.process_time()]
            copy_by_arrow(path)
            times.append(time.process_time())
            record = piga.read_run(path / "run.toml")
            times.append(time.process_time())
            write_rows(piga.compensate(record, cal), path / "out.parquet")
            times.append(time.process_time())
            spent.append(np.diff(times))
    copied, reading, writing = np.median(spent[1:], axis=0) / FILE_ROWS * 1e9
    FIGURES["Parquet to Parquet over reading and writing the same columns with PyArrow"] = round(
        (reading + writing) / copied, 1
    )
    FIGURES["of that, compensating and writing"] = round(writing)
    print(
        f"PyArrow {copied:.0f} ns a row; piga reads in {reading:.0f}, compensates and writes in {writing:.0f}"
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["write"]:
        write_data(Path(sys.argv[2]))
        sys.exit()
    wanted = [word for word in sys.argv[1:] if word != "--record"] or ["single", "triad", "latency", "file"]
    if "file" in wanted:
        file_to_file()
    if "single" in wanted:
        single(1)
        single(2)
    if "triad" in wanted:
        triad()
    if "latency" in wanted:
        latency()
    put_down("compensation-copy", COPIES)
    put_down("compensation", FIGURES)
