"""Records whose reference comes from a ``[stand]``, chunk by chunk: the record that is read whole, to the bit."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

import piga
from tests.compensation.run_files import (
    ANGLE,
    CAL,
    TIME,
    assert_file_holds,
    run_text,
    small_chunks,
    to_file,
)
from tests.compensation.twin_data import calibration_of
from tests.memory import LIMIT, largest_memory

ROWS, STEP = 600, 0.01
HEAD = 'kind = "dividing-head"\nlatitude = "40 deg"\ndwell = "0.9 s"\nroll = "0.3 rad"\n'
STANDS = {
    "head in order": HEAD + 'positions = "0:40:10 deg"',
    "head by label": HEAD + 'positions = { b = "0.1 rad", a = "0.9 rad", "a#2" = "0.2 rad", c = "1.1 rad" }',
    "centrifuge": 'kind = "centrifuge"\nlatitude = "40 deg"\nlevels = ["1 g", "2 g", "3 g", "1 g"]\ndown = false\n'
    'dwell = "0.9 s"\nroll = "0.2 rad"\ncounter_rotating = true',
    "rate table": 'kind = "rate-table"\nlatitude = "40 deg"\nrates = ["1 deg/s", "7 deg/s", "-3 deg/s", "0 deg/s"]\n'
    'axis = "horizontal"\nalong = "-Y0"\ndwell = "2 s"',
    "composite": 'kind = "composite"\npause = "1 s"\n[[stand.parts]]\nkind = "dividing-head"\nlatitude = "40 deg"\n'
    'positions = ["0 deg", "50 deg"]\ndwell = "1 s"\nmove = "0.5 s"\n[[stand.parts]]\nkind = "rate-table"\n'
    'latitude = "40 deg"\naxis = "horizontal"\nrates = ["5 deg/s"]\ndwell = "9 s"',
    "profile": 'kind = "profile"\nfile = "profile.csv"\ntime = { column = "t", unit = "s" }\n'
    'force = { columns = ["x", "y", "z"], unit = "g" }\n'
    'base_rate = { columns = ["p", "q", "r"], unit = "deg/s" }',
}  # fmt: skip


def written(
    folder: Path, stand: str, *, kind: str = "parquet", name: str = "run", time: str = TIME, output: str = ANGLE,
    more: str = 'segment = "part"', **columns: np.ndarray,
) -> Path:  # fmt: skip
    """A record of four visits; ``columns`` replace some."""
    t = STEP * np.arange(ROWS)
    table = {"t": t, "psi": 0.9 * t + 0.3 * np.sin(3.0 * t), "part": np.repeat(["b", "a", "c", "a"], ROWS // 4)}
    table |= {"wx": 1e-4 * t, "wy": np.full(ROWS, 2e-3), "wz": np.full(ROWS, -1e-3)}
    data = pa.table(table | columns)
    data_name = f"{name}.{kind}"
    if kind == "h5":
        with pytest.importorskip("h5py").File(folder / data_name, "w") as out:
            for column in ("t", "psi", "wx", "wy", "wz"):
                out.create_dataset(column, data=data[column].to_numpy(), chunks=True, compression=1)
    else:
        (pa.csv.write_csv if kind == "csv" else pa.parquet.write_table)(data, folder / data_name)
    log = 0.07 * np.arange(130)
    profile = {
        "t": log,
        "x": np.cos(log),
        "y": 0.1 * log,
        "z": np.sin(log),
        "p": log,
        "q": -log,
        "r": 0.0 * log,
    }
    pa.csv.write_csv(pa.table(profile), folder / "profile.csv")
    path = folder / f"{name}.toml"
    path.write_text(run_text(data_name, more, "[stand]", stand, time=time, output=output))
    return path


def calibration() -> piga.Calibration:
    return calibration_of({**CAL, "m_Y": 1e-3}, {"phi": 1e-4, "k0": 1e-6}, serial="A", angle_rms=1e-6)


def same(path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, chunk: int) -> dict[str, Any]:
    """Read and compensated whole in memory, and on disk in pieces: the same to the bit."""
    record = piga.read_run(path)
    whole = piga.compensate(record, calibration())
    small_chunks(monkeypatch, chunk)
    again = piga.read_run(path)
    for name in ("t", "output", "f", "base_rate", "segment_index", "begins"):
        assert getattr(again, name).tobytes() == getattr(record, name).tobytes(), name
    summary = to_file(path, calibration(), folder / "o.parquet")
    assert_file_holds(folder / "o.parquet", whole)
    return summary


@pytest.mark.long
@pytest.mark.parametrize(
    ("stand", "kind", "chunk"),
    [
        ("head by label", "csv", 37),
        ("profile", "csv", 7),
        ("composite", "parquet", 7),
    ],
)
def test_every_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stand: str, kind: str, chunk: int
) -> None:
    assert same(written(tmp_path, STANDS[stand], kind=kind), tmp_path, monkeypatch, chunk)["rows"] == ROWS


WORK = """
import sys
from piga.cli.main import main
sys.argv = ["piga", "compensate", *sys.argv[1:]]
try:
    main()
except SystemExit as stop:
    assert not stop.code, stop.code
"""


@pytest.mark.long
def test_pandas_stays_out(tmp_path: Path) -> None:
    """PyArrow loads it, where there is one, for empty cells in and out: 40 MB."""
    pytest.importorskip("pandas")
    psi = np.where(np.isin(np.arange(ROWS), [0, 1, 150, 151, 400]), np.nan, 0.9 * STEP * np.arange(ROWS))
    path = written(tmp_path, STANDS["head in order"], psi=psi)
    calibration().to_json(tmp_path / "cal.json")
    script = WORK + "assert 'pyarrow' in sys.modules and 'pandas' not in sys.modules\n"
    words = [str(path), "--calibration", str(tmp_path / "cal.json"), "--out", str(tmp_path / "o.csv")]
    done = subprocess.run([sys.executable, "-c", script, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.usefixtures("compiled")
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize(
    ("stand", "kind"),
    [*itertools.product(("centrifuge", "profile"), ("parquet", "csv")), ("composite", "h5")],
)
def test_memory_is_bounded(tmp_path: Path, stand: str, kind: str) -> None:
    rows = 4_000_000
    t = 0.001 * np.arange(rows)
    columns = {"t": t, "psi": 0.9 * t, "part": np.repeat(["b", "a", "c", "a"], rows // 4)}
    columns |= {"wx": t, "wy": t, "wz": t}
    text, more = STANDS[stand].replace("0.9 s", "1000 s"), "" if kind == "h5" else 'segment = "part"'
    path = written(tmp_path, text, kind=kind, more=more, **columns)
    if stand == "profile":
        columns = {"t": t, "x": np.cos(t), "y": 0.1 * t, "z": np.sin(t), "p": t, "q": -t, "r": 0.0 * t}
        pa.csv.write_csv(pa.table(columns), tmp_path / "profile.csv")
    calibration().to_json(tmp_path / "cal.json")
    words = [str(path), "--calibration", str(tmp_path / "cal.json"), "--out", str(tmp_path / "o.parquet")]
    assert largest_memory([sys.executable, "-c", WORK, *words]) < LIMIT
