"""What a record was like, and what its model is worth: plain data."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from piga.records.calibration.coefficient import Level, Number
from piga.results import Array, Column, Plotted, Result, Tabular
from piga.upper import doors

if TYPE_CHECKING:
    from piga.reports.render.figure import Figure

Count = Annotated[int, Meta(ge=0)]
"""A number of rows or events. Limits in types are checked when a record is read."""
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]


@dataclass(frozen=True)
class Event:
    """One kind of event in the data: its kind, its count, its first data row (1-based) and a detail in words."""

    kind: str
    count: Count
    first_row: Count | None = None
    detail: str = ""


def counted(kind: str, places: NDArray[np.int64], rows: NDArray[np.int64], detail: str) -> list[Event]:
    """An event of this kind at some places, indices in rising order into ``rows``, the file rows; none if there is no place."""
    return [Event(kind, int(places.size), int(rows[places[0]]), detail)] if places.size else []


@dataclass(frozen=True)
class Quality:
    """Numbers of rows read, used and masked, and every event that was detected or repaired while reading."""

    rows: Count
    used: Count
    masked: Count
    events: tuple[Event, ...] = ()

    @property
    def lost(self) -> float:
        """Share of the rows of the positions that were not used; moves and the time to settle are no part of them."""
        unused = self.rows - self.used
        between = min(sum(e.count for e in self.events if e.kind in _BETWEEN_POSITIONS), unused)
        return (unused - between) / max(self.rows - between, 1)


_BETWEEN_POSITIONS = ("moving", "settling")
"""Events whose rows lie between the positions of the stand."""


@dataclass(frozen=True)
class Outlier:
    """Output samples that do not lie on the path of the output. ``kind`` is spike, stuck or jump.

    ``time`` [s] and ``row`` (file row) are those of the first sample. ``samples`` is the number left out (0 for a
    jump). ``size`` is the largest deviation, in the unit of the residuals. ``run`` is set in a joint calibration.
    """

    kind: str
    time: Number
    row: Count
    samples: Count
    size: Number
    run: str | None = None


@dataclass(frozen=True)
class SegmentSummary:
    """Residual figures of one segment: rows, duration [s], mean a_x [m/s^2], turns [rev], rms in the unit of the residuals.

    ``turns`` is None for a direct instrument.
    """

    label: str
    rows: Count
    duration: Level
    mean_a_x: Number
    turns: Number | None = field(default=None, kw_only=True)
    rms: Level
    rms_before: Level
    max_after: Level


@dataclass(frozen=True, eq=False, repr=False)
class Residuals(Result, Plotted, Tabular):
    """Residual angle per used sample (not stored in the JSON; ``residuals.parquet`` holds it).

    ``plot()`` shows residuals against time, before and after: two panels.

    ``row`` is the 1-based file row, ``t`` [s], ``psi`` [rad] the output angle (for a rate log: its integral; of a direct
    instrument its output),
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

    def figure(self) -> Figure:
        """Residuals against time, before and after."""
        return doors().shown_calibration().residual_figure(self)

    def table_columns(self) -> dict[str, Column]:
        """One row for each used sample. ``segment`` and ``run`` are indices."""
        angle = self.unit.startswith("rad")
        columns = {"row": Column(self.row, "1"), "segment": Column(self.segment, "1"), "t": Column(self.t, "s")}
        columns["psi" if angle else "output"] = Column(self.psi, "rad" if angle else "1")
        columns |= {"a_x": Column(self.a_x, "m/s^2"), "before": Column(self.before, self.unit)}
        columns |= {"after": Column(self.after, self.unit), "innovation": Column(self.innovation, "1")}
        return columns if self.run is None else columns | {"run": Column(self.run, "1")}


@dataclass(frozen=True, eq=False, repr=False)
class SegmentLeverage(Result):
    """Influence of a segment on the coefficients.

    ``leverage`` is the trace of its information in the total. ``share`` is the part of each coefficient's information
    that is lost without it. ``shift`` is the change of each coefficient without it, in standard uncertainties; None: the
    coefficient is then not determined.
    """

    leverage: Level
    share: dict[str, Number]
    shift: dict[str, Number | None]


@dataclass(frozen=True)
class MonteCarloCheck:
    """Monte Carlo result of a coefficient (file units): mean, standard uncertainty, 95 % intervals and verdict.

    ``tolerance`` is delta of JCGM 101, 7.9.2. ``validated`` is True if the first-order interval agrees with the
    symmetric Monte Carlo interval.
    """

    mean: Number
    std: Level
    symmetric: tuple[Number, Number]
    shortest: tuple[Number, Number]
    first_order: tuple[Number, Number]
    tolerance: Level
    validated: bool


