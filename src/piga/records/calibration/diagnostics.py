"""Diagnostics of model and data: whiteness, leverage, missing terms, scatter, coloured noise, Monte Carlo."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from piga.records.calibration.budget import Number
from piga.results import Result


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
            document["missing_terms"] = list(document["missing_terms"])
            for entry in document["missing_terms"]:
                if not entry["scale_factor_under"]:
                    del entry["scale_factor_under"]
        return document
