"""Run files of known motion, and ``piga compensate`` on them in small pieces."""

from __future__ import annotations

import sys
from importlib import import_module

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from piga.cli.main import main
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of

TIME, ANGLE = 'time = { column = "t", unit = "s" }', 'kind = "angle", unit = "rad"'
REFERENCE = 'reference = { columns = ["fx", "fy", "fz"], unit = "m/s^2" }'


def run_text(file: str, output: str = ANGLE) -> str:
    head = ["[instrument]", 'serial = "A"', 'scale_factor = "0.8884 rad/s/g"']
    data = ["[data]", f'file = "{file}"', TIME, f'output = {{ column = "psi", {output} }}']
    return "\n".join([*head, *data, REFERENCE, ""])


KERNEL = import_module("piga.compensation.compensator")
CAL = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "k0": 1e-3}


def write(folder, name="run.parquet", rows=500, serial="A", phi=0.3, axes=None):
    t = np.arange(rows) * 0.01
    f = constant_force(t, 1.0, 3.0, 1.0)
    f = f if axes is None else f @ np.array(axes).T
    run = run_of(t, f, phi=phi, errors={"k0": 1e-3})
    table = pa.table(
        {"t": t, "psi": run.output, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2], "part": (t > 2.0).astype(int)}
    )
    pa.parquet.write_table(table, folder / name)
    path = folder / (name.split(".")[0] + ".toml")
    path.write_text(run_text(name))
    calibration_of({**CAL, "phi": phi}, {"phi": 1e-4}, serial=serial, angle_rms=1e-6).to_json(
        folder / (name.split(".")[0] + ".json")
    )
    return path


def command(monkeypatch, capsys, *words) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["piga", "compensate", *map(str, words)])
    code = 0
    try:
        main()
    except SystemExit as stop:
        code = int(stop.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err
