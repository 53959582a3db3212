"""Model choice: compare term sets on one record, from one reduction of all their columns.

All sets share the noise weights of the largest set that the record can determine. Their likelihoods then differ
only by the chi-square of their residuals. The whitened rows are reduced once per segment. A set is a selection of
columns of the triangular factors.

Prospects of terms, before a calibration, use the same reduction: every known term is added to the terms asked for.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from piga.calibration.fit import Fit
from piga.calibration.joint import fit_determined
from piga.calibration.model.design import Design
from piga.calibration.model.identifiability import alike_in_words, refuse_useless
from piga.calibration.model.request import Request, check_servo, make_request
from piga.calibration.summary import MergedRuns, RunSummary
from piga.calibration.weights import Positions, reduce_between
from piga.errors import ArgumentError, CalibrationError, IdentifiabilityError
from piga.progress import Progress, Steps
from piga.records.arrays import largest_size
from piga.records.calibration.coefficient import Coefficient, short_way
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
class TermSet:
    """One set of terms in the comparison. Figures are None if ``reason`` is not empty.

    Attributes
    ----------
    terms:
        The terms.
    reason, remedy:
        Why the record cannot determine the set, and what to do; empty if it can.
    alike:
        Coefficients that are hard to separate, one sentence each.
    parameters:
        Number of coefficients, including phases.
    chi_square, log_likelihood, bic:
        Of the whitened residual. Gaussian, with the weights common to all sets.
    coefficients, changes:
        Type A estimates, and their difference from the best set in standard uncertainties of the best set.
    """

    terms: tuple[str, ...]
    reason: str = ""
    remedy: str = ""
    alike: tuple[str, ...] = ()
    parameters: int = 0
    chi_square: float | None = None
    log_likelihood: float | None = None
    bic: float | None = None
    coefficients: tuple[Coefficient, ...] = ()
    changes: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class ModelComparison:
    """Term sets in the order asked; ``best`` is the index into ``sets`` of that with the least BIC.

    ``noise_terms`` is the set used for the common noise levels.
    """

    sets: tuple[TermSet, ...]
    observations: int
    noise_terms: tuple[str, ...]
    angle_rms: float
    angle_random_walk: float
    best: int | None

    def document(self) -> dict[str, Any]:
        """The comparison as plain data for JSON: coefficients in the units of calibration.json."""
        best = None if self.best is None else self.sets[self.best]
        sets: list[dict[str, Any]] = []
        for row in self.sets:
            sets.append({"terms": list(row.terms), "reason": row.reason})
            if row.chi_square is None or row.bic is None or best is None or best.bic is None:
                continue
            changes = dict(row.changes)
            sets[-1] |= {
                "parameters": row.parameters,
                "chi_square": row.chi_square,
                "log_likelihood": row.log_likelihood,
                "bic": row.bic,
                "chi_square_per_degree": row.chi_square / (self.observations - row.parameters),
                "bic_above_best": row.bic - best.bic,
                "coefficients": [
                    {"key": c.key, "value": c.value, "std": c.std, "unit": c.unit, "change": changes.get(c.key)}
                    for c in row.coefficients
                ],
            }
        return {
            "treatment": "noise levels of the largest set that the record separates, the same for all sets",
            "noise_terms": list(self.noise_terms),
            "angle_rms": self.angle_rms,
            "angle_random_walk": self.angle_random_walk,
            "observations": self.observations,
            "best": None if best is None else list(best.terms),
            "sets": sets,
        }


@one_thread()
def compare_models(
    run: Run,
    term_sets: Sequence[str | Sequence[str]] | None = None,
    *,
    phases: str | None = None,
    progress: Progress | None = None,
) -> ModelComparison:
    r"""Compare sets of terms on one record.

    With the common covariance V of the increments, a set with m coefficients and the residual r has

    .. math:: \ln L = -\tfrac12 (n \ln 2\pi + \ln|V| + r' V^{-1} r), \qquad
              \mathrm{BIC} = m \ln n - 2 \ln L

    [Schwarz1978]. V is the same for all sets: that of the largest set that the record can determine. A set that the record
    cannot determine stays in the table with the reason.

    Parameters
    ----------
    run:
        The record.
    term_sets:
        Sets of terms, each a list or one text; default: ``[model] compare`` of the run file.
    phases:
        Replaces the setting of the run file.
    progress:
        Called as ``progress(done, total, what)`` before each set; it returns False to stop (:mod:`piga.progress`).

    Raises
    ------
    ArgumentError
        For an unknown term, or no set.
    CalibrationError
        If the request does not fit the record.
    CancelledError
        If ``progress`` returns False.
    """
    wanted = tuple(term_names(terms) for terms in (run.model.compare if term_sets is None else term_sets))
    if not wanted:
        raise ArgumentError(
            "there are no term sets to compare",
            remedy="give a list of lists of terms, or [model] compare in the run file",
        )
    for index, terms in enumerate(wanted, start=1):
        if not terms:
            raise ArgumentError(f"term set {index} is empty", remedy="name its terms")
        check_terms(terms, where=f"term set {index}", output=run.unit)
    steps = Steps(progress, 1 + len(wanted))
    steps("finding the noise")
    weighed = _UnionReduction.of(run, make_request(run, union_of(wanted), "information", phases, per_run=()))
    rows = []
    for terms in wanted:
        steps(f"fitting {' '.join(terms)}")
        rows.append(weighed.compared(terms))
    steps.finish()
    known = [(row.bic, index) for index, row in enumerate(rows) if row.bic is not None]
    best = min(known)[1] if known else None
    if best is not None:
        foremost = rows[best].coefficients
        rows = [replace(row, changes=_changes(row.coefficients, foremost)) for row in rows]
    return ModelComparison(
        sets=tuple(rows),
        observations=weighed.summary.count,
        noise_terms=weighed.fit.design.request.terms,
        angle_rms=math.sqrt(weighed.fit.noise.white),
        angle_random_walk=math.sqrt(weighed.fit.noise.walk),
        best=best,
    )


def _changes(
    coefficients: tuple[Coefficient, ...], best: tuple[Coefficient, ...]
) -> tuple[tuple[str, float], ...]:
    """Difference of every coefficient from that of the best set, in standard uncertainties of the best."""
    pairs = [(c, known) for c in coefficients for known in best if known.key == c.key and known.std > 0.0]
    return tuple(
        (
            c.key,
            float(short_way(c.value - known.value) if c.name == "phi" else c.value - known.value) / known.std,
        )
        for c, known in pairs
    )


def union_of(wanted: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """All terms in order of appearance; ``k1`` uses the column of ``scale_factor``."""
    union = tuple(dict.fromkeys(term for terms in wanted for term in terms))
    return tuple(term for term in union if not (term == "k1" and "scale_factor" in union))


@dataclass(frozen=True)
class _UnionReduction:
    """A record, whitened and reduced over the union of all columns."""

    fit: Fit
    summary: RunSummary
    log_determinant: float

    @classmethod
    def of(cls, run: Run, request: Request) -> _UnionReduction:
        """Find the noise with the determined part of the union, then reduce the whole union once."""
        fit, _ = fit_determined(run, request)
        design = Design(fit.design.run, request, fit.design.scale_factor)
        noise = replace(fit.noise, scatter=0.0, stated=())
        triangles, logarithm = reduce_between(design, noise, Positions.of(fit.design.run).edges)
        return cls(fit, RunSummary.of_rows(design, noise, triangles), logarithm)

    def compared(self, terms: tuple[str, ...]) -> TermSet:
        """Figures of one set, or the reason why there are none."""
        runs, run = MergedRuns.of([self.summary], terms), self.fit.design.run
        try:
            check_servo(replace(self.fit.design.request, terms=terms))
            _, estimate = runs.solved()
            named, covariance = runs.named(estimate, estimate.covariance)
            spread = 0.0 if run.temperature is None else float(np.ptp(run.temperature))
            refuse_useless(named, largest_size(run.f), float(np.ptp(run.t)), spread)
        except (CalibrationError, IdentifiabilityError) as error:
            return TermSet(terms, error.message, error.remedy)
        n, m = self.summary.count, estimate.parameters
        likelihood = -0.5 * (n * math.log(2.0 * math.pi) + self.log_determinant + estimate.cost)
        return TermSet(
            terms,
            alike=tuple(alike_in_words(named, covariance)),
            parameters=m,
            chi_square=estimate.cost,
            log_likelihood=likelihood,
            bic=m * math.log(n) - 2.0 * likelihood,
            coefficients=named,
        )


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
        fields = {name: value for name, value in vars(self).items() if name != "reason"}
        return fields | {"determined": self.determined, "words": self.words()}


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
    # k1 and scale_factor exclude each other
    taken = {"phi", "k1", *asked} | ({"scale_factor"} if "k1" in asked else set())
    unseen = {name for name in UNITS if (run.direct and turns(name)) or not run.shows(name)}
    others = tuple(name for name in UNITS if name not in taken | unseen)
    own_phases = len(set(run.phase_group)) > 1 or run.model.phases == "per-segment"
    phase = "per-segment" if own_phases else "shared"
    wish = union_of((asked, *((*asked, term) for term in others)))
    weighed = _UnionReduction.of(run, make_request(run, wish, "information", phase, "output", ()))
    base, rows = _base(weighed, asked)
    for term in others:
        coupled = ("tan_beta",) if term in SERVO_TERMS and "tan_beta" not in base else ()
        rows.append(_prospect(term, weighed.compared((*base, *coupled, term)), asked=False))
    return tuple(rows)


def _base(weighed: _UnionReduction, asked: tuple[str, ...]) -> tuple[tuple[str, ...], list[TermProspect]]:
    """The asked terms that the record determines together, and the prospect of each asked term."""
    whole = weighed.compared(asked)
    if not whole.reason:
        return asked, [_prospect(term, whole, asked=True) for term in asked]
    base: tuple[str, ...] = ()
    rows: dict[str, TermProspect] = {}
    for term in asked:
        if harmonic(term) and term[0] == "c":
            continue  # is added with its partner
        pair = (term, f"c{term[1:]}") if harmonic(term) else (term,)
        tried = weighed.compared((*base, *pair))
        base = base if tried.reason else (*base, *pair)
        rows |= {name: _prospect(name, tried, asked=True) for name in pair}
    return base, [rows[term] for term in asked]


def _prospect(term: str, tried: TermSet, *, asked: bool) -> TermProspect:
    if tried.reason:
        return TermProspect(term, asked, None, tried.reason, tried.remedy, unit=unit_of(term))
    std, unit = next((c.std, c.unit) for c in tried.coefficients if c.name == term)
    doubt = next((words for words in tried.alike if re.search(rf"\b{term}\b", words)), "")
    return TermProspect(term, asked, std, doubt=doubt, unit=unit)
