"""What a record was like, and what its calibration is worth: diagnostics, and the verdict.

The verdict has a grade, one reason, the doubts, what was tested and what was not. Every page, terminal, file and warning shows
it. No other code judges a calibration as a whole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from piga.records.calibration.coefficient import NO_REFERENCE, Level, Number, StandSource
from piga.results import Array, Plotted, Result
from piga.tables import Column, Tabular
from piga.units import G0
from piga.upper import doors

if TYPE_CHECKING:
    from piga.records.calibration.calibration import Calibration
    from piga.reports.render.figure import Figure

Count = Annotated[int, Meta(ge=0)]
"""A number of rows or events. Limits in types are checked when a record is read."""
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
CREEP_ALARMS = 0.01
"""Probability that a record without creep shows one, over all sizes and times that are tried."""


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
        between = min(sum(e.count for e in self.events if e.kind in ("moving", "settling")), unused)
        return (unused - between) / max(self.rows - between, 1)


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

    A pair that turns with the output has two entries in ``terms``, ``estimate``, ``standard_uncertainty`` and ``unit``.
    ``chi2_fall`` is the relative fall of the sum of squares with the term, ``probability`` that of such a fall by chance.
    ``largest_shift`` is the change, in standard uncertainties, of the ``coefficient`` that changes most. ``alike``: other
    candidates that explain nearly as much.
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
    """A bias that decays after each move, ``size exp(-t / time_constant)`` at the time t [s] since the start of the position.

    ``size`` is the bias at the start [g]. With ``by_move`` it is proportional to the change of a_x by the move, and this is its
    size for 1 g. ``time_constant`` is the likeliest of a few [s], ``probability`` that of such a creep by chance, for all sizes
    and times that were tried. ``shift`` is the change of each coefficient without the creep, in its standard uncertainties.
    """

    size: Number
    standard_uncertainty: Level
    time_constant: Level
    by_move: bool
    probability: Probability
    shift: dict[str, Number]

    @property
    def seen(self) -> bool:
        """True if it is hardly chance."""
        return self.probability < CREEP_ALARMS

    @property
    def largest_shift(self) -> float:
        """Largest change of a coefficient in its standard uncertainties."""
        return max(map(abs, self.shift.values()), default=0.0)


@dataclass(frozen=True, eq=False, repr=False)
class Diagnostics(Result):
    """Diagnostics of model and data. An entry without a result is None or empty.

    ``segment_scatter_g`` is the scatter of the mean rates of the segments, root mean square [g]. ``segment_scatter_ratio`` is it
    divided by what all noise explains; ``..._without_it``: by what the angle's noise explains, if a slow noise is in the model.
    ``residual_kind`` is angle or rate; count of a direct instrument. ``range`` is that in which the calibration holds: ``a_x``,
    ``a_t`` [m/s^2], ``temperature`` [K]. ``samples`` to ``verdict`` are tests of the whitened residual; the verdict is "white",
    or says that it is not, or not tested. ``leverage`` is that of each segment, by label. ``advice`` are other interpretations
    of the data that fit far better. ``missing_terms`` are those that the residuals show, best first. ``creep`` is the likeliest
    after a move, seen or not. ``model_comparison`` is that of :meth:`piga.calibration.ModelComparison.document`.
    """

    segment_scatter_ratio: Level | None = None
    segment_scatter_g: Level | None = None
    segment_scatter_ratio_without_it: Level | None = None
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

    @property
    def worst_scatter(self) -> float:
        """The larger ratio of the scatter; 0 if there is none. It is a doubt above :data:`SCATTER`."""
        return max(self.segment_scatter_ratio or 0.0, self.segment_scatter_ratio_without_it or 0.0)


# -- verdict -------------------------------------------------------------------------------------------

Grade = Literal["clear", "doubt", "do not use"]

COUNTED = "not tested: rounding to whole counts correlates"
"""Verdict on whitened residuals that rounding can correlate. The others are ``white`` and ``not white: ...``."""
_TO_TEST = "sample at another rate, or take other angles or levels"
WELL_SEPARATED, SEPARATED = 1e3, 1e6
"""Largest condition numbers [1] of the column-scaled problem for "well separated" and for "separable" (own choices). The
condition number is the largest amplification of relative errors of the reference."""
_RMS_FROM_ONE = 0.1
"""Largest deviation [1] of the whitened residual's root mean square from 1 without a doubt, in records before 0.3 (own choice)."""
_MOVES = 0.25
"""Share [1] of rows not used above which they could move a coefficient by more than u (95 %): the estimate with all
rows differs from that with a share 1 - q of them by ``sqrt(q) u`` rms, and ``2 sqrt(q) > 1``."""
_CORRELATED = 1.0 / 3.0
"""Correlation [1] of neighbouring whitened residuals above which the variance of their mean is more than twice that of
white noise, ``(1 + r)/(1 - r) > 2``."""
_LARGE_RESIDUAL = 0.01745
"""Root mean square of the residuals [rad] (one degree) above which a fit must explain something (own choice)."""
_EXPLAINS = 0.7071
"""Ratio [1] of the residuals after and before the fit at which it explains half of their variance."""
SCATTER = 2.0
"""Ratio of the scatter of the segments' mean rates to the expected scatter above which it is reported."""
_OPEN = "unstated", "assumed"
EXAMPLES = 3
"""Most effects of sources that are not stated which the verdict names."""


