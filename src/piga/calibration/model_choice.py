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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit import Fit, repetitions
from piga.calibration.joint import MergedRuns, Wish
from piga.calibration.model.design import Design, ServoState
from piga.calibration.model.identifiability import alike_in_words, refuse_useless
from piga.calibration.model.reduction import Reduction, solve_upper
from piga.calibration.model.request import Request, make_request
from piga.calibration.model.solution import Estimate
from piga.calibration.remarks.missing_terms import CUBIC, constant_squares
from piga.calibration.summary import RunSummary, bare_summary, prepare
from piga.calibration.weights import Positions, reduce_between
from piga.errors import ArgumentError, CalibrationError, IdentifiabilityError
from piga.progress import Progress, Steps
from piga.records.arrays import largest_size
from piga.records.calibration.coefficient import Coefficient
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

_FEWEST_SEGMENTS = 4
"""Fewest segments for leaving out segments. A record with fewer segments is cut into blocks."""
_BLOCKS = 10
"""Number of blocks for a record of fewer segments; each has about the same number of rows."""
_MOST = 50
"""Most parts that are left out one by one. With more parts, neighbours are left out together."""
_DEPENDENT = 1e-9
"""Largest independent share of a column's length for which the column counts as dependent on the others."""


@dataclass(frozen=True, eq=False, repr=False)
class HeldOutPrediction(Result):
    """Prediction of parts that were left out.

    Attributes
    ----------
    chi_square:
        Sum of squares of the whitened prediction errors. If there is only noise: the number of observations.
    force_error:
        Mean prediction error of each part as specific force, root mean square over the parts [m/s^2].
    per_fold:
        ``chi_square`` of each fold.
    above_best, standard_error:
        Excess of ``chi_square`` over the best set, and its standard error from the scatter of the folds.
    """

    chi_square: float
    force_error: float
    per_fold: Array
    above_best: float = 0.0
    standard_error: float = 0.0

    def against(self, best: HeldOutPrediction) -> HeldOutPrediction:
        """The prediction with its excess over the best one."""
        excess = self.per_fold - best.per_fold
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


def parts_of(run: Run, per_segment: bool) -> tuple[Positions, str]:
    """The parts of a record that are left out and predicted, and their kind: segments or blocks."""
    edges = run.segment_edges().astype(np.int64)
    if per_segment or edges.size > _FEWEST_SEGMENTS:
        return Positions(edges, np.arange(edges.size - 1)), "segment"
    blocks = np.linspace(0, run.size, min(_BLOCKS, run.size) + 1).astype(np.int64)
    edges = np.unique(np.concatenate((edges, blocks)))
    return Positions(edges, run.segment_index[edges[:-1]].astype(np.int64)), "block"


def fold_of(parts: int) -> NDArray[np.int64]:
    """Fold of each part: one per part, or one for several neighbours if there are many parts."""
    return np.arange(parts) * min(parts, _MOST) // parts


