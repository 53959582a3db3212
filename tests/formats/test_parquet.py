"""Arrow columns: the same as the general way in makes, without loading pandas."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

import piga
from piga.formats.parquet import ParquetStream, write_residuals, write_run_parquet
from piga.results import label_column, number_column, text_column
from tests.records.calibration.test_verdict import TERMS, rate_log


def test_residuals_of_a_rate_log_are_rates_beside_an_angle(tmp_path: Path) -> None:
    """The output ``psi`` is an angle for a rate log, too: its integral."""
    calibration = piga.calibrate(rate_log(), TERMS)
    write_residuals(calibration, tmp_path / "r.parquet")
    schema = parquet.read_schema(tmp_path / "r.parquet")
    units = {field.name: field.metadata[b"unit"].decode() for field in schema}
    assert units == {name: column.unit for name, column in calibration.residuals.table_columns().items()}
    assert (units["psi"], units["before"], units["after"]) == ("rad", "rad/s", "rad/s")


@pytest.mark.parametrize("kind", ["float64", "int64", "int32"])
def test_numbers(kind: str) -> None:
    values = np.arange(-3, 9).astype(kind)
    assert number_column(values).equals(pa.array(values))
    assert number_column(values[::2]).equals(pa.array(values[::2]))
    assert number_column(values[:0]).equals(pa.array(values[:0]))
    assert np.isnan(number_column(np.array([np.nan])).to_numpy()).all()


def test_empty_cells() -> None:
    values = np.array([1.0, np.nan, 3.0] * 5)
    assert number_column(values, empty_cells=True).to_pylist() == [1.0, None, 3.0] * 5


@pytest.mark.parametrize("texts", [[], ["a", "", "δ 45°", "a"], ["0"]])
def test_texts(texts: list[str]) -> None:
    made = text_column(texts)
    made.validate(full=True)
    assert made.equals(pa.array(texts, pa.string()))


def test_labels() -> None:
    made = label_column(np.array([1, 0, 1], np.int32), ["up", "down"])
    assert made.to_pylist() == ["down", "up", "down"]


def test_pandas_is_not_loaded() -> None:
    """Half a second of every command that writes a table, where pandas is installed."""
    code = (
        "import sys, numpy as np; from piga.results import label_column, number_column;"
        "label_column(np.zeros(2, np.int32), ['a']); number_column(np.zeros(2));"
        "sys.exit('pandas' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_an_altered_page_is_refused(tmp_path: Path) -> None:
    """A bit is flipped in one byte after the other of a column. Numbers that are read are those that were written."""
    run, path = rate_log(), tmp_path / "run.parquet"
    write_run_parquet(run, path)
    raw, column = path.read_bytes(), parquet.read_metadata(path).row_group(0).column(1)
    assert column.path_in_schema == "output"
    refused = 0
    places = range(column.data_page_offset, column.data_page_offset + column.total_compressed_size, 97)
    for at in places:
        altered = bytearray(raw)
        altered[at] ^= 0x10
        path.write_bytes(altered)
        try:
            output = np.concatenate(
                [c.numbers["output"] for c in ParquetStream(path, ("output",), None).chunks()]
            )
        except piga.DataError as error:
            assert error.where.path == path  # noqa: PT017 - bytes that hold no number may be read
            refused += 1
        else:
            np.testing.assert_array_equal(output, run.output)
    assert refused > 0.95 * len(places)
