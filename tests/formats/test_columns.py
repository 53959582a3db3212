"""Arrow columns as float64: every kind of number, nulls, slices."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from piga.formats.columns import numbers_of

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
