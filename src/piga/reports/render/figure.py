"""A figure as plain data, with quantity and unit on every axis. Also the palette of all figures.

A figure function takes a result and returns a :class:`Figure`; it draws nothing. On a page ``page.js`` draws it with plotly.js,
from :func:`figure_document`. Matplotlib draws it in files and notebooks (:mod:`piga.reports.render.axes`).
:class:`Plot` makes a figure curve by curve.

A figure names roles, not colours. The palette is for print, screen and dark screens. Its hues follow the idea of
Okabe and Ito (vermilion, blue, bluish green); lightness differs as well, so that a grey print keeps the order.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.results import Plotted, Result

Mark = Literal["line", "points", "line+points", "bars", "band", "steps"]
Role = Literal["data", "model", "before", "after", "reference", "warning", "x", "y", "z", "muted"]

XYZ: Final[tuple[Role, Role, Role]] = ("x", "y", "z")
"""Roles of the three components of a vector."""
POINTS = 2000
"""Points that a drawn curve keeps at most."""


@dataclass(frozen=True)
class Axis:
    """Quantity and unit of one axis, e.g. ``Axis("time", "s")``; ``log`` for a logarithmic scale.

    ``dates``: values are days since 1970-01-01, UTC, and shown as calendar dates; for an x axis. ``names`` are the labels
    of the values 1, 2, ...; they stand on the axis in place of the numbers.
    """

    quantity: str
    unit: str
    log: bool = False
    limits: tuple[float, float] | None = None
    dates: bool = False
    names: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Label in the form ``quantity [unit]``; unit ``1`` is written as a plain name."""
        return self.quantity if self.unit in ("", "1") else f"{self.quantity} [{self.unit}]"


def axis(text: str | Axis, limits: tuple[float, float] | None = None, names: tuple[str, ...] = ()) -> Axis:
    """An axis from its text: ``quantity [unit]``, with ``log`` before it for a logarithmic scale.

    Examples
    --------
    >>> axis("log ripple amplitude [µg]")
    Axis(quantity='ripple amplitude', unit='µg', log=True, limits=None, dates=False, names=())
    """
    if isinstance(text, Axis):
        return text
    quantity, unit = re.fullmatch(r"(.*?)(?: \[([^\[\]]*)\])?", text, re.DOTALL).groups()  # type: ignore[union-attr]
    log = quantity.startswith("log ")
    return Axis(quantity.removeprefix("log "), unit or "1", log, limits, names=names)


@dataclass(frozen=True, eq=False, repr=False)
class Series(Result):
    """One curve: ``x`` and ``y`` of equal length, in the units of the panel's axes.

    ``upper`` is used with mark ``band``: the band lies between ``y`` and ``upper``.
    ``error`` draws symmetric error bars of that half-length. ``text`` is a hover label per point.
    ``segments`` is the index of the segment of each point: the reader
    can then select one, and the page marks it wherever it is shown.
    """

    x: ArrayLike
    y: ArrayLike
    name: str = ""
    mark: Mark = "line"
    role: Role = "data"
    upper: ArrayLike | None = None
    error: ArrayLike | None = None
    dashed: bool = False
    text: Sequence[str] | None = None
    segments: ArrayLike | None = None

    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """``x`` and ``y`` as float arrays."""
        return np.asarray(self.x, dtype=float), np.asarray(self.y, dtype=float)


