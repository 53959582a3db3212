"""A large file is checked and calibrated in a bounded memory, with the result of the same file in memory."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv

from tests.records.files import write_run

ROWS = 4_000_000
WORK = """
import json, sys, threading, time
import numpy as np
import piga
from piga.records import arrays
from piga.cli.calibrate import write_results
from pathlib import Path
from tests.memory import kilobytes

def private():
    return kilobytes("RssAnon") / 1024

def warm():
    t = np.arange(300000) / 1000.0
    f = np.column_stack([9.8 + 0.1 * np.sin(t), 0.1 * t / 300, 0.0 * t])
    run = piga.Run.from_arrays(t, np.cumsum(1e-3 * 0.0906 * f[:, 0]) + 1e-6 * np.sin(9 * t), f, scale_factor="0.8884 rad/s/g",
        units="SI")
    piga.calibrate(run, ["scale_factor", "k0"])

arrays.LARGE_BYTES = int(sys.argv[2])
warm()
peak, done = [private()], False
def watch():
    while not done:
        peak.append(private())
        time.sleep(0.005)
thread = threading.Thread(target=watch)
thread.start()
calibration = piga.calibrate(piga.read_run(sys.argv[1]))
write_results(calibration, Path(sys.argv[1]).parent, report=False)
done = True
thread.join()
print(json.dumps({"peak": max(peak), "values": [c.value for c in calibration.coefficients],
                  "std": [c.std for c in calibration.coefficients], "rms": calibration.residual_rms,
                  "outliers": {e.kind[8:]: e.count for e in calibration.quality.events if e.kind.startswith("outlier-")}}))
"""


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
    path = write_run(tmp_path)
    small, large = measured(path, 1 << 40), measured(path, 1 << 20)  # the first one may have to compile
    assert large["peak"] < (600.0 if dirty else 500.0)
    assert large["peak"] < small["peak"]
    np.testing.assert_allclose(large["values"], small["values"], rtol=1e-12)
    np.testing.assert_allclose(large["std"], small["std"], rtol=1e-9)
    assert large["rms"] == pytest.approx(small["rms"], rel=1e-9)
    assert large["outliers"] == small["outliers"]
    assert large["outliers"] == ({"spike": ROWS // 1000, "jump": 1} if dirty else {})


def measured(path: Path, limit: int) -> dict:
    done = subprocess.run(
        [sys.executable, "-c", WORK, str(path), str(limit)], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])
