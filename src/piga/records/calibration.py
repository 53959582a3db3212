"""The calibration record. Calibration writes it, compensation reads it. It is data only.

JSON schema ``piga.calibration/1`` (``records/schema/calibration-1.json``).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from piga.records.coverage import Coverage, coverage, is_of_reference
from piga.records.verdict import Verdict, verdict

Array = NDArray[np.float64]

_SHOWN = 20
"""Coefficients that ``repr`` shows."""
Count = Annotated[int, Meta(ge=0)]
"""A number of rows or events. This limit and the next two are checked when a record is read."""
Number = Annotated[float, Meta(ge=-1e100, le=1e100)]
"""Any finite number. The limit is far above every quantity here; squares and unit conversions stay finite."""
Level = Annotated[float, Meta(ge=0.0, le=1e100)]
"""A non-negative number, such as a standard uncertainty, a noise level or a largest residual."""


LOOSE_PHASE = 0.5
"""A phase with a standard uncertainty [rad] above this counts as not determined."""


@dataclass(frozen=True)
class Coefficient:
    """One coefficient: value and standard uncertainty in ``unit`` (the unit of calibration.json).

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
    def value_si(self) -> float:
        """Value in SI: ``cal["scale_factor"].value_si`` compares with ``Run.scale_factor`` [(rad/s)/(m/s^2)]."""
        from piga.records.terms import si_factor

        return self.value * si_factor(self.name)

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


@dataclass(frozen=True)
class Residuals:
    """Residual angle per used sample (not stored in the JSON; ``residuals.parquet`` holds it).

    ``row`` is the 1-based file row, ``t`` [s], ``psi`` [rad] the output angle (for a rate log: its integral),
    ``a_x`` [m/s^2] the reference. ``before`` [rad] is the angle minus that of the nominal instrument without coupling.
    ``after`` [rad] is the angle minus that of the fitted model. Both have the mean of each stretch removed; for a
    rate log both are rates [rad/s]. ``innovation`` [1] is the whitened residual. It is white with unit variance if
    model and noise levels are right. ``segment`` is the segment index of each sample. ``run`` is its run index in a
    joint calibration.
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


@dataclass(frozen=True)
class RunRecord:
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


@dataclass(frozen=True)
class Provenance:
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


@dataclass(frozen=True, kw_only=True)
class BudgetEntry:
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


@dataclass(frozen=True)
class SegmentLeverage:
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


@dataclass(frozen=True)
class MonteCarlo:
    """Comparison of first-order and Monte Carlo propagation (JCGM 101, clause 8), by key of the coefficient."""

    trials: int
    coefficients: dict[str, MonteCarloCheck]


@dataclass(frozen=True)
class MissingTerm:
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


@dataclass(frozen=True, kw_only=True)
class Diagnostics:
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


@dataclass(frozen=True)
class CalibrationFigures:
    """The part of a calibration that the history of an instrument needs. It is small: thousands fit into memory."""

    serial: str
    terms: tuple[str, ...]
    coefficients: tuple[Coefficient, ...]
    type_b: tuple[TypeB, ...]
    has_budget: bool


@dataclass(frozen=True, repr=False)
class Calibration:
    """Result of a calibration: coefficients with covariance, noise, residual figures and doubts.

    Index by coefficient name: ``cal["tan_beta"].value``; per-segment phases by ``cal["phi[3]"]``.
    ``notes`` are doubts, one sentence each. ``remarks`` are information, not doubts.
    ``surplus_observations`` is the number of observations (increments of the angle, rates, positions) minus the number
    of coefficients. It is not the degrees of freedom of an uncertainty: each coefficient has its own effective ones.
    ``bias_drift`` [rad/s/sqrt(s)] or ``segment_scatter`` [rad/s] is the slow noise of the rate, 0 if none was detected.
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
    residuals: Residuals | None = None
    history: dict[str, Array] | None = None
    runs: tuple[RunRecord, ...] = ()
    outliers: tuple[Outlier, ...] = ()
    bias_drift: float = 0.0
    segment_scatter: float = 0.0
    remarks: tuple[str, ...] = ()

    @property
    def type_a_only(self) -> bool:
        """True if the budget has no Type B source of the reference. The reference then counts as exact."""
        return not any(row.type == "B" and is_of_reference(row.source) for row in self.budget)

    @property
    def verdict(self) -> Verdict:
        """The verdict of :func:`piga.records.verdict.verdict`: what holds, what does not, what to do."""
        return verdict(self)

    def __repr__(self) -> str:
        rows = [f"  {c.key} = {_rounded(c)} +- {c.std:.2g} {c.unit}" for c in self.coefficients[:_SHOWN]]
        more = len(self.coefficients) - _SHOWN
        rows += [f"  and {more} more"] if more > 0 else []
        head = (
            f"<Calibration of {self.serial or 'an instrument'} by method {self.method}, standard uncertainties"
        )
        return "\n".join([head, *rows, *(f"  {line}" for line in self.verdict.lines())]) + ">"

    def __getitem__(self, key: str) -> Coefficient:
        for coefficient in self.coefficients:
            if coefficient.key == key:
                return coefficient
        raise KeyError(f"no coefficient '{key}'; there are: {', '.join(c.key for c in self.coefficients)}")

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


def _rounded(c: Coefficient) -> str:
    """The value, rounded to the last digit of its uncertainty."""
    if not (math.isfinite(c.std) and c.std > 0.0):
        return f"{c.value:.9g}"
    return f"{round(c.value, 1 - math.floor(math.log10(c.std))) + 0.0:.12g}"
