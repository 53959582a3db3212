"""The layout of a figure: lines, areas, dots and words at their positions, in points from the top left corner.

Every file format draws the same scene. Only colours and the syntax of shapes differ.
"""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from piga.reports.render.decimate import envelope_rows
from piga.reports.render.figure import Figure, Panel, Series
from piga.reports.render.scales import Scale, Ticks, axis_label, axis_ticks, extent, fitting_ticks

Array = NDArray[np.float64]

POINT = 1.0 / 72.0
"""Inches in a point, the unit of a scene."""
DRAWN = 1200
"""Points that a drawn curve keeps at most: two for each hundredth of an inch."""
FONT, TICK_FONT, TITLE_FONT = 8.5, 8.0, 9.0
LINE = 1.25
"""Distance of lines of text, relative to the size of the letters."""
TICK, GAP = 3.0, 3.0
"""Length of a tick, and the space between two things that stand beside each other."""
COLUMN_GAP, ROW_GAP, EDGE = 14.0, 8.0, 4.0
HANDLE, ENTRY_GAP = 20.0, 14.0
"""Length of the sample beside a legend entry, and the space between two entries."""
PASSES = 4
"""Largest number of rounds in which heights and left margins are fitted to each other."""
MOST_LINES, LONGEST = 3, 400
"""Lines and letters that a label, a title or a name keeps at most."""
FARTHEST = 1e6
"""Largest coordinate that is written."""
DOT, THIN, NORMAL = 3.5, 0.6, 1.1


@dataclass(frozen=True)
class Shape:
    """Lines through points, areas within them or dots at them; ``colour`` is a name of the palette."""

    kind: Literal["line", "area", "dots"]
    paths: tuple[Array, ...]
    colour: str
    size: float = THIN
    dashed: bool = False
    opacity: float = 1.0


@dataclass(frozen=True)
class Words:
    """A line of text at (``x``, ``y``) of its base line; ``turned`` reads upwards."""

    text: str
    x: float
    y: float
    size: float = FONT
    anchor: Literal["start", "middle", "end"] = "start"
    bold: bool = False
    turned: bool = False


@dataclass(frozen=True)
class Box:
    """A rectangle."""

    left: float
    top: float
    right: float
    bottom: float

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.right - self.left

    @property
    def height(self) -> float:
        """Extent along y."""
        return self.bottom - self.top


@dataclass(frozen=True)
class SceneGroup:
    """Shapes of one series (``key``) or of the frame; nothing outside ``clip`` is shown."""

    shapes: tuple[Shape, ...]
    key: str = ""
    clip: Box | None = None


@dataclass
class Scene:
    """All groups, in drawing order. ``scales`` are the x and y scales of every panel."""

    width: float
    height: float
    groups: list[SceneGroup] = field(default_factory=list)
    words: list[Words] = field(default_factory=list)
    scales: list[tuple[Scale, Scale]] = field(default_factory=list)


def rows_and_columns(figure: Figure) -> tuple[int, int]:
    """Rows and columns of panels."""
    columns = max(1, min(figure.columns, len(figure.panels)))
    return math.ceil(len(figure.panels) / columns), columns


def shares_x(figure: Figure) -> bool:
    """Whether stacked panels have one x axis: same quantity and unit in all of them."""
    axes = {(panel.x.quantity, panel.x.unit, panel.x.log) for panel in figure.panels}
    return len(figure.panels) > 1 and rows_and_columns(figure)[1] == 1 and len(axes) == 1


def series_key(figure: Figure, panel: int, series: int) -> str:
    """Name of a series in both renderings, e.g. ``spectrum-p0-s1``."""
    return f"{figure.key}-p{panel}-s{series}"


# -- words ---------------------------------------------------------------------------------------------

_WIDTHS = (
    (0.30, "iljIJ'|"),
    (0.37, " \u00a0.,:;!/\\ft()[]r-·\u202f"),
    (0.42, "¹²³⁰⁴⁵⁶⁷⁸⁹⁻"),
    (0.55, 'scz_*°"″?'),
    (0.80, "wGOQDHNUC+=<>−×~^&"),
    (1.00, "mMWµ@%–"),
)
_WIDTH = {letter: width for width, letters in _WIDTHS for letter in letters}


