"""Memory of ``piga compensate`` with a page."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from piga.units import G0
from tests.compensation.run_files import CAL, run_text
from tests.compensation.twin_data import calibration_of
from tests.memory import LIMIT, largest_memory


def memory(folder: Path, rows: int) -> int:
    """Largest memory of the command [bytes] on a slow swing of so many rows."""
    t = 0.001 * np.arange(rows)
    f = G0 * np.array([0.9 + 0.2 * np.sin(t / 40.0), 0.1 * np.cos(t / 35.0), 0.2 * np.sin(t / 33.0)])
    psi = 0.8884e-3 / G0 * np.cumsum(f[0])
    columns = {"t": t, "psi": psi + 1e-4 * np.sin(psi), "fx": f[0], "fy": f[1], "fz": f[2]}
    pa.parquet.write_table(pa.table(columns), folder / "run.parquet")
    (folder / "run.toml").write_text(run_text("run.parquet"))
    calibration_of(CAL, {"phi": 1e-4, "k0": 1e-6}, serial="A", angle_rms=1e-6).to_json(folder / "cal.json")
    words = ["run.toml", "--calibration", "cal.json", "--out", "out.parquet", "--report", "page.html"]
    paths = [word if word.startswith("--") else str(folder / word) for word in words]
    return largest_memory([sys.executable, "-m", "piga", "compensate", *paths])


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("rows", [1 << 18, 2_000_000])
def test_a_page(tmp_path: Path, rows: int) -> None:
    """Of a record that is read whole, and of one with more rows than the orders are shown of."""
    memory(tmp_path, 2000)  # the kernels stand on disk: compiling takes memory of its own, once
    assert memory(tmp_path, rows) < LIMIT
