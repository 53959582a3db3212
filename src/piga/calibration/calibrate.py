"""Calibrate: coefficients with uncertainty from a run, with residuals, verdict and provenance."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from piga.calibration.budget.monte_carlo import monte_carlo_intervals
from piga.calibration.budget.uncertainty import (
    Budget,
    budget_row,
    budget_rows,
    combined,
    contributions,
    make_budget,
    share_of_type_a,
    sources,
    stated_scatter,
    with_given_servo,
)
from piga.calibration.choice.model_choice import compare_models
from piga.calibration.classical.recursive import recursive_history, run_published
from piga.calibration.classical.revolutions import (
    clean_record,
    estimate_again,
    fit_revolutions,
    name_revolutions,
    revolutions_degrees,
    revolutions_result,
)
from piga.calibration.fit.one_run import Fit, fit_run, noise_of, refine_counted, without_slow
from piga.calibration.fit.residuals import (
    counted_products,
    diagnose,
    find_residuals,
    segment_scatter,
    segment_table,
)
from piga.calibration.intervals.added_noise import include_noise
from piga.calibration.intervals.degrees_of_freedom import type_a_degrees
from piga.calibration.joint.joint_fit import (
    check_items,
    fit_jointly,
    joint_contributions,
    joint_degrees,
    joint_sources,
)
from piga.calibration.joint.joint_result import joint_result
from piga.calibration.joint.summary import RunSummary, provenance, residual_figures, validity_ranges
from piga.calibration.model.design import Design, given_servo
from piga.calibration.model.identifiability import (
    Examination,
    examine,
    notes_in_words,
    refuse_useless,
    remarks_in_words,
)
from piga.calibration.model.request import Request, make_request
from piga.calibration.model.solution import Solution, name_coefficients, principal, solve
from piga.calibration.noise.weighting import weighting_mode
from piga.calibration.remarks.advice import advise, with_advice
from piga.calibration.remarks.all_remarks import find_remarks, with_remarks
from piga.calibration.remarks.left_out import left_out_of_runs, left_out_terms, odd_square
from piga.calibration.remarks.missing_terms import Candidates
from piga.errors import ArgumentError, CalibrationError, CalibrationWarning, DataError, IdentifiabilityError
from piga.progress import Progress, Steps
from piga.reading.checks import largest_size
from piga.records.calibration import (
    BudgetEntry,
    BudgetTable,
    Calibration,
    Coefficient,
    ColouredNoise,
    Diagnostics,
    Residuals,
    SegmentScatter,
    SegmentSummary,
)
from piga.records.run import Run
from piga.records.spool import extent
from piga.records.terms import si_factor, term_names, unit_of
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
    if request.method == "published":
        return _published_calibration(run, request, steps)
    if request.method == "revolutions":
        return _revolutions_calibration(run, request, steps)
    stated = stated_scatter(run)
    try:
        fit = fit_run(run, request)
        steps("finding the noise")
        fit = include_noise(refine_counted(fit), stated)
        coefficients, covariance = name_coefficients(fit.design, fit.solution, fit.covariance)
        spread = 0.0 if run.temperature is None else _range(run.temperature)
        refuse_useless(coefficients, largest_size(run.f), _range(run.t), spread)
    except (IdentifiabilityError, DataError) as error:
        raise with_advice(error, advise(run, request)) from None
    residuals = find_residuals(fit.design, fit.solution.values, fit.noise, fit.mode)
    candidates = Candidates(without_slow(fit))
    steps("adding up the budget")
    budget = make_budget(fit, coefficients, covariance, steps)
    doubts = left_out_terms(candidates, coefficients)
    for doubt in doubts:
        budget = budget.with_row(doubt.row(coefficients))
    type_a, whole = budget.covariances(covariance)
    degrees = type_a_degrees(fit) * share_of_type_a(type_a, covariance)
    covariance = whole
    coefficients = combined(coefficients, covariance, budget.rows, degrees)
    steps("checking the intervals")
    coefficients, monte_carlo = monte_carlo_intervals(fit, coefficients, budget, run.estimation.uncertainty)
    steps("looking for missing terms")
    said = find_remarks(fit, candidates, coefficients)
    history = _history(fit) if request.method == "recursive" else None
    examined = _examined(fit, residuals)
    notes = odd_square(fit, coefficients) + notes_in_words(coefficients, covariance, examined.scatter)
    result = _assemble(run, fit, coefficients, covariance, budget.rows, examined, notes, history)
    result = replace(result, remarks=remarks_in_words(coefficients, request.phases))
    result = with_remarks(result, fit, said, doubts)
    result = with_given_servo(result, given_servo(run), _moved_servo(run))
    compared = compare_models(run).document() if run.model.compare else None
    diagnostics = replace(result.diagnostics, monte_carlo=monte_carlo, model_comparison=compared)
    return replace(result, diagnostics=diagnostics)


def _moved_servo(run: Run) -> dict[str, dict[str, float]]:
    """Given coefficients of the servo, moved by each source of Type B that affects them."""
    return (
        {s.name: given_servo(s.moved) for s in sources(run) if s.moved.servo is not run.servo}
        if run.servo
        else {}
    )


def _range(values: Array) -> float:
    """Largest value minus smallest value."""
    low, high = extent(values)
    return high - low


def _history(fit: Fit) -> dict[str, Array]:
    """Estimate and standard uncertainty after 2 m .. n samples, for the convergence plot (file units)."""
    rows, samples = [], []
    keys: tuple[str, ...] = ()
    for mark, summaries in recursive_history(fit.design, fit.mode, fit.noise):
        if examine(fit.design, summaries).null_terms:
            continue
        solution = solve(fit.design, summaries)
        named, covariance = name_coefficients(fit.design, solution, solution.covariance)
        plain = [i for i, c in enumerate(named) if c.name != "phi" or not fit.design.has_phases]
        keys = tuple(named[i].name for i in plain)
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        rows.append([*(named[i].value for i in plain), *std[plain]])
        samples.append(mark)
    table = np.array(rows)
    result = {"sample": np.array(samples, dtype=float)}
    for i, key in enumerate(keys):
        result[key] = table[:, i]
        result[f"u({key})"] = table[:, len(keys) + i]
    return result


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
    plain = Diagnostics(residual_kind="rate" if run.kind == "rate" else "angle", range=validity_ranges(run))
    tests = diagnose(residuals, plain, (partial(counted_products, design, fit.noise, fit.mode, residuals),))
    scatter = segment_scatter(design, residuals, fit.noise, fit.coloured_rms)
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
        bias_drift=fit.noise.bias_drift,
        segment_scatter=fit.noise.segment_scatter,
        coloured_noise=None
        if fit.colour is None
        else ColouredNoise(fit.colour.name, fit.colour.rms, fit.colour.time, fit.colour.gain),
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
    degrees = joint_degrees(fit) * share_of_type_a(type_a, fit.covariance)
    doubts = left_out_of_runs(fit)
    rows = (
        *budget_rows(fit.coefficients, type_a, changes_by_source),
        *(doubt.row(fit.coefficients) for doubt in doubts),
    )
    whole = whole + sum((doubt.covariance for doubt in doubts), start=np.zeros_like(whole))
    result = joint_result(fit, whole, rows, degrees)
    result = replace(result, notes=(*(doubt.words for doubt in doubts if doubt.words), *result.notes))
    given = dict(fit.summaries[0].known_servo)
    moved = {
        source.name: dict(fit.summaries[index].sources[number].known_servo)
        for source in joint_sources(fit.summaries)
        for index, number in list(source.moved.items())[:1]
    }
    return with_given_servo(result, given, moved if given else {})


def _revolutions_calibration(run: Run, request: Request, steps: Steps) -> Calibration:
    """Calibration from mean rates over whole turns; Type B by moving the record."""
    cleaned = clean_record(run, request)
    steps("measuring whole turns")
    fit = fit_revolutions(cleaned[0], request)
    coefficients, covariance, note = name_revolutions(fit, request)
    keys = [coefficient.key for coefficient in coefficients]
    base = np.array([coefficient.value for coefficient in coefficients])
    steps("adding up the budget")
    changes_by_source = list(
        contributions(cleaned[0], base, lambda moved: estimate_again(moved, request, keys), steps=steps)
    )
    budget = budget_rows(coefficients, covariance, changes_by_source)
    covariance = covariance + sum(
        (change.T @ change for _, change in changes_by_source), start=np.zeros_like(covariance)
    )
    coefficients = combined(coefficients, covariance, budget, revolutions_degrees(fit, request))
    notes = notes_in_words(coefficients, covariance, SegmentScatter())
    notes = (*notes, note) if note else notes
    result = revolutions_result(run, cleaned, request, fit, coefficients, covariance, budget, notes)
    result = replace(result, remarks=remarks_in_words(coefficients, "shared"))
    return with_given_servo(result, given_servo(run), _moved_servo(run))


def _published_calibration(run: Run, request: Request, steps: Steps) -> Calibration:
    """Calibration by the published recursion. The residuals are those of its own solution."""
    run = replace(run, servo=())
    published = run_published(run, request)
    values, covariance = published.state.copy(), published.covariance
    if values[0] < 0.0:
        values[0], values[1] = -values[0], values[1] + np.pi
        flip = np.ones(values.size)
        flip[0] = -1.0
        covariance = covariance * np.outer(flip, flip)
    values[1] = principal(values[1])
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    coefficients = tuple(
        Coefficient(n, float(v), float(s), unit_of(n))
        for n, v, s in zip(published.names, values, std, strict=True)
    )
    linear_request = replace(request, phases="shared", phase_source="input")
    design = Design(run, linear_request, run.scale_factor)
    linear = _linear_values(design, dict(zip(published.names, values, strict=True)))
    steps("computing residuals")
    mode = weighting_mode(design, "rate")
    noise = noise_of(design, _fixed_solution(design, linear), mode)
    fit = Fit(
        design=design,
        mode=mode,
        noise=noise,
        summaries=[],
        solution=_fixed_solution(design, linear),
        covariance=covariance,
        examination=Examination(float("nan"), ()),
        d=np.zeros(0),
        h=np.zeros(0),
    )
    history = {"sample": published.samples.astype(float)}
    history |= {name: published.history[:, i] for i, name in enumerate(published.names)}
    notes = ("the published recursion depends on its first guess and predicts the phase from the input",)
    std_budget = (budget_row("fit residuals (repeatability)", "A", "normal", None, "", coefficients, std),)
    return _assemble(
        run,
        fit,
        coefficients,
        covariance,
        std_budget,
        _examined(fit, find_residuals(design, fit.solution.values, noise, mode)),
        notes,
        history,
    )


def _linear_values(design: Design, named: dict[str, float]) -> Array:
    """Column coefficients for given coefficients (file units)."""
    scale_factor = design.run.scale_factor
    tangent, phase = named["tan_beta"], named["phi"]
    known = {"p": tangent * np.cos(phase), "q": tangent * np.sin(phase)}
    known |= {name: value * si_factor(name) for name, value in named.items() if name not in ("tan_beta", "phi")}
    return np.array([scale_factor * known[name] for name in design.names])


def _fixed_solution(design: Design, linear: Array) -> Solution:
    values = np.tile(linear, (len(design.run.labels), 1))
    m = len(linear)
    return Solution(linear, np.zeros(0), np.zeros((m, m)), 0.0, (np.eye(m),), values)