@dataclass(frozen=True)
class Panel:
    """One pair of axes with its series. ``equal`` keeps the same scale on both axes (polar plots)."""

    x: Axis
    y: Axis
    series: tuple[Series, ...]
    title: str = ""
    equal: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class Figure(Result, Plotted):
    """One or more panels, side by side or stacked (then they share the x axis when alike).

    ``key`` is the figure's identifier (file name and anchor: letters, digits, hyphens; unique in a page);
    ``caption`` describes in one or two sentences what the figure shows and what a good result is. ``height`` [inch]
    is that of one row of panels. ``notes`` are small print below.
    """

    key: str
    title: str
    panels: tuple[Panel, ...]
    caption: str = ""
    columns: int = 1
    height: float = 3.2
    notes: tuple[str, ...] = ()

    def figure(self) -> Figure:
        """The figure itself."""
        return self

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of panels."""
        columns = max(1, min(self.columns, len(self.panels)))
        return math.ceil(len(self.panels) / columns), columns

    @property
    def shares_x(self) -> bool:
        """Whether stacked panels have one x axis: same quantity and unit in all of them."""
        axes = {(panel.x.quantity, panel.x.unit, panel.x.log) for panel in self.panels}
        return len(self.panels) > 1 and self.grid[1] == 1 and len(axes) == 1

    @property
    def description(self) -> str:
        """What is drawn, in words: of each panel its axes and the names of its series."""
        parts = []
        for panel in self.panels:
            names = list(dict.fromkeys(series.name for series in panel.series if series.name))
            title = f"{panel.title}: " if panel.title else ""
            axes = f"{panel.y.label} against {panel.x.label}"
            parts.append(title + axes + (f": {', '.join(names)}" if names else "") + ".")
        return " ".join(parts)


_THINNED = (
    "Of a long curve the lowest and the highest of each stretch are drawn. Zooming in shows the same points."
)


class Plot:
    """Makes a figure curve by curve. A curve goes to the last panel; :meth:`caption` ends the figure.

    The role of a curve is its name where that is a role (``before``, ``after``, ``x``), else ``role``.

    Parameters
    ----------
    key, title:
        Of the figure.
    x, y:
        Axes of the first panel, as :func:`axis` reads them. Without them begin with :meth:`panel`.
    columns, height:
        Of the figure.

    Examples
    --------
    >>> plot = Plot("drift", "Drift.", "time [s]", "log angle [arcsec]")
    >>> figure = plot.line([1, 2], [1, 4], "before").dashed([1, 2], [3, 3], "expected").caption("Good: below the line.")
    >>> [(series.name, series.role) for series in figure.panels[0].series]
    [('before', 'before'), ('expected', 'reference')]
    """

    def __init__(
        self,
        key: str,
        title: str,
        x: str | Axis = "",
        y: str | Axis = "",
        *,
        columns: int = 1,
        height: float = 3.2,
    ) -> None:
        self._figure = Figure(key, title, (), columns=columns, height=height)
        self._panels: list[Panel] = []
        self._thinned = False
        if x:
            self.panel(x, y)

    def panel(self, x: str | Axis, y: str | Axis, title: str = "", *, equal: bool = False) -> Self:
        """Begin the next panel."""
        self._panels.append(Panel(axis(x), axis(y), (), title, equal))
        return self

    def line(self, x: ArrayLike, y: ArrayLike, name: str = "", role: Role = "data", **more: Any) -> Self:
        """Add a curve, a long one by its envelope; ``more`` as for :class:`Series`."""
        role = next((known for known in get_args(Role) if known == name), role)
        if np.size(y) > POINTS:
            self._thinned = True
            kept = envelope_rows(y)
            x, y = np.asarray(x)[kept], np.asarray(y)[kept]
            each = {key for key in more if key not in ("mark", "dashed")}
            more |= {key: np.asarray(more[key])[kept] for key in each}
        panel = self._panels[-1]
        self._panels[-1] = replace(panel, series=(*panel.series, Series(x, y, name, role=role, **more)))
        return self

    def points(self, x: ArrayLike, y: ArrayLike, name: str = "", role: Role = "data", **more: Any) -> Self:
        """Add points."""
        return self.line(x, y, name, role, mark="points", **more)

    def marked(self, x: ArrayLike, y: ArrayLike, name: str = "", role: Role = "data", **more: Any) -> Self:
        """Add a curve with a mark at each of its points."""
        return self.line(x, y, name, role, mark="line+points", **more)

    def dashed(self, x: ArrayLike, y: ArrayLike, name: str = "", role: Role = "reference", **more: Any) -> Self:
        """Add a dashed curve."""
        return self.line(x, y, name, role, dashed=True, **more)

    def band(
        self, x: ArrayLike, lower: ArrayLike, upper: ArrayLike, name: str = "", role: Role = "muted"
    ) -> Self:
        """Add the area between two curves."""
        return self.line(x, lower, name, role, mark="band", upper=upper)

    def level(self, x: ArrayLike, value: float, name: str = "", role: Role = "reference") -> Self:
        """Add a dashed level line over the extent of ``x``."""
        ends = np.array([np.min(x), np.max(x)], dtype=float)
        return self.dashed(ends, np.full(2, value), name, role)

    def caption(self, text: str, *notes: str) -> Figure:
        """The figure with its caption, and small print below."""
        notes += (_THINNED,) * self._thinned
        return replace(self._figure, panels=tuple(self._panels), caption=text, notes=notes)


def envelope_rows(y: ArrayLike, limit: int = POINTS) -> NDArray[np.int64]:
    """Rows of ``y`` (n,) that keep its envelope, rising: lowest, highest and one gap row of each bucket, and both ends.

    Rows that are not finite are gaps of the curve. There are at most ``limit`` rows (at least 8); a shorter curve is whole.
    """
    values = np.asarray(y)
    if values.size <= limit:
        return np.arange(values.size)
    rows, width = [0, values.size - 1], math.ceil(values.size / ((limit - 2) // 3))
    for start in range(0, values.size, width):
        part = values[start : start + width]
        finite = np.isfinite(part)
        ends = (
            np.where(finite, part, np.inf).argmin(),
            np.where(finite, part, -np.inf).argmax(),
            finite.argmin(),
        )
        rows += [start + int(row) for row in ends]
    return np.unique(np.array(rows, dtype=np.int64))


_PALETTE: Final = {
    "data": ("#3b4e63", "#b4c3d3"),
    "model": ("#0f7a5c", "#4fcaa6"),
    "before": ("#d2691e", "#f0995c"),
    "after": ("#10528a", "#6fbcf2"),
    "reference": ("#23282e", "#dfe5ec"),
    "warning": ("#a2700a", "#efbb4a"),
    "x": ("#c2491d", "#f38d68"),
    "y": ("#12805f", "#58cfa8"),
    "z": ("#1e62b0", "#86b6f7"),
    "muted": ("#98a2ad", "#6b7783"),
    "ink": ("#1c2733", "#e6ebf1"),
    "soft": ("#56626f", "#9fabb8"),
    "grid": ("#dfe4ea", "#303b47"),
}
"""Colours of the roles, of text, of small print and of lines: on white paper, and on a dark screen."""
LIGHT: Final = {name: pair[0] for name, pair in _PALETTE.items()}
"""Colours on white paper."""


def css_variables(*, dark: bool) -> str:
    """Declarations of all colours, for the light or the dark theme of a page."""
    return " ".join(f"--{name}: {pair[dark]};" for name, pair in _PALETTE.items())


_DIGITS = 6


def figure_document(figure: Figure) -> dict[str, Any]:
    """The figure as plain data for ``page.js``. Its texts may stand in HTML. Numbers keep six digits of their spread."""
    rows, columns = figure.grid
    panels = [
        {
            "title": _text(panel.title),
            "x": _axis_document(panel.x),
            "y": _axis_document(panel.y),
            "equal": panel.equal,
            "series": [_series_document(series, panel) for series in panel.series],
        }
        for panel in figure.panels
    ]
    place = {"rows": rows, "columns": columns, "shared": figure.shares_x, "height": figure.height}
    return {"key": figure.key, **place, "panels": panels}


def _text(text: str) -> str:
    """Text as plotly.js shows it: it reads a little HTML, which data must not write."""
    return html.escape(text, quote=False)


def _axis_document(axis: Axis) -> dict[str, Any]:
    words = {"quantity": _text(axis.quantity), "unit": _text(axis.unit), "label": _text(axis.label)}
    return asdict(axis) | words | {"names": [_text(name) for name in axis.names]}


def _series_document(series: Series, panel: Panel) -> dict[str, Any]:
    more: dict[str, Any] = {"x": _numbers(series.x, panel.x), "y": _numbers(series.y, panel.y)}
    if series.upper is not None:
        more["upper"] = _numbers(series.upper, panel.y)
    if series.error is not None:
        more["error"] = _numbers(series.error, replace(panel.y, log=True))
    if series.segments is not None:
        more["segments"] = np.asarray(series.segments).astype(int).tolist()
    if series.text is not None:
        more["text"] = [_text(text) for text in series.text]
    look = {"mark": series.mark, "role": series.role, "dashed": series.dashed}
    return {"name": _text(series.name), **look, **more}


def _numbers(values: ArrayLike, axis: Axis) -> list[float | None]:
    """JSON numbers with six digits of the values' spread, on a logarithmic axis of each value; gaps are ``null``."""
    array = np.asarray(values, dtype=float)
    finite = array[np.isfinite(array)]
    spread = (float(np.ptp(finite)) or float(np.max(np.abs(finite))) or 1.0) if finite.size else 1.0
    decimals = _DIGITS - 1 - math.floor(math.log10(spread))
    return [
        None if not math.isfinite(v) else float(f"{v:.{_DIGITS}g}") if axis.log else round(v, decimals)
        for v in array.tolist()
    ]
