"""Streams through a pipe: lines are the record, and what is none is refused with its line."""

from __future__ import annotations

import io

import numpy as np
import pytest

import piga
from piga.compensation.compensator import compensate_lines
from tests.compensation.run_files import CAL
from tests.compensation.twin_data import calibration_of, constant_force, run_of

NAMES = ("t", "output", "fx", "fy", "fz")
T = 0.01 * np.arange(60)
F = constant_force(T, 1.0, 3.0, 0.5)


def by_lines(columns: dict, cal: piga.Calibration) -> np.ndarray:
    """What a stream of lines answers to these columns, (rows, names)."""
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    text = "\n\n".join([",".join(columns), *(",".join(map(repr, row)) for row in rows), ""])
    answer = io.StringIO()
    compensate_lines(io.StringIO(text), answer, piga.Compensator(cal))
    return np.array([line.split(",") for line in answer.getvalue().split()[1:]], float)


def refused(text: str, message: str) -> None:
    """The content is refused with these words."""
    with pytest.raises(piga.DataError, match=message):
        compensate_lines(io.StringIO(text), io.StringIO(), piga.Compensator(calibration_of(CAL)))


def test_lines_through_a_pipe_are_the_record() -> None:
    run, cal = run_of(T, F, phi=0.3), calibration_of({**CAL}, {"phi": 1e-4})
    answer, whole = (
        by_lines(dict(zip(NAMES, (run.t, run.output, *F.T), strict=True)), cal),
        piga.compensate(run, cal),
    )
    assert answer[:, 1].tobytes() == whole.ax.tobytes()
    assert answer[:, 3].tobytes() == whole.u_ax.tobytes()


def test_base_rate_and_temperature_through_a_pipe() -> None:
    rate, warm = np.tile([1e-4, 2e-3, -1e-3], (T.size, 1)), 293.15 + 5.0 * T
    run = run_of(T, F, phi=0.3, base_rate=rate, temperature=warm)
    cal = calibration_of({**CAL, "k0_T": 1e-4})
    columns = dict(zip(NAMES, (run.t, run.output, *F.T), strict=True))
    columns |= dict(zip(("wx", "wy", "wz"), rate.T, strict=True)) | {"temperature": warm}
    assert by_lines(columns, cal)[:, 1].tobytes() == piga.compensate(run, cal).ax.tobytes()


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("t,output,fx,fy", "there is no column 'fz'"),
        ("t,output,fx,fy,fz,speed", "unknown column 'speed'"),
        ("t,output,fx,fy,fz,fx", "twice the column 'fx'"),
        ("t,output,fx,fy,fz,wx,wz", "there is no column 'wy'"),
        ("", "there is no column 't'"),
    ],
)
def test_columns_of_a_pipe(header: str, message: str) -> None:
    refused(header + "\n", f"standard input: {message}")


NO_NUMBERS = ["nan", "inf", "-Infinity", "0_14", "１２", "1e999", "0x10", "", "1 2", "١", "1e", "--1", "\x00"]
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
        text = "\n".join(["t,output,fx,fy,fz", *texts[:row], ",".join(cells), *texts[row + 1 :], ""])
        answer = io.StringIO()
        with pytest.raises(
            piga.DataError, match=f"standard input: line {row + 2}: .* is not a row of 5 numbers"
        ):
            compensate_lines(io.StringIO(text), answer, piga.Compensator(calibration_of(CAL)))
        assert answer.getvalue().count("\n") == (row + 1 if row else 0)


def test_a_line_without_end() -> None:
    """Memory does not grow with it; and a last line that is cut is not taken for a shorter number."""

    class Endless(io.TextIOBase):
        asked = 0

        def readline(self, size: int = -1) -> str:  # type: ignore[override]
            assert 0 < size <= 1 << 20
            self.asked += size
            return "1" * size if self.asked > size else "t,output,fx,fy,fz\n"

    stream, answer = piga.Compensator(calibration_of(CAL)), io.StringIO()
    with pytest.raises(piga.DataError, match=r"line 2 is longer than 65536 characters"):
        compensate_lines(Endless(), io.StringIO(), stream)
    with pytest.raises(piga.DataError, match=r"line 3 has no end: the stream was cut off"):
        compensate_lines(io.StringIO("t,output,fx,fy,fz\n0,0,9.8,1,0\n0.01,0.1,9.8,1,0.12"), answer, stream)
    assert answer.getvalue().count("\n") == 2


TIMES = {
    "repeat": [0.0, 0.01, 0.02, 0.02, 0.03],
    "go back": [0.0, 0.01, 0.02, 0.01, 0.02],
    "leave a gap": [0.0, 0.01, 0.02, 5.0, 5.01],
    "go back from the start": [0.0, -1.0, -2.0, -3.0, -4.0],
}


@pytest.mark.parametrize("kind", list(TIMES))
def test_a_stretch_begins_where_time_does_not_go_on(kind: str) -> None:
    """Times that repeat, go back or leave a gap: no increment into that row (flag 1, dv 0, ax nan)."""
    t = TIMES[kind]
    columns = {"t": t, "output": [0.1 * i for i in range(5)], "fx": [9.8] * 5, "fy": [1.0] * 5, "fz": [0.0] * 5}
    _, ax, dv, _, flags = by_lines(columns, calibration_of(CAL)).T
    begins = np.diff(t, prepend=-1.0)
    begins = (begins <= 0.0) | (begins > 0.015)
    np.testing.assert_array_equal(flags, begins.astype(int))
    assert not dv[begins].any()
    assert np.isnan(ax[begins]).all()
