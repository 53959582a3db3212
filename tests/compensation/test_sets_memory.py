"""Memory of ``piga compensate``, for pages and large sets, too."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

from piga.compensation.sets import is_triad_file
from piga.units import G0
from tests.compensation.run_files import CAL, REFERENCE, run_text
from tests.compensation.twin_data import calibration_of
from tests.memory import LIMIT, largest_memory

WORK = """
import sys
from piga.cli.main import main
sys.argv = ["piga", "compensate", *sys.argv[1:]]
try:
    main()
except SystemExit as stop:
    assert not stop.code, stop.code
"""
pytestmark = [
    pytest.mark.usefixtures("compiled"),
    pytest.mark.slow,
    pytest.mark.long,
    pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc"),
]


def columns(rows: int, axis: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> dict[str, np.ndarray]:
    """A slow swing; the output turns with the force along ``axis``."""
    t = 0.001 * np.arange(rows)
    f = G0 * np.array([0.9 + 0.2 * np.sin(t / 40.0), 0.1 * np.cos(t / 35.0), 0.2 * np.sin(t / 33.0)])
    psi = 0.8884e-3 / G0 * np.cumsum(np.array(axis) @ f)
    return {"t": t, "psi": psi + 1e-4 * np.sin(psi), "fx": f[0], "fy": f[1], "fz": f[2]}


def written(folder: Path, rows: int, name: str = "run", more: str = "", **others: np.ndarray) -> Path:
    pa.parquet.write_table(pa.table(columns(rows) | others), folder / f"{name}.parquet")
    (folder / f"{name}.toml").write_text(run_text(f"{name}.parquet", REFERENCE, more))
    calibration_of(CAL, {"phi": 1e-4, "k0": 1e-6}, serial="A", angle_rms=1e-6).to_json(folder / "cal.json")
    return folder / f"{name}.toml"


def memory(run: Path, *more: str) -> int:
    """Largest memory of the command [bytes]."""
    words = [str(run), "--out", str(run.parent / "out.parquet"), *more]
    if not is_triad_file(run):
        words += ["--calibration", str(run.parent / "cal.json")]
    return largest_memory([sys.executable, "-c", WORK, *words])


@pytest.mark.parametrize("rows", [1 << 18, 2_000_000])
def test_a_page(tmp_path: Path, rows: int) -> None:
    """Of a record that is read whole, and of one with more rows than the orders are shown of."""
    assert memory(written(tmp_path, rows), "--report", str(tmp_path / "page.html")) < LIMIT
