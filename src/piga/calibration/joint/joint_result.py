"""Result of a joint fit: residuals and quality of all runs, each under its own name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga.calibration.budget.uncertainty import combined
from piga.calibration.fit.residuals import (
    Products,
    counted_products,
    diagnose,
    find_residuals,
    segment_scatter,
    segment_table,
)
from piga.calibration.joint.joint_fit import JointFit
from piga.calibration.joint.summary import LiveRun, provenance, residual_figures
from piga.calibration.model.identifiability import (
    refuse_useless,
    remarks_in_words,
    scatter_in_words,
)
from piga.records.calibration import (
    BudgetEntry,
    BudgetTable,
    Calibration,
    Diagnostics,
    Event,
    Provenance,
    Quality,
    Residuals,
    RunRecord,
    SegmentScatter,
    SegmentSummary,
)
from piga.records.terms import GYRO, integral_unit
from piga.results import Array


class _LivePart(NamedTuple):
    """Residuals of a run under the joint estimate, its segments, their scatter, and its lagged products."""

    residuals: Residuals
    segments: tuple[SegmentSummary, ...]
    scatter: SegmentScatter
    products: Products


def joint_result(
    fit: JointFit, covariance: Array, budget: tuple[BudgetEntry, ...], degrees: Array
) -> Calibration:
    """The calibration. ``covariance`` is the combined one, in the order of the coefficients.

    ``degrees`` are the degrees of freedom of Type A.
    """
    coefficients = combined(fit.coefficients, covariance, budget, degrees)
    _refuse_useless(fit, coefficients)
    kinds = {summary.kind for summary in fit.summaries}
    kind = kinds.pop() if len(kinds) == 1 else "angle"
    parts = [_live_part(fit, i, live, kind) if live else None for i, live in enumerate(fit.live)]
    records, segments = [], []
    for index, part in enumerate(parts):
        own = _own_segments(fit, index, part)
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
            *remarks_in_words(coefficients, covariance, "shared"),
            *_notes_on_runs(records),
        ),
        budget=BudgetTable(budget),
        diagnostics=(diagnose(residuals, plain, products) if residuals is not None else plain).with_scatter(
            scatter
        ),
        segments=tuple(segments),
        provenance=_provenance(fit),
        temperature_reference=first.temperature_reference,
        time_reference=first.time_reference,
        residuals=residuals,
        runs=tuple(records),
        outliers=tuple(replace(o, run=s.name) for s in fit.summaries for o in s.outliers),
        unit=first.unit,
    )


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
        residuals = _as_angles(residuals)
    return _LivePart(residuals, segment_table(design, residuals), scatter, products)


def _own_segments(fit: JointFit, index: int, part: _LivePart | None) -> tuple[SegmentSummary, ...]:
    return fit.summaries[index].segments if part is None else part.segments


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
        own = _own_segments(fit, index, part)
        if part is not None:
            pieces.append(replace(part.residuals, segment=part.residuals.segment + np.int32(offset)))
            run_of.append(index)
        offset += len(own)
    return _concatenated(pieces, run_of) if pieces else None


def _concatenated(pieces: list[Residuals], run_of: list[int]) -> Residuals:
    def column(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(piece, name) for piece in pieces])

    return Residuals(
        row=column("row"),
        t=column("t"),
        psi=column("psi"),
        a_x=column("a_x"),
        before=column("before"),
        after=column("after"),
        innovation=column("innovation"),
        segment=column("segment"),
        run=np.repeat(np.array(run_of, dtype=np.int32), [piece.t.size for piece in pieces]),
        unit=pieces[0].unit,
    )


def _as_angles(rates: Residuals) -> Residuals:
    step = np.diff(rates.t, prepend=rates.t[:1])
    step[np.diff(rates.segment, prepend=rates.segment[:1]) != 0] = 0.0
    before, after = np.cumsum(step * rates.before), np.cumsum(step * rates.after)
    return replace(rates, before=before, after=after, unit=integral_unit(rates.unit))


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
