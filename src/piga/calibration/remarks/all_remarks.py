"""Remarks on a finished calibration: leverage, missing terms, data read wrongly.

A remark that can move a coefficient by more than u is a doubt (``notes``); the others are ``remarks``.

One cause gets one remark. Data that were read wrongly look as if terms were missing, and a missing term affects single
segments. Advice on the data therefore suppresses suggestions of terms, and both suppress remarks on segments that
move a coefficient. Remarks change no result. All remarks use a fit without slow noise, because slow noise joins the segments
and absorbs the signature of a missing term. A suggestion states this.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from itertools import accumulate

from piga.calibration.fit import Fit
from piga.calibration.model.solution import variances_of
from piga.calibration.remarks.advice import advise, looks_wrong
from piga.calibration.remarks.left_out import CUBIC_SOURCE, DAMPING_SOURCE, LeftOut
from piga.calibration.remarks.leverage import find_leverage
from piga.calibration.remarks.missing_terms import Candidates, suggest_terms, suggestions_in_words
from piga.records.calibration import Calibration, Coefficient
from piga.records.calibration.verdict import scale_over_nominal


def with_remarks(
    result: Calibration, fit: Fit, candidates: Candidates, doubts: tuple[LeftOut, ...]
) -> Calibration:
    """The result with ``leverage``, ``missing_terms`` and ``advice`` in its diagnostics and in its notes.

    ``candidates`` are those of the fit without slow noise. A signature of the servo is reported by the suggestion of its term or
    by a sentence of its own.
    """
    plain, slow, coefficients = candidates.fit, fit.noise.scatter > 0.0, result.coefficients
    quiet = _known_without_slow(fit, plain, coefficients) if slow else coefficients
    leverage, alone, moved = find_leverage(plain, quiet, slow, {c.name: c.std for c in coefficients})
    scale = scale_over_nominal(result)
    advice = advise(fit.design.run, fit.design.request, scale) if looks_wrong(result) else ()
    missing = () if advice else suggest_terms(candidates, coefficients)
    diagnostics = replace(result.diagnostics, leverage=leverage, advice=advice, missing_terms=missing)
    also = "; the scatter of the segments may be the same effect" if slow else ""
    sources = [doubt.source for doubt in doubts]
    words = suggestions_in_words(missing, held=CUBIC_SOURCE in sources, turned=DAMPING_SOURCE in sources)
    said = {CUBIC_SOURCE} if any(entry.scale_factor_under for entry in missing) else set()
    said |= {DAMPING_SOURCE} if any(entry.terms == ("servo_damping",) for entry in missing) else set()
    # a clearer signature is told with the weaker one that moves a coefficient: they may have one cause
    shifts = list(accumulate(reversed([entry.largest_shift for entry in missing]), max))[::-1]
    suggested = (
        *((shift, sentence + also) for shift, sentence in zip(shifts, words, strict=True)),
        *(
            (doubt.largest_shift(coefficients), doubt.words)
            for doubt in doubts
            if doubt.words and doubt.source not in said
        ),
    )
    cause = (*((math.inf, words) for words in advice), *suggested) or moved
    result = replace(result, remarks=(*alone, *result.remarks), diagnostics=diagnostics)
    return with_sentences(result, cause)


def with_sentences(result: Calibration, sentences: Iterable[tuple[float, str]]) -> Calibration:
    """The result with sentences: a doubt if the shift before it is above one standard uncertainty, else a remark."""
    said = list(sentences)
    doubts = [words for shift, words in said if shift > 1.0]
    remarks = [words for shift, words in said if not shift > 1.0]
    return replace(result, notes=(*doubts, *result.notes), remarks=(*remarks, *result.remarks))


def _known_without_slow(fit: Fit, plain: Fit, coefficients: tuple[Coefficient, ...]) -> tuple[Coefficient, ...]:
    """Coefficients with standard uncertainties without slow noise."""
    named = [variances_of(one.design, one.solution, one.solution.covariance) for one in (fit, plain)]
    return tuple(
        replace(c, std=math.sqrt(max(c.std**2 - noisy + quiet, quiet)))
        for c, noisy, quiet in zip(coefficients, *named, strict=True)
    )
