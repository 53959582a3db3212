"""The verdict on a calibration: a grade, one reason, the doubts, what was tested and what was not.

Every page, terminal, file and warning shows this verdict. No other code judges a calibration as a whole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from piga.records.calibration.coefficient import NO_REFERENCE, StandSource
from piga.units import G0

if TYPE_CHECKING:
    from piga.records.calibration.calibration import Calibration

Grade = Literal["clear", "doubt", "do not use"]

COUNTED = "not tested: rounding to whole counts correlates"
"""Verdict on whitened residuals that rounding can correlate. The others are ``white`` and ``not white: ...``."""
_TO_TEST = "sample at another rate, or take other angles or levels"


WELL_SEPARATED, SEPARATED = 1e3, 1e6
"""Largest condition numbers [1] of the column-scaled problem for "well separated" and for "separable" (own choices). The
condition number is the largest amplification of relative errors of the reference."""
_RMS_FROM_ONE = 0.1
"""Largest deviation [1] of the whitened residual's root mean square from 1 that is called "of size one" (own choice)."""
_USED = 0.95
"""Least share [1] of used rows that is not mentioned as small (own choice)."""
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
_NOISE_WORDS = ("drift", "scatter", "not white")
"""A doubt with one of these words warns of the noise of the record."""
EXAMPLES = 3
"""Most effects of sources that are not stated which the verdict names."""


@dataclass(frozen=True)
class Doubt:
    """A doubt and its remedy. If it is ``grave``, the coefficients must not be used as they are."""

    what: str
    remedy: str = ""
    grave: bool = False

    @property
    def words(self) -> str:
        """Doubt and remedy in one sentence."""
        return f"{self.what}: {self.remedy}" if self.remedy else self.what


@dataclass(frozen=True)
class Verdict:
    """Doubts, the gravest first; what was tested, and what was not; the sources of the stand by name.

    A doubt can change a number by more than its uncertainty. ``stated`` and ``unstated`` are names of sources of Type
    B of the stand. A source whose size the record bounds counts as stated. A source that is waived is in neither.
    """

    doubts: tuple[Doubt, ...] = ()
    tested: tuple[str, ...] = ()
    not_tested: tuple[str, ...] = ()
    stated: tuple[str, ...] = ()
    unstated: tuple[str, ...] = ()

    @property
    def grade(self) -> Grade:
        """``clear`` without doubts, ``do not use`` with a grave doubt, else ``doubt``."""
        if any(doubt.grave for doubt in self.doubts):
            return "do not use"
        return "doubt" if self.doubts else "clear"

    @property
    def reason(self) -> str:
        """The reason of the grade: the gravest doubt; without doubts, what the uncertainties contain."""
        return self.doubts[0].what if self.doubts else f"no doubt in what was tested; {self.sources}"

    @property
    def sources(self) -> str:
        """What the uncertainties contain: ``Type A and 1 of 9 sources``."""
        known = len(self.stated) + len(self.unstated)
        return (
            f"Type A and {len(self.stated)} of {known} sources" if known else "no source of the stand is known"
        )

    @property
    def warns_of_noise(self) -> bool:
        """True if a doubt is about the noise of the record."""
        return any(word in doubt.what for doubt in self.doubts for word in _NOISE_WORDS)

    @property
    def headline(self) -> str:
        """Grade and reason in one sentence."""
        return f"{self.grade.capitalize()}: {self.reason}."

    def document(self) -> dict[str, Any]:
        """The verdict as JSON values."""
        return {
            "grade": self.grade,
            "reason": self.reason,
            "doubts": [{"what": doubt.what, "remedy": doubt.remedy} for doubt in self.doubts],
            "tested": self.tested,
            "not_tested": self.not_tested,
            "sources": self.sources,
            "sources_stated": self.stated,
            "sources_unstated": self.unstated,
        }


def verdict(calibration: Calibration) -> Verdict:
    """The verdict on a calibration. It uses only the record, so it is the same after writing and reading."""
    notes = tuple(Doubt(note) for note in calibration.notes)
    if calibration.given:
        return Verdict(notes, not_tested=("a record: there is none",))

    def names(*statuses: str) -> tuple[str, ...]:
        return tuple(one.name for status in statuses for one in calibration.sources if one.status == status)

    untested, stated = tuple(_not_tested(calibration)), names("stated", "bounded")
    judged = Verdict(not_tested=untested, stated=stated, unstated=names(*_OPEN))
    first = [*_nominal(calibration), *_explained(calibration)]
    remedies = " ".join(item.remedy for item in first if isinstance(item, Doubt))
    statements = [
        *first,
        *_creep(calibration),
        *(note for note in notes if note.what not in remedies),
        *_whiteness(calibration),  # after what may be its cause
        *_separation(calibration),
        *_rows(calibration),
        *_unstated(calibration, f"the uncertainties contain {judged.sources}"),
    ]
    doubts = sorted((item for item in statements if isinstance(item, Doubt)), key=lambda doubt: not doubt.grave)
    tested = tuple(item for item in statements if isinstance(item, str))
    return replace(judged, doubts=tuple(doubts), tested=tested)


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
        yield Doubt(
            "the fit leaves more than it explains: the reference and the output do not belong together",
            "check the times, the axes and the segments of both",
            grave=True,
        )


