"""Reading recorded tests: clean, dirty and damaged."""

from __future__ import annotations

import gzip
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

import piga
from piga.reading.checks import OutputScale, unwrapped
from piga.reading.columns import RawColumns
from piga.records.run import TimeBase
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


@pytest.mark.parametrize(
    ("encoding", "mark"), [("utf-8-sig", ""), ("gb18030", "时间"), ("utf-16", "时间"), ("utf-8", "时间")]
)
def test_encodings(tmp_path: Path, encoding: str, mark: str) -> None:
    text = "\n".join([f"t,n,fx,fy,fz,{mark}x", *[row + ",0" for row in lines()]]) + "\n"
    (tmp_path / "run.csv").write_bytes(text.encode(encoding))
    run = piga.read_run(write_run(tmp_path))
    assert run.size == 40
    assert ("encoding" in events(run)) == (encoding != "utf-8")


def test_semicolons_and_decimal_commas(tmp_path: Path) -> None:
    rows = [row.replace(",", ";").replace(".", ",") for row in lines()]
    run = read(tmp_path, rows, header="t;n;fx;fy;fz")
    np.testing.assert_allclose(run.f[:, 1], 0.1 * G0)
    np.testing.assert_allclose(np.diff(run.t), 0.05)


def test_mixed_decimal_marks_are_refused(tmp_path: Path) -> None:
    rows = [row.replace(",", ";") for row in lines()]
    rows[3] = rows[3].replace(".", ",")
    with pytest.raises(piga.DataError, match=r"decimal mark is ambiguous"):
        read(tmp_path, rows, header="t;n;fx;fy;fz")


def test_units_row_and_units_in_the_header(tmp_path: Path) -> None:
    run = read(tmp_path, ["s,,g,g,g", *lines()])
    assert run.size == 40
    assert run.row[0] == 3
    bracketed = read(tmp_path, lines(), header="t [s],n,fx [g],fy (g),fz [g]")
    assert bracketed.size == 40
    with pytest.raises(piga.DataError, match=r"column 'fx' has the unit 'm/s\^2' in the file, but 'g'"):
        read(tmp_path, lines(), header="t,n,fx [m/s^2],fy,fz")


def test_blank_lines_are_skipped_and_rows_stay_those_of_the_file(tmp_path: Path) -> None:
    rows = lines()
    rows.insert(5, "")
    rows.insert(9, "  ")
    run = read(tmp_path, rows)
    assert run.size == 40
    assert events(run)["blank-line"] == 2
    assert run.row[-1] == 43


def test_missing_values_are_masked_and_counted(tmp_path: Path) -> None:
    rows = lines()
    for i, token in ((7, "NaN"), (20, ""), (21, "OVER")):
        cells = rows[i].split(",")
        cells[2] = token
        rows[i] = ",".join(cells)
    run = read(tmp_path, rows)
    assert run.size == 37
    assert run.quality.masked == 3
    assert events(run)["missing-value"] == 3
    assert events(run)["gap"] == 2
    assert [e.first_row for e in run.quality.events if e.kind == "missing-value"] == [9]


def test_truncated_last_line_is_not_used(tmp_path: Path) -> None:
    write_log(tmp_path, lines())
    path = tmp_path / "run.csv"
    path.write_bytes(path.read_bytes()[:-3])
    run = piga.read_run(write_run(tmp_path))
    assert run.size == 39
    assert events(run)["truncated-last-line"] == 1


def test_dropped_samples_make_a_gap(tmp_path: Path) -> None:
    rows = lines()
    del rows[10:13]
    run = read(tmp_path, rows)
    assert events(run) == {"gap": 1}
    assert int(np.flatnonzero(run.begins)[1]) == 10
    np.testing.assert_allclose(psi_steps(run), STEP, atol=1e-4)


def test_repeated_and_conflicting_rows(tmp_path: Path) -> None:
    rows = lines()
    rows.insert(10, rows[9])
    clash = rows[20].split(",")
    clash[1] = str(int(clash[1]) + 3)
    rows.insert(21, ",".join(clash))
    run = read(tmp_path, rows)
    result = events(run)
    assert result["repeated-row"] == 1
    assert result["conflicting-row"] == 1
    assert run.size == 39


