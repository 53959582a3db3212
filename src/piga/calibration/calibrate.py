"""Calibrate: coefficients with uncertainty from a run, or from several together, with residuals, verdict and provenance."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

from piga.calibration.joint import (
    JointFit,
    check_items,
    effects,
    fit_alone,
    fit_jointly,
    given_servo_of,
    with_all_sources,
)
from piga.calibration.model.request import Request, make_request
from piga.calibration.remarks.advice import advise, with_advice
from piga.calibration.remarks.left_out import left_out_terms
from piga.calibration.remarks.missing_terms import Candidates
from piga.calibration.result import make_result
from piga.calibration.revolutions import whole_turns
from piga.calibration.summary import RunSummary
from piga.calibration.uncertainty import add_up, monte_carlo_intervals, with_given_servo
from piga.errors import ArgumentError, CalibrationError, CalibrationWarning, DataError, IdentifiabilityError
from piga.progress import Progress, Steps
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import BudgetTable
from piga.records.run import Run
from piga.records.terms import term_names
from piga.threads import one_thread

_STEPS = 5
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
        Replace the settings of the run files. ``per_run`` names terms with a value of their own in each
        run; by default k0, ``[]`` for none. Terms are a list or one text, ``"scale_factor, tan_beta, k0"``.
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
    steps, runs = Steps(progress, _STEPS), check_items(run)
    wanted, own = (None if names is None else list(term_names(names)) for names in (terms, per_run))
    with one_thread():
        steps("fitting the model")
        if len(runs) > 1 or isinstance(runs[0], RunSummary):
            if method not in (None, "information") or phase_source not in (None, "output"):
                raise CalibrationError(
                    "several runs can be calibrated together only with method 'information' and phase_source 'output'",
                    remedy="leave method and phase_source out, or calibrate the runs one by one",
                )
            result = _calibration(fit_jointly(runs, wanted, phases or phase, own, steps), steps)
        else:
            request = make_request(runs[0], wanted, method, phases or phase, phase_source, own)
            result = _of_one_run(runs[0], request, steps)
    steps.finish()
    for doubt in result.verdict.doubts:
        warnings.warn(doubt.words, CalibrationWarning, stacklevel=2)
    return result


def _of_one_run(run: Run, request: Request, steps: Steps) -> Calibration:
    """Calibration of one run; of whole turns, if the method asks for them: from their ends."""
    if request.method != "revolutions":
        return _calibration(_fitted(run, request, steps), steps)
    turns, terms, outliers = whole_turns(run, request)
    own = make_request(turns, terms, "information", "per-segment", "output", ())
    result = _calibration(_fitted(turns, own, steps), steps)
    words = "whole turns average the coupling out: tan_beta is not in the result; use method 'information'"
    notes = (words, *result.notes) if "tan_beta" in request.terms else result.notes
    return replace(result, method="revolutions", phases=request.phases, notes=notes, outliers=outliers)


def _fitted(run: Run, request: Request, steps: Steps) -> JointFit:
    """The fit of one run; if it is refused, and other axes, signs or units fit far better, the remedy says so."""
    try:
        return fit_alone(run, request, steps)
    except (IdentifiabilityError, DataError) as error:
        raise with_advice(error, advise(run, request)) from None


def _calibration(fit: JointFit, steps: Steps) -> Calibration:
    """From the fit and its intervals to the result: budget, doubts about the model, Monte Carlo, remarks."""
    steps("adding up the budget")
    fit = with_all_sources(fit, steps)
    candidates = Candidates.of(fit.without_scatter())
    doubts = left_out_terms(fit, candidates)
    budget = add_up(
        fit, effects(fit, stated=True), {one.source: one.change for one in doubts if one.change.any()}
    )
    steps("checking the intervals")
    coefficients, monte_carlo = monte_carlo_intervals(fit, budget)
    steps("looking for missing terms")
    result = make_result(fit, coefficients, budget.covariance, BudgetTable(budget.rows), doubts, candidates)
    result = replace(result, diagnostics=replace(result.diagnostics, monte_carlo=monte_carlo))
    return with_given_servo(result, *given_servo_of(fit))
