"""The calibration record. Calibration writes it, compensation reads it. It is data only.

JSON schema ``piga.calibration/1`` (``records/schema/calibration-1.json``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from piga.records.coverage import TYPE_A_ONLY, Coverage, coverage, is_of_reference
from piga.records.verdict import Verdict, verdict
from piga.results import (
    MOST_LINES,
    ByValue,
    Column,
    Correlated,
    Plots,
    Reported,
    Result,
    Tabular,
    above,
    first_lines,
    html_of,
    plotted,
    shortened,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from piga.instrument.parameters import ErrorModel, Instrument

Array = NDArray[np.float64]

_SHOWN, _DOUBTS = 5, 3
"""Lines of ``repr`` for coefficients and for doubts. With heading and verdict it has ten lines at most."""

Count = Annotated[int, Meta(ge=0)]
"""A number of rows or events. This limit and the next two are checked when a record is read."""
Number = Annotated[float, Meta(ge=-1e100, le=1e100)]
"""Any finite number. The limit is far above every quantity here; squares and unit conversions stay finite."""
Level = Annotated[float, Meta(ge=0.0, le=1e100)]
"""A non-negative number, such as a standard uncertainty, a noise level or a largest residual."""


LOOSE_PHASE = 0.5
"""A phase with a standard uncertainty [rad] above this counts as not determined."""


class SIValue(float):
    """A coefficient in SI. It is a plain number to compute with, and carries its uncertainty.

    >>> bias = Coefficient("k0", 3e-4, 1e-6, "g").si
    >>> f"{bias:.7f} {bias.unit}, u = {bias.std:.2g}"
    '0.0029420 m/s^2, u = 9.8e-06'

    Attributes
    ----------
    std, expanded, limits, unit:
        Standard uncertainty, half-width and ends of the 95 % interval, and the SI unit.
    """

    __slots__ = ("_coefficient",)
    _coefficient: Coefficient

    def __new__(cls, coefficient: Coefficient) -> SIValue:
        """The value of the coefficient in SI."""
        from piga.records.terms import si_factor

        number = super().__new__(cls, coefficient.value * si_factor(coefficient.name))
        number._coefficient = coefficient
        return number

    def __getnewargs__(self) -> tuple[Coefficient]:  # type: ignore[override]
        return (self._coefficient,)

    def __repr__(self) -> str:
        return f"{float(self)!r} +- {self.std:.2g} {self.unit}"

    @property
    def _factor(self) -> float:
        from piga.records.terms import si_factor

        return si_factor(self._coefficient.name)

    @property
    def value(self) -> float:
        """The plain number."""
        return float(self)

    @property
    def std(self) -> float:
        """Standard uncertainty."""
        return self._coefficient.std * self._factor

    @property
    def expanded(self) -> float:
        """Half-width of the 95 % interval."""
        return self._coefficient.expanded * self._factor

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the 95 % interval."""
        low, high = self._coefficient.limits
        return low * self._factor, high * self._factor

    @property
    def unit(self) -> str:
        """The SI unit."""
        from piga.records.terms import si_unit_of

        return si_unit_of(self._coefficient.name)


