"""What every result does in a notebook: compare, hash, copy, show itself, and leave as a table.

The methods live on the lowest floor, because plain data are made there. What they show is made by the rooms above. Such a
room is loaded by its name when the method is called (:data:`DOORS`), so data never import their reports.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from piga.errors import EXTRAS, missing_package

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
"""An array of numbers."""
SAMPLED = 64
"""Elements at each end of an array that its hash looks at."""

DOORS = {
    "arrow": "piga.formats.tables:arrow",
    "dataframe": "piga.formats.tables:dataframe",
    "dataset": "piga.formats.tables:dataset",
    "instrument": "piga.instrument.parameters:instrument_of",
    "error_model": "piga.instrument.parameters:error_model_of",
    "html": "piga.reports.shown:html_of",
    "summary": "piga.reports.shown:summary_of",
    "report": "piga.reports.shown:write_report",
    "figure": "piga.reports.shown:figure_of",
    "draw": "piga.reports.render.axes:draw",
    "run_from_table": "piga.stand.run_reference:run_from_table",
    "stand_reference": "piga.stand.run_reference:stand_reference",
    "correlated": "piga.formats.tables:correlated",
}
"""Functions of upper rooms that methods of results call: ``module:function`` by what they do."""


def above(name: str) -> Callable[..., Any]:
    """The function of an upper room with this name in :data:`DOORS`.

    Raises
    ------
    MissingPackageError
        If the room needs a package that is not installed. The message names the extra.
    """
    module, _, function = DOORS[name].partition(":")
    try:
        loaded: Callable[..., Any] = getattr(import_module(module), function)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in EXTRAS:
            raise missing_package(package) from None
        raise
    return loaded


def lazy(room: str, modules: dict[str, str]) -> Callable[[str], Any]:
    """``__getattr__`` of a room whose public names are imported on first use. ``modules``: the names of each module."""
    places = {name: f"{room}.{module}" for module, names in modules.items() for name in names.split()}

    def named(name: str) -> Any:
        if name in places:
            return getattr(import_module(places[name]), name)
        raise AttributeError(f"module '{room}' has no attribute '{name}'")

    return named


# -- values --------------------------------------------------------------------------------------------


def same(one: Any, other: Any) -> bool:
    """Whether two fields hold the same values. Arrays are compared element by element; nan equals nan."""
    if one is other:
        return True
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return _same_arrays(one, other)
    if isinstance(one, float) and isinstance(other, float):
        return one == other or (math.isnan(one) and math.isnan(other))
    if is_dataclass(one) and type(one) is type(other):
        return all(same(getattr(one, name), getattr(other, name)) for name in _compared(one))
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(same(value, other[key]) for key, value in one.items())
    if isinstance(one, (tuple, list)) and isinstance(other, (tuple, list)):
        return len(one) == len(other) and all(same(a, b) for a, b in zip(one, other, strict=True))
    return bool(one == other)


def _same_arrays(one: Any, other: Any) -> bool:
    if not (isinstance(one, np.ndarray) and isinstance(other, np.ndarray)) or one.shape != other.shape:
        return False
    return bool(np.array_equal(one, other, equal_nan=one.dtype.kind in "fc" and other.dtype.kind in "fc"))


def key_of(value: Any) -> Any:
    """A hashable key. Equal values (:func:`same`) have equal keys; of an array only shape and ends count."""
    if isinstance(value, np.ndarray):
        flat = value.reshape(-1)
        ends = np.concatenate((flat[:SAMPLED], flat[-SAMPLED:])).tolist()
        return value.shape, tuple(key_of(number) for number in ends)
    if isinstance(value, float):
        return "nan" if math.isnan(value) else value
    if is_dataclass(value):
        return type(value).__name__, *(key_of(getattr(value, name)) for name in _compared(value))
    if isinstance(value, Mapping):
        return frozenset((key, key_of(item)) for key, item in value.items())
    if isinstance(value, (tuple, list)):
        return tuple(key_of(item) for item in value)
    try:
        hash(value)
    except TypeError:
        return type(value).__name__
    return value


class ByValue:
    """Base of dataclasses that hold arrays. Equal means equal values, field by field; the hash fits.

    A field with ``compare=False`` does not count. Declare such a dataclass with ``eq=False``. A result is not equal to an
    array or a table: NumPy and pandas leave the comparison to the result, and do not compare element by element.
    """

    __array_ufunc__ = None
    __pandas_priority__ = 10_000

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return False if hasattr(other, "__array__") else NotImplemented
        return same(self, other)

    def __hash__(self) -> int:
        return hash(key_of(self))


def _compared(result: Any) -> list[str]:
    return [field.name for field in fields(result) if field.compare]


# -- shown ---------------------------------------------------------------------------------------------

MOST_LINES, WIDE = 10, 160
"""Lines of a ``repr``, and letters of a line."""


class Result(ByValue):
    """Base of results. ``repr`` has at most ten lines, and a notebook shows a table."""

    def in_brief(self) -> list[tuple[str, str]]:
        """What a notebook shows of the result: names and values in words."""
        return [(name, in_words(getattr(self, name))) for name in _compared(self)]

    def __repr__(self) -> str:
        rows = [f"{name}: {text}" for name, text in self.in_brief()]
        lines = [f"<{type(self).__name__}", *first_lines(rows, MOST_LINES - 1)]
        return "\n  ".join(shortened(line) for line in lines) + ">"

    def _repr_html_(self) -> str | None:
        return html_of(self)


class Reported:
    """Base of results that have a summary and a report page."""

    def summary(self) -> str:
        """The summary that the command prints, as plain text."""
        return above("summary")(self)

    def report(self, path: str | Path) -> Path:
        """Write the report page: one HTML file that opens offline. Returns its path."""
        return above("report")(self, path)


class Plots:
    """The figures of one result. Each method draws one of the report's figures with Matplotlib.

    ``ax`` is the axes to draw on, one for each panel of the figure. None: a new figure. The colours, labels and units are
    those of the report.
    """

    __slots__ = ("_result",)

    def __init__(self, result: object) -> None:
        self._result = result

    def _draw(self, name: str, ax: Axes | Sequence[Axes] | None) -> Figure:
        return above("draw")(above("figure")(self._result, name), ax)


def plotted(result: object, ax: Axes | Sequence[Axes] | None, name: str = "") -> Figure:
    """The figure of a result, drawn with Matplotlib."""
    return Plots(result)._draw(name, ax)


class Plotted:
    """Base of results with one figure. Their class says what it shows."""

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """The figure of the report for this result, drawn with Matplotlib. See :class:`piga.results.Plots` for ``ax``."""
        return plotted(self, ax)


def html_of(result: object) -> str | None:
    """What a notebook shows. None without the packages of the report: the notebook then shows ``repr``."""
    try:
        return above("html")(result)
    except ImportError:
        return None


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


class Correlated(Protocol):
    """A number that knows its uncertainty and what it is correlated with, of ``uncertainties`` or GTC."""

    def __add__(self, other: Correlated | float, /) -> Correlated: ...
    def __radd__(self, other: float, /) -> Correlated: ...
    def __sub__(self, other: Correlated | float, /) -> Correlated: ...
    def __rsub__(self, other: float, /) -> Correlated: ...
    def __mul__(self, other: Correlated | float, /) -> Correlated: ...
    def __rmul__(self, other: float, /) -> Correlated: ...
    def __truediv__(self, other: Correlated | float, /) -> Correlated: ...
    def __rtruediv__(self, other: float, /) -> Correlated: ...
    def __pow__(self, other: Correlated | float, /) -> Correlated: ...
    def __neg__(self) -> Correlated: ...


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
        return above("arrow")(self)

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
        return above("dataframe")(self)

    def to_xarray(self) -> xr.Dataset:
        """The table as an xarray data set. Each variable has its unit in ``attrs["units"]``.

        Raises
        ------
        MissingPackageError
            If xarray is not installed.
        """
        return above("dataset")(self)
