"""``piga platform``: every N-th row, and a word before large files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from piga.cli.computed import platform
from piga.cli.main import app

SCENARIO = """\
[site]
latitude = "40 deg"
[run]
duration = "100 s"
[sensors]
gimbal_noise = "1 arcsec"
"""


def test_every_tenth_row(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SCENARIO)
    for every, rows in ((1, 101), (10, 11)):
        out = tmp_path / f"out-{every}"
        arguments = ["platform", "simulate", str(tmp_path / "s.toml"), "--out", str(out), "--every", str(every)]
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == 0, done.exception
        tables = {name: pq.read_table(out / f"{name}.parquet") for name in ("readouts", "truth")}
        assert tables["readouts"].num_rows == rows
        for name in ("readouts.parquet", "truth.parquet", "report.html"):
            assert f"wrote {out / name}" in done.stdout
    whole = pq.read_table(tmp_path / "out-1" / "readouts.parquet")
    tenth = pq.read_table(tmp_path / "out-10" / "readouts.parquet")
    for name in whole.column_names:
        values, kept = whole.column(name).to_numpy(), tenth.column(name).to_numpy()
        if name.startswith("dv"):
            np.testing.assert_allclose(kept[1:], values[1:].reshape(10, 10).sum(axis=1), rtol=1e-9, atol=1e-12)
        else:
            np.testing.assert_array_equal(kept, values[::10])


def test_large_files_are_announced(capsys: pytest.CaptureFixture[str]) -> None:
    table = pa.table({"t": pa.array(range(7_000_000), pa.float64())})
    platform._announce([table], 1)
    assert (
        "writing 1 files of 7000000 rows, up to 56 MB together; fewer with --every N" in capsys.readouterr().err
    )
    platform._announce([table.slice(0, 100)], 1)
    assert capsys.readouterr().err == ""
