"""The result of a calibration: residuals with their tests, remarks, and where it comes from."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from typing import Any, Literal

import numpy as np

from piga.calibration.joint import JointFit, sources_of_stand
from piga.calibration.model.identifiability import one_way_in_words, remarks_in_words, scatter_in_words
from piga.calibration.model_choice import compare_models
from piga.calibration.orders import residual_angles
from piga.calibration.remarks.advice import advise, looks_wrong
from piga.calibration.remarks.creep import creep_in_words, creep_of_runs
from piga.calibration.remarks.left_out import LeftOut
from piga.calibration.remarks.leverage import find_leverage
from piga.calibration.remarks.missing_terms import CUBIC, Candidates, suggest_terms, suggestions_in_words
from piga.calibration.residuals import (
    diagnose,
    find_residuals,
    is_rounded,
    segment_scatter,
    segment_table,
)
from piga.calibration.sources import gravity_in_words
from piga.calibration.summary import LiveRun, provenance, residual_figures
from piga.records.calibration.calibration import Calibration, Provenance, RunRecord
from piga.records.calibration.coefficient import BudgetTable, Coefficient
from piga.records.calibration.diagnostics import (
    Diagnostics,
    Event,
    MissingTerm,
    Quality,
    Residuals,
    SegmentScatter,
    SegmentSummary,
    scale_over_nominal,
)
from piga.records.terms import GYRO, SERVO_TERMS
from piga.results import Array


@dataclass(frozen=True)
class _RunResiduals:
    """Residuals of a run with raw data under the estimate, its segments, and their scatter."""

    residuals: Residuals
    segments: tuple[SegmentSummary, ...]
    scatter: SegmentScatter


def make_result(
    fit: JointFit,
    coefficients: tuple[Coefficient, ...],
    covariance: Array,
    budget: BudgetTable,
    doubts: tuple[LeftOut, ...],
    candidates: Candidates,
) -> Calibration:
    """The calibration with its residuals and remarks; ``candidates`` are the terms that the model may lack."""
    kinds = {summary.kind for summary in fit.summaries}
    kind = kinds.pop() if len(kinds) == 1 else "angle"
    parts = [_residuals_of(fit, i, live, kind) if live else None for i, live in enumerate(fit.live)]
    held, records = [part for part in parts if part], [_record(fit, i, part) for i, part in enumerate(parts)]
    segments = [
        row if fit.only else replace(row, label=f"{summary.name}:{row.label}")
        for summary, part in zip(fit.summaries, parts, strict=True)
        for row in (summary if part is None else part).segments
    ]
    scatter = max((part.scatter for part in held), key=lambda one: one.worst, default=SegmentScatter())
    live, first, weights = [live for live in fit.live if live], fit.summaries[0], [r.rows for r in records]
    direct, terms = first.unit != GYRO, fit.wish.terms
    result = Calibration(
        serial=first.serial,
        scale_factor_nominal=first.scale_factor,
        terms=terms,
        phases="per-segment" if any(s.phases == "per-segment" for s in fit.summaries) else "shared",
        phase_source="output",
        method="information",
        coefficients=coefficients,
        covariance=covariance,
        surplus_observations=float(sum(weights) - len(coefficients)),
        angle_rms=_mean_square([r.angle_rms for r in records], weights),
        angle_random_walk=_mean_square([r.angle_random_walk for r in records], weights),
        residual_rms=_mean_square([r.residual_rms for r in records], weights),
        residual_rms_before=_mean_square([r.residual_rms_before for r in records], weights),
        residual_max_before=max(r.residual_max_before for r in records),
        residual_max_after=max(r.residual_max_after for r in records),
        quality=_joint_quality(records),
        condition=fit.examination.condition,
        notes=scatter_in_words(scatter, direct=direct),
        remarks=remarks_in_words(coefficients, covariance),
        sources=sources_of_stand(fit, [doubt.listed for doubt in doubts if doubt.listed]),
        scale_factor_tolerance=max((one.run.model.tolerance for one in live), default=0.01),
        gravity="; ".join(dict.fromkeys(filter(None, (gravity_in_words(one.run) for one in live)))),
        budget=budget,
        diagnostics=replace(_tested(fit, held, kind), **asdict(scatter)),
        segments=tuple(segments),
        provenance=_provenance(fit),
        temperature_reference=first.temperature_reference,
        time_reference=first.time_reference,
        residuals=_all_residuals(parts, fit),
        runs=() if fit.only else tuple(records),
        outliers=tuple(replace(o, run=s.name or None) for s in fit.summaries for o in s.outliers),
        unit=first.unit,
    )
    if fit.only:
        result = _of_one_run(result, fit, fit.only, candidates, doubts)
    else:
        missing = suggest_terms(candidates, coefficients)
        scattered = any(summary.noise.scatter > 0.0 for summary in fit.summaries)
        diagnostics = replace(result.diagnostics, missing_terms=missing)
        result = replace(result, remarks=(*result.remarks, *_notes_on_runs(records)), diagnostics=diagnostics)
        result = _with_sentences(result, _suggested(missing, doubts, coefficients, scattered=scattered))
    return _with_creep(result, fit)


def _of_one_run(
    result: Calibration, fit: JointFit, live: LiveRun, candidates: Candidates, doubts: tuple[LeftOut, ...]
) -> Calibration:
    """The result with what is found for a single run only: settings, comparison of models, leverage, missing terms, advice."""
    run, request = live.run, live.request
    compared: Any = compare_models(run).document() if run.model.compare else None
    result = replace(
        result,
        phase_source=request.phase_source,
        method=request.method,
        segment_scatter=live.fit.noise.segment_scatter,
        remarks=(*one_way_in_words(run, request.terms), *result.remarks),
        diagnostics=replace(result.diagnostics, model_comparison=compared),
    )
    return _with_remarks(result, fit, live, candidates, doubts)


def _residuals_of(fit: JointFit, index: int, live: LiveRun, kind: str) -> _RunResiduals:
    """Residuals of a run and what is found from them.

    Residual rates are converted to angles if runs of both kinds are joined (``kind`` is that of all residuals).
    """
    design, values = fit.design_of(index, live)
    residuals = find_residuals(design, values, live.fit.noise, live.fit.mode)
    scatter = segment_scatter(design, residuals, live.fit.noise)
    if fit.summaries[index].kind != kind:
        residuals = residual_angles(residuals, "rate")
    return _RunResiduals(residuals, segment_table(design, residuals), scatter)


def _tested(fit: JointFit, parts: list[_RunResiduals], kind: str) -> Diagnostics:
    """Tests of the whitened residuals of all runs with raw data."""
    angle: Literal["angle", "count"] = "count" if fit.summaries[0].unit != GYRO else "angle"
    tests = Diagnostics(residual_kind="rate" if kind == "rate" else angle, range=fit.ranges)
    if parts:
        innovations = [part.residuals.innovation for part in parts]
        rounded = any(is_rounded(live.run, live.fit.noise) for live in fit.live if live)
        tests = diagnose(innovations, tests, rounded=rounded)
    return tests


def _record(fit: JointFit, index: int, part: _RunResiduals | None) -> RunRecord:
    summary, live = fit.summaries[index], fit.live[index]
    figures = summary.figures if part is None else residual_figures(part.residuals)
    return RunRecord(
        name=summary.name,
        source=summary.source,
        stand=summary.stand,
        phases=summary.phases,
        raw=part is not None,
        rows=live.fit.design.rows if live else summary.count,
        angle_rms=summary.noise.angle_rms,
        angle_random_walk=summary.noise.angle_random_walk,
        **figures,
        quality=summary.quality,
        undetermined=summary.undetermined,
        input_sha256=summary.input_sha256,
    )


def _all_residuals(parts: list[_RunResiduals | None], fit: JointFit) -> Residuals | None:
    """Residuals of all runs with raw data, one after the other."""
    if fit.only and parts[0]:
        return parts[0].residuals
    pieces: list[Residuals] = []
    run_of: list[int] = []
    offset = 0
    for index, (summary, part) in enumerate(zip(fit.summaries, parts, strict=True)):
        if part is not None:
            pieces.append(replace(part.residuals, segment=part.residuals.segment + np.int32(offset)))
            run_of.append(index)
        offset += len((summary if part is None else part).segments)
    if not pieces:
        return None
    names = ("row", "t", "psi", "a_x", "before", "after", "innovation", "segment")
    columns = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names}
    run = np.repeat(np.array(run_of, dtype=np.int32), [piece.t.size for piece in pieces])
    return Residuals(**columns, run=run, unit=pieces[0].unit)


def _mean_square(values: list[float], weights: list[int]) -> float:
    return float(np.sqrt(np.average(np.square(values), weights=weights)))


def _joint_quality(records: list[RunRecord]) -> Quality:
    if len(records) == 1 and not records[0].name:
        return records[0].quality
    events = tuple(
        Event(event.kind, event.count, event.first_row, f"run {record.name}: {event.detail}".rstrip(": "))
        for record in records
        for event in record.quality.events
    )
    return Quality(
        sum(r.quality.rows for r in records),
        sum(r.quality.used for r in records),
        sum(r.quality.masked for r in records),
        events,
    )


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
        "per_run": list(fit.wish.per_run),
    }
    if fit.only:
        options = {"source": fit.only.run.source, "noise_given": fit.only.request.angle_rms is not None}
    return provenance(hashes, options)


def _with_remarks(
    result: Calibration, fit: JointFit, only: LiveRun, candidates: Candidates, doubts: tuple[LeftOut, ...]
) -> Calibration:
    """The result with ``leverage``, ``missing_terms`` and ``advice`` in its diagnostics and in its notes.

    ``candidates`` are those of the fit without slow noise. A signature of the servo is reported by the suggestion of its term or
    by a sentence of its own.
    """
    coefficients, live = result.coefficients, only.fit
    leverage, alone, moved = find_leverage(fit, candidates.fit, coefficients)
    scale = scale_over_nominal(result)
    advice = advise(live.design.run, live.design.request, scale) if looks_wrong(result) else ()
    missing = () if advice else suggest_terms(candidates, coefficients)
    diagnostics = replace(result.diagnostics, leverage=leverage, advice=advice, missing_terms=missing)
    suggested = _suggested(missing, doubts, coefficients, scattered=live.noise.scatter > 0.0)
    cause = (*((math.inf, words) for words in advice), *suggested) or moved
    result = replace(result, remarks=(*alone, *result.remarks), diagnostics=diagnostics)
    return _with_sentences(result, cause)


def _suggested(
    missing: tuple[MissingTerm, ...],
    doubts: tuple[LeftOut, ...],
    coefficients: tuple[Coefficient, ...],
    *,
    scattered: bool = False,
) -> tuple[tuple[float, str], ...]:
    """Sentences on missing terms and on signatures of the servo, each with the largest shift that it explains."""
    also = "; the scatter of the segments may be the same effect" if scattered else ""
    lacking = [(doubt.largest_shift(coefficients), doubt.words) for doubt in doubts if doubt.words]
    if lacking:
        missing = tuple(entry for entry in missing if not {*SERVO_TERMS, *CUBIC} & {*entry.terms})
    words = suggestions_in_words(missing)
    # a clearer signature is told with the weaker one that moves a coefficient: they may have one cause
    shifts = list(accumulate(reversed([entry.largest_shift for entry in missing]), max))[::-1]
    return (*lacking, *((shift, sentence + also) for shift, sentence in zip(shifts, words, strict=True)))


def _with_sentences(result: Calibration, sentences: Iterable[tuple[float, str]]) -> Calibration:
    """The result with sentences: a doubt if the shift before it is above one standard uncertainty, else a remark."""
    said = list(sentences)
    doubts = [words for shift, words in said if shift > 1.0]
    remarks = [words for shift, words in said if not shift > 1.0]
    return replace(result, notes=(*doubts, *result.notes), remarks=(*remarks, *result.remarks))


def _with_creep(result: Calibration, fit: JointFit) -> Calibration:
    """The result with a creep in its diagnostics: a doubt if it moves a coefficient by more than u, else a remark."""
    found = creep_of_runs(fit, result.coefficients)
    if found is None:
        return result
    live, creep = found
    result = replace(result, diagnostics=replace(result.diagnostics, creep=creep))
    if not creep.seen or result.diagnostics.advice:
        return result
    words = (f"run '{live.name}': " if live.name else "") + creep_in_words(live.run, creep)
    return _with_sentences(result, [(creep.largest_shift, words)])
