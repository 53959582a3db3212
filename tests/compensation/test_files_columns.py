"""Whatever a data file holds: on disk and in pieces it gives what it gives in memory, to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

import piga
from piga.compensation.files import orthogonal_triad
from piga.units import G0
from tests.compensation.run_files import (
    ANGLE,
    CAL,
    REFERENCE,
    TIME,
    assert_file_holds,
    run_text,
    set_to_file,
    small_chunks,
    to_file,
)
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of

ROWS, STEP = 400, 0.01


BASE = np.array([2e-5, 3e-3, -2e-3])


def written(
    folder: Path, *, kind: str = "angle", output: str = ANGLE, time: str = TIME, more: str = "",
    name: str = "run", **columns: np.ndarray,
) -> Path:  # fmt: skip
    """A record of a slow swing with base rate and a temperature that drifts; ``columns`` replace or add some."""
    t = STEP * np.arange(ROWS)
    f = np.array([1.0, 3.0, 1.0]) * G0 * (1.0 + 0.1 * np.sin(t))[:, None]
    warm = 293.15 + 0.5 * np.sin(0.7 * t)
    run = run_of(
        t,
        f,
        phi=0.3,
        kind=kind,
        base_rate=np.tile(BASE, (ROWS, 1)),
        errors={"k0": 1e-3, "k0_T": 1e-5},
        temperature=warm,
    )
    table = {"t": t, "psi": run.output, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2]}
    table |= {"wx": np.full(ROWS, BASE[0]), "wy": np.full(ROWS, BASE[1]), "wz": np.full(ROWS, BASE[2])}
    table |= {"warm": warm - 273.15, "k": np.arange(ROWS) % 100, "part": np.repeat([1, 2, 1, 3], ROWS // 4)}
    pa.parquet.write_table(pa.table(table | columns), folder / f"{name}.parquet")
    path = folder / f"{name}.toml"
    path.write_text(run_text(f"{name}.parquet", REFERENCE, more, time=time, output=output))
    return path


def folded(path: Path, turn: float) -> None:
    """Fold the output at ``turn`` [rad]."""
    table = pa.parquet.read_table(path.with_suffix(".parquet"))
    psi = np.mod(table["psi"].to_numpy() + 1.0, turn)
    pa.parquet.write_table(table.set_column(1, "psi", pa.array(psi)), path.with_suffix(".parquet"))


def same(path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, cal: piga.Calibration) -> dict[str, int]:
    """Compare both ways; returns the repairs that were counted on the way."""
    whole = piga.compensate(piga.read_run(path), cal)
    small_chunks(monkeypatch, 37)
    result = to_file(path, cal, folder / "o.parquet")["repairs"]
    assert_file_holds(folder / "o.parquet", whole)
    return result


@pytest.mark.parametrize(("turn", "kept"), [(2.0 * np.pi, True), (5.0, False)])
def test_a_gap_loses_the_phase_of_a_range_that_is_no_whole_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, turn: float, kept: bool
) -> None:
    t = STEP * np.arange(ROWS) + np.where(np.arange(ROWS) < 300, 0.0, 7.0)
    path = written(tmp_path, output=f'kind = "angle", unit = "rad", wraps_at = "{turn!r} rad"', t=t)
    folded(path, turn)
    cal = calibration_of(CAL, serial="A")
    if kept:
        assert same(path, tmp_path, monkeypatch, cal)["gap"] == 1
        return
    small_chunks(monkeypatch, 37)
    with pytest.raises(piga.CalibrationError, match="the zero of the output angle was lost before segment"):
        to_file(path, cal, tmp_path / "o.parquet")


def test_nothing_usable(tmp_path: Path) -> None:
    path = written(tmp_path, fy=np.full(ROWS, np.nan))
    with pytest.raises(piga.DataError, match=r"run\.parquet: no row has all needed values"):
        to_file(path, calibration_of(CAL, serial="A"), tmp_path / "o.parquet")


def test_units_that_contradict_the_run_file(tmp_path: Path) -> None:
    path = written(tmp_path)
    table = pa.parquet.read_table(tmp_path / "run.parquet")
    fields = [field.with_metadata({"unit": "g"}) if field.name == "fy" else field for field in table.schema]
    pa.parquet.write_table(table.cast(pa.schema(fields)), tmp_path / "run.parquet")
    words = r"column 'fy' has the unit 'g' in the file, but 'm/s\^2' in the run file"
    with pytest.raises(piga.DataError, match=words):
        to_file(path, calibration_of(CAL, serial="A"), tmp_path / "o.parquet")
    with pytest.raises(piga.DataError, match=words):
        piga.read_run(path)


def test_sets_that_do_not_fit_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small_chunks(monkeypatch, 37)
    mounted = orthogonal_triad([calibration_of(CAL, serial="A")] * 3)
    runs = [written(tmp_path, name=name) for name in "xy"]
    rate = written(tmp_path, name="z", kind="rate", output='kind = "rate", unit = "rad/s"')
    with pytest.raises(piga.DataError, match=r"z\.toml: the output is of kind 'rate', .*x\.toml is 'angle'"):
        set_to_file([*runs, rate], mounted, tmp_path / "o.parquet")
    short = written(tmp_path, name="z")
    table = pa.parquet.read_table(tmp_path / "z.parquet")
    pa.parquet.write_table(table.slice(0, 333), tmp_path / "z.parquet")
    with pytest.raises(piga.DataError, match=r"z\.toml: has 333 rows that can be used, .*x\.toml has 400"):
        set_to_file([*runs, short], mounted, tmp_path / "o.parquet")
    pa.parquet.write_table(table.slice(0, 0), tmp_path / "z.parquet")
    for name in "xyz":
        pa.parquet.write_table(
            table.set_column(3, "fy", pa.array(np.full(ROWS, np.nan))), tmp_path / f"{name}.parquet"
        )
    with pytest.raises(piga.DataError, match=r"x\.parquet: no row has all needed values"):
        set_to_file([*runs, short], mounted, tmp_path / "o.parquet")


NUMBERED_CAL = calibration_of(
    {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3}, {"phi": 1e-4}, serial="A", angle_rms=1e-6
)


NUMBERED_ROWS = 900


def numbered_columns() -> dict[str, np.ndarray]:
    t = np.arange(NUMBERED_ROWS) * 0.01
    f = constant_force(t, 1.0, 3.0, 1.0)
    psi = run_of(t, f, phi=0.3).output
    number = np.arange(250, 250 + NUMBERED_ROWS, dtype=float)
    number[400:] += 3.0
    f[[5, 310], 1] = 1e6
    psi[[77, 600]] = -1e9
    return {"t": t, "psi": psi, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2], "n": number % 256}


def write_numbered(folder, name: str, more: str):
    result = numbered_columns()
    if name.endswith("tdms"):
        tdms = pytest.importorskip("nptdms")
        with tdms.TdmsWriter(folder / name) as writer:
            writer.write_segment([tdms.ChannelObject("log", key, value) for key, value in result.items()])
    else:
        pa.parquet.write_table(pa.table(result), folder / name)
    path = folder / "run.toml"
    path.write_text(run_text(name, REFERENCE, more))
    return path


@pytest.mark.parametrize("name", ["run.parquet", "run.tdms"])
def test_ranges_and_sequence_numbers_hold_in_a_streamed_file(tmp_path, monkeypatch, name):
    more = 'sequence = { column = "n", wraps_at = 256 }\n[data.range]\npsi = [-1e6, 1e6]\nfy = [-100.0, 100.0]'
    path = write_numbered(tmp_path, name, more)
    whole = piga.compensate(piga.read_run(path), NUMBERED_CAL)
    small_chunks(monkeypatch, 37)
    summary = to_file(path, NUMBERED_CAL, tmp_path / "o.parquet")
    assert summary["rows"] == whole.size == NUMBERED_ROWS - 4
    assert_file_holds(tmp_path / "o.parquet", whole)
    assert summary["repairs"] == {"saturated": 4, "gap": 4, "sequence-gap": 5}
    assert np.count_nonzero(whole.flagged("no_increment")) > 1
