"""What a finished calibration says about model and data: leverage, missing terms, data read wrongly.

One cause gets one remark: data that fit far better when read otherwise look as if terms were missing, and a
missing term moves single segments. So advice on the data holds back the suggestions of terms, and both hold
back the remarks on segments that move a coefficient. Nothing is ever applied. All are found without a slow noise,
which joins the segments or takes up what a missing term leaves; a suggestion then says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from piga.calibration.fit.one_run import Fit
from piga.calibration.model.coefficients import name_coefficients
from piga.calibration.model.solution import solve
from piga.calibration.noise.weighting import reduce_segments
from piga.calibration.remarks.advice import advise, looks_wrong
from piga.calibration.remarks.left_out import CUBIC_SOURCE, DAMPING_SOURCE, LeftOut
from piga.calibration.remarks.leverage import find_leverage
from piga.calibration.remarks.missing_terms import suggest_terms, suggestions_in_words
from piga.records.calibration import Calibration, Coefficient


@dataclass(frozen=True)
class Remarks:
    """Diagnostics of leverage, its remarks on single segments and on moved coefficients, and terms suggested."""

    diagnostics: dict[str, Any]
    alone: tuple[str, ...]
    moved: tuple[str, ...]
    missing: tuple[dict[str, Any], ...]


def find_remarks(
    fit: Fit, groups: tuple[int, ...], per_segment: bool, coefficients: tuple[Coefficient, ...]
) -> Remarks:
    """What the fit behind a result says: it needs neither its residuals nor the rest of it.

    Parameters
    ----------
    fit, groups, per_segment:
        The fit, the phase group of every segment, and whether each has its own.
    coefficients:
        Those of the result, with combined standard uncertainties.
    """
    slow = fit.noise.slow > 0.0
    plain = without_slow(fit, groups)
    known = _known_without_slow(fit, plain, per_segment, coefficients) if slow else coefficients
    found, alone, moved = find_leverage(plain, groups, per_segment, known, slow)
    _in_reported_uncertainties(found, known, coefficients)
    return Remarks(found, alone, moved, suggest_terms(plain, groups, per_segment, coefficients))


def _in_reported_uncertainties(
    found: dict[str, Any], known: tuple[Coefficient, ...], coefficients: tuple[Coefficient, ...]
) -> None:
    """The shifts of the table in units of the standard uncertainties that are reported."""
    for row in found.get("leverage", {}).values():
        for one, reported in zip(known, coefficients, strict=True):
            if one.segment is None and row["shift"].get(one.name) is not None and one.std != reported.std:
                row["shift"][one.name] *= one.std / reported.std


def with_remarks(
    result: Calibration, fit: Fit, remarks: Remarks, doubts: tuple[LeftOut, ...] = ()
) -> Calibration:
    """The result with ``leverage``, ``missing_terms`` and ``advice`` among its diagnostics and in its notes.

    What the servo leaves is said by the suggestion of its term, or in words of its own.
    """
    advice = advise(fit.design.run, fit.design.request) if looks_wrong(result) else ()
    missing = () if advice else remarks.missing
    found = dict(remarks.diagnostics)
    if advice:
        found |= {"advice": list(advice)}
    if missing:
        found |= {"missing_terms": list(missing)}
    slow = "bias drift" if fit.noise.drift > 0.0 else "scatter of the segments"
    also = f"; the {slow} found may be the same effect" if fit.noise.slow > 0.0 else ""
    sources = [doubt.source for doubt in doubts]
    words = suggestions_in_words(missing, held=CUBIC_SOURCE in sources, turned=DAMPING_SOURCE in sources)
    said = {CUBIC_SOURCE} if any("scale_factor_under" in entry for entry in missing) else set()
    said |= {DAMPING_SOURCE} if any(entry["terms"] == ["servo_damping"] for entry in missing) else set()
    suggested = (
        *(sentence + also for sentence in words),
        *(doubt.words for doubt in doubts if doubt.words and doubt.source not in said),
    )
    cause = (*advice, *suggested) or remarks.moved
    return replace(
        result, notes=(*cause, *result.notes, *remarks.alone), diagnostics=result.diagnostics | found
    )


def without_slow(fit: Fit, groups: tuple[int, ...]) -> Fit:
    """The fit by the weights of white noise and random walk, one summary per segment."""
    if fit.noise.slow == 0.0:
        return fit
    noise = fit.noise.without_slow()
    if fit.slow_part is not None:
        return replace(fit, noise=noise, covariance=fit.solution.covariance)
    summaries = reduce_segments(fit.design, fit.mode, noise)
    solution = solve(fit.design, summaries, groups)
    return replace(fit, noise=noise, summaries=summaries, solution=solution, covariance=solution.covariance)


def _known_without_slow(
    fit: Fit, plain: Fit, per_segment: bool, coefficients: tuple[Coefficient, ...]
) -> tuple[Coefficient, ...]:
    """Coefficients with the standard uncertainties that they would have without a slow noise."""
    named = [
        np.diag(name_coefficients(one.design, one.solution, one.covariance, per_segment)[1])
        for one in (fit, plain)
    ]
    return tuple(
        replace(c, std=math.sqrt(max(c.std**2 - noisy + quiet, quiet)))
        for c, noisy, quiet in zip(coefficients, *named, strict=True)
    )
