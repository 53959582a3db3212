"""Lines longer than any log's are named as such; wide files, long comments and files of one line kind are read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import piga
from tests.records.files import events, lines, write_run

HEADER = b"t,n,fx,fy,fz\n"
ROWS = ("\n".join(lines()) + "\n").encode()


def read(folder: Path, content: bytes, name: str = "run.csv", **options: str) -> piga.Run:
    (folder / name).write_bytes(content)
    return piga.read_run(write_run(folder, name, **options))


def test_a_line_without_end(tmp_path: Path) -> None:
    with pytest.raises(piga.DataError, match="a line is longer than 16 MiB"):
        read(tmp_path, HEADER + ROWS + b"1" * (40 << 20) + b"\n")


def test_a_file_of_four_thousand_columns(tmp_path: Path) -> None:
    """Header and first row are longer than the 64 KiB that are looked at first."""
    more = 4000
    names = HEADER.rstrip() + b"".join(b",channel_number_%05d" % i for i in range(more))
    rows = [line.encode() + b",0.123456789012" * more for line in lines()]
    run = read(tmp_path, b"\n".join([names, *rows, b""]))
    (tmp_path / "plain").mkdir()
    plain = read(tmp_path / "plain", HEADER + ROWS)
    np.testing.assert_array_equal(run.t, plain.t)
    np.testing.assert_array_equal(run.output, plain.output)
    np.testing.assert_array_equal(run.row, plain.row)


ONE_COLUMN = """\
[instrument]
serial = "T-1"
scale_factor = "0.8884 rad/s/g"
counts_per_revolution = 72000
{instrument}
[data]
file = "run.csv"
sample_rate = "20 Hz"
output = {{ column = "n", kind = "counts" }}
[model]
terms = ["scale_factor"]
"""


def one_column(folder: Path, rows: list[str], instrument: str = "") -> piga.Run:
    (folder / "run.csv").write_text("\n".join(["n", *rows, ""]))
    (folder / "run.toml").write_text(ONE_COLUMN.format(instrument=instrument))
    return piga.read_run(folder / "run.toml", need_reference=False)


def test_one_column_without_a_reference(tmp_path: Path) -> None:
    """Lines of blanks are blank lines there, not missing values."""
    run = one_column(tmp_path, ["0", "509", "  ", "1018", "1527", "\t", "2036"])
    np.testing.assert_allclose(run.output, np.arange(5) * 509 * 2.0 * np.pi / 72000.0, rtol=1e-15)
    np.testing.assert_array_equal(run.row, [2, 3, 5, 6, 8])
    assert events(run) == {"blank-line": 2}
    assert np.isnan(run.f).all()
    with pytest.raises(piga.RunFileError, match=r"\[data\] reference is missing(?s:.*)or a \[stand\] table"):
        piga.read_run(tmp_path / "run.toml")


def test_a_counter_that_folds_without_a_reference(tmp_path: Path) -> None:
    """The largest step seen stands for what the reference would allow."""
    counts = [str(509 * i % 65536) for i in range(400)]
    run = one_column(tmp_path, counts, "counter_bits = 16")
    np.testing.assert_allclose(np.diff(run.output), 509 * 2.0 * np.pi / 72000.0, rtol=1e-9)
    assert events(run) == {"counter-roll-over": 3}
    with pytest.raises(piga.DataError, match="a roll-over cannot be recognised"):
        one_column(tmp_path, [str(30_000 * i % 65536) for i in range(400)], "counter_bits = 16")


def test_a_comma_in_a_cell_of_a_file_with_points(tmp_path: Path) -> None:
    text = (HEADER + ROWS).decode().replace(",", ";").replace("1018;", "1,018;", 1)
    with pytest.raises(piga.DataError, match=r"row 4, column 'n' \(B\): '1,018'(?s:.*)is ',' a decimal mark"):
        read(tmp_path, text.encode(), data="decimal = '.'")