def test_time_that_jumps_back_splits_the_record(tmp_path: Path) -> None:
    rows = [*lines(20), *lines(20)]
    run = read(tmp_path, rows)
    assert events(run)["time-jump-back"] == 1
    assert run.begins.sum() == 2


@pytest.mark.parametrize("bits", [16, 24])
def test_counters_that_wrap(tmp_path: Path, bits: int) -> None:
    start = 2**bits - 3000
    rows = []
    for i, row in enumerate(lines()):
        cells = row.split(",")
        cells[1] = str((start + int(cells[1])) % 2**bits)
        rows.append(",".join(cells) + f",{i // 20}")
    run = read(
        tmp_path,
        rows,
        header="t,n,fx,fy,fz,seg",
        instrument=f"counter_bits = {bits}",
        data='segment = "seg"',
    )
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
    assert events(run)["segment-split"] == 1


def test_a_counter_too_narrow_for_the_rate_is_refused(tmp_path: Path) -> None:
    with pytest.raises(piga.DataError, match=r"(?s)more than half .* sample at [\d.]+ Hz"):
        read(tmp_path, [f"{i / 20},{i % 256},1.0,0.1,0.0" for i in range(40)], instrument="counter_bits = 8")
    with pytest.raises(piga.DataError, match=r"outside the range"):
        read(tmp_path, lines(400), instrument="counter_bits = 16")


def test_a_folded_counter_without_its_width_is_refused(tmp_path: Path) -> None:
    rows = [
        ",".join([c if k != 1 else str(int(c) % 65536) for k, c in enumerate(r.split(","))]) for r in lines(400)
    ]
    with pytest.raises(piga.DataError, match=r"(?s)row 131, column 'n': the output jumps.*counter_bits"):
        read(tmp_path, rows)


def test_angle_that_folds(tmp_path: Path) -> None:
    rows = [f"{i / 20},{(25.4 * i) % 360.0:.6f},1.0,0.1,0.0" for i in range(60)]
    write_log(tmp_path, rows)
    path = write_run(tmp_path)
    text = path.read_text().replace('kind = "counts" }', 'kind = "angle", unit = "deg", wraps_at = "360 deg" }')
    path.write_text(text)
    run = piga.read_run(path)
    np.testing.assert_allclose(psi_steps(run), np.radians(25.4), atol=1e-7)
    assert run.phase_group == (0,)


@pytest.mark.parametrize(("span", "kept"), [("1080 deg", True), ("1100 deg", False)])
def test_an_angle_in_mrad_keeps_its_phase_over_whole_turns(tmp_path: Path, span: str, kept: bool) -> None:
    """1080 deg are three turns; in mrad the division leaves a rounding error. Kept across the gap of two segments."""
    fold = np.radians(float(span.split(maxsplit=1)[0])) * 1e3
    turned = np.radians(25.4 * np.arange(120)) * 1e3 % fold
    rows = [f"{i / 20 + 60 * (i >= 60)},{a:.9f},1.0,0.1,0.0,{i >= 60:d}" for i, a in enumerate(turned)]
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,p")
    path = write_run(tmp_path, data='segment = "p"')
    text = path.read_text().replace(
        'kind = "counts" }', f'kind = "angle", unit = "mrad", wraps_at = "{span}" }}'
    )
    path.write_text(text)
    assert (len(set(piga.read_run(path).phase_group)) == 1) == kept


def test_an_output_that_is_locked_in_one_position_is_not_called_saturated(tmp_path: Path) -> None:
    """It rests at its largest value there, and runs away from it in the position before and after."""
    moving = np.concatenate([np.arange(400) * 20, np.full(400, 7990), 7980 - 20 * np.arange(400)])
    locked = slice(400, 800)
    moving[locked] += np.random.default_rng(1).choice([0, -1], 400, p=[0.9, 0.1])
    position = np.repeat([0, 1, 2], 400)
    force = np.array([1.0, 0.0, -1.0])[position]
    rows = [
        f"{i / 20:.2f},{n},{0.04 * f:.4f},1.0,0.0,{p}"
        for i, (n, f, p) in enumerate(zip(moving, force, position, strict=True))
    ]
    result = events(read(tmp_path, rows, header="t,n,fx,fy,fz,p", data='segment = "p"'))
    assert "stuck-value" not in result


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


