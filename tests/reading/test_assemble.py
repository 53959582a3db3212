"""Reading recorded tests: clean, dirty and damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import piga
from piga.formats.text import convention
from piga.records import arrays
from piga.units import G0
from tests.records.files import events, lines, psi_steps, read, write_log, write_run

STEP = 10179.0 / 20.0 * 2.0 * np.pi / 72000


def test_a_clean_log(tmp_path: Path) -> None:
    run = read(tmp_path, lines())
    assert run.size == 40
    assert run.quality.used == 40
    assert run.quality.events == ()
    np.testing.assert_allclose(run.f[0], [G0, 0.1 * G0, 0.0])
    np.testing.assert_allclose(psi_steps(run), STEP, atol=1e-4)
    assert run.resolution == pytest.approx(2 * np.pi / 72000)
    assert run.labels == ("all",)
    assert run.row[0] == 2
    assert set(run.input_sha256) == {"run.toml", "run.csv"}


def test_a_counter_that_wraps_loses_its_phase_between_segments(tmp_path: Path) -> None:
    rows = []
    for i, row in enumerate(lines()):
        cells = row.split(",")
        cells[1] = str((62536 + int(cells[1])) % 65536)
        rows.append(",".join(cells) + f",{i // 20}")
    data = {"instrument": "counter_bits = 16", "data": 'segment = "seg"'}
    run = read(tmp_path, rows, header="t,n,fx,fy,fz,seg", **data)
    assert events(run)["counter-roll-over"] == 1
    np.testing.assert_allclose(psi_steps(run), STEP, atol=1e-4)
    assert run.phase_group == (0, 1)
    assert events(run)["phase-lost"] == 1
    with pytest.raises(piga.CalibrationError, match=r"'shared' is not possible.*segment '1'"):
        piga.calibrate(run, ["tan_beta"])


def test_a_counter_of_whole_revolutions_keeps_its_phase(tmp_path: Path) -> None:
    rows = [f"{i / 20:.4f},{(9000 * i) % 65536},1.0,0.1,0.0,{i // 20}" for i in range(40)]
    path = write_run(tmp_path, instrument="counter_bits = 16", data='segment = "seg"')
    path.write_text(path.read_text().replace("72000", "32768"))
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,seg")
    assert piga.read_run(path).phase_group == (0, 0)


def test_a_gap_inside_a_segment_loses_the_phase_of_a_wrapping_counter(tmp_path: Path) -> None:
    rows = lines()
    del rows[10:15]
    rows = [",".join([c if k != 1 else str(int(c) % 65536) for k, c in enumerate(r.split(","))]) for r in rows]
    run = read(tmp_path, rows, instrument="counter_bits = 16")
    assert run.labels == ("all", "all/2")
    assert events(run)["phase-lost"] == 1


@pytest.mark.parametrize(
    ("unit", "fold", "kept"),
    [
        ("deg", '"360 deg"', True),
        ("deg", "360", True),
        ("mrad", '"1080 deg"', True),
        ("mrad", '"1100 deg"', False),
    ],
)
def test_an_angle_that_folds_keeps_its_phase_over_whole_turns(
    tmp_path: Path, unit: str, fold: str, kept: bool
) -> None:
    """1080 deg are three turns; in mrad the division leaves a rounding error. Kept across the gap of two segments."""
    span = float(fold.strip('"').split(maxsplit=1)[0])
    turned = 25.4 * np.arange(120) % span
    turned = turned if unit == "deg" else np.radians(turned) * 1e3
    rows = [f"{i / 20 + 60 * (i >= 60)},{a:.9f},1.0,0.1,0.0,{i >= 60:d}" for i, a in enumerate(turned)]
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,p")
    path = write_run(tmp_path, data='segment = "p"')
    folds = f'kind = "angle", unit = "{unit}", wraps_at = {fold} }}'
    path.write_text(path.read_text().replace('kind = "counts" }', folds))
    run = piga.read_run(path)
    np.testing.assert_allclose(psi_steps(run), np.radians(25.4), atol=1e-7)
    assert (len(set(run.phase_group)) == 1) == kept


def test_rate_and_temperature_and_base_rate(tmp_path: Path) -> None:
    rows = [f"{i / 20},50.9,1.0,0.1,0.0,25.0,15.0,0,0" for i in range(30)]
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,T,wx,wy,wz")
    data = (
        'temperature = { column = "T", unit = "degC" }\n'
        'base_rate = { columns = ["wx", "wy", "wz"], unit = "deg/h" }'
    )
    path = write_run(tmp_path, data=data)
    path.write_text(path.read_text().replace('kind = "counts" }', 'kind = "rate", unit = "deg/s" }'))
    run = piga.read_run(path)
    assert run.kind == "rate"
    np.testing.assert_allclose(run.output, np.radians(50.9))
    assert run.temperature is not None
    assert run.base_rate is not None
    np.testing.assert_allclose(run.temperature, 298.15)
    np.testing.assert_allclose(run.base_rate[:, 0], np.radians(15.0) / 3600)


def test_a_segment_visited_twice_is_two_segments(tmp_path: Path) -> None:
    rows = [row + f",{(0, 1, 0)[i // 14]}" for i, row in enumerate(lines())]
    run = read(tmp_path, rows, header="t,n,fx,fy,fz,seg", data='segment = "seg"')
    assert run.labels == ("0", "1", "0#2")


@pytest.mark.parametrize("damaged", [False, True])
def test_labels_lose_their_blanks_and_an_empty_one_is_no_segment(tmp_path: Path, damaged: bool) -> None:
    """In the rows that are read all at once, and in those that are read one by one."""
    rows = [f"{row},{('up ', ' up', '  ', 'down')[i // 10]}" for i, row in enumerate(lines())]
    rows[5] = rows[5].replace(",1.0,", ",x,") if damaged else rows[5]
    run = read(tmp_path, rows, header="t,n,fx,fy,fz,p", data='segment = "p"\ndamaged_rows = "mask"')
    assert run.labels == ("up", "down")
    assert events(run)["no-segment"] == 10
    assert run.size == 30 - damaged


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1), st.integers(13, 30))
def test_unwrapping_gives_back_any_counter(tmp_path: Path, seed: int, bits: int) -> None:
    rng = np.random.default_rng(seed)
    limit = min(2**bits // 2 - 1, 600)
    counts = np.cumsum(rng.integers(-limit, limit, 60)) + rng.integers(0, 2**bits)
    rows = [f"{i / 20},{int(c) % 2**bits},1.0,0.1,0.0" for i, c in enumerate(counts)]
    run = read(tmp_path, rows, instrument=f"counter_bits = {bits}")
    np.testing.assert_allclose(np.diff(run.output) / run.resolution, np.diff(counts), atol=1e-6)


def test_rows_are_left_out_with_their_reason(tmp_path: Path) -> None:
    whole = read(tmp_path, lines())
    left = 'leave_out = [{ rows = [10, 14], reason = "door slammed" }, { rows = [41, 41], reason = "end" }]'
    run = read(tmp_path, lines(), data=left)
    assert set(whole.row) - set(run.row) == {10, 11, 12, 13, 14, 41}
    assert run.begins[run.row == 15]
    assert [(e.kind, e.count, e.first_row) for e in run.quality.events if e.kind == "left-out"] == [
        ("left-out", 5, 10),
        ("left-out", 1, 41),
    ]
    assert "door slammed" in next(e.detail for e in run.quality.events if e.kind == "left-out")
    np.testing.assert_array_equal(run.f, whole.f[np.isin(whole.row, run.row)])


@pytest.mark.parametrize("rows", ["[14, 10]", "[1, 1]", "[42, 50]", "[2, 41]"])
def test_rows_that_cannot_be_left_out(tmp_path: Path, rows: str) -> None:
    with pytest.raises(piga.DataError, match="row"):
        read(tmp_path, lines(), data=f'leave_out = [{{ rows = {rows}, reason = "why" }}]')
    with pytest.raises(piga.RunFileError, match="reason"):
        read(tmp_path, lines(), data=f"leave_out = [{{ rows = {rows} }}]")


def test_lost_and_disordered_sequence_numbers_are_counted(tmp_path: Path) -> None:
    numbers = [*range(10), *range(13, 30), *range(25, 38)]
    rows = [f"{row},{k}" for row, k in zip(lines(len(numbers)), numbers, strict=True)]
    run = read(tmp_path, rows, header="t,n,fx,fy,fz,k", data='sequence = { column = "k" }')
    assert {"sequence-gap": 1, "sequence-back": 1}.items() <= events(run).items()
    assert np.flatnonzero(run.begins).tolist() == [0, 10, 27]


def outcome(path: Path) -> piga.Run | str:
    """The run, or the error."""
    try:
        return piga.read_run(path)
    except piga.PigaError as error:
        return str(error)


@pytest.mark.parametrize("data", ['segment = "s"', 'segment = "s"\ndamaged_rows = "mask"'])
def test_any_size_of_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, data: str) -> None:
    """A log with everything that a log may have wrong."""
    rows = [f"{line},{'AB'[i // 12 % 2]}" for i, line in enumerate(lines(60))]
    rows[5] = rows[5].replace(",A", ',"A"')
    rows[9] = rows[9].replace(",1.0,", ",NaN,")
    rows[20:22] = rows[21:19:-1]
    del rows[30:33]
    rows[40:40] = ["", rows[40]]
    for at, damaged in ((10, "x,1,1.0,0.1,0.0,A"), (15, "1,2"), (44, rows[44] + "\0"), (45, rows[45] + "\r,")):
        rows[at] = damaged
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,s")
    path = write_run(tmp_path, data=data)
    whole = outcome(path)
    assert isinstance(whole, str) == ("mask" not in data)
    for piece, large in ((20, 0), (77, 1 << 30), (500, 0)):
        monkeypatch.setattr(convention, "PIECE_BYTES", piece)
        monkeypatch.setattr(arrays, "LARGE_BYTES", large)
        assert outcome(path) == whole
