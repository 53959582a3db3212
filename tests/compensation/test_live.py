"""Streams through a pipe: lines and batches are the record, and what is none is refused with its line."""

from __future__ import annotations

import io

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest

import piga
from piga.compensation.live import compensate_arrow, compensate_lines
from tests.compensation.run_files import CAL
from tests.compensation.twin_data import calibration_of, constant_force, run_of


def live_table(rows=50):
    t = np.arange(rows) * 0.01
    f = constant_force(t, 1.0, 3.0)
    run = run_of(t, f, phi=0.3)
    return pa.table({"t": t, "output": run.output, "fx": f[:, 0], "fy": f[:, 1], "fz": f[:, 2]}), run


def test_lines_and_batches_through_a_pipe_are_the_record():
    table, run = live_table()
    cal = calibration_of({**CAL}, {"phi": 1e-4})
    whole = piga.compensate(run, cal)
    text = io.StringIO(
        "t,output,fx,fy,fz\n" + "\n".join(",".join(map(repr, r.values())) for r in table.to_pylist()) + "\n"
    )
    answer = io.StringIO()
    assert compensate_lines(text, answer, piga.Compensator(cal)) == 50
    answered = np.array([line.split(",")[1] for line in answer.getvalue().splitlines()[1:]], dtype=float)
    assert answered.tobytes() == whole.ax.tobytes()
    sent, got = io.BytesIO(), io.BytesIO()
    with pa.ipc.new_stream(sent, table.schema) as writer:
        writer.write_table(table, 7)
    sent.seek(0)
    compensate_arrow(sent, got, piga.Compensator(cal))
    got.seek(0)
    assert pa.ipc.open_stream(got).read_all().column("u_ax").to_numpy().tobytes() == whole.u_ax.tobytes()


T = 0.01 * np.arange(60)
F = constant_force(T, 1.0, 3.0, 0.5)


def test_base_rate_and_temperature_through_a_pipe() -> None:
    rate, warm = np.tile([1e-4, 2e-3, -1e-3], (T.size, 1)), 293.15 + 5.0 * T
    run = run_of(T, F, phi=0.3, base_rate=rate, temperature=warm)
    cal = calibration_of({**CAL, "k0_T": 1e-4})
    names = "t, output, fx, fy, fz, wx, wy, wz, temperature"
    rows = np.column_stack((run.t, run.output, F, rate, warm)).tolist()
    text = "\n\n".join([names, *(",".join(map(repr, row)) for row in rows), ""])
    answer = io.StringIO()
    assert compensate_lines(io.StringIO(text), answer, piga.Compensator(cal)) == T.size
    ax = np.array([line.split(",")[1] for line in answer.getvalue().splitlines()[1:]], dtype=float)
    assert ax.tobytes() == piga.compensate(run, cal).ax.tobytes()


@pytest.mark.parametrize(
    ("header", "message"),
    [("t,output,fx,fy", "no column 'fz'"), ("t,output,fx,fy,fz,speed", "the unknown column 'speed'")],
)
def test_columns_of_a_pipe(header: str, message: str) -> None:
    stream = piga.Compensator(calibration_of(CAL))
    with pytest.raises(piga.DataError, match=f"standard input: {message}"):
        compensate_lines(io.StringIO(header + "\n"), io.StringIO(), stream)
    table = pa.table({name: [1.0] for name in header.split(",")})
    sent = io.BytesIO()
    with pa.ipc.new_stream(sent, table.schema) as writer:
        writer.write_table(table)
    sent.seek(0)
    with pytest.raises(piga.DataError, match=f"standard input: {message}"):
        compensate_arrow(sent, io.BytesIO(), stream)


def test_names_of_a_pipe_stand_once_and_base_rates_together() -> None:
    stream = piga.Compensator(calibration_of(CAL))
    for header, message in (
        ("t,output,fx,fy,fz,fx", "the column 'fx' occurs twice"),
        ("t,output,fx,fy,fz,wx,wz", "no column 'wy', but the other base rates"),
        ("", "no column 't'"),
    ):
        with pytest.raises(piga.DataError, match=f"standard input: {message}"):
            compensate_lines(io.StringIO(header + "\n"), io.StringIO(), stream)


