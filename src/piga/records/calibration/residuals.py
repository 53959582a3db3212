"""What a record was like: events while reading, outliers, and the residuals of its samples and segments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from piga.results import Column, Result, Tabular, plotted

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


Array = NDArray[np.float64]


Count = Annotated[int, Meta(ge=0)]
"""A number of rows or events. This limit and the next two are checked when a record is read."""


@dataclass(frozen=True)
class Event:
    """One kind of event in the data: its kind, its count, its first data row (1-based) and a detail in words."""

    kind: str
    count: Count
    first_row: int | None = None
    detail: str = ""


@dataclass(frozen=True)
class Quality:
    """Numbers of rows read, used and masked, and every event that was detected or repaired while reading."""

    rows: Count
    used: Count
    masked: Count
    events: tuple[Event, ...] = ()


@dataclass(frozen=True)
class Outlier:
    """Output samples that do not lie on the path of the output. ``kind`` is spike, stuck or jump.

    ``time`` [s] and ``row`` (file row) are those of the first sample. ``samples`` is the number left out (0 for a
    jump). ``size`` is the largest deviation [rad; rad/s for a rate log]. ``run`` is set in a joint calibration.
    """

    kind: str
    time: float
    row: int
    samples: int
    size: float
    run: str | None = None


@dataclass(frozen=True)
class SegmentSummary:
    """Residual figures of one segment: rows, duration [s], mean a_x [m/s^2], turns [rev], rms [rad]."""

    label: str
    rows: int
    duration: float
    mean_a_x: float
    turns: float
    rms: float
    rms_before: float
    max_after: float


@dataclass(frozen=True, eq=False, repr=False)
class Residuals(Result, Tabular):
    """Residual angle per used sample (not stored in the JSON; ``residuals.parquet`` holds it).

    ``row`` is the 1-based file row, ``t`` [s], ``psi`` [rad] the output angle (for a rate log: its integral),
    ``a_x`` [m/s^2] the reference. ``before`` [rad] is the angle minus that of the nominal instrument without coupling.
    ``after`` [rad] is the angle minus that of the fitted model. Both have the mean of each stretch removed; for a
    rate log both are rates [rad/s]. ``innovation`` [1] is the whitened residual. It is white with unit variance if
    model and noise levels are right. ``segment`` is the segment index of each sample. ``run`` is its run index in a
    joint calibration. ``unit`` is that of ``before`` and ``after``.
    """

    row: NDArray[np.int64]
    t: Array
    psi: Array
    a_x: Array
    before: Array
    after: Array
    innovation: Array
    segment: NDArray[np.int32]
    run: NDArray[np.int32] | None = None
    unit: str = "rad"

    def table_columns(self) -> dict[str, Column]:
        """One row for each used sample. ``segment`` and ``run`` are indices."""
        columns = {
            "row": Column(self.row),
            "segment": Column(self.segment),
            "t": Column(self.t, "s"),
            "psi": Column(self.psi, "rad"),
            "a_x": Column(self.a_x, "m/s^2"),
            "before": Column(self.before, self.unit),
            "after": Column(self.after, self.unit),
            "innovation": Column(self.innovation),
        }
        return columns if self.run is None else columns | {"run": Column(self.run)}

    def plot(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Residuals against time, before and after: two panels. See :class:`piga.results.Plots`."""
        return plotted(self, ax)