def test_sample_rate_instead_of_time(tmp_path: Path) -> None:
    write_log(tmp_path, lines())
    path = write_run(tmp_path)
    path.write_text(path.read_text().replace('time = { column = "t", unit = "s" }', 'sample_rate = "20 Hz"'))
    np.testing.assert_allclose(np.diff(piga.read_run(path).t), 0.05)


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


def test_parquet_is_read_like_csv(tmp_path: Path) -> None:
    plain = read(tmp_path, lines())
    columns = {"t": plain.t, "n": np.round(plain.output / plain.resolution).astype(np.int64)}
    columns |= {name: plain.f[:, i] / G0 for i, name in enumerate(("fx", "fy", "fz"))}
    parquet.write_table(pa.table(columns), tmp_path / "run.parquet")
    run = piga.read_run(write_run(tmp_path, "run.parquet"))
    np.testing.assert_allclose(run.output, plain.output, atol=1e-15)
    np.testing.assert_allclose(run.f, plain.f, rtol=1e-15)


def test_gzip_is_read(tmp_path: Path) -> None:
    write_log(tmp_path, lines())
    (tmp_path / "run.csv.gz").write_bytes(gzip.compress((tmp_path / "run.csv").read_bytes()))
    assert piga.read_run(write_run(tmp_path, "run.csv.gz")).size == 40


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((5, "abc"), r"row 7, column 'n' \(B\): 'abc' is not a number"),
        ((5, "１２"), "full-width"),
        ((5, "1 000"), "'1 000' is not a number"),
        ((5, "7,8"), "row 7 has 6 cells, the header has 5"),
        ((5, "12.5"), "row 7, column 'n': 12.5 is not a whole count\n  remedy: set kind to 'angle'"),
        ((5, "9" * 20), "not a whole count"),
        ((5, "1\x00"), "NUL"),
    ],
)
def test_damaged_cells_are_named(tmp_path: Path, change: tuple[int, str], message: str) -> None:
    rows = lines()
    cells = rows[change[0]].split(",")
    cells[1] = change[1]
    rows[change[0]] = ",".join(cells)
    with pytest.raises(piga.DataError, match=message) as caught:
        read(tmp_path, rows)
    assert "run.csv" in str(caught.value)
    assert "remedy" in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"\n\n", "is empty"),
        (b"t,n,fx,fy,fz\n", "no data"),
        (b"t,n,fx,fy,fz\n0,1", "no data"),
        (b"t,t,fx,fy,fz\n0,1,1,1,1\n", "duplicate column name"),
        (b"0,1,1,1,1\n0.1,1,1,1,1\n", "not column names"),
        (b"t,m,fx,fy,fz\n0,1,1,1,1\n", "no column 'n'; the columns are: t, m, fx"),
        (b"t,n,fx,fy,fz\n0,1,1,1,1\n", "fewer than two usable rows"),
        (b"t,n,fx,fy,fz\n0,nan,1,1,1\n1,nan,1,1,1\n", "no row has all"),
        (b"t,n,fx,fy,fz\n1,1,1,1,1\n1,1,1,1,1\n", "fewer than two usable rows"),
        (b"\xff\xfe\xff", "utf-16|NUL|empty"),
    ],
)
def test_unusable_files(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "run.csv").write_bytes(content)
    with pytest.raises(piga.DataError, match=message):
        piga.read_run(write_run(tmp_path))


