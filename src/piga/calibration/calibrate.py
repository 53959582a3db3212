"""Calibrate: coefficients with uncertainty from a run, or from several together, with residuals, verdict and provenance."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from piga._version import __version__
from piga.calibration.doubts import advise, find_creep, find_leverage, looks_wrong, with_advice
from piga.calibration.intervals import segment_scatter
from piga.calibration.joint import (
    JointFit,
    check_items,
    effects,
    fit_alone,
    fit_jointly,
    joint_sources,
    now,
    sources_of_stand,
    with_all_sources,
)
from piga.calibration.missing_terms import (
    CUBIC,
    Candidates,
    LeftOut,
    largest_shift,
    left_out_terms,
    suggest_terms,
    suggestions_in_words,
)
from piga.calibration.model.identifiability import one_way_in_words, remarks_in_words, scatter_in_words
from piga.calibration.model.request import make_request
from piga.calibration.model_choice import compare_models
from piga.calibration.sources import gravity_in_words
from piga.calibration.summary import RunSummary
from piga.calibration.uncertainty import Budget, add_up, monte_carlo_intervals, with_given_servo
from piga.calibration.weights import (
    Positions,
    diagnose,
    find_residuals,
    is_rounded,
    residual_angles,
    residual_figures,
    segment_table,
)
from piga.errors import ArgumentError, CalibrationError, CalibrationWarning, DataError, IdentifiabilityError
from piga.progress import Progress, Steps
from piga.records.calibration.calibration import Calibration, Provenance, RunRecord
from piga.records.calibration.coefficient import BudgetTable, Coefficient
from piga.records.calibration.diagnostics import (
    Diagnostics,
    Event,
    MissingTerm,
    Quality,
    Residuals,
    SegmentSummary,
    scale_over_nominal,
)
from piga.records.run import Run
from piga.records.terms import GYRO, SERVO_TERMS, term_names
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
            try:
                fit = fit_alone(runs[0], request, steps)
            except (IdentifiabilityError, DataError) as error:  # other axes, signs or units may fit far better
                raise with_advice(error, advise(runs[0], request)) from None
            result = _calibration(fit, steps)
    steps.finish()
    for doubt in result.verdict.doubts:
        warnings.warn(doubt.words, CalibrationWarning, stacklevel=2)
    return result


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
    result = _result(fit, coefficients, budget, doubts)
    result = _with_remarks(result, fit, candidates, doubts)
    result = replace(result, diagnostics=replace(result.diagnostics, monte_carlo=monte_carlo))
    by_source = {source.name: dict(source.known_servo) for source, _ in joint_sources(fit.summaries)}
    moved_servo = {name: servo for name, servo in by_source.items() if servo}
    return with_given_servo(result, dict(fit.summaries[0].known_servo), moved_servo)


def _part_of(
    fit: JointFit, index: int, kind: str
) -> tuple[RunRecord, tuple[SegmentSummary, ...], Residuals | None, Diagnostics]:
    """What the result says of a run: its record and segments; with raw data its residuals under the estimate, too.

    Residual rates become angles if runs of both kinds are joined (``kind`` is that of all residuals).
    """
    summary, live = fit.summaries[index], fit.live[index]
    segments, figures, residuals, scatter = summary.segments, summary.figures, None, Diagnostics()
    if live:
        design, values = fit.design_of(index, live)
        residuals = find_residuals(design, values, summary.noise)
        if not design.point:
            positions = fit.positions(index, fit.estimate)
            each = values[Positions.of(live.design.run).segments]
            scatter = segment_scatter(positions, each, summary.noise, design)
        if summary.kind != kind:
            residuals = residual_angles(residuals, "rate")
        segments, figures = segment_table(design, residuals), residual_figures(residuals)
    record = RunRecord(
        name=summary.name,
        source=summary.source,
        stand=summary.stand,
        phases=summary.phases,
        raw=live is not None,
        rows=live.design.rows if live else summary.count,
        angle_rms=math.sqrt(summary.noise.white),
        angle_random_walk=math.sqrt(summary.noise.walk),
        **figures,
        quality=summary.quality,
        undetermined=summary.undetermined,
        input_sha256=summary.input_sha256,
    )
    return record, segments, residuals, scatter


def _result(
    fit: JointFit, coefficients: tuple[Coefficient, ...], budget: Budget, doubts: tuple[LeftOut, ...]
) -> Calibration:
    """The calibration with its residuals and their tests, without the remarks that look for causes."""
    only, first, kinds = fit.only, fit.summaries[0], {summary.kind for summary in fit.summaries}
    kind = kinds.pop() if len(kinds) == 1 else "angle"
    parts = [_part_of(fit, index, kind) for index in range(len(fit.summaries))]
    records, segments, residuals, scatters = (list(column) for column in zip(*parts, strict=True))
    rows = [record.rows for record in records]
    white, walk, after, before = (
        float(np.sqrt(np.average(np.square([getattr(r, name) for r in records]), weights=rows)))
        for name in ("angle_rms", "angle_random_walk", "residual_rms", "residual_rms_before")
    )
    runs = [live.design.run for live in fit.live if live]
    scatter = max(scatters, key=lambda one: one.worst_scatter)
    angle: Literal["angle", "count"] = "count" if first.unit != GYRO else "angle"
    tests = replace(scatter, residual_kind="rate" if kind == "rate" else angle, range=fit.ranges)
    innovations = [own.innovation for own in residuals if own]
    if innovations:
        rounded = any(is_rounded(live.design.run, live.noise) for live in fit.live if live)
        tests = diagnose(innovations, tests, rounded=rounded)
    compared: Any = (
        compare_models(only.design.run).document() if only and only.design.run.model.compare else None
    )
    named = [(f"{r.name}:" if not only else "", own) for r, own in zip(records, segments, strict=True)]
    return Calibration(
        serial=first.serial,
        scale_factor_nominal=first.scale_factor,
        terms=fit.terms,
        phases="per-segment" if any(s.phases == "per-segment" for s in fit.summaries) else "shared",
        phase_source=only.design.request.phase_source if only else "output",
        method=only.design.request.method if only else "information",
        coefficients=coefficients,
        covariance=budget.covariance,
        surplus_observations=float(sum(rows) - len(coefficients)),
        angle_rms=white,
        angle_random_walk=walk,
        segment_scatter=math.sqrt(first.noise.scatter) if only else 0.0,
        residual_rms=after,
        residual_rms_before=before,
        residual_max_before=max(record.residual_max_before for record in records),
        residual_max_after=max(record.residual_max_after for record in records),
        quality=records[0].quality if only else _joint_quality(records),
        condition=fit.examination.condition,
        notes=scatter_in_words(scatter, direct=first.unit != GYRO),
        remarks=(
            *(one_way_in_words(only.design.run, fit.terms) if only else ()),
            *remarks_in_words(coefficients, budget.covariance),
            *(() if only else _notes_on_runs(records)),
        ),
        sources=sources_of_stand(fit, [doubt.listed for doubt in doubts if doubt.listed]),
        scale_factor_tolerance=max((run.model.tolerance for run in runs), default=0.01),
        gravity="; ".join(dict.fromkeys(filter(None, map(gravity_in_words, runs)))),
        budget=BudgetTable(budget.rows),
        diagnostics=replace(tests, model_comparison=compared),
        segments=tuple(replace(row, label=name + row.label) for name, own in named for row in own),
        provenance=_provenance(fit),
        temperature_reference=first.temperature_reference,
        time_reference=first.time_reference,
        residuals=residuals[0] if only else _joint_residuals(residuals, [len(own) for own in segments]),
        runs=() if only else tuple(records),
        outliers=tuple(replace(o, run=s.name or None) for s in fit.summaries for o in s.outliers),
        unit=first.unit,
    )


def _joint_residuals(residuals: list[Residuals | None], segments: list[int]) -> Residuals | None:
    """Residuals of all runs with raw data, one after the other. ``segments`` is the number of segments of each."""
    pieces: list[Residuals] = []
    for index, own in enumerate(residuals):
        if own:
            run, offset = np.full(own.t.size, index, dtype=np.int32), np.int32(sum(segments[:index]))
            pieces.append(replace(own, segment=own.segment + offset, run=run))
    if not pieces:
        return None
    names = ("row", "t", "psi", "a_x", "before", "after", "innovation", "segment", "run")
    columns = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names}
    return Residuals(**columns, unit=pieces[0].unit)


def _joint_quality(records: list[RunRecord]) -> Quality:
    events = tuple(
        Event(event.kind, event.count, event.first_row, f"run {record.name}: {event.detail}".rstrip(": "))
        for record in records
        for event in record.quality.events
    )
    all_rows, used, masked = np.sum([[q.rows, q.used, q.masked] for q in (r.quality for r in records)], axis=0)
    return Quality(int(all_rows), int(used), int(masked), events)


def _notes_on_runs(records: list[RunRecord]) -> Iterator[str]:
    """Terms that each run alone could not determine, and which runs are summaries."""
    for record in records:
        if record.undetermined:
            listed = ", ".join(record.undetermined)
            yield f"run '{record.name}' alone cannot separate {listed}: the other runs do"
    for record in records:
        if not record.raw:
            yield f"run '{record.name}' is a summary: its residual figures are those of its own fit"


def _provenance(fit: JointFit) -> Provenance:
    """Hashes of the inputs of all runs. A file name that occurs twice is marked with its run."""
    hashes: dict[str, str] = {}
    for summary in fit.summaries:
        for name, digest in summary.input_sha256.items():
            hashes[name if hashes.get(name, digest) == digest else f"{summary.name}: {name}"] = digest
    options: dict[str, Any] = {
        "runs": [s.source or s.name for s in fit.summaries],
        "per_run": list(fit.per_run),
    }
    if fit.only:
        options = {
            "source": fit.only.design.run.source,
            "noise_given": fit.only.design.request.angle_rms is not None,
        }
    return Provenance(hashes, f"piga {__version__}", now(), options)


def _with_remarks(
    result: Calibration, fit: JointFit, candidates: Candidates, doubts: tuple[LeftOut, ...]
) -> Calibration:
    """The result with leverage, advice, missing terms and creep in its diagnostics, and their sentences.

    A remark that can move a coefficient by more than u is a doubt (``notes``); the others are ``remarks``. Remarks change no
    number. One cause gets one remark. Data that were read wrongly look as if terms were missing, and a missing term affects
    single segments. Advice on the data therefore suppresses suggestions of terms, and both suppress remarks on segments that
    move a coefficient.
    """
    coefficients, only = result.coefficients, fit.only
    leverage, alone, moved = find_leverage(fit, candidates.fit, coefficients)
    advice: tuple[str, ...] = ()
    if only and looks_wrong(result):
        advice = advise(only.design.run, only.design.request, scale_over_nominal(result))
    missing = () if advice else suggest_terms(candidates, coefficients)
    said = [*((math.inf, words) for words in advice), *_suggested(fit, missing, doubts, coefficients)] or [
        *moved
    ]
    creep, words_of_creep = find_creep(fit, coefficients)
    if creep and words_of_creep and not advice:
        said.insert(0, (creep.largest_shift, words_of_creep))
    tests = replace(result.diagnostics, leverage=leverage, advice=advice, missing_terms=missing, creep=creep)
    return replace(
        result,
        notes=(*(words for shift, words in said if shift > 1.0), *result.notes),
        remarks=(*(words for shift, words in said if not shift > 1.0), *alone, *result.remarks),
        diagnostics=tests,
    )


def _suggested(
    fit: JointFit,
    missing: tuple[MissingTerm, ...],
    doubts: tuple[LeftOut, ...],
    coefficients: tuple[Coefficient, ...],
) -> Iterator[tuple[float, str]]:
    """Sentences on signatures of the servo and on missing terms, each with the largest shift that it explains."""
    scattered = any(summary.noise.scatter > 0.0 for summary in fit.summaries)
    also = "; the scatter of the segments may be the same effect" if scattered else ""
    lacking = [one for one in doubts if one.words]
    yield from ((largest_shift(coefficients, one.change)[0], one.words) for one in lacking)
    if lacking:
        missing = tuple(entry for entry in missing if not {*SERVO_TERMS, *CUBIC} & {*entry.terms})
    for index, sentence in enumerate(suggestions_in_words(missing)):
        # a clearer signature is told with the weaker one that moves a coefficient: they may have one cause
        yield max(entry.largest_shift for entry in missing[index:]), sentence + also