def _whiteness(calibration: Calibration) -> Iterator[str | Doubt]:
    """Whiteness moves no number where the scatter of the positions gives the intervals: it is said, and is no doubt.

    It is one where the noise within one position gives an interval, that of its own phase, and correlation doubles its variance.
    """
    tests, variance = calibration.diagnostics, calibration.diagnostics.variance
    if tests.verdict is None or tests.ljung_box_probability is None or variance is None or math.isnan(variance):
        return
    chance, neighbours, rms = tests.ljung_box_probability, tests.lag1_correlation or 0.0, math.sqrt(variance)
    tested = f"(Ljung-Box, {'p < 1e-300' if chance < 1e-300 else f'p = {chance:.2g}'})"
    contained = "the intervals come from the scatter of the positions, which contains it"
    within = not _by_positions(calibration) or any(c.segment is not None for c in calibration.coefficients)
    if tests.verdict.startswith("white"):
        yield f"the whitened residuals are {tests.verdict} {tested}"
    else:
        what, remedy = f"the whitened residuals are not white {tested}", "look for suggested terms"
        if tests.verdict == COUNTED:
            what = f"the whitened residuals correlate {tested}, as rounding to whole counts can make them"
            remedy = _TO_TEST
        elif not calibration.direct:
            remedy = "look for lines in the residuals by revolution order, and for suggested terms"
        if within and abs(neighbours) > _CORRELATED:
            size = math.sqrt((1.0 + abs(neighbours)) / max(1.0 - abs(neighbours), 1e-3))
            small = f"intervals from the noise within one position are about {size:.2g} times too small"
            yield Doubt(f"{what}: {small}", remedy)
        elif tests.verdict != COUNTED:
            yield f"{what}: {contained}; {remedy}"
    size_words = f"the whitened residuals have a root mean square of {rms:.3f} instead of 1"
    if abs(rms - 1.0) <= _RMS_FROM_ONE:
        yield f"the whitened residuals are of size one ({rms:.3f})"
    elif _by_positions(calibration):
        yield f"{size_words}: {contained}"
    else:
        yield Doubt(size_words, "check the noise levels that were given, and the residuals of single segments")


def _by_positions(calibration: Calibration) -> bool:
    """True if the intervals come from the scatter of the positions: since version 0.3."""
    return not calibration.provenance.software.startswith(("piga 0.1", "piga 0.2"))


def _creep(calibration: Calibration) -> Iterator[str]:
    creep = calibration.diagnostics.creep
    if creep is not None and not creep.seen:
        yield f"no creep after a move stands out of the scatter of the positions (p = {creep.probability:.2g})"


def _separation(calibration: Calibration) -> Iterator[str | Doubt]:
    """Separation of the coefficients. What it magnifies is in u, or listed by source: only the limit of arithmetic is a doubt."""
    condition = calibration.condition
    shown = f"{condition:.2g}" if math.isfinite(condition) else "infinite"
    if condition <= WELL_SEPARATED:
        yield f"the record separates the coefficients (condition number {shown})"
    elif condition <= SEPARATED:
        yield (
            f"some coefficients are hard to separate (condition number {shown}): the uncertainties contain this, and so do "
            "the effects of the sources; to narrow them leave terms out, or add positions, levels or another kind of run"
        )
    else:
        yield Doubt(
            f"the record hardly separates the coefficients (condition number {shown})",
            "leave terms out, or add positions, levels or another kind of run",
            grave=True,
        )


def _rows(calibration: Calibration) -> Iterator[str | Doubt]:
    lost = calibration.quality.lost
    if lost <= 1.0 - _USED:
        share = "all" if lost == 0.0 else f"{100.0 * (1.0 - lost):.4g} % of the"
        yield f"{share} rows of the positions were used"
        return
    moved = f"the others would move a coefficient by up to {2.0 * math.sqrt(lost):.2g} u (95 %)"
    what = f"only {100.0 * (1.0 - lost):.3g} % of the rows were used: {moved}"
    yield Doubt(what, "see the findings in the data") if lost > _MOVES else what


_OPEN = "unstated", "assumed"


def _unstated(calibration: Calibration, contained: str) -> Iterator[str | Doubt]:
    sources = calibration.sources
    open_ones = [source for source in sources if source.status in _OPEN]
    if open_ones:
        named = ", ".join(map(_open_words, open_ones))
        what = f"{contained}; not stated: {named}{_largest_effects(calibration, open_ones)}"
        example = 'waived = { timing = "clock of the laboratory" }'
        yield Doubt(what, f"state them in [uncertainty], or waive one with a reason: {example}")
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
    words = [
        f"{text.removesuffix(' 1').replace('e-0', 'e-')}, {size:.2g} u" for size, text in effects[:EXAMPLES]
    ]
    return f". {'; '.join(words)}" if words else ""


def _not_tested(calibration: Calibration) -> Iterator[str]:
    yield "a change of the bias as slow as the test, and the bias of another day"
    yield "an error of the stand that is the same at each visit of a position: only stated sources contain it"
    if calibration.diagnostics.creep is None:
        yield "a creep after each move"
    if calibration.diagnostics.verdict is None:
        yield "the whiteness of the residuals"
    if calibration.diagnostics.verdict == COUNTED:
        yield f"the whiteness of the residuals: rounding to whole counts can correlate them. To test it, {_TO_TEST}"
