"""The verdict on a calibration: what holds, what does not, and what to do.

Report page, terminal, ``repr``, calibration.json, the certificate's working copy and the warnings of
:func:`piga.calibrate` all show this verdict. No other code judges a calibration as a whole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from piga.records.calibration.coefficient import TYPE_A_ONLY
from piga.units import G0

if TYPE_CHECKING:
    from piga.records.calibration import Calibration

Level = Literal["good", "doubtful", "bad"]

COUNTED = "white but for the counting"
"""Verdict on whitened residuals whose correlation comes from counting. The others are ``white`` and ``not white: ...``."""


@dataclass(frozen=True)
class Thresholds:
    """Limits beyond which a figure of a calibration becomes a doubt.

    Attributes
    ----------
    well_separated, separated:
        Largest condition numbers [1] of the column-scaled problem for "well separated" and for "separable".
        The condition number is the largest amplification of relative errors of the reference.
    residual_rms:
        Largest deviation [1] of the whitened residual's root mean square from 1. Standard uncertainties are wrong by
        the same ratio as the noise levels.
    used:
        Least share [1] of used rows. A smaller share gives a remark.
    scale:
        Ratio [1] of the estimated to the nominal scale factor (or its inverse) above which data or units are wrong.
    """

    well_separated: float = 1e3
    separated: float = 1e6
    residual_rms: float = 0.1
    used: float = 0.95
    scale: float = 2.0


THRESHOLDS = Thresholds()

NOISE_WORDS = ("drift", "scatter", "not white")
"""A doubt with one of these words warns of the noise of the record."""


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
    """What holds of a calibration, and its doubts, the gravest first."""

    holds: tuple[str, ...]
    doubts: tuple[Doubt, ...]

    @property
    def level(self) -> Level:
        """Level of the verdict: ``good`` without doubts, ``bad`` with a grave doubt."""
        if any(doubt.grave for doubt in self.doubts):
            return "bad"
        return "doubtful" if self.doubts else "good"

    @property
    def warns_of_noise(self) -> bool:
        """True if a doubt is about the noise of the record."""
        return any(word in doubt.what for doubt in self.doubts for word in NOISE_WORDS)

    @property
    def headline(self) -> str:
        """The verdict in one sentence."""
        count = len(self.doubts)
        return {
            "good": "Every test that was made holds.",
            "doubtful": f"Use with care: {count} doubt{'s' * (count > 1)}.",
            "bad": "Do not use these coefficients before this is settled.",
        }[self.level]

    def lines(self) -> list[str]:
        """The verdict for a terminal: headline, doubts with remedies, what holds."""
        doubts = [f"  does not hold: {doubt.words}" for doubt in self.doubts]
        return [f"verdict: {self.headline}", *doubts, *(f"  holds: {what}" for what in self.holds)]


def verdict(calibration: Calibration) -> Verdict:
    """The verdict on a calibration. It uses only the record, so it is the same after writing and reading."""
    if calibration.given:
        return Verdict((), tuple(Doubt(note) for note in calibration.notes))
    statements = [
        *_scale(calibration),
        *_whiteness(calibration),
        *_separation(calibration),
        *_budget(calibration),
        *_rows(calibration),
    ]
    said = " ".join(item.remedy for item in statements if isinstance(item, Doubt))
    statements += [Doubt(note) for note in calibration.notes if note not in said]
    doubts = [item for item in statements if isinstance(item, Doubt)]
    doubts.sort(key=lambda doubt: not doubt.grave)
    return Verdict(tuple(item for item in statements if isinstance(item, str)), tuple(doubts))


def whitened_rms(calibration: Calibration) -> float:
    """Root mean square of the whitened residual: 1 if model and noise levels are right, nan if unknown."""
    variance = calibration.diagnostics.variance
    return math.sqrt(math.nan if variance is None else variance)


def _scale(calibration: Calibration) -> Iterator[str | Doubt]:
    values = {c.name: c.value for c in calibration.coefficients}
    nominal = calibration.scale_factor_nominal * G0
    ratio = values.get("scale_factor", nominal) / nominal + values.get("k1", 0.0)
    if 1.0 / THRESHOLDS.scale < ratio < THRESHOLDS.scale:
        return
    remedy = (
        "; ".join(calibration.diagnostics.advice)
        or "check units and signs of reference, output, time and scale_factor"
    )
    yield Doubt(f"the scale factor is {ratio:.4g} times the nominal one", remedy, grave=True)


def _whiteness(calibration: Calibration) -> Iterator[str | Doubt]:
    tests, rms = calibration.diagnostics, whitened_rms(calibration)
    if tests.verdict is None or tests.ljung_box_probability is None or math.isnan(rms):
        return
    chance = tests.ljung_box_probability
    shown = "p < 1e-300" if chance < 1e-300 else f"p = {chance:.2g}"
    counted = tests.verdict == COUNTED
    if tests.verdict != "white" and not counted:
        yield Doubt(
            f"the whitened residuals are not white (Ljung-Box, {shown}): the model or the noise "
            "description is incomplete; the intervals come from the scatter of the positions",
            "look for lines in the residuals by revolution order, and for suggested terms",
        )
    if abs(rms - 1.0) > THRESHOLDS.residual_rms:
        yield Doubt(
            f"the whitened residuals have a root mean square of {rms:.3f} instead of 1",
            "check the noise levels that were given, and the residuals of single segments",
        )
    elif counted:
        yield (
            f"the whitened residuals correlate as whole counts make them, and no further (p = "
            f"{tests.counting_probability:.2g}), and are of size one ({rms:.3f})"
        )
    elif tests.verdict == "white":
        yield f"the whitened residuals are white (Ljung-Box, {shown}) and of size one ({rms:.3f})"


def _separation(calibration: Calibration) -> Iterator[str | Doubt]:
    condition = calibration.condition
    shown = f"{condition:.2g}" if math.isfinite(condition) else "infinite"
    if condition <= THRESHOLDS.well_separated:
        yield f"the record separates the coefficients (condition number {shown})"
    elif condition <= THRESHOLDS.separated:
        yield Doubt(
            f"some coefficients are hard to separate (condition number {shown}): errors of the reference are "
            "magnified",
            "leave terms out, or add positions, levels or another kind of run",
        )
    else:
        yield Doubt(
            f"the record hardly separates the coefficients (condition number {shown})",
            "leave terms out, or add positions, levels or another kind of run",
            grave=True,
        )


def _budget(calibration: Calibration) -> Iterator[str | Doubt]:
    if calibration.type_a_only:
        yield Doubt(
            TYPE_A_ONLY, "state [uncertainty] in the run file (in Python: Run.from_arrays(uncertainty=...))"
        )
        return
    count = sum(row.type == "B" for row in calibration.budget)
    yield f"the uncertainties hold the fit and {count} source{'s' * (count > 1)} of Type B"


def _rows(calibration: Calibration) -> Iterator[str | Doubt]:
    quality = calibration.quality
    share = quality.used / quality.rows if quality.rows else 1.0
    if share < THRESHOLDS.used:
        yield Doubt(f"only {100.0 * share:.3g} % of the rows were used", "see the findings in the data")
    else:
        yield f"{'all' if share == 1.0 else f'{100.0 * share:.4g} % of the'} rows were used"