def text_width(text: str, size: float = FONT, *, bold: bool = False) -> float:
    """Width of a text, a little above that of common sans-serif fonts."""
    wide = sum(
        _WIDTH.get(letter, 1.0 if unicodedata.east_asian_width(letter) in "WF" else 0.64) for letter in text
    )
    return wide * size * (1.1 if bold else 1.0)


def wrapped(text: str, width: float, size: float = FONT, *, bold: bool = False) -> list[str]:
    """Lines of a text that fit the width, broken at spaces and, where a word is longer, within it.

    A text of more than :data:`MOST_LINES` ends with an ellipsis.
    """
    lines: list[str] = []
    for word in text[:LONGEST].split(" "):
        whole = f"{lines[-1]} {word}" if lines else word
        if lines and text_width(whole, size, bold=bold) <= width:
            lines[-1] = whole
            continue
        lines.append(word)
        while len(lines) <= MOST_LINES and (fit := _fitting(lines[-1], width, size, bold=bold)) < len(
            lines[-1]
        ):
            lines[-1:] = [lines[-1][:fit], lines[-1][fit:]]
    if len(lines) <= MOST_LINES and len(text) <= LONGEST:
        return lines
    last = lines[:MOST_LINES][-1]
    kept = _fitting(last, width - size, size, bold=bold)
    return [*lines[: MOST_LINES - 1], f"{last[:kept]}…"]


def _fitting(text: str, width: float, size: float, *, bold: bool) -> int:
    """How many letters of a text fit the width, at least one."""
    widths = np.cumsum([text_width(letter, size, bold=bold) for letter in text])
    return max(int(np.searchsorted(widths, width, side="right")), 1)


# -- layout --------------------------------------------------------------------------------------------


def figure_scene(figure: Figure, width: float) -> Scene:
    """The figure laid out in ``width`` points."""
    rows = rows_and_columns(figure)[0]
    legend, legend_height = _legend(figure, width)
    scene = Scene(width, figure.height * rows / POINT + max(0.0, legend_height - LINE * FONT))
    _Layout(figure, scene, legend_height).draw()
    for group, words in legend:
        scene.groups.append(group)
        scene.words += words
    return scene


