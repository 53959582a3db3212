"""What every result does in a notebook: compare, copy, show itself, and leave as a table.

The methods live on the lowest floor, because plain data are made there. What they show is made by the rooms above. A method
imports its room when it is called, so data never load their reports. The module that shows a kind of result has three
functions: ``page(result)`` for the report, ``brief(result)`` for terminal and notebook, ``figures(result)`` by name.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError, needed
from piga.upper import doors

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

    from piga.reports.render.figure import Figure

Array = NDArray[np.float64]
"""An array of numbers."""


# -- values --------------------------------------------------------------------------------------------


def same(one: Any, other: Any) -> bool:
    """Whether two fields hold the same values. Arrays are compared element by element; nan equals nan."""
    if one is other:
        return True
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        numbers = one.dtype.kind in "fc" and other.dtype.kind in "fc"
        return np.array_equal(one, other, equal_nan=numbers)
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return False
    if isinstance(one, float) and isinstance(other, float):
        return one == other or (math.isnan(one) and math.isnan(other))
    if is_dataclass(one) and type(one) is type(other):
        return all(same(getattr(one, name), getattr(other, name)) for name in _compared(one))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same(value, other[key]) for key, value in one.items())
    if isinstance(one, (tuple, list)) and isinstance(other, (tuple, list)):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    return bool(one == other)


class ByValue:
    """Base of dataclasses that hold arrays. Equal means equal values, field by field. There is no hash.

    A field with ``compare=False`` does not count. Declare such a dataclass with ``eq=False``.
    """

    def __eq__(self, other: object) -> bool:
        return same(self, other) if type(other) is type(self) else NotImplemented

    __hash__ = None  # type: ignore[assignment]


def _compared(result: Any) -> list[str]:
    return [field.name for field in fields(result) if field.compare]


# -- shown ---------------------------------------------------------------------------------------------

MOST_LINES, WIDE = 10, 160
"""Lines of a ``repr``, and letters of a line."""


class Shown:
    """Base of results that a notebook shows: by the ``brief`` of the module that shows them."""

    def _subject(self) -> ModuleType:
        """The module that shows this result. Here: names and values."""
        return doors().pages()

    def heading(self) -> str:
        """The first line of what is shown."""
        return type(self).__name__

    def in_brief(self) -> list[tuple[str, str]]:
        """What a notebook shows of the result: names and values in words."""
        raise NotImplementedError

    def _repr_html_(self) -> str | None:
        try:
            return doors().pages().card_html(self._subject().brief(self))
        except ImportError:  # without the packages of the report the notebook shows ``repr``
            return None


class Result(ByValue, Shown):
    """Base of results. ``repr`` has at most ten lines, and a notebook shows a table."""

    def in_brief(self) -> list[tuple[str, str]]:
        """What a notebook shows of the result: names and values in words."""
        return [(name, in_words(getattr(self, name))) for name in _compared(self)]

    def __repr__(self) -> str:
        rows = [f"{name}: {text}" for name, text in self.in_brief()]
        lines = [f"<{type(self).__name__}", *first_lines(rows, MOST_LINES - 1)]
        return "\n  ".join(shortened(line) for line in lines) + ">"


class Reported(Shown):
    """Base of results that have a summary and a report page. Its ``repr`` holds the tiles of the summary."""

    def in_brief(self) -> list[tuple[str, str]]:
        """The key numbers of the summary."""
        plain = doors().pages().ascii_text
        return [(tile.label, plain(tile.words)) for tile in self._subject().brief(self).tiles]

    def summary(self) -> str:
        """The summary that the command prints, as plain text."""
        return doors().pages().page_text(self._subject().brief(self))

    def report(self, path: str | Path) -> Path:
        """Write the report page: one HTML file that opens offline. Returns its path.

        Raises
        ------
        ArgumentError
            If the name does not end in .html.
        """
        from piga.output import write_whole

        target = Path(path)
        if target.suffix != ".html":
            raise ArgumentError(f"report {target}: the name must end in .html", remedy="e.g. report.html")
        page = self._subject().page(self)
        return write_whole(
            target, lambda part: doors().pages().write_page(page, part), remedy="choose another path"
        )


def drawn(figure: Figure, ax: Axes | Sequence[Axes] | None = None) -> Canvas:
    """A figure of a report, drawn with Matplotlib in the colours, labels and units of the report.

    ``ax`` is the axes to draw on, one for each panel of the figure. None: a new figure.
    """
    return doors().drawing().draw(figure, ax)


class Plotted(Shown):
    """Base of results with one figure. Their class says what it shows."""

    def figure(self) -> Figure:
        """The figure of the report for this result, as plain data."""
        return next(iter(self._subject().figures(self).values()))()

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Canvas:
        """The figure of the report for this result, drawn with Matplotlib. See :func:`piga.results.drawn` for ``ax``."""
        return drawn(self.figure(), ax)


def first_lines(lines: list[str], most: int, where: str = "") -> list[str]:
    """At most so many lines. The last one says how many are left out, and ``where`` they are."""
    if len(lines) <= most:
        return lines
    return [*lines[: most - 1], f"and {len(lines) - most + 1} more{where}"]


def shortened(line: str) -> str:
    """A line of at most :data:`WIDE` letters."""
    return line if len(line) <= WIDE else f"{line[: WIDE - 3]}..."


def in_words(value: Any) -> str:
    """A value in a few words: numbers with six digits, arrays with their shape and ends."""
    if isinstance(value, np.ndarray):
        ends = value.dtype.kind in "fiu" and value.ndim == 1 and value.size
        reach = f", {value[0]:.6g} to {value[-1]:.6g}" if ends else ""
        return f"array {' x '.join(map(str, value.shape))}{reach}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (str, int, type(None))):
        return str(value)
    if isinstance(value, Mapping):
        return f"{len(value)} entries" + (f": {', '.join(map(str, value))}" if value else "")
    if isinstance(value, (tuple, list)):
        plain = len(value) <= MOST_LINES and all(isinstance(item, (str, int, float)) for item in value)
        return ", ".join(map(in_words, value)) if plain else f"{len(value)} items"
    return type(value).__name__


def finite(value: Any) -> Any:
    """A value for JSON: a number that is not finite becomes None."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def plain(value: Any) -> Any:
    """A result as values of JSON, by the names of its fields."""
    return msgspec.to_builtins(value, enc_hook=lambda item: item.tolist())