@dataclass(frozen=True)
class Doubt:
    """A doubt and its remedy. If it is ``grave``, the coefficients must not be used as they are; ``noise``: it is about noise."""

    what: str
    remedy: str = ""
    grave: bool = False
    noise: bool = False

    @property
    def words(self) -> str:
        """Doubt and remedy in one sentence."""
        return f"{self.what}: {self.remedy}" if self.remedy else self.what


@dataclass(frozen=True)
class Verdict:
    """Doubts, the gravest first; what was tested, and what was not; the sources of the stand by name.

    A doubt can change a number by more than its uncertainty. ``reason`` is the gravest doubt; without doubts, what the
    uncertainties contain, as ``sources`` says. ``stated`` and ``unstated`` are names of sources of Type B of the stand. A source
    whose size the record bounds counts as stated. A source that is waived is in neither.
    """

    grade: Grade
    reason: str
    sources: str
    doubts: tuple[Doubt, ...]
    tested: tuple[str, ...]
    not_tested: tuple[str, ...]
    stated: tuple[str, ...] = ()
    unstated: tuple[str, ...] = ()

    @property
    def headline(self) -> str:
        """Grade and reason in one sentence."""
        return f"{self.grade.capitalize()}: {self.reason}."

    def document(self) -> dict[str, Any]:
        """The verdict as JSON values."""
        names = ("grade", "reason", "doubts", "tested", "not_tested", "sources")
        values = {name: getattr(self, name) for name in names}
        values["doubts"] = [{"what": doubt.what, "remedy": doubt.remedy} for doubt in self.doubts]
        return values | {"sources_stated": self.stated, "sources_unstated": self.unstated}


def verdict(calibration: Calibration) -> Verdict:
    """The verdict on a calibration. It uses only the record, so it is the same after writing and reading."""
    c, notes = calibration, [Doubt(note) for note in calibration.notes]
    stated = tuple(one.name for one in c.sources if one.status in ("stated", "bounded"))
    unstated = tuple(one.name for status in _OPEN for one in c.sources if one.status == status)
    count = len(stated) + len(unstated)
    contained = f"Type A and {len(stated)} of {count} sources" if count else "no source of the stand is known"
    statements: list[str | Doubt] = [*notes]
    if not c.given:
        first = [*_nominal(c), *_explained(c)]
        remedies = " ".join(item.remedy for item in first if isinstance(item, Doubt))
        statements = [
            *first,
            *_creep(c),
            *(note for note in notes if note.what not in remedies),
            *_whiteness(c),  # after what may be its cause
            *_separation(c),
            *_rows(c),
            *_unstated(c, f"the uncertainties contain {contained}"),
        ]
    doubts = sorted((item for item in statements if isinstance(item, Doubt)), key=lambda doubt: not doubt.grave)
    return Verdict(
        "clear" if not doubts else "do not use" if doubts[0].grave else "doubt",
        doubts[0].what if doubts else f"no doubt in what was tested; {contained}",
        contained,
        tuple(doubts),
        tuple(item for item in statements if isinstance(item, str)),
        ("a record: there is none",) if c.given else tuple(_not_tested(c)),
        stated,
        unstated,
    )


