"""``piga platform``: every N-th row, and a word before large files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
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
    platform._announce(7_000_000, 1, 1, 1)
    assert (
        "1 files of 7000000 rows will be written, up to 56 MB together; fewer with --every N"
        in capsys.readouterr().err
    )
    platform._announce(7_000_000, 2, 1, 2)
    assert "files of 3500000 rows will be written, up to 56 MB together\n" in capsys.readouterr().err
    platform._announce(100, 1, 1, 1)
    assert capsys.readouterr().err == ""


def test_the_size_is_known_before_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is announced before anything is computed is what the tables hold in the end."""
    (tmp_path / "s.toml").write_text(
        SCENARIO.replace('"100 s"', '"100 s"\nstep = "0.5 s"')
        + '[compensation]\nmisalignment = "true"\nattitude = "true"\n'
    )
    told: list[tuple[int, int, int, int]] = []
    monkeypatch.setattr(platform, "_announce", lambda *what: told.append(what))
    monkeypatch.setattr(
        platform, "_simulated", lambda _: pytest.fail("computed first") if not told else SIMULATED(_)
    )
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["platform", "simulate", str(tmp_path / "s.toml"), "--out", str(out)])
    assert done.exit_code == 0, done.exception
    tables = [pq.read_table(out / f"{name}.parquet") for name in ("readouts", "truth")]
    assert told == [(tables[0].num_rows, sum(table.num_columns for table in tables), 2, 1)]
    told.clear()
    out = tmp_path / "navigated"
    done = CliRunner().invoke(app, ["platform", "navigate", str(tmp_path / "s.toml"), "--out", str(out)])
    assert done.exit_code == 0, done.exception
    tables = [pq.read_table(path) for path in out.glob("navigation-*.parquet")]
    assert told == [(tables[0].num_rows, sum(table.num_columns for table in tables), len(tables), 1)]


SIMULATED = platform._simulated