# -- tables --------------------------------------------------------------------------------------------


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

    def to_xarray(self) -> xr.Dataset:
        """The table as an xarray data set. Each variable has its unit in ``attrs["units"]``; time is a coordinate.

        Raises
        ------
        MissingPackageError
            If xarray is not installed.
        """
        variables = {
            name: (("row",), _plain_column(column), {"units": column.unit})
            for name, column in self.table_columns().items()
        }
        times = {name: variables.pop(name) for name in ("t",) if name in variables}
        return needed("xarray").Dataset(variables, times, {"notes": list(self.table_notes())})


def columns_of(rows: Sequence[Mapping[str, Any]], units: Mapping[str, str]) -> dict[str, Column]:
    """Columns of a table from its rows: a value by name. A name that has no unit here has the unit 1."""
    names = list(rows[0]) if rows else []
    return {name: Column(np.array([row[name] for row in rows]), units.get(name, "1")) for name in names}


def _plain_column(column: Column) -> NDArray[Any]:
    """Values of a column; labels as text."""
    if column.labels is None:
        return np.asarray(column.values)
    return np.array(column.labels, dtype=object)[np.asarray(column.values)]


def arrow_table(columns: dict[str, Column], metadata: dict[str, str] | None = None) -> pa.Table:
    """Columns as an Arrow table. The field of each has its ``unit``. Numbers share their memory."""
    import pyarrow as pa

    arrays = {name: _array(column) for name, column in columns.items()}
    fields = [pa.field(name, arrays[name].type, metadata={"unit": columns[name].unit}) for name in columns]
    return pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields, metadata=metadata))


def _array(column: Column) -> pa.Array:
    if column.labels is not None:
        return label_column(column.values.astype(np.int32), column.labels)
    if column.values.dtype.kind in "OU":
        return text_column([str(value) for value in column.values])
    return number_column(column.values)


def number_column(values: NDArray, empty_cells: bool = False) -> Any:
    """Arrow array that shares the memory of numbers (n,). With ``empty_cells``, nan becomes null."""
    import pyarrow as pa

    contiguous = np.ascontiguousarray(values)
    validity = pa.py_buffer(np.packbits(~np.isnan(contiguous), bitorder="little")) if empty_cells else None
    return pa.Array.from_buffers(
        pa.from_numpy_dtype(contiguous.dtype), contiguous.size, [validity, pa.py_buffer(contiguous)]
    )


def text_column(values: Sequence[str]) -> Any:
    """Arrow array of texts."""
    import pyarrow as pa

    encoded = [value.encode() for value in values]
    ends = np.cumsum([0, *(len(value) for value in encoded)], dtype=np.int32)
    return pa.StringArray.from_buffers(len(encoded), pa.py_buffer(ends), pa.py_buffer(b"".join(encoded)))


def label_column(codes: NDArray, labels: Sequence[str]) -> Any:
    """Arrow array of texts, given by indices (n,) into ``labels``."""
    import pyarrow as pa

    return pa.DictionaryArray.from_arrays(number_column(codes), text_column(labels))
