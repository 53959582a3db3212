"""Model choice: compare term sets on one record, from one reduction of all their columns.

All sets share the noise weights of the largest set that the record can determine. Their likelihoods then differ
only by the chi-square of their residuals. The whitened rows are reduced once per segment. A set is a selection of
columns of the triangular factors. Each part of the record is predicted exactly from the others: the prediction error
needs only the triangular factors (own derivation, docs/theory).

Prospects of terms, before a calibration, use the same reduction: every known term is added to the terms asked for.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from piga.calibration.fit import Fit
from piga.calibration.intervals import inverse_root
from piga.calibration.joint import fit_determined
from piga.calibration.model.design import Design
from piga.calibration.model.identifiability import alike_in_words, refuse_useless
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request, check_servo, make_request
from piga.calibration.model.solution import Estimate
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
from piga.results import Array, Result
from piga.threads import one_thread

_ALONE = 1e-9
"""Smallest remainder ``1 - leverage`` with which a part can be predicted from the others."""


@dataclass(frozen=True, eq=False, repr=False)
class HeldOutPrediction(Result):
    """Prediction of parts that were left out.

    Attributes
    ----------
    chi_square:
        Sum of squares of the whitened prediction errors. If there is only noise: the number of observations.
    force_error:
        Mean prediction error of each part as specific force, root mean square over the parts [m/s^2].
    per_part:
        ``chi_square`` of each part.
    above_best, standard_error:
        Excess of ``chi_square`` over the best set, and its standard error from the scatter of the parts.
    """

    chi_square: float
    force_error: float
    per_part: Array
    above_best: float = 0.0
    standard_error: float = 0.0

    def against(self, best: HeldOutPrediction) -> HeldOutPrediction:
        """The prediction with its excess over the best one."""
        excess = self.per_part - best.per_part
        error = math.sqrt(excess.size) * float(np.std(excess, ddof=1)) if excess.size > 1 else 0.0
        return replace(self, above_best=float(excess.sum()), standard_error=error)

    @property
    def as_good_as_best(self) -> bool:
        """True within one standard error of the best prediction; rounding errors are allowed for."""
        return self.above_best <= self.standard_error + 1e-9 * self.chi_square

    def document(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "prediction_chi_square": self.chi_square,
            "prediction_above_best": self.above_best,
            "prediction_standard_error": self.standard_error,
            "prediction_force_error": self.force_error,
        }


def predict(parts: Sequence[Reduction], scale_factor: float) -> HeldOutPrediction | None:
    """Predict every part from the others; exact, from one fit to all (own derivation, docs/theory).

    Parameters
    ----------
    parts:
        Triangles ``[columns of the set | constant force | y]`` of the parts.
    scale_factor:
        Converts the coefficient of the constant force to a force.

    Returns
    -------
    Prediction or None
        None when there are fewer than two parts, or when the set cannot be determined without one of the parts.
    """
    if len(parts) < 2:
        return None
    factors = np.array([part.factor for part in parts])
    rows, constants = np.delete(factors, -2, axis=2), factors[:, :, -2]
    x = rows[:, :, :-1] @ inverse_root(list(rows), rows.shape[2] - 1)
    missed = rows[:, :, -1] - x @ np.einsum("jka,jk->a", x, rows[:, :, -1])
    rest = np.eye(x.shape[2]) - np.einsum("jka,jkb->jab", x, x)
    if np.linalg.eigvalsh(rest).min() < _ALONE:
        return None
    score = np.einsum("jka,jk->ja", x, missed)[:, :, None]
    missed = missed + (x @ np.linalg.solve(rest, score))[:, :, 0]
    squares = np.sum(missed**2, axis=1)
    forces = np.sum(constants * missed, axis=1) / np.sum(constants**2, axis=1) / scale_factor
    return HeldOutPrediction(float(squares.sum()), float(np.sqrt(np.mean(forces**2))), squares)


@dataclass(frozen=True)
class TermSet:
    """One set of terms in the comparison. Figures are None if ``reason`` is not empty.

    Attributes
    ----------
    terms:
        The terms.
    reason:
        Why the record cannot determine the set or cannot be predicted with it; empty if it can.
    remedy:
        What to do about that.
    alike:
        Coefficients that are hard to separate, one sentence each.
    parameters:
        Number of coefficients, including phases.
    chi_square, log_likelihood, bic, aic:
        Of the whitened residual. Gaussian, with the weights common to all sets.
    weight:
        Schwarz weight: share of ``exp(-BIC/2)`` among the sets that are determined.
    prediction:
        Prediction of the parts of the record that were left out.
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
    aic: float | None = None
    weight: float | None = None
    prediction: HeldOutPrediction | None = None
    coefficients: tuple[Coefficient, ...] = ()
    changes: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class ModelComparison:
    """Term sets in the order asked; ``best`` and ``best_prediction`` are indices into ``sets``.

    ``best`` has the least BIC. ``best_prediction`` has the fewest coefficients of all sets whose prediction is
    within one standard error of the best one. ``noise_terms`` is the set used for the common noise levels.
    ``parted_by`` says what was left out: segments, or blocks of a record of one segment.
    """

    sets: tuple[TermSet, ...]
    observations: int
    parts: int
    parted_by: str
    noise_terms: tuple[str, ...]
    angle_rms: float
    angle_random_walk: float
    best: int | None
    best_prediction: int | None

    @property
    def ranking(self) -> tuple[int, ...]:
        """Indices of the sets by BIC; sets without a BIC come last."""
        order = [math.inf if row.bic is None else row.bic for row in self.sets]
        return tuple(sorted(range(len(order)), key=lambda index: (order[index], index)))

    def document(self) -> dict[str, Any]:
        """The comparison as plain data for JSON: forces [m/s^2], coefficients in the units of calibration.json."""
        best = self.sets[self.best].bic if self.best is not None else None
        return {
            "treatment": "noise levels of the largest set that the record separates, the same for all sets",
            "noise_terms": list(self.noise_terms),
            "angle_rms": self.angle_rms,
            "angle_random_walk": self.angle_random_walk,
            "observations": self.observations,
            "parts": self.parts,
            "parted_by": self.parted_by,
            "best": None if self.best is None else list(self.sets[self.best].terms),
            "best_prediction": None
            if self.best_prediction is None
            else list(self.sets[self.best_prediction].terms),
            "sets": [_set_document(row, best, self.observations) for row in self.sets],
        }