def scale_over_nominal(calibration: Calibration) -> float:
    """Scale factor over the nominal one; 1 where it is not estimated."""
    values = {c.name: c.value for c in calibration.coefficients}
    nominal = calibration.scale_factor_nominal * G0
    return values.get("scale_factor", nominal) / nominal + values.get("k1", 0.0)


def _nominal(calibration: Calibration) -> Iterator[str | Doubt]:
    ratio, tolerance = scale_over_nominal(calibration), calibration.scale_factor_tolerance
    if abs(ratio - 1.0) <= tolerance:
        yield f"K is within {100.0 * tolerance:.3g} % of its nominal value"
        return
    size = f"{ratio:.4g} times" if abs(ratio - 1.0) > 0.5 else f"{100.0 * (ratio - 1.0):+.2g} % off"
    counts = "" if calibration.direct else ", and the counts per revolution"
    check = f"check the nominal value, units and signs of reference, output and time{counts}"
    advice = "; ".join(calibration.diagnostics.advice)
    remedy = advice or f"{check}; or state [model] scale_factor_tolerance"
    yield Doubt(f"the scale factor is {size} the nominal one", remedy, grave=True)


def _explained(calibration: Calibration) -> Iterator[str | Doubt]:
    before, after = calibration.residual_rms_before, calibration.residual_rms
    large = calibration.diagnostics.residual_kind != "angle" or after > _LARGE_RESIDUAL
    if large and after > _EXPLAINS * before:
        what = "the fit leaves more than it explains: the reference and the output do not belong together"
        yield Doubt(what, "check the times, the axes and the segments of both", grave=True)


def _whiteness(calibration: Calibration) -> Iterator[str | Doubt]:
    """Whiteness moves no number where the scatter of the positions gives the intervals: it is said, and is no doubt.

    It is one where the noise within one position gives an interval, that of its own phase, and correlation doubles its variance.
    """
    tests, chance = calibration.diagnostics, calibration.diagnostics.ljung_box_probability
    if tests.verdict is None or chance is None or tests.variance is None or math.isnan(tests.variance):
        return
    tested = f"(Ljung-Box, {'p < 1e-300' if chance < 1e-300 else f'p = {chance:.2g}'})"
    modelled = calibration.provenance.software.startswith(
        ("piga 0.1", "piga 0.2")
    )  # intervals by a model of the noise
    within = modelled or any(c.segment is not None for c in calibration.coefficients)
    neighbours = abs(tests.lag1_correlation or 0.0)
    lines = "" if calibration.direct else "lines in the residuals by revolution order, and for "
    what, remedy = f"the whitened residuals are not white {tested}", f"look for {lines}suggested terms"
    if tests.verdict == COUNTED:
        what = f"the whitened residuals correlate {tested}, as rounding to whole counts can make them"
        remedy = _TO_TEST
    if tests.verdict.startswith("white"):
        yield f"the whitened residuals are {tests.verdict} {tested}"
    elif within and neighbours > _CORRELATED:
        size = math.sqrt((1.0 + neighbours) / max(1.0 - neighbours, 1e-3))
        small = f"intervals from the noise within one position are about {size:.2g} times too small"
        yield Doubt(f"{what}: {small}", remedy, noise=True)
    elif tests.verdict != COUNTED:
        yield f"{what}: the intervals come from the scatter of the positions, which contains it; {remedy}"
    rms = math.sqrt(tests.variance)
    if modelled and abs(rms - 1.0) > _RMS_FROM_ONE:
        what = f"the whitened residuals have a root mean square of {rms:.3f} instead of 1"
        remedy = "check the noise levels that were given, and the residuals of single segments"
        yield Doubt(what, remedy, noise=True)


def _creep(calibration: Calibration) -> Iterator[str]:
    creep = calibration.diagnostics.creep
    if creep is not None and not creep.seen:
        yield f"no creep after a move stands out of the scatter of the positions (p = {creep.probability:.2g})"


