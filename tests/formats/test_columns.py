"""Arrow columns as float64: every kind of number, nulls, slices; without Arrow's compute functions."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest

from piga.formats.columns import label_text, numbers_of

KINDS = [
    pa.int8(), pa.uint8(), pa.int16(), pa.uint16(), pa.int32(), pa.uint32(), pa.int64(), pa.uint64(),
    pa.float16(), pa.float32(), pa.float64(),
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_every_kind_of_number_with_nulls_and_an_offset(kind):
    values = [7, None, 100, 3, None, 0]
    if not pa.types.is_floating(kind):
        column = pa.array(values, kind)
    else:
        column = pa.array(
            np.array([7, 0, 100, 3, 0, 0], kind.to_pandas_dtype()),
            kind,
            mask=np.array([0, 1, 0, 0, 1, 0], bool),
        )
    expected = np.array([np.nan if value is None else value for value in values])
    assert numbers_of(column).dtype == np.float64
    np.testing.assert_array_equal(numbers_of(column), expected)
    np.testing.assert_array_equal(numbers_of(column.slice(2, 3)), expected[2:5])


def test_large_counts_are_rounded_to_the_nearest_float():
    counts = [2**53 + 1, -(2**62) - 3, 2**63 - 1]
    assert numbers_of(pa.array(counts, pa.int64())).tolist() == [float(count) for count in counts]


def test_a_column_of_nulls_is_nan():
    assert np.isnan(numbers_of(pa.nulls(3))).all()


def test_whole_counts_need_no_compute_functions():
    code = (
        "import sys, pyarrow as pa\nfrom piga.formats.columns import numbers_of\n"
        "counts = pa.Array.from_buffers(pa.int64(), 3, [None, pa.py_buffer(bytes(24))])\n"
        "assert numbers_of(counts).tolist() == [0.0, 0.0, 0.0]\nsys.exit(3 if 'pyarrow.compute' in sys.modules else 0)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_labels_as_text() -> None:
    given = (None, b" up ", 3.0, 2.5, float("nan"), np.float64(4.0), 7)
    assert [label_text(value) for value in given] == ["", "up", "3", "2.5", "", "4", "7"]