def _set_document(row: TermSet, best: float | None, observations: int) -> dict[str, Any]:
    document: dict[str, Any] = {"terms": list(row.terms), "reason": row.reason}
    if row.chi_square is None or row.bic is None or best is None:
        return document
    document |= {
        "parameters": row.parameters,
        "chi_square": row.chi_square,
        "chi_square_per_degree": row.chi_square / (observations - row.parameters),
        "log_likelihood": row.log_likelihood,
        "bic": row.bic,
        "bic_above_best": row.bic - best,
        "aic": row.aic,
        "weight": row.weight,
    }
    changes = dict(row.changes)
    document["coefficients"] = [
        {"key": c.key, "value": c.value, "std": c.std, "unit": c.unit, "change": changes.get(c.key)}
        for c in row.coefficients
    ]
    if row.prediction is not None:
        document |= row.prediction.document()
    return document


_PROBE = "k0"
"""Column that converts a prediction error to a mean specific force. It is reduced with every union."""


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
              \mathrm{BIC} = m \ln n - 2 \ln L, \qquad \mathrm{AIC} = 2 m - 2 \ln L

    [Schwarz1978]. V is the same for all sets: that of the largest set that the record can determine. Every part of
    the record is also predicted from the others (not with one phase per segment). A set that the record
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
    _check_sets(wanted, run.unit)
    steps = Steps(progress, 1 + len(wanted))
    steps("finding the noise")
    union = union_of(wanted)
    request = make_request(run, union, "information", phases, per_run=())
    weighed = UnionReduction.of(run, request)
    rows = []
    for terms in wanted:
        steps(f"fitting {' '.join(terms)}")
        rows.append(weighed.compared(terms))
    steps.finish()
    rows, best, best_prediction = _ranked(rows)
    return ModelComparison(
        sets=tuple(rows),
        observations=weighed.summary.count,
        parts=len(weighed.summary.positions),
        parted_by=weighed.parted_by,
        noise_terms=weighed.fit.design.request.terms,
        angle_rms=weighed.fit.noise.angle_rms,
        angle_random_walk=weighed.fit.noise.angle_random_walk,
        best=best,
        best_prediction=best_prediction,
    )


def _check_sets(wanted: tuple[tuple[str, ...], ...], unit: str) -> None:
    if not wanted:
        raise ArgumentError(
            "there are no term sets to compare",
            remedy="give a list of lists of terms, or [model] compare in the run file",
        )
    for index, terms in enumerate(wanted, start=1):
        if not terms:
            raise ArgumentError(f"term set {index} is empty", remedy="name its terms")
        check_terms(terms, where=f"term set {index}", output=unit)