def predict(parts: Sequence[Reduction], scale_factor: float) -> HeldOutPrediction | None:
    """Predict every part from the others.

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
    folds = fold_of(len(parts))
    squares, forces = np.zeros(int(folds[-1]) + 1), []
    for fold in range(squares.size):
        estimate = _least_squares(rows[folds != fold].reshape(-1, rows.shape[2]))
        if estimate is None:
            return None
        for part in np.flatnonzero(folds == fold):
            missed, constant = rows[part, :, -1] - rows[part, :, :-1] @ estimate, constants[part]
            squares[fold] += float(missed @ missed)
            forces.append(float(constant @ missed) / float(constant @ constant) / scale_factor)
    return HeldOutPrediction(float(squares.sum()), float(np.sqrt(np.mean(np.square(forces)))), squares)


def _least_squares(rows: Array) -> Array | None:
    """Estimate from rows ``[x | y]``; None when the columns are dependent."""
    size = np.linalg.norm(rows[:, :-1], axis=0)
    if (size == 0.0).any():
        return None
    triangle: Array = np.linalg.qr(rows / np.append(size, 1.0))[1]
    m = size.size
    if np.abs(np.diag(triangle)[:m]).min() <= _DEPENDENT:
        return None
    return solve_upper(triangle[:m, :m], triangle[:m, m]) / size


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
    ``parted_by`` says what was left out: segments or blocks. ``notes`` say how the choice of a set changes K
    if the record cannot decide between sets.
    """

    sets: tuple[TermSet, ...]
    observations: int
    parts: int
    folds: int
    parted_by: str
    noise_terms: tuple[str, ...]
    angle_rms: float
    angle_random_walk: float
    best: int | None
    best_prediction: int | None
    notes: tuple[str, ...] = ()

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
            "folds": self.folds,
            "parted_by": self.parted_by,
            "best": None if self.best is None else list(self.sets[self.best].terms),
            "best_prediction": None
            if self.best_prediction is None
            else list(self.sets[self.best_prediction].terms),
            "notes": list(self.notes),
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
    wanted = _with_servo_first(run, wanted)
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
    rows = _with_weights(_with_best_prediction(rows))
    best = _least([row.bic for row in rows])
    return ModelComparison(
        sets=tuple(_with_changes(rows, best)),
        observations=weighed.summary.count,
        parts=len(weighed.summary.positions),
        folds=weighed.folds,
        parted_by=weighed.parted_by,
        noise_terms=weighed.fit.design.request.terms,
        angle_rms=weighed.fit.noise.angle_rms,
        angle_random_walk=weighed.fit.noise.angle_random_walk,
        best=best,
        best_prediction=_simplest(rows),
        notes=_meanings(rows),
    )


def _with_servo_first(run: Run, wanted: tuple[tuple[str, ...], ...]) -> tuple[tuple[str, ...], ...]:
    """The sets. Before each set with a cube of a_x comes the same set with the servo's stiffness in its place.

    Only if ``a_x^2 + a_t^2`` is constant: both sets then fit alike but give a different K.
    """
    if constant_squares(run)[0] is None or run.servo:
        return wanted
    sets: list[tuple[str, ...]] = []
    for terms in wanted:
        cubes = [name for name in CUBIC[1:] if name in terms]
        if len(cubes) == 1 and {"scale_factor", "tan_beta"} <= set(terms) and "servo" not in terms:
            sets.append(tuple("servo" if name == cubes[0] else name for name in terms))
        sets.append(terms)
    known = [frozenset(terms) for terms in wanted]
    return tuple(
        terms
        for i, terms in enumerate(sets)
        if terms in wanted or (frozenset(terms) not in known and terms not in sets[:i])
    )


