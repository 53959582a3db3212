"""Parquet files: the units of what is written, and pages that were altered."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyarrow import parquet

import piga
from piga.formats.columns import ParquetStream, write_residuals, write_run_parquet
from tests.records.calibration.test_diagnostics_verdict import TERMS, rate_log


def test_residuals_of_a_rate_log_are_rates_beside_an_angle(tmp_path: Path) -> None:
    """The output ``psi`` is an angle for a rate log, too: its integral."""
    calibration = piga.calibrate(rate_log(), TERMS)
    write_residuals(calibration, tmp_path / "r.parquet")
    schema = parquet.read_schema(tmp_path / "r.parquet")
    units = {field.name: field.metadata[b"unit"].decode() for field in schema}
    assert units == {name: column.unit for name, column in calibration.residuals.table_columns().items()}
    assert (units["psi"], units["before"], units["after"]) == ("rad", "rad/s", "rad/s")


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