def union_of(wanted: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """All terms in order of appearance; ``k1`` uses the column of ``scale_factor``."""
    union = tuple(dict.fromkeys(term for terms in wanted for term in terms))
    return tuple(term for term in union if not (term == "k1" and "scale_factor" in union))


@dataclass(frozen=True)
class UnionReduction:
    """A record, whitened and reduced over the union of all columns: its summary has one triangle per part."""

    fit: Fit
    summary: RunSummary
    parted_by: str
    log_determinant: float

    @classmethod
    def of(cls, run: Run, request: Request) -> UnionReduction:
        """Find the noise with the determined part of the union, then reduce the whole union once."""
        (fit, _), columns = fit_determined(run, request), tuple(dict.fromkeys((*request.terms, _PROBE)))
        design = Design(fit.run, replace(request, terms=columns), fit.design.scale_factor)
        noise = replace(fit.noise, scatter=0.0, stated=())
        positions = Positions.of(fit.run)
        triangles, logarithm = reduce_between(design, fit.mode, noise, positions.edges)
        summary = RunSummary.of_rows(design, noise, triangles, positions)
        return cls(fit, summary, "block" if positions.continuous else "segment", logarithm)

    def compared(self, terms: tuple[str, ...], *, predict: bool = True) -> TermSet:
        """Figures of one set, or the reason why there are none; without ``predict`` no part is left out and predicted."""
        runs = MergedRuns.of([self.summary], terms)
        try:
            check_servo(replace(self.fit.design.request, terms=terms))
            _, estimate = runs.solved()
            coefficients, alike = self._named(runs, estimate)
        except (CalibrationError, IdentifiabilityError) as error:
            return TermSet(terms, error.message, error.remedy)
        n, m = self.summary.count, estimate.parameters
        likelihood = -0.5 * (n * math.log(2.0 * math.pi) + self.log_determinant + estimate.cost)
        own_phases = len(self.summary.labels) > 1 and runs.layout.local > 0
        return TermSet(
            terms,
            alike=alike,
            parameters=m,
            chi_square=estimate.cost,
            log_likelihood=likelihood,
            bic=m * math.log(n) - 2.0 * likelihood,
            aic=2.0 * m - 2.0 * likelihood,
            prediction=self._predicted(runs, estimate) if predict and not own_phases else None,
            coefficients=coefficients,
        )

    def _predicted(self, runs: MergedRuns, estimate: Estimate) -> HeldOutPrediction | None:
        parts = [repetition.part for repetition in runs.repetitions(estimate, (_PROBE,))]
        return predict(parts, self.summary.inner_scale_factor)

    def _named(self, runs: MergedRuns, estimate: Estimate) -> tuple[tuple[Coefficient, ...], tuple[str, ...]]:
        """The coefficients, and those of them that are hard to separate."""
        run = self.fit.design.run
        named, covariance = runs.named(estimate, estimate.covariance)
        spread = 0.0 if run.temperature is None else float(np.ptp(run.temperature))
        refuse_useless(named, largest_size(run.f), float(np.ptp(run.t)), spread)
        return named, tuple(alike_in_words(named, covariance))


def _least(values: Iterable[float | None]) -> int | None:
    """Index of the least value; None if there is none."""
    known = [(value, index) for index, value in enumerate(values) if value is not None]
    return min(known)[1] if known else None


def _ranked(rows: list[TermSet]) -> tuple[list[TermSet], int | None, int | None]:
    """The sets beside the best one: Schwarz weights, excess of the prediction, changes of coefficients; with both best indices."""
    best = _least(row.bic for row in rows)
    if best is None:
        return rows, None, None
    known = {index: row.bic for index, row in enumerate(rows) if row.bic is not None}
    shares = {index: math.exp(-0.5 * (bic - known[best])) for index, bic in known.items()}
    total = math.fsum(shares.values())
    foremost = _least(row.prediction.chi_square if row.prediction else None for row in rows)
    prediction = None if foremost is None else rows[foremost].prediction
    ranked = [
        replace(
            row,
            weight=shares[index] / total if index in shares else None,
            prediction=row.prediction.against(prediction) if row.prediction and prediction else None,
            changes=_changes(row.coefficients, rows[best].coefficients),
        )
        for index, row in enumerate(rows)
    ]
    near = (row.parameters if row.prediction and row.prediction.as_good_as_best else None for row in ranked)
    return ranked, best, _least(near)


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
