"""A figure as plain data: what is drawn, with quantity and unit on every axis.

A figure function takes a result and returns a :class:`Figure`; it draws nothing. The renderers
(static SVG/PNG for print and scripts-off, interactive for the screen) draw any figure.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Mark = Literal["line", "points", "line+points", "bars", "band", "steps"]
Role = Literal["data", "model", "before", "after", "reference", "warning", "x", "y", "z", "muted"]


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


@dataclass(frozen=True)
class Series:
    """One curve: ``x`` and ``y`` of equal length, in the units of the panel's axes.

    ``upper`` is used with mark ``band``: the band lies between ``y`` and ``upper``.
    ``error`` draws symmetric error bars of that half-length. ``text`` is a hover label per point.
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


@dataclass(frozen=True)
class Figure:
    """One or more panels, side by side or stacked (then they share the x axis when alike).

    ``key`` is the figure's identifier (file name and anchor: letters, digits, hyphens; unique in a page);
    ``caption`` says in one or two sentences what is to be seen and what is good; ``height`` [inch] is that
    of one row of panels; ``notes`` are small print below.
    """

    key: str
    title: str
    panels: tuple[Panel, ...]
    caption: str = ""
    columns: int = 1
    height: float = 3.2
    notes: tuple[str, ...] = field(default=())
