"""Records on disk: what the run file says of ranges and sequence numbers holds there, too; TDMS."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from tests.compensation.run_files import small_chunks, to_file
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of

RUN = """
[instrument]
serial = "A"
scale_factor = "0.8884 rad/s/g"
[data]
file = "{file}"
time = {{ column = "t", unit = "s" }}
output = {{ column = "psi", kind = "angle", unit = "rad" }}
reference = {{ columns = ["fx", "fy", "fz"], unit = "m/s^2" }}
{more}
"""
CAL = calibration_of(
    {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3}, {"phi": 1e-4}, serial="A", angle_rms=1e-6
)
ROWS = 900


def columns() -> dict[str, np.ndarray]:
    t = np.arange(ROWS) * 0.01
    f = constant_force(t, 1.0, 3.0, 1.0)
    psi = run_of(t, f, phi=0.3).output
    number = np.arange(250, 250 + ROWS, dtype=float)
    number[400:] += 3.0
    f[[5, 310], 1] = 1e6
    psi[[77, 600]] = -1e9
    return {"t": t, "psi": psi, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2], "n": number % 256}


def write(folder, name: str, more: str):
    result = columns()
    if name.endswith("tdms"):
        tdms = pytest.importorskip("nptdms")
        with tdms.TdmsWriter(folder / name) as writer:
            writer.write_segment([tdms.ChannelObject("log", key, value) for key, value in result.items()])
    else:
        pa.parquet.write_table(pa.table(result), folder / name)
    path = folder / "run.toml"
    path.write_text(RUN.format(file=name, more=more))
    return path


@pytest.mark.parametrize("name", ["run.parquet", "run.tdms"])
@pytest.mark.parametrize("chunk", [37, 1 << 16])
def test_ranges_and_sequence_numbers_hold_in_a_streamed_file(tmp_path, monkeypatch, name, chunk):
    more = 'sequence = { column = "n", wraps_at = 256 }\n[data.range]\npsi = [-1e6, 1e6]\nfy = [-100.0, 100.0]'
    path = write(tmp_path, name, more)
    whole = piga.compensate(piga.read_run(path), CAL)
    small_chunks(monkeypatch, chunk)
    summary, result = to_file(path, CAL, tmp_path / "o.parquet")
    table = pa.parquet.read_table(tmp_path / "o.parquet")
    assert summary.rows == whole.size == ROWS - 4
    for column in ("t", "ax", "dv", "u_ax", "flags"):
        assert table.column(column).to_numpy().tobytes() == getattr(whole, column).tobytes()
    assert result == {"saturated": 4, "gap": 4, "sequence-gap": 5}
    assert np.count_nonzero(whole.flagged("no_increment")) > 1
