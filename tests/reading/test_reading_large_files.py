"""A large file is calibrated in a bounded memory."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv

import piga
from tests.memory import LIMIT, largest_memory
from tests.records.files import write_run

ROWS = 4_000_000


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("dirty", [False, True], ids=["clean", "dirty"])
def test_memory_does_not_grow_with_the_file(tmp_path: Path, dirty: bool) -> None:
    """Dirty: every thousandth reading is off by up to 1000 counts, and the reading jumps once."""
    t = np.arange(ROWS) / 1000.0
    f = np.column_stack([np.cos(t / 400.0), np.sin(t / 400.0), np.full(ROWS, 0.01)])
    turned = np.cumsum(0.8884e-3 * f[:, 0])
    noise = 2e-5 * np.random.default_rng(1).standard_normal(ROWS)
    counts = np.round((turned + 1e-4 * np.sin(turned) + noise) * 72000 / (2 * np.pi)).astype(np.int64)
    if dirty:
        counts[500::1000] += np.random.default_rng(2).integers(20, 1000, counts[500::1000].size)
        counts[ROWS // 2 :] += 5000
    table = pa.table({"t": np.round(t, 3), "n": counts, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2]})
    csv.write_csv(table, tmp_path / "run.csv")
    assert (tmp_path / "run.csv").stat().st_size > 180e6
    work = (
        "import sys, piga; from piga.records import arrays; arrays.LARGE_BYTES = 1 << 20;"
        "piga.calibrate(piga.read_run(sys.argv[1])).to_json(sys.argv[2])"
    )
    words = [str(write_run(tmp_path)), str(tmp_path / "c.json")]
    assert largest_memory([sys.executable, "-c", work, *words]) < LIMIT
    result = piga.Calibration.from_json(tmp_path / "c.json")
    assert result["scale_factor"].value == pytest.approx(0.8884, rel=1e-4)
    outliers = {e.kind[8:]: e.count for e in result.quality.events if e.kind.startswith("outlier-")}
    assert outliers == ({"spike": ROWS // 1000, "jump": 1} if dirty else {})
