"""Run files of known motion, and ``piga compensate`` on them in small pieces."""

from __future__ import annotations

import sys
from importlib import import_module

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

import piga
from piga.cli.main import main
from piga.compensation.files import file_to_file
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of

RUN = """
[instrument]
serial = "A"
scale_factor = "0.8884 rad/s/g"
{counter}
[data]
file = "{file}"
time = {{ column = "t", unit = "s" }}
output = {{ column = "psi", kind = "{kind}" {unit} }}
reference = {{ columns = ["fx", "fy", "fz"], unit = "m/s^2" }}
{segment}
"""


KERNEL = import_module("piga.compensation.compensator")


CAL = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "k0": 1e-3}


def write(folder, name="run.parquet", rows=500, serial="A", counts=False, phi=0.3, axes=None):
    t = np.arange(rows) * 0.01
    f = constant_force(t, 1.0, 3.0, 1.0)
    f = f if axes is None else f @ np.array(axes).T
    run = run_of(t, f, phi=phi, errors={"k0": 1e-3})
    output = np.rint(run.output / (2 * np.pi) * 72000).astype(np.int64) % 2**16 if counts else run.output
    table = pa.table(
        {"t": t, "psi": output, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2], "part": (t > 2.0).astype(int)}
    )
    if name.endswith("csv"):
        pa.csv.write_csv(table, folder / name)
    else:
        pa.parquet.write_table(table, folder / name)
    text = RUN.format(
        file=name, kind="counts" if counts else "angle", unit="" if counts else ', unit = "rad"', segment="",
        counter="counts_per_revolution = 72000\ncounter_bits = 16" if counts else "",
    )  # fmt: skip
    path = folder / (name.split(".")[0] + ".toml")
    path.write_text(text)
    calibration_of({**CAL, "phi": phi}, {"phi": 1e-4}, serial=serial, angle_rms=1e-6).to_json(
        folder / (name.split(".")[0] + ".json")
    )
    return path


def small_chunks(monkeypatch, rows: int) -> None:
    """Records lie on disk, and so many rows are read and compensated at a time; sets of three are solved in as many."""
    monkeypatch.setattr("piga.compensation.sets.set_files.READINGS", 3 * rows)
    monkeypatch.setattr("piga.compensation.sets.set_files.HELD_ROWS", 0)
    monkeypatch.setattr("piga.compensation.files.file_to_file.HELD_ROWS", 0)
    monkeypatch.setattr("piga.records.spool.BLOCK", rows)
    monkeypatch.setattr("piga.formats.containers.parquet_reader.CHUNK_ROWS", rows)
    monkeypatch.setattr("piga.formats.containers.container.CHUNK_ROWS", rows)
    monkeypatch.setattr("piga.formats.text.source.PIECE_BYTES", 100 * rows)


def to_file(path, calibration, out, **options):
    """Read and compensate a run into Parquet: the summary, and the findings by kind."""
    record = piga.read_run(path, held=file_to_file.HELD_ROWS)
    summary = file_to_file.compensate_to_file(record, calibration, out, "parquet", **options)
    return summary, file_to_file.found_while_reading(record)


def command(monkeypatch, capsys, *words) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["piga", "compensate", *map(str, words)])
    code = 0
    try:
        main()
    except SystemExit as stop:
        code = int(stop.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err