def test_missing_and_foreign_files(tmp_path: Path) -> None:
    with pytest.raises(piga.DataError, match=r"run\.csv: cannot be read"):
        piga.read_run(write_run(tmp_path))
    (tmp_path / "run.parquet").write_bytes(b"PAR1 not really")
    with pytest.raises(piga.DataError, match=r"not a readable Parquet"):
        piga.read_run(write_run(tmp_path, "run.parquet"))
    (tmp_path / "run.doc").write_bytes(b"x")
    with pytest.raises(piga.DataError, match=r"files of kind '.doc'"):
        piga.read_run(write_run(tmp_path, "run.doc"))
    (tmp_path / "bad.csv.gz").write_bytes(b"no gzip")
    with pytest.raises(piga.DataError, match=r"cannot be read"):
        piga.read_run(write_run(tmp_path, "bad.csv.gz"))
    (tmp_path / "bomb.csv.gz").write_bytes(gzip.compress(b"t,n,fx,fy,fz\n" + b"0,0,1,0,0\n" * 5_000_000))
    with pytest.raises(piga.DataError, match=r"unpacks to more than"):
        piga.read_run(write_run(tmp_path, "bomb.csv.gz"))


def test_parquet_faults(tmp_path: Path) -> None:
    parquet.write_table(pa.table({"t": [0.0, 1.0], "n": ["a", "b"]}), tmp_path / "run.parquet")
    with pytest.raises(piga.DataError, match=r"no column 'fx'|holds string"):
        piga.read_run(write_run(tmp_path, "run.parquet"))
    full = {"t": [0.0, 1.0, 2.0], "n": [0, None, 5], "fx": [1.0] * 3, "fy": [0.0] * 3, "fz": [0.0] * 3}
    parquet.write_table(pa.table(full), tmp_path / "run.parquet")
    run = piga.read_run(write_run(tmp_path, "run.parquet"))
    assert run.size == 2
    assert events(run)["missing-value"] == 1


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 2**32 - 1), st.integers(13, 30))
def test_unwrapping_gives_back_any_counter(tmp_path: Path, seed: int, bits: int) -> None:
    rng = np.random.default_rng(seed)
    limit = min(2**bits // 2 - 1, 600)
    counts = np.cumsum(rng.integers(-limit, limit, 60)) + rng.integers(0, 2**bits)
    rows = [f"{i / 20},{int(c) % 2**bits},1.0,0.1,0.0" for i, c in enumerate(counts)]
    run = read(tmp_path, rows, instrument=f"counter_bits = {bits}")
    np.testing.assert_allclose(np.diff(run.output) / run.resolution, np.diff(counts), atol=1e-6)


@pytest.mark.parametrize("limit", [None, 60])
def test_a_slow_counter_rests_where_it_turns(tmp_path: Path, limit: int | None) -> None:
    """The plateau of a rounded turning point is expected; the same motion cut off by a limit is reported."""
    force = np.cos(2.0 * np.pi * np.arange(4000) / 2000.0)
    counts = np.round(np.cumsum(10179.0 * 0.002 * force / 20.0)).astype(int)
    top = counts.max() if limit is None else counts.max() - limit
    rows = [
        f"{i / 20.0:.2f},{min(n, top)},{0.002 * f:.6f},0.1,0.0"
        for i, (n, f) in enumerate(zip(counts, force, strict=True))
    ]
    assert ("stuck-value" in events(read(tmp_path, rows))) == (limit is not None)


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


NAMES = ("t", "n", "fx", "fy", "fz")


def test_an_unwrapped_reading_takes_the_nearest_turn() -> None:
    values = np.array([250.0, 4.0, 10.0, 200.0, 190.0])
    begins = np.array([True, False, False, True, False])
    scale = OutputScale(0.5, 256.0, keeps_phase=False, counts=True)
    raw = RawColumns(Path("run.csv"), {"n": values}, np.zeros(5, np.int32), ("all",), np.arange(5))
    output, lost = unwrapped(raw, "n", TimeBase(begins, 1.0, ()), scale, 40.0)
    np.testing.assert_array_equal(output, [125.0, 130.0, 133.0, 100.0, 95.0])
    assert [(event.kind, event.count) for event in raw.events] == [("counter-roll-over", 1)]
    np.testing.assert_array_equal(lost, [False, False, False, True, False])


def test_the_digest_beside_a_log_counts(tmp_path: Path) -> None:
    write_log(tmp_path, lines())
    run = piga.read_run(write_run(tmp_path))
    (digest,) = {value for name, value in run.input_sha256.items() if name.endswith(".csv")}
    beside = tmp_path / "run.csv.sha256"
    beside.write_text(f"{digest}  run.csv\n")
    assert piga.read_run(tmp_path / "run.toml").size == run.size
    for words in ("", "0" * 64):
        beside.write_text(words)
        with pytest.raises(piga.DataError, match="SHA-256 is not the one in"):
            piga.read_run(tmp_path / "run.toml")


def test_a_log_that_changes_or_is_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from piga.reading import columns

    path = write_log(tmp_path, lines())
    states = iter([(1, 0, 0, 0), (2, 0, 0, 0)])
    with monkeypatch.context() as patch:
        patch.setattr(columns, "_state", lambda *_file: next(states))
        with pytest.raises(piga.DataError, match="changed while it was read"):
            piga.read_run(write_run(tmp_path))
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(piga.DataError, match="not a regular file"):
        piga.read_run(tmp_path / "run.toml")


def test_a_sheet_is_asked_of_a_text_file(tmp_path: Path) -> None:
    write_log(tmp_path, lines())
    with pytest.raises(piga.DataError, match=r"sheet is for \.xlsx files"):
        piga.read_run(write_run(tmp_path, data='sheet = "log"'))


@pytest.mark.parametrize(
    ("cell", "options", "hint"),
    [
        ("１２", {}, "full-width"),
        ("1'000", {}, "thousands separators"),
        ("1.5", {"data": "decimal = ','\ndelimiter = ';'"}, "is not a number"),
    ],
)
def test_cells_with_a_hint(tmp_path: Path, cell: str, options: dict[str, str], hint: str) -> None:
    mark = ";" if options else ","
    rows = [row.replace(",", mark).replace(".", "," if options else ".") for row in lines()]
    cells = rows[5].split(mark)
    cells[1] = cell
    rows[5] = mark.join(cells)
    with pytest.raises(piga.DataError, match=hint):
        read(tmp_path, rows, header=mark.join(NAMES), **options)


def test_a_reference_in_another_unit_is_suspected(tmp_path: Path) -> None:
    rows = [f"{i / 20:.4f},{round(10179.0 * i / 20)},{G0},0.0,0.0" for i in range(60)]
    run = read(tmp_path, rows)
    (event,) = [event for event in run.quality.events if "|f|" in event.detail]
    assert event.kind == "implausible-unit"
    assert "too large by" in event.detail


def test_an_output_that_stands_still_is_noticed(tmp_path: Path) -> None:
    rows = [f"{i / 20:.4f},{min(round(10179.0 * i / 20), 300_000)},1.0,0.1,0.0" for i in range(1500)]
    result = events(read(tmp_path, rows))
    assert "stopped-output" in result or "stuck-value" in result


def test_lost_and_disordered_sequence_numbers_are_counted(tmp_path: Path) -> None:
    numbers = [*range(10), *range(13, 30), *range(25, 38)]
    rows = [f"{row},{k}" for row, k in zip(lines(len(numbers)), numbers, strict=True)]
    run = read(tmp_path, rows, header="t,n,fx,fy,fz,k", data='sequence = { column = "k" }')
    result = {event.kind: event for event in run.quality.events}
    assert result["sequence-gap"].count == 1
    assert result["sequence-gap"].detail.startswith("3 samples missing")
    assert result["sequence-back"].count == 1
    assert np.flatnonzero(run.begins).tolist() == [0, 10, 27]


def test_every_reset_of_a_counter_is_named(tmp_path: Path) -> None:
    rows = lines(60)
    for first in (20, 40):
        base = int(rows[first].split(",")[1])
        for k in range(first, 60):
            cells = rows[k].split(",")
            rows[k] = ",".join([cells[0], str(int(cells[1]) - base), *cells[2:]])
    with pytest.raises(
        piga.DataError, match=r"row 22, column 'n': the counter goes to 0.*, and in rows 42: it was reset"
    ):
        read(tmp_path, rows)
