"""Figures in sentences of the theory: each is the setting that the program uses, or what a formula of the page gives."""

from __future__ import annotations

import json
import math
import re

import pytest
from scipy.stats import binomtest, norm

from piga.calibration.budget.monte_carlo import MONTE_CARLO
from piga.calibration.classical.revolutions import REVOLUTIONS
from piga.calibration.fit.outliers import OUTLIERS
from piga.calibration.fit.residuals import WHITENESS
from piga.calibration.fit.servo import SERVO_FIT
from piga.calibration.model.design import DESIGN
from piga.calibration.noise.settings import NOISE
from piga.calibration.remarks.advice import ADVICE
from piga.calibration.remarks.leverage import LEVERAGE
from piga.calibration.remarks.missing_terms import CANDIDATES
from piga.calibration.remarks.slow_changes import TEMPERATURE
from piga.units import G0

from .pages import DOCS

WORDS = {2: "two", 3: "three", 4: "four", 6: "six", 9: "nine"}


def word(number: float) -> str:
    return WORDS[int(number)] if number == int(number) else f"{number:g}"


def spaced(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def seen_from() -> float:
    """Size of a signature, in standard deviations, that a two-sided test of 1 % sees with 95 %."""
    return float(norm.isf(0.005) + norm.isf(0.05))


def pulled(amplification: float) -> float:
    """a/b at which pulling amplifies the scatter of a turn so much: {eq}`calibration-pulled`."""
    return math.sqrt((amplification + 0.5) / (amplification - 1.0))


def servo_term() -> float:
    """``s g^2`` of the instrument of the page."""
    K, H, k_i = 0.8884 / G0, 0.1, 3000.0
    return K * (K * H) / (2.0 * k_i) * G0**2


CALIBRATION = {
    "walk in the weights": f"gains less than {NOISE.walk_in_weights:g} in twice the log-likelihood",
    "restricted likelihood": f"computed at {word(len(NOISE.information_ratios))} points",
    "long records": f"Records above {spaced(NOISE.restricted_rows)} increments do without it",
    "no faint walk": f"None is assumed in records above {spaced(NOISE.restricted_rows)} increments",
    "least of a faint walk": f"At least {NOISE.faint_least:g} of the variance by white noise",
    "draws": f"There are {WHITENESS.draws} draws",
    "correlations": f"the {WHITENESS.lags} correlations lie outside those of the draws",
    "drawn rows": f"The draws take the first {spaced(WHITENESS.drawn_rows)} rows",
    "coarse counting": f"below {NOISE.counting_white:g} c²",
    "passes": f"In the first {word(NOISE.counting_trusted)} passes",
    "long counted records": f"In records of more than {spaced(NOISE.counting_long)} rows",
    "contrasts": f"in {NOISE.white_contrasts} or more contrasts",
    "even contrasts": f"white noise of the same variance to {100 * NOISE.white_even:.0f} %",
    "no drift": f"- below {NOISE.slow_in_covariance:g}: no drift",
    "drift in the covariance": f"- from {NOISE.slow_in_covariance:g} to {NOISE.slow_in_weights:g}: the drift",
    "drift in the weights": f"- above {NOISE.slow_in_weights:g}: the fit is weighted",
    "search of a scatter": f"with {NOISE.fewest_segments} to {NOISE.most_segments} segments",
    "values of the scatter": f"leave {word(NOISE.slow_enough)} or more values of the scatter",
    "Monte Carlo": f"tan_beta is below {word(MONTE_CARLO.doubtful)} of its standard uncertainties",
    "good samples left out": f"set for {OUTLIERS.false_alarms:g} good samples left out",
    "limit": f"({norm.isf(0.5 * OUTLIERS.false_alarms / 1e6):.2f} standard deviations for a million samples)",
    "bad increments": f"{100 * (1 - (1 - 0.2) ** 2):.0f} % of the increments) bad",
    "moved counts": f"less than {word(OUTLIERS.moved_counts)} counts in half of the increments",
    "least counts": f"by more than {OUTLIERS.least_counts:g} counts",
    "a slip": f"A slip must gain {OUTLIERS.slip_cost:g} of chi-square",
    "wrong readings": f"gain {OUTLIERS.wrong_cost:g} times their share of the stretch",
    "longer side": {0.25: "the longer side wins beyond three quarters"}[
        OUTLIERS.slip_cost / OUTLIERS.wrong_cost
    ],
    "judged": f"With more than {OUTLIERS.judged} stretches that hold jumps",
    "bad samples": f"more than {100 * OUTLIERS.largest_share:.0f} % bad samples is refused",
    "phases tried": f"the best of {SERVO_FIT.scan} phases",
    "phase held": f"below {word(SERVO_FIT.seen)} of its uncertainties",
    "servo told": f"leave less than {SERVO_FIT.separate:.0e} of it".replace("e-0", "e-"),
    "candidate told": f"leaves at least {CANDIDATES.confounded:.0e} of its column".replace("e-0", "e-"),
    "alarms": f"at {100 * CANDIDATES.false_alarms:g} % over the number of candidates",
    "parts": f"({CANDIDATES.pieces} parts, where segments are few)",
    "notable": f"sum of squares by over {100 * CANDIDATES.notable:g} %",
    "suggestions": f"at most {word(CANDIDATES.suggestions)} times",
    "joined rows": f"about {DESIGN.joined_rows} rows, as long as the output turns by less than {DESIGN.joined_turn:g} rad",
    "seen signature": f"`{norm.isf(0.005):.2f} + {norm.isf(0.05):.2f} = {seen_from():.2f}`",
    "ratio": f"where `r < {1 / seen_from():.3f}`",
    "larger u": f"by less than {100 * (math.hypot(1, 1 / seen_from()) - 1):.1f} %",
    "bound": f"{norm.ppf(TEMPERATURE.confidence):.2f} u_g` with {100 * TEMPERATURE.confidence:.0f} %",
    "end of the bound": f"The bound ends at {1e6 * TEMPERATURE.bias:.0f} micro-g/K",
    "share": f"A share above {100 * LEVERAGE.determines:.0f} %",
    "influential": f"by more than {word(LEVERAGE.influential)} standard uncertainties",
    "unlikely": f"more than {LEVERAGE.unlikely:g} standard deviations of the change",
    "off": f"within a factor of {word(ADVICE.off)} of the nominal one",
    "samples": f"at most {ADVICE.samples} samples",
    "far better": f"its residual is {word(ADVICE.far_better)} times smaller",
    "as good": f"Readings within {100 * (ADVICE.as_good - 1):.0f} % of it",
    "snap": f"within {100 * ADVICE.snap:.0f} % of a factor of units",
    "parts of a turn": f"passes {REVOLUTIONS.phases} parts of a turn",
    "clear coupling": f"{word(REVOLUTIONS.clear)} standard uncertainties",
    "near lock": f"above {REVOLUTIONS.locking:g} (a/b below {pulled(REVOLUTIONS.locking):.2f})",
}


@pytest.mark.parametrize("sentence", CALIBRATION.values(), ids=CALIBRATION.keys())
def test_calibration(sentence: str) -> None:
    assert sentence in text("calibration")


def test_servo() -> None:
    assert f"by `s g²`: {1e6 * servo_term():.0f} ppm for the instrument above" in text("servo")


def test_the_servo_body_is_as_near_as_the_page_says() -> None:
    """The measured fall of the mean rate against ``s a_t^2``: to 1e-4 of it, and to the digits of the table."""
    for figure in measured("servo-body"):
        across = math.sin(math.radians(float(figure["column"].split()[0])))
        assert figure["value"] == pytest.approx(-1e6 * servo_term() * across**2, rel=1e-4, abs=5e-5)
    assert "is right to 1e-4 of the change" in text("servo")


def test_mutation() -> None:
    sample = [one for one in measured("mutation") if "version" not in one]  # those of the page: 0.1.0
    noticed, of = (
        int(sum(one["value"] for one in sample if one["column"] == name)) for name in ("noticed", "of")
    )
    interval = binomtest(noticed, of).proportion_ci(0.95, method="wilson")
    words = re.sub(r"\s+", " ", (DOCS / "quality.md").read_text(encoding="utf-8"))
    share = f"{noticed} were noticed: {100 * noticed / of:.0f} %"
    assert f"{share}, with a 95 % interval of {100 * interval.low:.0f} to {100 * interval.high:.0f} %" in words
    assert f"all numerics: {of} mutants" in words
    assert f"of the {of - noticed} survivors" in words


def measured(name: str) -> list[dict]:
    return json.loads((DOCS / "measured" / f"{name}.json").read_text(encoding="utf-8"))["figures"]


def text(page: str) -> str:
    """A page of the theory with one blank between its words."""
    return re.sub(r"\s+", " ", (DOCS / "theory" / f"{page}.md").read_text(encoding="utf-8"))
