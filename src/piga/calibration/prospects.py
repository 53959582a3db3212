"""Which terms a record can separate, before it is calibrated with them.

Every known term is added to the terms asked for. The estimator then says whether the record determines it. All these sets
share one reduction of the record, as in the comparison of models.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from piga.calibration.model.request import make_request
from piga.calibration.model_choice import TermSet, UnionReduction, union_of
from piga.records.run import Run
from piga.records.terms import (
    SERVO_TERMS,
    UNITS,
    check_terms,
    harmonic,
    shown_unit,
    term_names,
    turns,
    unit_of,
)
from piga.threads import one_thread


@dataclass(frozen=True)
class TermProspect:
    """What a record can say about one term.

    Attributes
    ----------
    term:
        The term.
    asked:
        True if it is among the asked terms.
    std:
        Type A standard uncertainty [unit in files] that the record gives, with its own noise; None if the record does
        not determine the term.
    reason, remedy:
        Why it does not, and what to do; empty if it does.
    doubt:
        Which other terms are hard to separate from it; empty if there is none.
    unit:
        Unit of ``std``.
    """

    term: str
    asked: bool
    std: float | None = None
    reason: str = ""
    remedy: str = ""
    doubt: str = ""
    unit: str = "1"

    @property
    def determined(self) -> bool:
        """True if the record determines the term."""
        return self.std is not None

    def words(self) -> str:
        """The verdict in words."""
        if self.std is None:
            return self.reason
        factor, unit = shown_unit(self.term, self.unit)
        size = f"determined, u = {factor * self.std:.2g}{'' if unit == '1' else f' {unit}'}"
        return f"{size}; {self.doubt}" if self.doubt else size

    def document(self) -> dict[str, Any]:
        """The prospect as plain data for JSON."""
        return {
            "term": self.term,
            "asked": self.asked,
            "determined": self.determined,
            "std": self.std,
            "unit": self.unit,
            "words": self.words(),
            "remedy": self.remedy,
            "doubt": self.doubt,
        }


@one_thread()
def term_prospects(run: Run, terms: str | Sequence[str] | None = None) -> tuple[TermProspect, ...]:
    """Say of every known term whether the record determines it together with the asked ones.

    If the zero of the output angle is lost between segments, each segment has its own phase.

    Parameters
    ----------
    run:
        The record.
    terms:
        The asked terms; default: those of the run file.

    Returns
    -------
    tuple[TermProspect, ...]
        The asked terms first, then all others.

    Raises
    ------
    ArgumentError, CalibrationError
        If the record does not fit the request, or determines nothing.
    """
    asked = run.model.terms if terms is None else term_names(terms)
    check_terms(asked, output=run.unit)
    others = tuple(term for term in _known(run, asked) if term not in asked)
    own_phases = len(set(run.phase_group)) > 1 or run.model.phases == "per-segment"
    phase = "per-segment" if own_phases else "shared"
    wish = union_of((asked, *((*asked, term) for term in others)))
    weighed = UnionReduction.of(run, make_request(run, wish, "information", phase, "output", ()))
    base, rows = _base(weighed, asked)
    for term in others:
        names = (*base, *_needed(term, base), term)
        rows.append(_prospect(term, weighed.compared(names, predict=False), asked=False))
    return tuple(rows)


def _known(run: Run, asked: tuple[str, ...]) -> tuple[str, ...]:
    """All terms that may be added to the terms asked for; ``k1`` and ``scale_factor`` exclude each other."""
    names = [name for name in UNITS if name != "phi" and not (run.direct and turns(name))]
    if {"scale_factor", "k1"} & set(asked):
        names = [name for name in names if name not in ("scale_factor", "k1")]
    else:
        names.remove("k1")
    return tuple(name for name in names if run.shows(name))


def _needed(term: str, base: tuple[str, ...]) -> tuple[str, ...]:
    """Terms that a term requires and that are missing."""
    return ("tan_beta",) if term in SERVO_TERMS and "tan_beta" not in base else ()


def _base(weighed: UnionReduction, asked: tuple[str, ...]) -> tuple[tuple[str, ...], list[TermProspect]]:
    """The asked terms that the record determines together, and the prospect of each asked term."""
    whole = weighed.compared(asked, predict=False)
    if not whole.reason:
        return asked, [_prospect(term, whole, asked=True) for term in asked]
    base: tuple[str, ...] = ()
    rows: dict[str, TermProspect] = {}
    for term in asked:
        if harmonic(term) and term[0] == "c":
            continue  # is added with its partner
        pair = (term, f"c{term[1:]}") if harmonic(term) else (term,)
        tried = weighed.compared((*base, *pair), predict=False)
        base = base if tried.reason else (*base, *pair)
        rows |= {name: _prospect(name, tried, asked=True) for name in pair}
    return base, [rows[term] for term in asked]


def _prospect(term: str, tried: TermSet, *, asked: bool) -> TermProspect:
    if tried.reason:
        return TermProspect(term, asked, None, tried.reason, tried.remedy, unit=unit_of(term))
    std, unit = next((c.std, c.unit) for c in tried.coefficients if c.name == term)
    doubt = next((words for words in tried.alike if re.search(rf"\b{term}\b", words)), "")
    return TermProspect(term, asked, std, doubt=doubt, unit=unit)