NO_NUMBERS = [
    "nan",
    "inf",
    "-Infinity",
    "0_14",
    "\uff11\uff12",
    "1e999",
    "0x10",
    "",
    "1 2",
    "\u0661",
    "1e",
    "--1",
    "\0",
]
"""What Python's float() takes for a number, or a logger writes in place of one."""


@pytest.mark.parametrize("cell", NO_NUMBERS)
@pytest.mark.parametrize("row", [0, 4], ids=["first row", "after a gap"])
def test_cells_of_a_pipe_that_are_no_numbers(cell: str, row: int) -> None:
    """Refused with their line wherever they stand; the rows before are answered."""
    table = [[0.01 * i + (5.0 if i >= 4 else 0.0), 0.1 * i, 9.8, 1.0, 0.0] for i in range(6)]
    texts = [",".join(map(repr, values)) for values in table]
    for column in range(5):
        cells = texts[row].split(",")
        cells[column] = cell
        sent = "\n".join(["t,output,fx,fy,fz", *texts[:row], ",".join(cells), *texts[row + 1 :], ""])
        answer = io.StringIO()
        with pytest.raises(
            piga.DataError, match=f"standard input: line {row + 2}: .* is not a row of 5 numbers"
        ):
            compensate_lines(io.StringIO(sent), answer, piga.Compensator(calibration_of(CAL)))
        assert answer.getvalue().count("\n") == (row + 1 if row else 0)


def test_a_line_without_end() -> None:
    """Memory does not grow with it; and a last line that is cut is not taken for a shorter number."""

    class Endless(io.TextIOBase):
        asked = 0

        def readline(self, size: int = -1) -> str:  # type: ignore[override]
            assert 0 < size <= 1 << 20
            self.asked += size
            return "1" * size if self.asked > size else "t,output,fx,fy,fz\n"

    stream = piga.Compensator(calibration_of(CAL))
    with pytest.raises(piga.DataError, match=r"line 2 is longer than 65536 characters"):
        compensate_lines(Endless(), io.StringIO(), stream)
    answer = io.StringIO()
    with pytest.raises(piga.DataError, match=r"line 3 has no end: the stream was cut off"):
        compensate_lines(io.StringIO("t,output,fx,fy,fz\n0,0,9.8,1,0\n0.01,0.1,9.8,1,0.12"), answer, stream)
    assert answer.getvalue().count("\n") == 2


@pytest.mark.parametrize("compression", [None, "lz4"])
def test_cut_and_damaged_arrow_streams(compression: str | None) -> None:
    """Every length of a stream, and many a changed byte: answered, or refused in words."""
    table = pa.table({name: np.arange(4.0) for name in ("t", "output", "fx", "fy", "fz")})
    sent = io.BytesIO()
    with pa.ipc.new_stream(
        sent, table.schema, options=pa.ipc.IpcWriteOptions(compression=compression)
    ) as writer:
        writer.write_table(table, 2)
    whole = sent.getvalue()
    draw = np.random.default_rng(3)
    cases = [whole[:length] for length in range(0, len(whole), 23)]
    for _ in range(80):
        changed = bytearray(whole)
        changed[draw.integers(len(whole))] = draw.integers(256)
        cases.append(bytes(changed))
    cal = calibration_of(CAL)
    for case in cases:
        try:
            with np.errstate(all="ignore"):  # compiled kernels do not warn
                compensate_arrow(io.BytesIO(case), io.BytesIO(), piga.Compensator(cal))
        except piga.DataError as error:
            assert str(error).startswith("standard input: ")  # noqa: PT017 - either outcome is right


@pytest.mark.parametrize("kind", [0, 2, 3, 4, 5, 6, 255])
def test_only_a_schema_is_read_as_a_schema(kind: int) -> None:
    """The type of the first message is damaged: PyArrow reads its content as a schema all the same, and crashes."""
    sent = bytearray(packed_stream(4))
    message = pa.ipc.MessageReader.open_stream(bytes(sent)).read_next_message()
    metadata = bytes(message.metadata)
    table = int.from_bytes(metadata[:4], "little")
    entries = table - int.from_bytes(metadata[table : table + 4], "little", signed=True)
    at = table + int.from_bytes(
        metadata[entries + 6 : entries + 8], "little"
    )  # the second field of the message: its type
    start = sent.index(metadata)
    assert sent[start + at] == 1
    sent[start + at] = kind
    with pytest.raises(piga.DataError, match="no Arrow stream"):
        compensate_arrow(io.BytesIO(sent), io.BytesIO(), piga.Compensator(calibration_of(CAL)))