def _separation(calibration: Calibration) -> Iterator[str | Doubt]:
    """Separation of the coefficients. What it magnifies is in u, or listed by source: only the limit of arithmetic is a doubt."""
    condition = calibration.condition
    shown = f"condition number {condition:.2g}" if math.isfinite(condition) else "condition number infinite"
    remedy = "leave terms out, or add positions, levels or another kind of run"
    if condition <= WELL_SEPARATED:
        yield f"the record separates the coefficients ({shown})"
    elif condition <= SEPARATED:
        contained = "the uncertainties contain this, and so do the effects of the sources; to narrow them"
        yield f"some coefficients are hard to separate ({shown}): {contained} {remedy}"
    else:
        yield Doubt(f"the record hardly separates the coefficients ({shown})", remedy, grave=True)


def _rows(calibration: Calibration) -> Iterator[str | Doubt]:
    lost = calibration.quality.lost
    moved = (
        f": the others would move a coefficient by up to {2.0 * math.sqrt(lost):.2g} u (95 %)" if lost else ""
    )
    what = f"{100.0 * (1.0 - lost):.4g} % of the rows of the positions were used{moved}"
    yield Doubt(what, "see the findings in the data") if lost > _MOVES else what


_STATED_ELSEWHERE = {
    "servo": "add 'servo' to [model] terms, or give [instrument] servo",
    "height": "give the height in [stand]",
    "earth_rate": "give [data] base_rate, or the latitude in [stand]",
}
"""Where a source is stated that is none of [uncertainty]."""


def _unstated(calibration: Calibration, contained: str) -> Iterator[str | Doubt]:
    sources = calibration.sources
    open_ones = [source for source in sources if source.status in _OPEN]
    if open_ones:
        named = ", ".join(map(_open_words, open_ones))
        what = f"{contained}; not stated: {named}{_largest_effects(calibration, open_ones)}"
        example = 'waived = { timing = "clock of the laboratory" }'
        ways = [_STATED_ELSEWHERE[one.name] for one in open_ones if one.name in _STATED_ELSEWHERE]
        ways += ["state the others in [uncertainty]"] if 0 < len(ways) < len(open_ones) else []
        remedy = ", ".join(ways) or "state them in [uncertainty]"
        yield Doubt(what, f"{remedy}, or waive one with a reason: {example}")
    elif calibration.type_a_only and not sources:
        remedy = "state [uncertainty] in the run file (in Python: Run.from_arrays(uncertainty=...))"
        yield Doubt(NO_REFERENCE, remedy)
    elif sources:
        yield f"{contained} of the stand"
    yield from (_open_words(source) for source in sources if source.status == "bounded")
    waived = [f"{source.name} ({source.reason})" for source in sources if source.status == "waived"]
    if waived:
        yield f"waived, not in the uncertainties: {', '.join(waived)}"


def _open_words(source: StandSource) -> str:
    return f"{source.name} ({source.reason})" if source.reason else source.name


def _largest_effects(calibration: Calibration, sources: list[StandSource]) -> str:
    named = {c.key: c for c in calibration.coefficients if c.std > 0.0}
    effects = [
        (abs(change) / c.std, f"1 {source.unit} of {component} changes {key} by {change:.2g} {c.unit}")
        for source in sources
        for component, changes in source.effects.items()
        for key, change in changes.items()
        if source.status == "unstated" and (c := named.get(key))
    ]
    effects.sort(key=lambda effect: -effect[0])
    words = "; ".join(f"{text.removesuffix(' 1')}, {size:.2g} u" for size, text in effects[:EXAMPLES])
    return f". {words}".replace("e-0", "e-") if words else ""


def _not_tested(calibration: Calibration) -> Iterator[str]:
    yield "a change of the bias as slow as the test, and the bias of another day"
    yield "an error of the stand that is the same at each visit of a position: only stated sources contain it"
    if calibration.diagnostics.creep is None:
        yield "a creep after each move"
    if calibration.diagnostics.verdict is None:
        yield "the whiteness of the residuals"
    if calibration.diagnostics.verdict == COUNTED:
        yield f"the whiteness of the residuals: rounding to whole counts can correlate them. To test it, {_TO_TEST}"