@dataclass(frozen=True, eq=False, repr=False)
class MonteCarlo(Result):
    """Comparison of first-order and Monte Carlo propagation (JCGM 101, clause 8), by key of the coefficient."""

    trials: Count
    coefficients: dict[str, MonteCarloCheck]


@dataclass(frozen=True, eq=False, repr=False)
class MissingTerm(Result):
    """A term that is not in the model, but whose signature is in the residuals. It is not applied.

    Attributes
    ----------
    terms, estimate, standard_uncertainty, unit:
        One entry for each term. A pair that turns with the output has two.
    chi2_fall, probability:
        Relative fall of the sum of squares with the term, and the probability of such a fall by chance.
    largest_shift, coefficient:
        Largest change of a coefficient, in its standard uncertainties, and the name of that coefficient.
    alike:
        Other candidates that explain nearly as much.
    """

    terms: tuple[str, ...]
    estimate: tuple[Number, ...]
    standard_uncertainty: tuple[Level, ...]
    unit: tuple[str, ...]
    chi2_fall: Number
    probability: Probability
    largest_shift: Number
    coefficient: str
    alike: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class Creep(Result):
    """A bias that decays after each move, ``size exp(-t / time_constant)`` at the time t since the start of the position.

    Attributes
    ----------
    size, standard_uncertainty:
        Bias at the start of a position [g]. With ``by_move`` it is proportional to the change of a_x by the move, and this
        is its size for 1 g.
    time_constant:
        The likeliest of a few [s].
    probability:
        Probability of such a creep by chance, for all sizes and times that were tried.
    shift:
        Change of each coefficient if the creep is taken out, in its standard uncertainties.
    time, mean, band:
        Residual rate over K [g], less that of its position, stacked by the time [s] since the start of the position: mean over
        the positions, and half width of the 95 % interval by their scatter.
    """

    size: Number
    standard_uncertainty: Level
    time_constant: Level
    by_move: bool
    probability: Probability
    shift: dict[str, Number]
    time: tuple[Number, ...]
    mean: tuple[Number, ...]
    band: tuple[Level, ...]

    @property
    def seen(self) -> bool:
        """True if it is hardly chance."""
        return self.probability < CREEP_ALARMS

    @property
    def largest_shift(self) -> float:
        """Largest change of a coefficient in its standard uncertainties."""
        return max(map(abs, self.shift.values()), default=0.0)


CREEP_ALARMS = 0.01
"""Probability that a record without creep shows one, over all sizes and times that are tried."""


@dataclass(frozen=True)
class SegmentScatter:
    """Scatter of the mean rates of the segments, root mean square [g]; None if there are too few segments.

    ``segment_scatter_ratio`` is the scatter divided by what all noise explains; ``..._without_it``: by what the noise of the
    angle explains, if a slow noise is in the model.
    """

    segment_scatter_ratio: Level | None = None
    segment_scatter_g: Level | None = None
    segment_scatter_ratio_without_it: Level | None = None

    @property
    def worst(self) -> float:
        """The larger ratio; 0 if there is none."""
        return max(self.segment_scatter_ratio or 0.0, self.segment_scatter_ratio_without_it or 0.0)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Diagnostics(Result, SegmentScatter):
    """Diagnostics of model and data. An entry without a result is None or empty.

    Attributes
    ----------
    residual_kind, range:
        Kind of residuals (angle or rate; count of a direct instrument); range in which the calibration holds: ``a_x``, ``a_t``
        [m/s^2], ``temperature`` [K].
    samples, variance, lag1_correlation, ljung_box, ljung_box_lags, ljung_box_probability, skewness, excess_kurtosis, verdict:
        Tests of the whitened residual; the verdict is "white", or says that it is not, or not tested.
    leverage:
        Leverage of each segment, by label.
    advice, missing_terms:
        Other interpretations of the data that fit far better, in words; missing terms that the residuals show, best first.
    creep:
        The likeliest creep after a move, seen or not; None if it was not tested.
    monte_carlo:
        Comparison of Monte Carlo and first-order propagation.
    model_comparison:
        Comparison of sets of terms, as :meth:`piga.calibration.ModelComparison.document` gives it.
    """

    residual_kind: Literal["angle", "rate", "count"] = "angle"
    range: dict[str, tuple[Number, Number]] = field(default_factory=dict)
    samples: Count | None = None
    variance: Level | None = None
    lag1_correlation: Number | None = None
    ljung_box: Number | None = None
    ljung_box_lags: Count | None = None
    ljung_box_probability: Probability | None = None
    skewness: Number | None = None
    excess_kurtosis: Number | None = None
    verdict: str | None = None
    leverage: dict[str, SegmentLeverage] = field(default_factory=dict)
    advice: tuple[str, ...] = ()
    missing_terms: tuple[MissingTerm, ...] = ()
    creep: Creep | None = None
    monte_carlo: MonteCarlo | None = None
    model_comparison: dict[str, Any] | None = None
