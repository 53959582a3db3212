"""Tables of results: columns with units, and Arrow tables of them that share their memory."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga.errors import needed

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


class Column(NamedTuple):
    """A column of a table: values (n,), their unit, and texts if the values are indices of ``labels``."""

    values: NDArray[Any]
    unit: str = "1"
    labels: Sequence[str] | None = None


class Tabular:
    """Base of results that are a table. Any tool that reads Arrow takes them: pandas, polars, DuckDB, pyarrow."""

    def table_columns(self) -> dict[str, Column]:
        """The columns of the table, in order, with their units."""
        raise NotImplementedError

    def table_notes(self) -> tuple[str, ...]:
        """Remarks that go with the table, in the metadata of its schema."""
        return ()

    def to_arrow(self) -> pa.Table:
        """The table as a ``pyarrow.Table``. The metadata of each field hold its unit."""
        needed("pyarrow")
        notes = self.table_notes()
        return arrow_table(self.table_columns(), {"piga.notes": json.dumps(notes)} if notes else None)

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """The table as an Arrow stream (PyCapsule interface), e.g. for ``polars.DataFrame(run)``.

        A calibration is a mapping and a budget a tuple, which polars takes first: ``polars.DataFrame(cal.to_arrow())``.
        """
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def to_dataframe(self) -> pd.DataFrame:
        """The table as a pandas data frame. ``attrs["units"]`` holds the units.

        Raises
        ------
        MissingPackageError
            If pandas is not installed.
        """
        needed("pandas")
        frame: pd.DataFrame = self.to_arrow().to_pandas()
        frame.attrs["units"] = {name: column.unit for name, column in self.table_columns().items()}
        if self.table_notes():
            frame.attrs["notes"] = list(self.table_notes())
        return frame


def columns_of(rows: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> dict[str, Column]:
    """Columns of a table from its rows: a value by name. A name that has no unit here has the unit 1."""
    names = list(rows[0]) if rows else []
    return {name: Column(np.array([row[name] for row in rows]), units.get(name, "1")) for name in names}


def arrow_table(
    columns: Mapping[str, Column], metadata: dict[str, str] | None = None, empty_cells: bool = False
) -> pa.Table:
    """Columns as an Arrow table. The field of each has its ``unit``. Numbers share their memory.

    ``empty_cells``: nan becomes null.
    """
    import pyarrow as pa

    arrays = {name: _array(column, empty_cells) for name, column in columns.items()}
    fields = [
        pa.field(name, array.type, empty_cells, {"unit": columns[name].unit}) for name, array in arrays.items()
    ]
    return pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields, metadata=metadata))


def _array(column: Column, empty_cells: bool) -> pa.Array:
    if column.labels is not None:
        return label_column(column.values.astype(np.int32), column.labels)
    if column.values.dtype.kind in "OU":
        return _text_column([str(value) for value in column.values])
    return number_column(column.values, empty_cells)


def number_column(values: NDArray, empty_cells: bool = False) -> Any:
    """Arrow array that shares the memory of numbers (n,). With ``empty_cells``, nan becomes null."""
    import pyarrow as pa

    contiguous = np.ascontiguousarray(values)
    validity = pa.py_buffer(np.packbits(~np.isnan(contiguous), bitorder="little")) if empty_cells else None
    return pa.Array.from_buffers(
        pa.from_numpy_dtype(contiguous.dtype), contiguous.size, [validity, pa.py_buffer(contiguous)]
    )


def _text_column(values: Sequence[str]) -> Any:
    """Arrow array of texts."""
    import pyarrow as pa

    encoded = [value.encode() for value in values]
    ends = np.cumsum([0, *(len(value) for value in encoded)], dtype=np.int32)
    return pa.StringArray.from_buffers(len(encoded), pa.py_buffer(ends), pa.py_buffer(b"".join(encoded)))


def label_column(codes: NDArray, labels: Sequence[str]) -> Any:
    """Arrow array of texts, given by indices (n,) into ``labels``."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(number_column(codes), _text_column(labels))
