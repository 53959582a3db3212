"""Small run files and data files for the reader's tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import piga

RUN = """\
[instrument]
serial = "T-1"
scale_factor = "0.8884 rad/s/g"
counts_per_revolution = 72000
{instrument}
[data]
file = "{file}"
time = {{ column = "t", unit = "s" }}
output = {{ column = "n", kind = "counts" }}
reference = {{ columns = ["fx", "fy", "fz"], unit = "g" }}
{data}
[model]
terms = ["scale_factor", "k0"]
{model}
"""


def write_run(
    folder: Path, file: str = "run.csv", *, instrument: str = "", data: str = "", model: str = ""
) -> Path:
    path = folder / "run.toml"
    path.write_text(RUN.format(file=file, instrument=instrument, data=data, model=model), encoding="utf-8")
    return path


def lines(count: int = 40, rate: float = 20.0) -> list[str]:
    """Rows of a log at rest along X0: t, n, fx, fy, fz."""
    return [f"{i / rate:.4f},{round(10179.0 * i / rate)},1.0,0.1,0.0" for i in range(count)]


def write_log(folder: Path, rows: list[str], *, header: str = "t,n,fx,fy,fz", name: str = "run.csv") -> Path:
    path = folder / name
    path.write_bytes(("\n".join([header, *rows]) + "\n").encode("utf-8"))
    return path


def read(folder: Path, rows: list[str], **options: str) -> piga.Run:
    header = options.pop("header", "t,n,fx,fy,fz")
    write_log(folder, rows, header=header)
    return piga.read_run(write_run(folder, **options))


def events(run: piga.Run) -> dict[str, int]:
    return {event.kind: event.count for event in run.quality.events}


def psi_steps(run: piga.Run) -> np.ndarray:
    return np.diff(run.output)[~run.begins[1:]]
