"""A figure as plain data, with quantity and unit on every axis. Also the palette of all figures.

A figure function takes a result and returns a :class:`Figure`; it draws nothing. The renderers
(static SVG/PNG for print and scripts-off, interactive for the screen) draw any figure.

A figure names roles, not colours. The palette is for print, screen and dark screens. Its hues follow the idea of
Okabe and Ito (vermilion, blue, bluish green); lightness differs as well, so that a grey print keeps the order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.results import Result

Mark = Literal["line", "points", "line+points", "bars", "band", "steps"]
Role = Literal["data", "model", "before", "after", "reference", "warning", "x", "y", "z", "muted"]

XYZ: Final[tuple[Role, Role, Role]] = ("x", "y", "z")
"""Roles of the three components of a vector."""


@dataclass(frozen=True)
class Axis:
    """Quantity and unit of one axis, e.g. ``Axis("time", "s")``; ``log`` for a logarithmic scale.

    ``dates``: values are days since 1970-01-01, UTC, and shown as calendar dates; for an x axis.
    """

    quantity: str
    unit: str
    log: bool = False
    limits: tuple[float, float] | None = None
    dates: bool = False

    @property
    def label(self) -> str:
        """Label in the form ``quantity [unit]``; unit ``1`` is written as a plain name."""
        return self.quantity if self.unit in ("", "1") else f"{self.quantity} [{self.unit}]"


@dataclass(frozen=True, eq=False, repr=False)
class Series(Result):
    """One curve: ``x`` and ``y`` of equal length, in the units of the panel's axes.

    ``upper`` is used with mark ``band``: the band lies between ``y`` and ``upper``.
    ``error`` draws symmetric error bars of that half-length. ``text`` is a hover label per point.
    ``rows`` is the row of the record of each point, for a curve that shows only the outline of its rows: the page
    then says how many of the rows in view are drawn. ``segments`` is the index of the segment of each point: the reader
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
    text: tuple[str, ...] | None = None
    rows: ArrayLike | None = None
    segments: ArrayLike | None = None

    def arrays(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """``x`` and ``y`` as float arrays."""
        return np.asarray(self.x, dtype=float), np.asarray(self.y, dtype=float)


@dataclass(frozen=True)
class Panel:
    """One pair of axes with its series. ``equal`` keeps the same scale on both axes (polar plots).

    ``of_segments`` are curves of single segments, each with the index of its segment. A page on the screen shows one while
    its segment is selected; print and pictures leave them out.
    """

    x: Axis
    y: Axis
    series: tuple[Series, ...]
    title: str = ""
    equal: bool = False
    of_segments: tuple[tuple[int, Series], ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Figure(Result):
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


INK: Final = "#1c2733"
SOFT: Final = "#56626f"
GRID: Final = "#dfe4ea"

LIGHT: Final[dict[Role, str]] = {
    "data": "#3b4e63",
    "model": "#0f7a5c",
    "before": "#d2691e",
    "after": "#10528a",
    "reference": "#23282e",
    "warning": "#a2700a",
    "x": "#c2491d",
    "y": "#12805f",
    "z": "#1e62b0",
    "muted": "#98a2ad",
}
"""Colour of each role on white paper."""

DARK: Final[dict[Role, str]] = {
    "data": "#b4c3d3",
    "model": "#4fcaa6",
    "before": "#f0995c",
    "after": "#6fbcf2",
    "reference": "#dfe5ec",
    "warning": "#efbb4a",
    "x": "#f38d68",
    "y": "#58cfa8",
    "z": "#86b6f7",
    "muted": "#6b7783",
}
"""Colour of each role on a dark screen."""

_CHROME: Final = {"ink": (INK, "#e6ebf1"), "soft": (SOFT, "#9fabb8"), "grid": (GRID, "#303b47")}


def css_names() -> dict[str, str]:
    """CSS variable of each light colour, e.g. ``{"#10528a": "--role-after"}``."""
    names = {light: f"--{name}" for name, (light, _) in _CHROME.items()}
    return names | {colour: f"--role-{role}" for role, colour in LIGHT.items()}


def light_colour(name: str) -> str:
    """Colour on white paper by its name: ``ink``, ``soft``, ``grid`` or ``role-`` and a role."""
    return _LIGHT_BY_NAME[name]


def css_variable(name: str) -> str:
    """The same as a variable of a page, which follows its theme."""
    return f"var(--{name})"


_LIGHT_BY_NAME = {name.removeprefix("--"): colour for colour, name in css_names().items()}


def css_variables(*, dark: bool) -> str:
    """Declarations of all colours, for the light or the dark theme of a page."""
    chrome = {f"--{name}": pair[dark] for name, pair in _CHROME.items()}
    roles = {f"--role-{role}": colour for role, colour in (DARK if dark else LIGHT).items()}
    return " ".join(f"{name}: {colour};" for name, colour in (chrome | roles).items())