@dataclass(frozen=True, eq=False)
class Coefficient(ByValue):
    """One coefficient: value and standard uncertainty in ``unit``, the unit of calibration.json. ``si`` gives it in SI.

    ``value``, ``std``, ``expanded`` and ``limits`` are in ``unit``. Everything else in piga is SI: arrays, ``Run``,
    :class:`piga.Instrument`, and ``si``.

    ``segment`` and ``run`` name the segment and the run it belongs to; None: it belongs to all of them.
    ``degrees_of_freedom`` are the effective degrees of freedom of the standard uncertainty (JCGM 100, G.4).
    ``interval`` is the shortest 95 % interval of a Monte Carlo propagation (JCGM 101), where one was needed.
    """

    name: str
    value: float
    std: float
    unit: str
    segment: str | None = None
    run: str | None = None
    degrees_of_freedom: float = math.inf
    interval: tuple[float, float] | None = None

    @property
    def owner(self) -> str | None:
        """``segment``, ``run`` or ``run:segment``; None for a coefficient of the instrument."""
        parts = [part for part in (self.run, self.segment) if part is not None]
        return ":".join(parts) if parts else None

    @property
    def key(self) -> str:
        """``name`` or ``name[owner]``: the name used in the covariance."""
        return self.name if self.owner is None else f"{self.name}[{self.owner}]"

    @property
    def si(self) -> SIValue:
        """The coefficient in SI: a number with ``std``, ``expanded``, ``limits`` and ``unit``.

        ``cal["scale_factor"].si`` compares with ``Run.scale_factor`` [(rad/s)/(m/s^2)].
        """
        return SIValue(self)

    @property
    def value_si(self) -> float:
        """The value of ``si`` as a plain number."""
        return float(self.si)

    @property
    def coverage(self) -> Coverage:
        """Coverage factor, half-width and limits for 95 %: :func:`piga.records.coverage.coverage`."""
        return coverage(self)

    @property
    def determined(self) -> bool:
        """False for a phase whose standard uncertainty is above ``LOOSE_PHASE``: the data do not determine it."""
        return self.name != "phi" or self.std <= LOOSE_PHASE

    @property
    def coverage_factor(self) -> float:
        """Coverage factor for 95 %; nan where a Monte Carlo interval is used."""
        return self.coverage.factor

    @property
    def expanded(self) -> float:
        """Half-width of the 95 % interval. It is the expanded uncertainty U if the budget is complete."""
        return self.coverage.half_width

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the 95 % coverage interval."""
        return self.coverage.low, self.coverage.high


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


@dataclass(frozen=True, eq=False, repr=False)
class RunRecord(Result):
    """One run of a joint calibration: its identity, noise, residuals, quality and inputs.

    ``raw`` is False if only the summary of the run was available. Its residual figures are then those of its own fit.
    ``undetermined`` names the terms that this run alone cannot determine.
    """

    name: str
    source: str
    stand: str | None
    phase: str
    raw: bool
    rows: int
    angle_rms: float
    angle_random_walk: float
    residual_rms: float
    residual_rms_before: float
    residual_max_before: float
    residual_max_after: float
    quality: Quality
    undetermined: tuple[str, ...] = ()
    input_sha256: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, repr=False)
class Provenance(Result):
    """Origin of the numbers: software, method and inputs."""

    input_sha256: dict[str, str]
    software: str
    created: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Amount:
    """A value with its unit."""

    value: Number
    unit: str


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class BudgetEntry(Result):
    """One source of the uncertainty budget.

    Attributes
    ----------
    source, type, distribution:
        Name, type (A or B) and distribution.
    standard_uncertainty:
        Size of the source; None if it has no size of its own.
    degrees_of_freedom:
        Degrees of freedom of the standard uncertainty. None if it is known exactly, or if each coefficient has its own (Type A).
    contributions:
        Change of each coefficient, by key and in its unit, for one standard uncertainty of the source.
    sensitivities:
        Change of each coefficient for one unit of the source (JCGM 100, 5.1.3); empty if the source has no size.
    """

    source: str
    type: Literal["A", "B"]
    distribution: str = "normal"
    standard_uncertainty: Amount | None = None
    degrees_of_freedom: Level | None = None
    contributions: dict[str, Number]
    sensitivities: dict[str, Amount] = field(default_factory=dict)

    def contribution(self, coefficient: Coefficient) -> float:
        """Change of a coefficient; 0 if the source does not act on it."""
        return self.contributions.get(coefficient.key, 0.0)

    def renamed(self, names: dict[str, str]) -> BudgetEntry:
        """The entry for some of the coefficients, renamed. The argument gives the new key by old key."""
        return replace(
            self,
            contributions={names[k]: v for k, v in self.contributions.items() if k in names},
            sensitivities={names[k]: v for k, v in self.sensitivities.items() if k in names},
        )

    def document(self) -> dict[str, Any]:
        """The entry as plain data for JSON."""
        return _without(asdict(self), () if self.sensitivities else ("sensitivities",))


class BudgetTable(tuple[BudgetEntry, ...], Tabular):
    """The uncertainty budget: its sources in order. As a table it has one row for each source and coefficient."""

    __slots__ = ()

    def __repr__(self) -> str:
        rows = [f"{entry.source}, type {entry.type}, {entry.distribution}" for entry in self]
        lines = ["<BudgetTable", *first_lines(rows, MOST_LINES - 1)]
        return "\n  ".join(shortened(line) for line in lines) + ">"

    def _repr_html_(self) -> str | None:
        return html_of(self)

    def table_columns(self) -> dict[str, Column]:
        """Source, type and distribution, the coefficient, and the contribution in the unit of the coefficient."""
        from piga.records.terms import unit_of

        rows = [(entry, key, value) for entry in self for key, value in entry.contributions.items()]
        texts = {
            "source": [entry.source for entry, _, _ in rows],
            "type": [entry.type for entry, _, _ in rows],
            "distribution": [entry.distribution for entry, _, _ in rows],
            "coefficient": [key for _, key, _ in rows],
            "unit": [unit_of(key) for _, key, _ in rows],
        }
        columns = {name: Column(np.array(values, dtype=object)) for name, values in texts.items()}
        size = np.array(
            [math.nan if e.standard_uncertainty is None else e.standard_uncertainty.value for e, _, _ in rows]
        )
        units = [e.standard_uncertainty.unit if e.standard_uncertainty else "" for e, _, _ in rows]
        contribution = np.array([value for _, _, value in rows], dtype=float)
        return columns | {
            "contribution": Column(contribution, "as in column unit"),
            "standard_uncertainty": Column(size, "as in column unit_of_source"),
            "unit_of_source": Column(np.array(units, dtype=object)),
        }


@dataclass(frozen=True, eq=False, repr=False)
class SegmentLeverage(Result):
    """Influence of a segment on the coefficients.

    ``leverage`` is the trace of its information in the total. ``share`` is the part of each coefficient's information
    that is lost without it. ``shift`` is the change of each coefficient without it, in standard uncertainties; None: the
    coefficient is then not determined.
    """

    leverage: float
    share: dict[str, float]
    shift: dict[str, float | None]


@dataclass(frozen=True)
class MonteCarloCheck:
    """Monte Carlo result of a coefficient (file units): mean, standard uncertainty, 95 % intervals and verdict.

    ``tolerance`` is delta of JCGM 101, 7.9.2. ``validated`` is True if the first-order interval agrees with the
    symmetric Monte Carlo interval.
    """

    mean: float
    std: float
    symmetric: tuple[float, float]
    shortest: tuple[float, float]
    first_order: tuple[float, float]
    tolerance: float
    validated: bool


@dataclass(frozen=True, eq=False, repr=False)
class MonteCarlo(Result):
    """Comparison of first-order and Monte Carlo propagation (JCGM 101, clause 8), by key of the coefficient."""

    trials: int
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
    scale_factor_under:
        Scale factor by the name that a cubic signature is given; empty for other terms.
    """

    terms: tuple[str, ...]
    estimate: tuple[float, ...]
    standard_uncertainty: tuple[float, ...]
    unit: tuple[str, ...]
    chi2_fall: float
    probability: float
    largest_shift: float
    coefficient: str
    alike: tuple[str, ...] = ()
    scale_factor_under: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class SegmentScatter:
    """Scatter of the mean rates of the segments; None if there are too few segments.

    ``segment_scatter_ratio`` is the scatter divided by what all noise explains. ``segment_scatter_ratio_without_it`` is
    the scatter divided by what the noise of the angle explains, if a slow noise is in the model.
    ``segment_scatter_g`` is the root mean square [g].
    """

    segment_scatter_ratio: float | None = None
    segment_scatter_g: float | None = None
    segment_scatter_ratio_without_it: float | None = None

    @property
    def worst(self) -> float:
        """The larger ratio; 0 if there is none."""
        return max(self.segment_scatter_ratio or 0.0, self.segment_scatter_ratio_without_it or 0.0)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Diagnostics(Result):
    """Diagnostics of model and data. An entry without a result is None or empty.

    Attributes
    ----------
    residual_kind, range:
        Kind of residuals (angle or rate); range in which the calibration holds: ``a_x``, ``a_t`` [m/s^2], ``temperature`` [K].
    turns, scatter_of_a_turn:
        Number of whole turns of the output, and the scatter of one turn [rad] (method "revolutions").
    samples, variance, lag1_correlation, ljung_box, ljung_box_lags, ljung_box_probability, skewness, excess_kurtosis, verdict:
        Tests of the whitened residual; the verdict is "white", "white but for the counting", or says that it is not.
    counting_probability:
        Probability of correlations at least this far from those of counting; None if they are white or the output is not counted.
    segment_scatter_ratio, segment_scatter_g, segment_scatter_ratio_without_it:
        See :class:`SegmentScatter`.
    leverage:
        Leverage of each segment, by label.
    advice, missing_terms:
        Other interpretations of the data that fit far better, in words; missing terms that the residuals show, best first.
    monte_carlo:
        Comparison of Monte Carlo and first-order propagation.
    model_comparison:
        Comparison of sets of terms: the document of :class:`piga.calibration.ModelComparison`.
    """

    residual_kind: Literal["angle", "rate"] = "angle"
    range: dict[str, tuple[Number, Number]] = field(default_factory=dict)
    turns: int | None = None
    scatter_of_a_turn: float | None = None
    samples: int | None = None
    variance: float | None = None
    lag1_correlation: float | None = None
    ljung_box: float | None = None
    ljung_box_lags: int | None = None
    ljung_box_probability: float | None = None
    counting_probability: float | None = None
    skewness: float | None = None
    excess_kurtosis: float | None = None
    verdict: str | None = None
    segment_scatter_ratio: float | None = None
    segment_scatter_g: float | None = None
    segment_scatter_ratio_without_it: float | None = None
    leverage: dict[str, SegmentLeverage] = field(default_factory=dict)
    advice: tuple[str, ...] = ()
    missing_terms: tuple[MissingTerm, ...] = ()
    monte_carlo: MonteCarlo | None = None
    model_comparison: dict[str, Any] | None = None

    def with_scatter(self, scatter: SegmentScatter) -> Diagnostics:
        """A copy with this scatter of the segments."""
        return replace(self, **asdict(scatter))

    def document(self) -> dict[str, Any]:
        """Plain data for JSON, without the entries that have no result."""
        document = {k: v for k, v in asdict(self).items() if v is not None and v not in ({}, ())}
        if self.missing_terms:
            document["missing_terms"] = [
                _without(entry, () if entry["scale_factor_under"] else ("scale_factor_under",))
                for entry in document["missing_terms"]
            ]
        return document