class _Layout:
    """Places of the panels: all of a row are equally high, all of a column begin and end together."""

    def __init__(self, figure: Figure, scene: Scene, top: float) -> None:
        self.figure, self.scene = figure, scene
        self.rows, self.columns = rows_and_columns(figure)
        self.shared = shares_x(figure)
        self.slot = (scene.width - 2.0 * EDGE - COLUMN_GAP * (self.columns - 1)) / self.columns
        self.ranges = _ranges(figure, shared=self.shared)
        self.lefts, before = [0.0] * self.columns, [-1.0]
        for _ in range(PASSES):
            if self.lefts == before:
                break
            before = self.lefts
            self._set_heights(top)
            self.lefts = [max(map(self._left_margin, self._column(column))) for column in range(self.columns)]
        scene.height = max(scene.height, self.tops[-1] + self.plot_height + self.below[-1] + EDGE)

    def _set_heights(self, top: float) -> None:
        """Share the height between plots and the words around them."""
        above, self.below = map(list, zip(*(self._around(row) for row in range(self.rows)), strict=True))
        free = self.scene.height - top - sum(above) - sum(self.below) - EDGE
        self.plot_height = max(free / self.rows, 30.0)
        self.tops = [
            top + sum(above[: row + 1]) + sum(self.below[:row]) + row * self.plot_height
            for row in range(self.rows)
        ]

    def draw(self) -> None:
        """All panels of all columns."""
        for column in range(self.columns):
            indices, left = self._column(column), self.lefts[column]
            start = EDGE + column * (self.slot + COLUMN_GAP)
            right = start + self.slot
            over = max(self._overhang(index, start + left, right) for index in indices)
            for index in indices:
                top = self.tops[index // self.columns]
                box = Box(start + left, top, right - over, top + self.plot_height)
                _Drawing(self, index, box, start).draw(self._y_words(index)[1])

    def has_x_words(self, index: int) -> bool:
        """Whether ticks and label stand below this panel."""
        return not self.shared or index == len(self.figure.panels) - 1

    def title_lines(self, index: int) -> list[str]:
        """Lines of the panel's title; it may reach over the words left of the next panel, which begin below it."""
        title, column = self.figure.panels[index].title, index % self.columns
        over = EDGE if column == self.columns - 1 else COLUMN_GAP + TITLE_FONT
        room = self.slot - self.lefts[column] + over
        return wrapped(title, room, TITLE_FONT, bold=True) if title else []

    def x_label_lines(self, index: int, ticks: Ticks | None = None) -> list[str]:
        """Lines of the label of the x axis; those of the bare axis before its ticks are known."""
        panel = self.figure.panels[index]
        label = panel.x.label if ticks is None else axis_label(panel.x, ticks)
        return wrapped(label, self.slot - 40.0)

    def _column(self, column: int) -> range:
        return range(column, len(self.figure.panels), self.columns)

    def _around(self, row: int) -> tuple[float, float]:
        """Height of the words above and below the plots of a row."""
        indices = range(row * self.columns, min((row + 1) * self.columns, len(self.figure.panels)))
        titles = max(len(self.title_lines(index)) for index in indices)
        labels = [len(self.x_label_lines(index)) for index in indices if self.has_x_words(index)]
        below = TICK + GAP + TICK_FONT + max(labels) * LINE * FONT + GAP if labels else 0.0
        return titles * LINE * TITLE_FONT + ROW_GAP, below

    def _y_words(self, index: int) -> tuple[Ticks, list[str]]:
        """Ticks of the y axis and the lines of its label."""
        panel, up = self.figure.panels[index], self.ranges[index][1]
        ticks = _y_ticks(panel, Scale(*up, self.plot_height, 0.0, panel.y.log))
        return ticks, wrapped(axis_label(panel.y, ticks), self.plot_height + GAP)

    def _left_margin(self, index: int) -> float:
        ticks, label = self._y_words(index)
        widest = max((text_width(word, TICK_FONT) for word in ticks.words), default=0.0)
        return len(label) * LINE * FONT + GAP + widest + GAP + TICK

    def _overhang(self, index: int, left: float, right: float) -> float:
        """Space that the last label of the x axis needs beyond the end of the axis."""
        panel = self.figure.panels[index]
        scale = Scale(*self.ranges[index][0], left, right, panel.x.log)
        ticks = _x_ticks(panel, scale)
        if not ticks.words or not self.has_x_words(index):
            return 0.0
        return max(0.0, float(scale.place(ticks.at[-1])) + 0.5 * text_width(ticks.words[-1], TICK_FONT) - right)


def _x_ticks(panel: Panel, scale: Scale) -> Ticks:
    whole = _is_whole(series.arrays()[0] for series in panel.series)
    return fitting_ticks(panel.x, scale, lambda word: text_width(word, TICK_FONT), 8.0, whole=whole)


def _y_ticks(panel: Panel, scale: Scale) -> Ticks:
    most = min(max(2, round(abs(scale.end - scale.start) / (2.2 * TICK_FONT))), 10)
    whole = _is_whole(series.arrays()[1] for series in panel.series)
    return axis_ticks(panel.y, scale, most, whole=whole)


def _is_whole(values: Iterable[Array]) -> bool:
    """Whether all values are whole numbers, so that nothing lies between two of them."""
    parts = [part[np.isfinite(part)] for part in values]
    return any(part.size for part in parts) and all(bool(np.all(part == np.round(part))) for part in parts)


Range = tuple[float, float]


def _ranges(figure: Figure, *, shared: bool) -> list[tuple[Range, Range]]:
    """Shown range of x and y of every panel."""
    x = [[values for s in panel.series for values in _reach_x(s)] for panel in figure.panels]
    if shared:
        whole = [values for part in x for values in part]
        axis = next((p.x for p in figure.panels if p.x.limits is not None), figure.panels[0].x)
        across = [extent(axis, whole)] * len(x)
    else:
        across = [extent(panel.x, values) for panel, values in zip(figure.panels, x, strict=True)]
    ranges = []
    for panel, reach in zip(figure.panels, across, strict=True):
        bars = any(s.mark == "bars" for s in panel.series)
        ranges.append((reach, extent(panel.y, (v for s in panel.series for v in _reach_y(s)), from_zero=bars)))
    return ranges


def _reach_x(series: Series) -> list[Array]:
    x, y = series.arrays()
    x = x[np.isfinite(y)]
    if series.mark == "bars":
        half = 0.5 * bar_width(x)
        return [x - half, x + half]
    return [x]


def _reach_y(series: Series) -> list[Array]:
    x, y = series.arrays()
    y = np.where(np.isfinite(x), y, np.nan)
    reach = [y]
    if series.upper is not None:
        reach.append(np.asarray(series.upper, dtype=float))
    if series.error is not None:
        error = np.asarray(series.error, dtype=float)
        reach += [y - error, y + error]
    return reach + ([np.zeros(1)] if series.mark == "bars" else [])


def bar_width(x: Array) -> float:
    """Width of bars at these places, with a fifth of the distance between them."""
    steps = np.diff(np.unique(x))
    return 0.8 * float(steps.min()) if steps.size else 0.8


# -- one panel -----------------------------------------------------------------------------------------


class _Drawing:
    """One panel in its box."""

    def __init__(self, layout: _Layout, index: int, box: Box, start: float) -> None:
        self.layout, self.index, self.start = layout, index, start
        self.panel: Panel = layout.figure.panels[index]
        self.scene = layout.scene
        across, up = layout.ranges[index]
        if self.panel.equal:
            across, up, box = _equal(self.panel, across, up, box)
        self.box = box
        self.x = Scale(*across, box.left, box.right, self.panel.x.log)
        self.y = Scale(*up, box.bottom, box.top, self.panel.y.log)
        self.scene.scales.append((self.x, self.y))

    def draw(self, label: list[str]) -> None:
        """Frame with words, then the series: areas below lines."""
        self._frame(label)
        limits = self.panel.x.limits is not None or self.panel.y.limits is not None
        clip = (
            Box(self.box.left - 1, self.box.top - 1, self.box.right + 1, self.box.bottom + 1)
            if limits
            else None
        )
        numbered = list(enumerate(self.panel.series))
        for order, series in sorted(numbered, key=lambda item: item[1].mark not in ("band", "bars")):
            key = series_key(self.layout.figure, self.index, order)
            self.scene.groups.append(SceneGroup(_shapes(series, self.x, self.y), key, clip))

    def _frame(self, label: list[str]) -> None:
        """Grid, axes with ticks, and all words around them."""
        box = self.box
        x_ticks, y_ticks = _x_ticks(self.panel, self.x), _y_ticks(self.panel, self.y)
        across, up = self.x.place(x_ticks.at).tolist(), self.y.place(y_ticks.at).tolist()
        grid = [_segment(x, box.top, x, box.bottom) for x in across]
        grid += [_segment(box.left, y, box.right, y) for y in up]
        marks = [np.array([[box.left, box.top], [box.left, box.bottom], [box.right, box.bottom]])]
        for xs, ys, length in (
            (across, up, TICK),
            (self.x.place(x_ticks.minor).tolist(), self.y.place(y_ticks.minor).tolist(), 0.6 * TICK),
        ):
            marks += [_segment(x, box.bottom, x, box.bottom + length) for x in xs]
            marks += [_segment(box.left - length, y, box.left, y) for y in ys]
        self.scene.groups.append(
            SceneGroup((Shape("line", tuple(grid), "grid"), Shape("line", tuple(marks), "soft")))
        )
        if self.layout.has_x_words(self.index):
            self._x_words(x_ticks, across)
        self._y_words(y_ticks, up, label)
        title = self.layout.title_lines(self.index)
        base = box.top - 0.6 * ROW_GAP - (len(title) - 1) * LINE * TITLE_FONT
        self.scene.words += [
            Words(text, box.left, base + n * LINE * TITLE_FONT, TITLE_FONT, bold=True)
            for n, text in enumerate(title)
        ]

    def _x_words(self, ticks: Ticks, places: list[float]) -> None:
        base, middle = self.box.bottom + TICK + GAP + 0.75 * TICK_FONT, 0.5 * (self.box.left + self.box.right)
        self.scene.words += [
            Words(word, x, base, TICK_FONT, "middle") for word, x in zip(ticks.words, places, strict=True)
        ]
        base += 0.25 * TICK_FONT
        self.scene.words += [
            Words(text, middle, base + n * LINE * FONT, anchor="middle")
            for n, text in enumerate(self.layout.x_label_lines(self.index, ticks), 1)
        ]

    def _y_words(self, ticks: Ticks, places: list[float], label: list[str]) -> None:
        edge, middle = self.box.left - TICK - GAP, 0.5 * (self.box.top + self.box.bottom)
        self.scene.words += [
            Words(word, edge, y + 0.36 * TICK_FONT, TICK_FONT, "end")
            for word, y in zip(ticks.words, places, strict=True)
        ]
        first = self.start + 0.8 * FONT
        if self.panel.equal:
            widest = max((text_width(word, TICK_FONT) for word in ticks.words), default=0.0)
            first = edge - widest - GAP - (len(label) - 1) * LINE * FONT
        self.scene.words += [
            Words(text, first + n * LINE * FONT, middle, anchor="middle", turned=True)
            for n, text in enumerate(label)
        ]


def _segment(x0: float, y0: float, x1: float, y1: float) -> Array:
    return np.array([[x0, y0], [x1, y1]])


def _equal(panel: Panel, across: Range, up: Range, box: Box) -> tuple[Range, Range, Box]:
    """One scale on both axes: a smaller box where the limits are set, else wider ranges."""
    wide, tall = across[1] - across[0], up[1] - up[0]
    unit = min(box.width / wide, box.height / tall)
    if panel.x.limits is not None and panel.y.limits is not None:
        spare, left = box.height - unit * tall, 0.5 * (box.left + box.right - unit * wide)
        return across, up, Box(left, box.top + 0.5 * spare, left + unit * wide, box.bottom - 0.5 * spare)
    room_x, room_y = 0.5 * (box.width / unit - wide), 0.5 * (box.height / unit - tall)
    return (across[0] - room_x, across[1] + room_x), (up[0] - room_y, up[1] + room_y), box


# -- series --------------------------------------------------------------------------------------------


def drawn_rows(series: Series) -> NDArray[np.int64]:
    """Rows that are drawn of a series; of a long one its outline."""
    rows = envelope_rows(series.y, DRAWN)
    return rows if series.upper is None else np.union1d(rows, envelope_rows(series.upper, DRAWN))


def _shapes(series: Series, x_scale: Scale, y_scale: Scale) -> tuple[Shape, ...]:
    """What is drawn of a series."""
    x_values, y_values = series.arrays()
    rows = drawn_rows(series)
    x, y = x_scale.place(x_values[rows]), y_scale.place(y_values[rows])
    colour = f"role-{series.role}"
    if series.mark == "bars":
        half = 0.5 * bar_width(x_values)
        left, right = x_scale.place(x_values[rows] - half), x_scale.place(x_values[rows] + half)
        return (Shape("area", _bars(left, right, y, _floor(y_scale, np.zeros(1))[0]), colour),)
    if series.mark == "band":
        upper = y_scale.place(np.asarray(series.upper, dtype=float)[rows])
        return (Shape("area", _band(x, _floor(y_scale, y_values[rows], y), upper), colour, opacity=0.18),)
    shapes = []
    if series.error is not None:
        error = np.asarray(series.error, dtype=float)[rows]
        low, high = y_values[rows] - error, y_values[rows] + error
        shapes.append(Shape("line", _error_bars(x, _floor(y_scale, low), y_scale.place(high)), colour, 0.8))
    if series.mark != "points":
        curve = _runs(*(_steps(x, y) if series.mark == "steps" else (x, y)))
        size = THIN if series.role == "muted" else NORMAL
        shapes.append(Shape("line", curve, colour, size, dashed=series.dashed))
    if series.mark in ("points", "line+points"):
        kept = np.isfinite(x) & np.isfinite(y)
        shapes.append(Shape("dots", (_path(x[kept], y[kept]),), colour, DOT))
    return tuple(shapes)


def _floor(scale: Scale, values: Array, places: Array | None = None) -> Array:
    """Places of values; those below zero on a logarithmic axis lie at its low end."""
    places = scale.place(values) if places is None else places
    return np.where((values <= 0.0) & scale.log, scale.start, places)


def _path(x: Array, y: Array) -> Array:
    return np.clip(np.column_stack((x, y)), -FARTHEST, FARTHEST)


def _runs(x: Array, y: Array) -> tuple[Array, ...]:
    """A curve in pieces between its gaps."""
    there = np.isfinite(x) & np.isfinite(y)
    ends = np.flatnonzero(np.diff(there.astype(np.int8))) + 1
    parts = (part for part in np.split(np.arange(x.size), ends) if part.size > 1 and there[part[0]])
    return tuple(_path(x[part], y[part]) for part in parts)


def _steps(x: Array, y: Array) -> tuple[Array, Array]:
    """Level lines around each point, with the steps half way between two points."""
    if x.size < 2:
        return x, y
    middle = 0.5 * (x[1:] + x[:-1])
    return np.concatenate((x[:1], np.repeat(middle, 2), x[-1:])), np.repeat(y, 2)


def _bars(left: Array, right: Array, y: Array, base: float) -> tuple[Array, ...]:
    corners = zip(left.tolist(), right.tolist(), y.tolist(), strict=True)
    return tuple(
        _path(np.array([a, a, b, b]), np.array([base, top, top, base]))
        for a, b, top in corners
        if all(map(math.isfinite, (a, b, top)))
    )


def _band(x: Array, lower: Array, upper: Array) -> tuple[Array, ...]:
    lower = np.where(np.isfinite(upper), lower, np.nan)
    upper = np.where(np.isfinite(lower), upper, np.nan)
    below, above = _runs(x, lower), _runs(x, upper)
    return tuple(np.concatenate((one, other[::-1])) for one, other in zip(below, above, strict=True))


def _error_bars(x: Array, low: Array, high: Array) -> tuple[Array, ...]:
    """A bar with a cap at both ends for each point."""
    paths, cap = [], 1.8
    for at, a, b in zip(x.tolist(), low.tolist(), high.tolist(), strict=True):
        if all(map(math.isfinite, (at, a, b))):
            bar = [(at - cap, a), (at + cap, a), (at, a), (at, b), (at - cap, b), (at + cap, b)]
            paths.append(np.clip(np.array(bar), -FARTHEST, FARTHEST))
    return tuple(paths)


# -- legend --------------------------------------------------------------------------------------------


def _legend(figure: Figure, width: float) -> tuple[list[tuple[SceneGroup, list[Words]]], float]:
    """Entries in rows above the panels, each name once, and the height that they take."""
    named: dict[str, Series] = {}
    for series in (series for panel in figure.panels for series in panel.series):
        if series.name:
            named.setdefault(series.name, series)
    entries: list[tuple[SceneGroup, list[Words]]] = []
    x, top, deepest = EDGE, EDGE, 0
    for name, series in named.items():
        lines = wrapped(name, width - 2.0 * EDGE - HANDLE - GAP)
        needed = HANDLE + GAP + 2.0 + max(text_width(line) for line in lines)
        if entries and x + needed > width - EDGE:
            x, top, deepest = EDGE, top + deepest * LINE * FONT, 0
        words = [
            Words(line, x + HANDLE + GAP + 2.0, top + (n + 0.85) * LINE * FONT) for n, line in enumerate(lines)
        ]
        entries.append((SceneGroup(_sample(series, x, top + 0.55 * LINE * FONT)), words))
        x, deepest = x + needed + ENTRY_GAP, max(deepest, len(lines))
    return entries, (top + deepest * LINE * FONT if entries else 0.0)


def _sample(series: Series, x: float, y: float) -> tuple[Shape, ...]:
    """The look of a series beside its name."""
    colour, half, middle = f"role-{series.role}", 3.5, x + 0.5 * HANDLE
    if series.mark in ("bars", "band"):
        corners = np.array([[x, y + half], [x, y - half], [x + HANDLE, y - half], [x + HANDLE, y + half]])
        return (Shape("area", (corners,), colour, opacity=0.18 if series.mark == "band" else 1.0),)
    shapes = []
    if series.error is not None:
        ends = (np.array([middle]), np.array([y + 4.0]), np.array([y - 4.0]))
        shapes.append(Shape("line", _error_bars(*ends), colour, 0.8))
    if series.mark != "points":
        size = THIN if series.role == "muted" else NORMAL
        shapes.append(Shape("line", (_segment(x, y, x + HANDLE, y),), colour, size, dashed=series.dashed))
    if series.mark in ("points", "line+points"):
        shapes.append(Shape("dots", (np.array([[middle, y]]),), colour, DOT))
    return tuple(shapes)
