"""Arrow arrays from columns, made from their memory: the general way in looks for (and loads) pandas first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyarrow as pa


def number_column(values: NDArray, empty_cells: bool = False) -> pa.Array:
    """Array over the memory of numbers (n,); with ``empty_cells`` it is null where they are nan."""
    import pyarrow as pa

    held = np.ascontiguousarray(values)
    known = pa.py_buffer(np.packbits(~np.isnan(held), bitorder="little")) if empty_cells else None
    return pa.Array.from_buffers(pa.from_numpy_dtype(held.dtype), held.size, [known, pa.py_buffer(held)])


def text_column(values: Sequence[str]) -> pa.StringArray:
    """Array of texts."""
    import pyarrow as pa

    encoded = [value.encode() for value in values]
    ends = np.cumsum([0, *(len(value) for value in encoded)], dtype=np.int32)
    return pa.StringArray.from_buffers(len(encoded), pa.py_buffer(ends), pa.py_buffer(b"".join(encoded)))


def label_column(codes: NDArray, labels: Sequence[str]) -> pa.DictionaryArray:
    """Array of texts by their index (n,) in ``labels``."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(number_column(codes), text_column(labels))