def _meanings(rows: list[TermSet]) -> tuple[str, ...]:
    """Meaning of K with the servo's stiffness and with a cube of a_x, for sets that differ only in this."""
    notes = []
    values = {
        frozenset(row.terms): next((c for c in row.coefficients if c.name == "scale_factor"), None)
        for row in rows
    }
    for row in rows:
        own = values[frozenset(row.terms)]
        for cube in CUBIC[1:]:
            other = values.get(frozenset(row.terms) - {"servo"} | {cube})
            if "servo" in row.terms and own is not None and other is not None:
                size = "k3 g^2" if cube == "k3" else "what k2o takes of it"
                notes.append(
                    f"scale_factor is {own.value:.8g} {own.unit} with servo and {other.value:.8g} with {cube} "
                    f"instead (difference {size}); where a_x^2 + a_t^2 never changes, BIC and prediction cannot "
                    "choose between them; a servo of finite stiffness has the term servo"
                )
    return tuple(notes)


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
        live = prepare(run, request, "")
        fit, columns = live.fit, tuple(dict.fromkeys((*request.terms, _PROBE)))
        design = Design(live.run, replace(request, terms=columns), fit.design.scale_factor)
        noise = replace(fit.noise, scatter=0.0, stated=())
        positions, parted_by = parts_of(live.run, design.per_segment)
        triangles, logarithm = reduce_between(design, fit.mode, noise, positions.edges)
        held = repetitions(design, noise, triangles, positions)
        summary = bare_summary("", request, design, fit.noise, held)
        return cls(fit, summary, parted_by, logarithm)

    @property
    def folds(self) -> int:
        """Number of groups of parts; a group is left out together."""
        return int(fold_of(len(self.summary.positions))[-1]) + 1

    def compared(self, terms: tuple[str, ...], *, predict: bool = True) -> TermSet:
        """Figures of one set, or the reason why there are none; without ``predict`` no part is left out and predicted."""
        runs = MergedRuns.of(Wish.of_one(terms), [self.summary])
        try:
            _refuse_servo_alone(terms)
            state, _, estimate = runs.solved()
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
            prediction=self._predicted(runs, state) if predict and not own_phases else None,
            coefficients=coefficients,
        )

    def _predicted(self, runs: MergedRuns, state: ServoState | None) -> HeldOutPrediction | None:
        parts = [repetition.part for repetition in runs.repetitions(state, (_PROBE,))]
        return predict(parts, self.summary.inner_scale_factor)

    def _named(self, runs: MergedRuns, estimate: Estimate) -> tuple[tuple[Coefficient, ...], tuple[str, ...]]:
        """The coefficients, and those of them that are hard to separate."""
        run = self.fit.design.run
        named, covariance = runs.named(estimate, estimate.covariance)
        spread = 0.0 if run.temperature is None else float(np.ptp(run.temperature))
        refuse_useless(named, largest_size(run.f), float(np.ptp(run.t)), spread)
        return named, tuple(alike_in_words(named, covariance))


def _refuse_servo_alone(terms: tuple[str, ...]) -> None:
    """Raise if terms of the servo are requested without the coupling, whose phase they need."""
    if set(SERVO_TERMS) & set(terms) and "tan_beta" not in terms:
        raise CalibrationError(
            "the terms of the servo need the phase of tan_beta", remedy="add 'tan_beta' to the terms"
        )


def _least(values: list[float | None]) -> int | None:
    known = [(value, index) for index, value in enumerate(values) if value is not None]
    return min(known)[1] if known else None


def _with_weights(rows: list[TermSet]) -> list[TermSet]:
    """Schwarz weights among the sets that are determined."""
    known = [row.bic for row in rows if row.bic is not None]
    if not known:
        return rows
    total = math.fsum(math.exp(-0.5 * (bic - min(known))) for bic in known)
    return [
        row if row.bic is None else replace(row, weight=math.exp(-0.5 * (row.bic - min(known))) / total)
        for row in rows
    ]


def _with_best_prediction(rows: list[TermSet]) -> list[TermSet]:
    """All predictions, each with its excess over the best one."""
    at = _least([None if row.prediction is None else row.prediction.chi_square for row in rows])
    if at is None:
        return rows
    best = rows[at].prediction
    return [
        row if row.prediction is None or best is None else replace(row, prediction=row.prediction.against(best))
        for row in rows
    ]


def _simplest(rows: list[TermSet]) -> int | None:
    """Index of the set with the fewest coefficients among those within one standard error of the best prediction."""
    near = [
        (row.parameters, index)
        for index, row in enumerate(rows)
        if row.prediction is not None and row.prediction.as_good_as_best
    ]
    return min(near)[1] if near else None


def _with_changes(rows: list[TermSet], best: int | None) -> list[TermSet]:
    """The sets with the difference of every coefficient from the best set, in standard uncertainties of the best."""
    if best is None:
        return rows
    reference = {c.key: c for c in rows[best].coefficients}
    result = []
    for row in rows:
        changes = []
        for c in row.coefficients:
            known = reference.get(c.key)
            if known is not None and known.std > 0.0:
                change = c.value - known.value
                if c.name == "phi":
                    change = math.remainder(change, 2.0 * math.pi)
                changes.append((c.key, change / known.std))
        result.append(replace(row, changes=tuple(changes)))
    return result


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