TIMES = {
    "repeat": [0.0, 0.01, 0.02, 0.02, 0.03],
    "go back": [0.0, 0.01, 0.02, 0.01, 0.02],
    "leave a gap": [0.0, 0.01, 0.02, 5.0, 5.01],
    "go back from the start": [0.0, -1.0, -2.0, -3.0, -4.0],
}


@pytest.mark.parametrize("kind", list(TIMES))
def test_both_doors_begin_a_stretch_at_the_same_rows(kind: str) -> None:
    """Times that repeat, go back or leave a gap: no increment into that row (flag 1, dv 0, ax nan), through either door."""
    t = TIMES[kind]
    columns = {"t": t, "output": [0.1 * i for i in range(5)], "fx": [9.8] * 5, "fy": [1.0] * 5, "fz": [0.0] * 5}
    table, sent, got, said = pa.table(columns), io.BytesIO(), io.BytesIO(), io.StringIO()
    with pa.ipc.new_stream(sent, table.schema) as writer:
        writer.write_table(table, 2)
    sent.seek(0)
    compensate_arrow(sent, got, piga.Compensator(calibration_of(CAL)))
    lines = [",".join(columns), *(",".join(map(repr, row)) for row in zip(*columns.values(), strict=True)), ""]
    compensate_lines(io.StringIO("\n".join(lines)), said, piga.Compensator(calibration_of(CAL)))
    batches = pa.ipc.open_stream(got.getvalue()).read_all()
    told = np.array([line.split(",") for line in said.getvalue().split()[1:]], float)
    for number, name in enumerate(said.getvalue().split()[0].split(",")):
        np.testing.assert_array_equal(batches.column(name).to_numpy(), told[:, number], err_msg=name)
    begins = np.diff(t, prepend=-1.0)
    begins = (begins <= 0.0) | (begins > 0.015)
    np.testing.assert_array_equal(batches.column("flags").to_numpy(), begins.astype(int))
    assert not batches.column("dv").to_numpy()[begins].any()
    assert np.isnan(batches.column("ax").to_numpy()[begins]).all()


def packed_stream(rows: int, compression: str | None = "zstd") -> bytes:
    """One batch of columns that hold one value."""
    table = pa.table({name: np.zeros(rows) for name in ("t", "output", "fx", "fy", "fz")})
    sent, options = io.BytesIO(), pa.ipc.IpcWriteOptions(compression=compression)
    with pa.ipc.new_stream(sent, table.schema, options=options) as writer:
        writer.write_table(table)
    return sent.getvalue()


def test_a_batch_of_too_many_rows_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("piga.compensation.live.MOST_ROWS", 1999)
    stream = piga.Compensator(calibration_of(CAL))
    with pytest.raises(piga.DataError, match=r"a batch of 2000 rows, more than 1999"):
        compensate_arrow(io.BytesIO(packed_stream(2000)), io.BytesIO(), stream)


def test_arrow_columns_that_hold_no_numbers() -> None:
    columns = {name: pa.array([1.0]) for name in ("t", "output", "fx", "fy")}
    for column in (pa.array(["0_14"]), pa.array([[1.0]]), pa.array([True])):
        table, sent = pa.table(columns | {"fz": column}), io.BytesIO()
        with pa.ipc.new_stream(sent, table.schema) as writer:
            writer.write_table(table)
        sent.seek(0)
        with pytest.raises(piga.DataError, match=r"column 'fz' holds .*, not numbers"):
            compensate_arrow(sent, io.BytesIO(), piga.Compensator(calibration_of(CAL)))


def test_no_arrow_stream_and_an_empty_one() -> None:
    stream = piga.Compensator(calibration_of(CAL))
    with pytest.raises(piga.DataError, match="standard input: no Arrow stream"):
        compensate_arrow(io.BytesIO(b"t,output,fx,fy,fz\n"), io.BytesIO(), stream)
    schema = pa.schema([(name, pa.float64()) for name in ("t", "output", "fx", "fy", "fz")])
    sent, got = io.BytesIO(), io.BytesIO()
    pa.ipc.new_stream(sent, schema).close()
    sent.seek(0)
    assert compensate_arrow(sent, got, stream) == 0
    assert got.getvalue() == b""