def _without(document: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key not in names}


class TypeB(NamedTuple):
    """A source of Type B: its contribution to each coefficient, in its unit, and its degrees of freedom."""

    source: str
    degrees_of_freedom: float
    contributions: dict[str, float]


@dataclass(frozen=True, eq=False, repr=False)
class CalibrationFigures(Result):
    """The part of a calibration that the history of an instrument needs. It is small: thousands fit into memory."""

    serial: str
    terms: tuple[str, ...]
    coefficients: tuple[Coefficient, ...]
    type_b: tuple[TypeB, ...]
    has_budget: bool


class CalibrationPlots(Plots):
    """Figures of a calibration. See :class:`piga.results.Plots` for ``ax``.

    Raises
    ------
    CalibrationError
        If the calibration has no data for the figure, for instance no residuals after reading calibration.json.
    """

    def residuals(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Residuals against time, before and after calibration: two panels."""
        return self._draw("residuals", ax)

    def orders(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Ripple that the residuals show, against revolution order."""
        return self._draw("orders", ax)

    def ripple(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Ripple around the turn of the output: two panels."""
        return self._draw("ripple", ax)

    def segments(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Residuals of each segment."""
        return self._draw("segments", ax)

    def budget(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Share of each source in the variance of each coefficient."""
        return self._draw("budget", ax)

    def allan(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Allan deviation of the residual rate, with the noise of the model."""
        return self._draw("allan", ax)

    def whiteness(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Tests of the whitened residual."""
        return self._draw("whiteness", ax)

    def convergence(self, ax: Axes | Sequence[Axes] | None = None) -> Figure:
        """Estimates while the record comes in, for method "recursive"."""
        return self._draw("convergence", ax)


@dataclass(frozen=True)
class ColouredNoise:
    """Coloured noise of the rate in a record.

    ``kind`` is the likeliest: ``flicker``, ``markov``, and in rate logs ``drift`` or ``scatter``. ``rms`` [rad/s] is the
    standard deviation of the rate that it makes, ``time`` [s] the correlation time (0: it has none), ``gain`` the gain of
    twice the log-likelihood by it.
    """

    kind: str
    rms: float
    time: float
    gain: float

    @property
    def words(self) -> str:
        """The kind in words."""
        return {
            "flicker": "1/f noise",
            "markov": f"first-order Markov noise of about {self.time:.2g} s",
            "drift": "a random walk of the rate",
            "scatter": "rates that scatter from segment to segment",
        }.get(self.kind, self.kind)


@dataclass(frozen=True, repr=False, eq=False)
class Calibration(ByValue, Reported, Tabular, Mapping[str, Coefficient]):
    """Result of a calibration: coefficients with covariance, noise, residual figures and doubts.

    It is a mapping of coefficients in their order: ``cal["tan_beta"].value``; per-segment phases are ``cal["phi[3]"]``.
    ``in``, iteration, ``len``, ``keys``, ``values`` and ``items`` work as those of a dict. Coefficients are in the units
    of calibration.json; ``cal["k0"].si`` is SI, and so is everything else.
    Two calibrations are equal if they state the same. ``residuals`` and ``history`` do not count, and a pickle leaves them
    out: they are as long as the record.
    ``notes`` are doubts, one sentence each. ``remarks`` are information, not doubts.
    ``surplus_observations`` is the number of observations (increments of the angle, rates, positions) minus the number
    of coefficients. It is not the degrees of freedom of an uncertainty: each coefficient has its own effective ones.
    ``bias_drift`` [rad/s/sqrt(s)] or ``segment_scatter`` [rad/s] is the slow noise of the rate, 0 if none was detected.
    ``coloured_noise`` is in the uncertainties and not in the weights; None if none was detected.
    """

    serial: str
    scale_factor_nominal: float
    terms: tuple[str, ...]
    phase: str
    phase_source: str
    method: str
    coefficients: tuple[Coefficient, ...]
    covariance: Array
    surplus_observations: float
    angle_rms: float
    angle_random_walk: float
    residual_rms: float
    residual_rms_before: float
    residual_max_before: float
    residual_max_after: float
    quality: Quality
    condition: float
    notes: tuple[str, ...]
    budget: tuple[BudgetEntry, ...]
    diagnostics: Diagnostics
    segments: tuple[SegmentSummary, ...]
    provenance: Provenance
    temperature_reference: float = 293.15
    time_reference: float = 0.0
    residuals: Residuals | None = field(default=None, compare=False)
    history: dict[str, Array] | None = field(default=None, compare=False)
    runs: tuple[RunRecord, ...] = ()
    outliers: tuple[Outlier, ...] = ()
    bias_drift: float = 0.0
    segment_scatter: float = 0.0
    coloured_noise: ColouredNoise | None = None
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "budget", BudgetTable(self.budget))

    @property
    def type_a_only(self) -> bool:
        """True if the budget has no Type B source of the reference. The reference then counts as exact."""
        return not self.given and not any(
            row.type == "B" and is_of_reference(row.source) for row in self.budget
        )

    @property
    def given(self) -> bool:
        """True if the coefficients were given (:meth:`from_coefficients`), not estimated from a record."""
        return self.quality.rows == 0 and not self.segments and not self.runs

    @property
    def verdict(self) -> Verdict:
        """The verdict of :func:`piga.records.verdict.verdict`: what holds, what does not, what to do."""
        return verdict(self)

    def __repr__(self) -> str:
        named = (
            f"<Calibration of {self.serial or 'an instrument'} by method {self.method}, standard uncertainties"
        )
        rows = [f"{c.key} = {_rounded(c)} +- {c.std:.2g} {c.unit}" for c in self.coefficients]
        judged = self.verdict
        doubts = [f"  does not hold: {doubt.words}" for doubt in judged.doubts]
        lines = [
            *first_lines(rows, _SHOWN),
            f"verdict: {judged.headline}",
            *first_lines(doubts, _DOUBTS, ": summary()"),
        ]
        return "\n  ".join([named, *(shortened(line) for line in lines)]) + ">"

    def _repr_html_(self) -> str | None:
        return html_of(self)

    @property
    def plot(self) -> CalibrationPlots:
        """The report's figures, drawn with Matplotlib: ``cal.plot.residuals()``."""
        return CalibrationPlots(self)

    def table_columns(self) -> dict[str, Column]:
        """The coefficients as a table: one row each, in its own unit and in SI. Segment and run are empty where none is named."""
        from piga.records.terms import si_unit_of

        held = self.coefficients
        texts = {
            "coefficient": [c.key for c in held],
            "name": [c.name for c in held],
            "segment": [c.segment or "" for c in held],
            "run": [c.run or "" for c in held],
            "unit": [c.unit for c in held],
            "unit_si": [si_unit_of(c.name) for c in held],
        }
        numbers = {
            "value": [c.value for c in held],
            "std": [c.std for c in held],
            "expanded": [c.expanded for c in held],
            "low": [c.limits[0] for c in held],
            "high": [c.limits[1] for c in held],
            "degrees_of_freedom": [c.degrees_of_freedom for c in held],
            "value_si": [c.value_si for c in held],
            "std_si": [c.si.std for c in held],
        }
        columns = {name: np.array(values, dtype=object) for name, values in texts.items()}
        columns |= {name: np.array(values, dtype=float) for name, values in numbers.items()}
        row_unit = dict.fromkeys(("value", "std", "expanded", "low", "high"), "as in column unit")
        row_unit |= dict.fromkeys(("value_si", "std_si"), "as in column unit_si")
        return {name: Column(values, row_unit.get(name, "1")) for name, values in columns.items()}

    def table_notes(self) -> tuple[str, ...]:
        """The remark that uncertainties are of Type A only, where it holds."""
        return (TYPE_A_ONLY,) if self.type_a_only else ()

    def correlated(
        self, library: Literal["uncertainties", "GTC"] | None = None, *, si: bool = False
    ) -> dict[str, Correlated]:
        """The coefficients as numbers that know their covariance, by key, to compute on with.

        Parameters
        ----------
        library:
            ``"uncertainties"`` or ``"GTC"``. None: the one that is installed, ``uncertainties`` first. GTC takes over the
            fewest effective degrees of freedom of all coefficients: it has one number for correlated quantities.
        si:
            In SI; else in the units of calibration.json.

        Examples
        --------
        >>> import piga
        >>> cal = piga.Calibration.from_coefficients({"scale_factor": (0.9, 1e-3), "k0": (1e-4, 1e-6)})
        >>> c = cal.correlated("uncertainties")
        >>> f"{c['scale_factor'] * c['k0']:.2u}"
        '(9.00+/-0.09)e-05'

        Raises
        ------
        MissingPackageError
            If the library is not installed.
        """
        made: dict[str, Correlated] = above("correlated")(self, library, si=si)
        return made

    def __getitem__(self, key: str) -> Coefficient:
        for coefficient in self.coefficients:
            if coefficient.key == key:
                return coefficient
        raise KeyError(f"no coefficient '{key}'; there are: {', '.join(c.key for c in self.coefficients)}")

    def __iter__(self) -> Iterator[str]:
        return (coefficient.key for coefficient in self.coefficients)

    def __len__(self) -> int:
        return len(self.coefficients)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"residuals": None, "history": None}

    def __copy__(self) -> Calibration:
        return replace(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> Calibration:
        return replace(self, **{f.name: deepcopy(getattr(self, f.name), memo) for f in fields(self)})

    def instrument(self, alpha0: float | str = 0.0) -> Instrument:
        """The calibrated instrument (SI): its scale factor, and ``beta`` from ``tan_beta``.

        A scale factor that was not estimated is the nominal one. ``alpha0`` [rad] is the gimbal angle at the start. It belongs
        to a run, so a calibration does not know it.
        """
        instrument: Instrument = above("instrument")(self, alpha0)
        return instrument

    def error_model(self) -> ErrorModel:
        """The other coefficients as an error model (SI), to propagate or simulate with.

        Warns
        -----
        PigaWarning
            If a coefficient has no place in the exact motion and is left out: a harmonic from the second on, or a term of
            the servo. The message names it.
        """
        model: ErrorModel = above("error_model")(self)
        return model

    @classmethod
    def from_coefficients(
        cls,
        coefficients: Mapping[str, Given],
        *,
        covariance: ArrayLike | None = None,
        serial: str = "",
        scale_factor_nominal: float | str | None = None,
        phase_source: str = "output",
    ) -> Calibration:
        """Make a calibration without a run, for instance from a data sheet.

        Parameters
        ----------
        coefficients:
            Value by name. A number is in the unit of calibration.json (``scale_factor`` rad/s/g, ``k0`` g); text carries
            its unit. A pair is value and standard uncertainty. A :class:`Coefficient` stands for itself.
            Phases of segments are named ``phi[3]``.
        covariance:
            Covariance (n, n) of the coefficients in their order and units. None: uncorrelated.
        serial, scale_factor_nominal, phase_source:
            As in a run file; the nominal scale factor is in SI or carries its unit. None: that of ``coefficients``.

        Raises
        ------
        ArgumentError
            If a name or unit is not known, or the covariance contradicts the uncertainties.

        Examples
        --------
        >>> import piga
        >>> cal = piga.Calibration.from_coefficients({"scale_factor": 0.8884, "tan_beta": (4.8e-3, 1e-6), "phi": 0.3})
        >>> cal["tan_beta"].std, list(cal)
        (1e-06, ['scale_factor', 'tan_beta', 'phi'])
        """
        from piga.records.given_calibration import calibration_of

        return calibration_of(coefficients, covariance, serial, scale_factor_nominal, phase_source)

    def figures(self) -> CalibrationFigures:
        """The part that a history of the instrument needs."""
        type_b = tuple(
            TypeB(row.source, row.degrees_of_freedom or math.inf, row.contributions)
            for row in self.budget
            if row.type == "B"
        )
        return CalibrationFigures(self.serial, self.terms, self.coefficients, type_b, bool(self.budget))

    def for_run(self, name: str) -> Calibration:
        """One run of a joint calibration as a calibration: the common coefficients and those of the run, under plain names.

        Raises
        ------
        CalibrationError
            If there is no such run.
        """
        from piga.errors import CalibrationError

        record = next((run for run in self.runs if run.name == name), None)
        if record is None:
            known = ", ".join(run.name for run in self.runs) or "none: it is a calibration of one run"
            raise CalibrationError(f"the calibration has no run '{name}'", remedy=f"runs: {known}")
        chosen = [i for i, c in enumerate(self.coefficients) if c.run in (None, name)]
        names = {self.coefficients[i].key: replace(self.coefficients[i], run=None).key for i in chosen}
        return replace(
            self,
            coefficients=tuple(replace(self.coefficients[i], run=None) for i in chosen),
            covariance=self.covariance[np.ix_(chosen, chosen)],
            phase=record.phase,
            angle_rms=record.angle_rms,
            angle_random_walk=record.angle_random_walk,
            budget=tuple(row.renamed(names) for row in self.budget),
            residuals=None,
            runs=(),
        )

    def to_json(self, path: str | Path) -> None:
        """Write ``calibration.json`` (schema ``piga.calibration/1``)."""
        from piga.records.calibration_json import write_calibration

        write_calibration(self, Path(path))

    @staticmethod
    def from_json(path: str | Path) -> Calibration:
        """Read ``calibration.json``.

        Raises
        ------
        CalibrationError
            If the file is not a calibration record of a known schema.
        """
        from piga.records.calibration_json import read_calibration

        return read_calibration(Path(path))


Given = float | str | tuple[float | str, float | str] | Coefficient
"""A coefficient as :meth:`Calibration.from_coefficients` takes it."""


def _rounded(c: Coefficient) -> str:
    """The value, rounded to the last digit of its uncertainty."""
    if not (math.isfinite(c.std) and c.std > 0.0):
        return f"{c.value:.9g}"
    return f"{round(c.value, 1 - math.floor(math.log10(c.std))) + 0.0:.12g}"
