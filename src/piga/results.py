"""What every result does in a notebook: compare, copy and show itself.

The methods live on the lowest floor, because plain data are made there. What they show is made by the rooms above. A method
imports its room when it is called, so data never load their reports. The module that shows a kind of result has three
functions: ``page(result)`` for the report, ``brief(result)`` for terminal and notebook, ``figures(result)`` by name.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.output import write_whole
from piga.upper import doors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

    from piga.reports.render.figure import Figure

Array = NDArray[np.float64]
"""An array of numbers."""


def same(one: Any, other: Any) -> bool:
    """Whether two fields hold the same values. Arrays are compared element by element; nan equals nan."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        numbers = one.dtype.kind in "fc" and other.dtype.kind in "fc"
        return np.array_equal(one, other, equal_nan=numbers)
    if one is other or isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return one is other
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
        return repr_of(lines)


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
        target = Path(path)
        if target.suffix != ".html":
            raise ArgumentError(f"report {target}: the name must end in .html", remedy="e.g. report.html")
        page = self._subject().page(self)
        write = doors().pages().write_page
        return write_whole(target, lambda part: write(page, part), remedy="choose another path")


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


def repr_of(lines: Iterable[str]) -> str:
    """The lines of a ``repr``, each of at most :data:`WIDE` letters."""
    return "\n  ".join(line if len(line) <= WIDE else f"{line[: WIDE - 3]}..." for line in lines) + ">"


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
