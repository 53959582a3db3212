"""Calibrate: coefficients with uncertainty from a run, with residuals, verdict and provenance."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from piga.calibration.budget.effects import sources_of_stand
from piga.calibration.budget.monte_carlo import monte_carlo_intervals
from piga.calibration.budget.sources import gravity_in_words, sources
from piga.calibration.budget.uncertainty import (
    Budget,
    budget_rows,
    combined,
    make_budget,
    share_of_type_a,
    stated_scatter,
    with_given_servo,
)
from piga.calibration.choice.model_choice import compare_models
from piga.calibration.fit.one_run import Fit, fit_run, interval_of_run, without_scatter
from piga.calibration.fit.residuals import (
    counted_products,
    diagnose,
    find_residuals,
    segment_scatter,
    segment_table,
)
from piga.calibration.history import history_of
from piga.calibration.intervals import Interval
from piga.calibration.joint.joint_fit import (
    check_items,
    fit_jointly,
    joint_contributions,
    joint_sources,
    joint_sources_of_stand,
)
from piga.calibration.joint.joint_result import joint_result
from piga.calibration.joint.summary import RunSummary, provenance, residual_figures, validity_ranges
from piga.calibration.model.design import given_servo
from piga.calibration.model.identifiability import (
    one_way_in_words,
    refuse_useless,
    remarks_in_words,
    scatter_in_words,
)
from piga.calibration.model.request import Request, make_request
from piga.calibration.model.solution import asked_order, layout_of, name_coefficients
from piga.calibration.remarks.advice import advise, with_advice
from piga.calibration.remarks.all_remarks import find_remarks, with_remarks, with_sentences
from piga.calibration.remarks.creep import creep_of_run, creep_of_runs, with_creep
from piga.calibration.remarks.left_out import left_out_of_runs, left_out_terms, odd_square
from piga.calibration.remarks.missing_terms import Candidates
from piga.calibration.revolutions import whole_turns
from piga.errors import ArgumentError, CalibrationError, CalibrationWarning, DataError, IdentifiabilityError
from piga.progress import Progress, Steps
from piga.reading.checks import largest_size
from piga.records.calibration import (
    BudgetEntry,
    BudgetTable,
    Calibration,
    Coefficient,
    Diagnostics,
    Residuals,
    SegmentScatter,
    SegmentSummary,
)
from piga.records.run import Run
from piga.records.terms import term_names
from piga.results import Array
from piga.threads import one_thread

STEPS = 5
"""Steps of a calibration that ``progress`` hears of."""


def calibrate(
    run: Run | RunSummary | Sequence[Run | RunSummary],
    terms: str | list[str] | tuple[str, ...] | None = None,
    method: str | None = None,
    *,
    phases: str | None = None,
    phase_source: str | None = None,
    per_run: str | list[str] | tuple[str, ...] | None = None,
    progress: Progress | None = None,
    phase: str | None = None,
) -> Calibration:
    """Estimate the coefficients of an instrument from a recorded test, or from several together.

    The error model (docs/theory/calibration) is linear in its coefficients once the measured output angle is
    used as phase. The fit therefore needs no first guess and has one optimum. Increments of the angle are whitened
    with the noise levels of the record and reduced orthogonally (own derivation in docs/theory/calibration).

    Parameters
    ----------
    run:
        The record, from :func:`piga.read_run` or :meth:`piga.Run.from_arrays`; or a list of records and
        :class:`piga.calibration.RunSummary` of one instrument, calibrated jointly.
    terms, method, phases, phase_source, per_run:
        Replace the settings of the run files. ``per_run`` names terms that may differ between the runs. Terms are a list or
        one text, ``"scale_factor, tan_beta, k0"``.
    progress:
        Called as ``progress(done, total, what)`` before each step; it returns False to stop (:mod:`piga.progress`).

    phase:
        Former name of ``phases``; scripts that use it run on.

    Returns
    -------
    Calibration
        Coefficients with covariance, noise levels, residuals, verdict, provenance.

    Warns
    -----
    CalibrationWarning
        For every doubt of ``Calibration.verdict``, with a remedy.

    Raises
    ------
    IdentifiabilityError
        If the record cannot determine what is asked; names the terms and a test that could.
    CalibrationError, ArgumentError
        If the request does not fit the record.
    CancelledError
        If ``progress`` returns False.
    """
    if phase is not None and phases is not None:
        raise ArgumentError("phase and phases: one is the former name of the other", remedy="give phases alone")
    phases = phases or phase
    steps = Steps(progress, STEPS)
    wanted, own = (None if names is None else list(term_names(names)) for names in (terms, per_run))
    with one_thread():
        result = _calibration(run, wanted, method, phases, phase_source, own, steps)
    steps.finish()
    for doubt in result.verdict.doubts:
        warnings.warn(doubt.words, CalibrationWarning, stacklevel=2)
    return result


def _calibration(
    run: Run | RunSummary | Sequence[Run | RunSummary],
    terms: list[str] | tuple[str, ...] | None,
    method: str | None,
    phases: str | None,
    phase_source: str | None,
    per_run: list[str] | tuple[str, ...] | None,
    steps: Steps,
) -> Calibration:
    """The result of :func:`calibrate`."""
    steps("fitting the model")
    if not isinstance(run, Run):
        runs = check_items(run)
        if len(runs) > 1 or not isinstance(runs[0], Run):
            return _joint_calibration(runs, terms, method, phases, phase_source, per_run, steps)
        run = runs[0]
    request = make_request(run, terms, method, phases, phase_source, per_run)
    if request.method == "revolutions":
        return _of_whole_turns(run, request, steps)
    stated = stated_scatter(run)
    try:
        fit = fit_run(run, request, stated)
        steps("finding the intervals")
        interval = interval_of_run(fit)
        coefficients, covariance = name_coefficients(fit.design, fit.solution, interval.covariance)
        spread = 0.0 if run.temperature is None else _range(run.temperature)
        refuse_useless(coefficients, largest_size(run.f), _range(run.t), spread)
    except (IdentifiabilityError, DataError) as error:
        raise with_advice(error, advise(run, request)) from None
    residuals = find_residuals(fit.design, fit.solution.values, fit.noise, fit.mode)
    candidates = Candidates(without_scatter(fit))
    steps("adding up the budget")
    budget = make_budget(fit, coefficients, covariance, steps)
    doubts = left_out_terms(candidates, coefficients)
    for doubt in doubts:
        budget = budget.with_row(doubt.row(coefficients))
    type_a, whole = budget.covariances(covariance)
    degrees = _degrees(fit, interval) * share_of_type_a(type_a, covariance)
    covariance = whole
    coefficients = combined(coefficients, covariance, budget.rows, degrees)
    steps("checking the intervals")
    coefficients, monte_carlo = monte_carlo_intervals(
        fit, interval.covariance, degrees, coefficients, budget, run.estimation.uncertainty
    )
    steps("looking for missing terms")
    said = find_remarks(fit, candidates, coefficients)
    creep = creep_of_run(fit, coefficients)
    history = history_of(fit) if request.method == "recursive" else None
    examined = _examined(fit, residuals)
    notes = odd_square(fit, coefficients) + scatter_in_words(examined.scatter, direct=run.direct)
    result = _assemble(run, fit, coefficients, covariance, budget.rows, examined, notes, history)
    result = replace(
        result,
        remarks=(
            *one_way_in_words(run, request.terms),
            *remarks_in_words(coefficients, covariance, request.phases),
        ),
        sources=(*sources_of_stand(fit), *(doubt.listed for doubt in doubts if doubt.listed)),
        scale_factor_tolerance=run.model.tolerance,
        gravity=gravity_in_words(run),
    )
    result = with_creep(with_remarks(result, fit, said, doubts), run, creep)
    result = with_given_servo(result, given_servo(run), _moved_servo(run))
    compared = compare_models(run).document() if run.model.compare else None
    diagnostics = replace(result.diagnostics, monte_carlo=monte_carlo, model_comparison=compared)
    return replace(result, diagnostics=diagnostics)


def _moved_servo(run: Run) -> dict[str, dict[str, float]]:
    """Given coefficients of the servo, moved by each source of Type B that affects them."""
    return {s.name: given_servo(s.moved) for s in sources(run) if "servo" in s.fields} if run.servo else {}


def _degrees(fit: Fit, interval: Interval) -> Array:
    """Degrees of freedom of Type A in the order of the coefficients."""
    phases = fit.solution.phases.size
    return interval.degrees[
        asked_order(layout_of(fit.design, max(phases, 1)), fit.design.request.terms, phases)
    ]


def _range(values: Array) -> float:
    """Largest value minus smallest value."""
    return float(values.max() - values.min())


@dataclass(frozen=True)
class _Examined:
    """The residuals of a fit, their tests, the scatter of the mean rates, and one row per segment."""

    residuals: Residuals
    diagnostics: Diagnostics
    scatter: SegmentScatter
    segments: tuple[SegmentSummary, ...]


def _examined(fit: Fit, residuals: Residuals) -> _Examined:
    """The residuals of a fit and what they say."""
    design, run = fit.design, fit.design.run
    plain = Diagnostics(residual_kind=run.quantity, range=validity_ranges(run))
    tests = diagnose(residuals, plain, (partial(counted_products, design, fit.noise, fit.mode, residuals),))
    scatter = segment_scatter(design, residuals, fit.noise)
    return _Examined(residuals, tests.with_scatter(scatter), scatter, segment_table(design, residuals))


def _assemble(
    run: Run,
    fit: Fit,
    coefficients: tuple[Coefficient, ...],
    covariance: Array,
    budget: tuple[BudgetEntry, ...],
    examined: _Examined,
    notes: tuple[str, ...],
    history: dict[str, Array] | None,
) -> Calibration:
    request = fit.design.request
    rows = fit.design.rows
    return Calibration(
        serial=run.serial,
        scale_factor_nominal=run.scale_factor,
        terms=request.terms,
        phases=request.phases,
        phase_source=request.phase_source,
        method=request.method,
        coefficients=coefficients,
        covariance=covariance,
        surplus_observations=float(rows - len(coefficients)),
        angle_rms=fit.noise.angle_rms,
        angle_random_walk=fit.noise.angle_random_walk,
        **residual_figures(examined.residuals),
        quality=fit.design.run.quality,
        outliers=fit.outliers,
        segment_scatter=fit.noise.segment_scatter,
        condition=fit.examination.condition,
        notes=notes,
        budget=BudgetTable(budget),
        diagnostics=examined.diagnostics,
        segments=examined.segments,
        provenance=provenance(
            dict(run.input_sha256), {"source": run.source, "noise_given": request.angle_rms is not None}
        ),
        temperature_reference=request.temperature_reference,
        time_reference=fit.design.time_reference,
        residuals=examined.residuals,
        history=history,
        unit=fit.design.run.unit,
    )


def _joint_calibration(
    items: list[Run | RunSummary],
    terms: list[str] | tuple[str, ...] | None,
    method: str | None,
    phases: str | None,
    phase_source: str | None,
    per_run: list[str] | tuple[str, ...] | None,
    steps: Steps,
) -> Calibration:
    """Calibrate several runs or summaries of runs together."""
    if method not in (None, "information") or phase_source not in (None, "output"):
        raise CalibrationError(
            "several runs can be calibrated together only with method 'information' and phase_source 'output'",
            remedy="leave method and phase_source out, or calibrate the runs one by one",
        )
    fit = fit_jointly(items, terms, phases, per_run, steps)
    steps("adding up the budget")
    changes_by_source = list(joint_contributions(fit, steps))
    changes = tuple(change for _, change in changes_by_source)
    type_a, whole = Budget((), changes, tuple(s.in_fit for s, _ in changes_by_source)).covariances(
        fit.covariance
    )
    steps("looking for missing terms")
    degrees = fit.degrees * share_of_type_a(type_a, fit.covariance)
    doubts = left_out_of_runs(fit)
    rows = (
        *budget_rows(fit.coefficients, type_a, changes_by_source),
        *(doubt.row(fit.coefficients) for doubt in doubts),
    )
    whole = whole + sum((doubt.covariance for doubt in doubts), start=np.zeros_like(whole))
    result = joint_result(fit, whole, rows, degrees)
    live = [item for item in items if isinstance(item, Run)]
    result = replace(
        result,
        sources=(*joint_sources_of_stand(fit), *(doubt.listed for doubt in doubts if doubt.listed)),
        scale_factor_tolerance=max((run.model.tolerance for run in live), default=0.01),
        gravity="; ".join(dict.fromkeys(filter(None, map(gravity_in_words, live)))),
    )
    said = ((doubt.largest_shift(result.coefficients), doubt.words) for doubt in doubts if doubt.words)
    result = with_sentences(result, said)
    crept = creep_of_runs(fit, result.coefficients)
    if crept is not None:
        one, creep = crept
        result = with_creep(result, one.run, creep, one.name)
    given = dict(fit.summaries[0].known_servo)
    moved = {
        source.name: dict(fit.summaries[index].sources[number].known_servo)
        for source in joint_sources(fit.summaries)
        for index, number in list(source.moved.items())[:1]
    }
    return with_given_servo(result, given, moved if given else {})


def _of_whole_turns(run: Run, request: Request, steps: Steps) -> Calibration:
    """Calibration from the ends of whole turns of the output."""
    turns = whole_turns(run, request)
    result = _calibration(turns.run, turns.terms, "information", "per-segment", "output", (), steps)
    notes = result.notes
    if "tan_beta" in request.terms:
        notes = (
            "whole turns average the coupling out: tan_beta is not in the result; use method 'information'",
            *notes,
        )
    return replace(result, method="revolutions", phases=request.phases, notes=notes, outliers=turns.outliers)
