"""What a calibration makes of a fit, of one run or of several: budget, doubts, residuals with their tests, remarks, result.

:class:`OneRun` and :class:`SeveralRuns` answer the same questions. ``calibrate`` asks them in order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import accumulate
from typing import Literal, NamedTuple

import numpy as np

from piga.calibration.fit import Fit, fit_run, history_of, interval_of_run, without_scatter
from piga.calibration.intervals import Interval
from piga.calibration.joint import (
    JointFit,
    joint_contributions,
    joint_sources,
    joint_sources_of_stand,
)
from piga.calibration.model.design import given_servo
from piga.calibration.model.identifiability import (
    one_way_in_words,
    refuse_useless,
    remarks_in_words,
    scatter_in_words,
)
from piga.calibration.model.request import Request
from piga.calibration.model.solution import asked_order, layout_of, name_coefficients, variances_of
from piga.calibration.model_choice import compare_models
from piga.calibration.monte_carlo import monte_carlo_intervals
from piga.calibration.orders import residual_angles
from piga.calibration.remarks.advice import advise, looks_wrong, with_advice
from piga.calibration.remarks.creep import creep_in_words, creep_of_runs, find_creep
from piga.calibration.remarks.left_out import (
    CUBIC_SOURCE,
    DAMPING_SOURCE,
    LeftOut,
    left_out_of_runs,
    left_out_terms,
)
from piga.calibration.remarks.leverage import find_leverage
from piga.calibration.remarks.missing_terms import Candidates, suggest_terms, suggestions_in_words
from piga.calibration.residuals import (
    Products,
    counted_products,
    diagnose,
    find_residuals,
    segment_scatter,
    segment_table,
    with_slow_counts,
)
from piga.calibration.sources import gravity_in_words, sources
from piga.calibration.summary import LiveRun, provenance, residual_figures, validity_ranges
from piga.calibration.uncertainty import Budget, budget_of, make_budget, sources_of_stand, stated_scatter
from piga.errors import DataError, IdentifiabilityError
from piga.progress import Steps
from piga.records.arrays import largest_size
from piga.records.calibration import (
    BudgetEntry,
    BudgetTable,
    Calibration,
    Coefficient,
    Creep,
    Diagnostics,
    Event,
    MonteCarlo,
    Provenance,
    Quality,
    Residuals,
    RunRecord,
    SegmentScatter,
    SegmentSummary,
)
from piga.records.calibration.verdict import scale_over_nominal
from piga.records.run import Run
from piga.records.terms import GYRO
from piga.results import Array


@dataclass(frozen=True)
class OneRun:
    """The fit of one run with its intervals; ``run`` is the record as given."""

    run: Run
    fit: Fit
    interval: Interval
    coefficients: tuple[Coefficient, ...]
    covariance: Array

    @classmethod
    def of(cls, run: Run, request: Request, steps: Steps) -> OneRun:
        """Fit a run and find the intervals.

        Raises
        ------
        IdentifiabilityError, DataError
            If the record does not determine what is asked. If other axes, signs or units fit far better, the remedy says so.
        """
        try:
            fit = fit_run(run, request, stated_scatter(run))
            steps("finding the intervals")
            interval = interval_of_run(fit)
            coefficients, covariance = name_coefficients(fit.design, fit.solution, interval.covariance)
            spread = 0.0 if run.temperature is None else float(np.ptp(run.temperature))
            refuse_useless(coefficients, largest_size(run.f), float(np.ptp(run.t)), spread)
        except (IdentifiabilityError, DataError) as error:
            raise with_advice(error, advise(run, request)) from None
        return cls(run, fit, interval, coefficients, covariance)

    @property
    def degrees(self) -> Array:
        """Degrees of freedom of Type A in the order of the coefficients."""
        design, phases = self.fit.design, self.fit.solution.phases.size
        layout = layout_of(design, max(phases, 1))
        return self.interval.degrees[asked_order(layout, design.request.terms, phases)]

    @cached_property
    def candidates(self) -> Candidates:
        """The terms that may be missing."""
        return Candidates(without_scatter(self.fit))

    def budget(self, steps: Steps) -> Budget:
        """The budget of the stated sources."""
        return make_budget(self.fit, self.coefficients, self.covariance, steps)

    def doubts(self) -> tuple[LeftOut, ...]:
        """Signatures of a servo that the model lacks."""
        return left_out_terms(self.candidates, self.coefficients)

    def propagated(
        self, coefficients: tuple[Coefficient, ...], degrees: Array, budget: Budget
    ) -> tuple[tuple[Coefficient, ...], MonteCarlo | None]:
        """The coefficients with intervals by Monte Carlo where the first order fails."""
        wanted = self.run.estimation.uncertainty
        return monte_carlo_intervals(self.fit, self.interval.covariance, degrees, coefficients, budget, wanted)

    def result(
        self,
        coefficients: tuple[Coefficient, ...],
        covariance: Array,
        budget: tuple[BudgetEntry, ...],
        doubts: tuple[LeftOut, ...],
    ) -> Calibration:
        """The calibration with its residuals and remarks."""
        run, fit, design = self.run, self.fit, self.fit.design
        request, record = design.request, design.run
        residuals = find_residuals(design, fit.solution.values, fit.noise, fit.mode)
        scatter = segment_scatter(design, residuals, fit.noise)
        plain = Diagnostics(residual_kind=record.quantity, range=validity_ranges(record))
        counted = partial(counted_products, design, fit.noise, fit.mode, residuals)
        compared = compare_models(run).document() if run.model.compare else None
        options = {"source": run.source, "noise_given": request.angle_rms is not None}
        result = Calibration(
            serial=run.serial,
            scale_factor_nominal=run.scale_factor,
            terms=request.terms,
            phases=request.phases,
            phase_source=request.phase_source,
            method=request.method,
            coefficients=coefficients,
            covariance=covariance,
            surplus_observations=float(design.rows - len(coefficients)),
            angle_rms=fit.noise.angle_rms,
            angle_random_walk=fit.noise.angle_random_walk,
            **residual_figures(residuals),
            quality=record.quality,
            outliers=fit.outliers,
            segment_scatter=fit.noise.segment_scatter,
            condition=fit.examination.condition,
            notes=scatter_in_words(scatter, direct=run.direct),
            remarks=(
                *one_way_in_words(run, request.terms),
                *remarks_in_words(coefficients, covariance),
            ),
            sources=(
                *sources_of_stand(fit, [c.key for c in coefficients]),
                *(doubt.listed for doubt in doubts if doubt.listed),
            ),
            scale_factor_tolerance=run.model.tolerance,
            gravity=gravity_in_words(run),
            budget=BudgetTable(budget),
            diagnostics=replace(
                with_slow_counts(diagnose(residuals, plain, (counted,)), record).with_scatter(scatter),
                model_comparison=compared,
            ),
            segments=segment_table(design, residuals),
            provenance=provenance(dict(run.input_sha256), options),
            temperature_reference=request.temperature_reference,
            time_reference=design.time_reference,
            residuals=residuals,
            history=history_of(fit) if request.method == "recursive" else None,
            unit=run.unit,
        )
        result = _with_remarks(result, fit, self.candidates, doubts)
        return _with_creep(result, run, find_creep(fit.record, coefficients))

    def servo(self) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
        """Given coefficients of the servo, and the same moved by each source of Type B that affects them."""
        moving = [s for s in sources(self.run) if "servo" in s.fields] if self.run.servo else []
        return given_servo(self.run), {source.name: given_servo(source.moved) for source in moving}


@dataclass(frozen=True)
class SeveralRuns:
    """The fit of several runs or summaries of runs together."""

    fit: JointFit

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        """Coefficients by Type A."""
        return self.fit.coefficients

    @property
    def covariance(self) -> Array:
        """Their covariance."""
        return self.fit.covariance

    @property
    def degrees(self) -> Array:
        """Their degrees of freedom."""
        return self.fit.degrees

    def budget(self, steps: Steps) -> Budget:
        """The budget of the stated sources of all runs."""
        changes_by_source = list(joint_contributions(self.fit, steps))
        in_fit = tuple(source.in_fit for source, _ in changes_by_source)
        return budget_of(self.coefficients, self.covariance, changes_by_source, in_fit)

    def doubts(self) -> tuple[LeftOut, ...]:
        """Signatures of a servo that the model lacks."""
        return left_out_of_runs(self.fit)

    def result(
        self,
        coefficients: tuple[Coefficient, ...],
        covariance: Array,
        budget: tuple[BudgetEntry, ...],
        doubts: tuple[LeftOut, ...],
    ) -> Calibration:
        """The calibration with its residuals and remarks."""
        fit, runs = self.fit, [live.run for live in self.fit.live if live]
        result = replace(
            _joint_result(fit, coefficients, covariance, budget),
            sources=(*joint_sources_of_stand(fit), *(doubt.listed for doubt in doubts if doubt.listed)),
            scale_factor_tolerance=max((run.model.tolerance for run in runs), default=0.01),
            gravity="; ".join(dict.fromkeys(filter(None, map(gravity_in_words, runs)))),
        )
        said = ((doubt.largest_shift(coefficients), doubt.words) for doubt in doubts if doubt.words)
        result = _with_sentences(result, said)
        crept = creep_of_runs(fit, coefficients)
        if crept is None:
            return result
        live, creep = crept
        return _with_creep(result, live.run, creep, live.name)

    def servo(self) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
        """Given coefficients of the servo, and the same moved by each source of Type B that affects them."""
        summaries = self.fit.summaries
        given = dict(summaries[0].known_servo)
        moved = {
            source.name: dict(summaries[index].sources[number].known_servo)
            for source, numbers in joint_sources(summaries)
            for index, number in list(numbers.items())[:1]
        }
        return given, moved if given else {}


def _joint_result(
    fit: JointFit, coefficients: tuple[Coefficient, ...], covariance: Array, budget: tuple[BudgetEntry, ...]
) -> Calibration:
    """The result of several runs; residuals and quality of each run under its own name."""
    _refuse_useless(fit, coefficients)
    kinds = {summary.kind for summary in fit.summaries}
    kind = kinds.pop() if len(kinds) == 1 else "angle"
    parts = [_live_part(fit, i, live, kind) if live else None for i, live in enumerate(fit.live)]
    records, segments = [], []
    for index, part in enumerate(parts):
        own = fit.summaries[index].segments if part is None else part.segments
        records.append(_record(fit, index, part))
        segments += [replace(row, label=f"{fit.summaries[index].name}:{row.label}") for row in own]
    residuals = _all_residuals(fit, parts)
    held = [part for part in parts if part is not None]
    scatter = max((part.scatter for part in held), key=lambda one: one.worst, default=SegmentScatter())
    products = tuple(part.products for part in held)
    direct = fit.summaries[0].unit != GYRO
    notes = scatter_in_words(scatter, direct=direct)
    angle: Literal["angle", "count"] = "count" if direct else "angle"
    plain = Diagnostics(residual_kind="rate" if kind == "rate" else angle, range=_ranges(fit))
    weights = np.array([record.rows for record in records], dtype=float)
    first = fit.summaries[0]
    tests = diagnose(residuals, plain, products) if residuals is not None else plain
    for live in fit.live:
        tests = tests if live is None else with_slow_counts(tests, live.run)
    return Calibration(
        serial=first.serial,
        scale_factor_nominal=first.scale_factor,
        terms=fit.wish.terms,
        phases="per-segment" if any(s.phases == "per-segment" for s in fit.summaries) else "shared",
        phase_source="output",
        method="information",
        coefficients=coefficients,
        covariance=covariance,
        surplus_observations=float(sum(s.count for s in fit.summaries) - len(coefficients)),
        angle_rms=_mean_square([r.angle_rms for r in records], weights),
        angle_random_walk=_mean_square([r.angle_random_walk for r in records], weights),
        residual_rms=_mean_square([r.residual_rms for r in records], weights),
        residual_rms_before=_mean_square([r.residual_rms_before for r in records], weights),
        residual_max_before=max(r.residual_max_before for r in records),
        residual_max_after=max(r.residual_max_after for r in records),
        quality=_joint_quality(records),
        condition=fit.examination.condition,
        notes=notes,
        remarks=(
            *remarks_in_words(coefficients, covariance),
            *_notes_on_runs(records),
        ),
        budget=BudgetTable(budget),
        diagnostics=tests.with_scatter(scatter),
        segments=tuple(segments),
        provenance=_provenance(fit),
        temperature_reference=first.temperature_reference,
        time_reference=first.time_reference,
        residuals=residuals,
        runs=tuple(records),
        outliers=tuple(replace(o, run=s.name) for s in fit.summaries for o in s.outliers),
        unit=first.unit,
    )


class _LivePart(NamedTuple):
    """Residuals of a run under the joint estimate, its segments, their scatter, and its lagged products."""

    residuals: Residuals
    segments: tuple[SegmentSummary, ...]
    scatter: SegmentScatter
    products: Products


def _live_part(fit: JointFit, index: int, live: LiveRun, kind: str) -> _LivePart:
    """Residuals of a run under the joint estimate, its segments, their scatter, and its lagged products.

    Residual rates are converted to angles if runs of both kinds are joined (``kind`` is that of all residuals).
    """
    summary = fit.summaries[index]
    design, values = fit.design_of(index, live)
    residuals = find_residuals(design, values, live.fit.noise, live.fit.mode)
    scatter = segment_scatter(design, residuals, live.fit.noise)
    products = partial(counted_products, design, live.fit.noise, live.fit.mode, residuals)
    if summary.kind != kind:
        residuals = residual_angles(residuals, "rate")
    return _LivePart(residuals, segment_table(design, residuals), scatter, products)


def _record(fit: JointFit, index: int, part: _LivePart | None) -> RunRecord:
    summary = fit.summaries[index]
    figures = summary.figures if part is None else residual_figures(part.residuals)
    return RunRecord(
        name=summary.name,
        source=summary.source,
        stand=summary.stand,
        phases=summary.phases,
        raw=part is not None,
        rows=summary.count,
        angle_rms=summary.noise.angle_rms,
        angle_random_walk=summary.noise.angle_random_walk,
        **figures,
        quality=summary.quality,
        undetermined=summary.undetermined,
        input_sha256=summary.input_sha256,
    )


def _all_residuals(fit: JointFit, parts: list[_LivePart | None]) -> Residuals | None:
    """Residuals of all runs with raw data, one after the other."""
    pieces: list[Residuals] = []
    run_of: list[int] = []
    offset = 0
    for index, part in enumerate(parts):
        if part is not None:
            pieces.append(replace(part.residuals, segment=part.residuals.segment + np.int32(offset)))
            run_of.append(index)
        offset += len(fit.summaries[index].segments if part is None else part.segments)
    if not pieces:
        return None
    names = ("row", "t", "psi", "a_x", "before", "after", "innovation", "segment")
    columns = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names}
    run = np.repeat(np.array(run_of, dtype=np.int32), [piece.t.size for piece in pieces])
    return Residuals(**columns, run=run, unit=pieces[0].unit)


def _mean_square(values: list[float], weights: Array) -> float:
    return float(np.sqrt(np.average(np.square(values), weights=weights)))


def _joint_quality(records: list[RunRecord]) -> Quality:
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


def _ranges(fit: JointFit) -> dict[str, tuple[float, float]]:
    """Range in which the calibration is valid: that of all runs together."""
    result: dict[str, tuple[float, float]] = {}
    for summary in fit.summaries:
        for name, (low, high) in summary.ranges.items():
            now_low, now_high = result.get(name, (low, high))
            result[name] = (min(low, now_low), max(high, now_high))
    return result


def _refuse_useless(fit: JointFit, coefficients: tuple) -> None:
    ranges = _ranges(fit)
    largest = max(*(abs(v) for v in ranges["a_x"]), ranges["a_t"][1])
    duration = max(sum(segment.duration for segment in s.segments) for s in fit.summaries)
    spread = float(np.ptp(ranges["temperature"])) if "temperature" in ranges else 0.0
    refuse_useless(coefficients, largest, duration, spread)


def _provenance(fit: JointFit) -> Provenance:
    """Hashes of the inputs of all runs. A file name that occurs twice is marked with its run."""
    hashes: dict[str, str] = {}
    for summary in fit.summaries:
        for name, digest in summary.input_sha256.items():
            hashes[name if hashes.get(name, digest) == digest else f"{summary.name}: {name}"] = digest
    options = {"runs": [s.source or s.name for s in fit.summaries], "per_run": list(fit.wish.per_run)}
    return provenance(hashes, options)


def _with_remarks(
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
    return _with_sentences(result, cause)


def _with_sentences(result: Calibration, sentences: Iterable[tuple[float, str]]) -> Calibration:
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


def _with_creep(result: Calibration, run: Run, creep: Creep | None, name: str = "") -> Calibration:
    """The result with a creep in its diagnostics: a doubt if it moves a coefficient by more than u, else a remark.

    ``name`` is that of the run among several.
    """
    result = replace(result, diagnostics=replace(result.diagnostics, creep=creep))
    if creep is None or not creep.seen or result.diagnostics.advice:
        return result
    words = (f"run '{name}': " if name else "") + creep_in_words(run, creep)
    return _with_sentences(result, [(creep.largest_shift, words)])
