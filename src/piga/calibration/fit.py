"""The fit of one run. Linear estimate and weights are computed in turn until both are stable; then the intervals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from piga.calibration.intervals import Repetition
from piga.calibration.model.design import Design
from piga.calibration.model.identifiability import Examination, examine, refuse_if_confounded
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request
from piga.calibration.model.solution import Solution, name_coefficients, solve
from piga.calibration.outliers import (
    find_flags,
    first_noise,
    is_misfit,
    is_too_many,
    later_noise,
    leave_out,
    misses_of,
    resolution_of,
    robust_values,
    suspicious,
    without_rates,
)
from piga.calibration.servo import at_phases, reduce_settled
from piga.calibration.weights import (
    RATE,
    Noise,
    Positions,
    find_noise,
    find_scatter,
    of_segments,
    reduce_between,
    residual_increments,
    starting_noise,
    weighting_mode,
    with_scatter,
)
from piga.errors import CalibrationError
from piga.records.calibration.diagnostics import Outlier
from piga.records.run import Run
from piga.results import Array

_REFITS = 4
"""Most fits; the weights are usually stable after two."""
_ROUNDS = 5
"""Most rounds of leaving samples out and fitting again; two or three are usual."""


@dataclass(frozen=True)
class Fit:
    """A finished fit of one run.

    ``rows`` are the triangles ``[model | rate | y]`` of the positions, without scatter; servo columns have no phase.
    ``d`` and ``h`` are the residual increments and their intervals. ``outliers`` are the samples left out.
    """

    design: Design
    mode: str
    noise: Noise
    rows: list[Reduction]
    solution: Solution
    examination: Examination
    d: Array = field(repr=False)
    h: Array = field(repr=False)
    outliers: tuple[Outlier, ...] = ()

    @cached_property
    def positions(self) -> list[Reduction]:
        """The same triangles with the servo columns at the phases of the fit."""
        return at_phases(self.design, self.rows)


def fit_run(run: Run, request: Request, stated: tuple[float, ...] = ()) -> Fit:
    """Fit a run. Samples that do not lie on the path of the output are left out first.

    ``stated`` [rad^2/s^2] is the variance of the rate of each segment by the run file.

    Raises
    ------
    DataError
        If more than two in five of the samples are bad.
    """
    fit = plain = _fit(run, request, stated)
    parameters = fit.solution.parameters
    d = fit.d - _scattered(fit)
    if request.phase_source == "input" or not suspicious(d, fit.h, fit.mode, fit.noise, run, parameters):
        return fit
    plain.design.forget()
    raw = Design(run, request, run.scale_factor, plain.design.servo)
    resolution = resolution_of(run)
    misses = misses_of(raw, robust_values(raw))
    if fit.noise.rate_variances(len(run.labels)).any():
        misses = without_rates(misses, Positions.of(run).edges, resolution)
    raw.forget()
    noise = first_noise(misses, parameters)
    flags = find_flags(misses, noise, resolution, parameters)
    for _ in range(_ROUNDS):
        if not flags.any() or is_misfit(run, misses, flags) or is_too_many(flags):
            return plain
        cleaned, outliers = leave_out(run, misses, flags, free=request.phases == "per-segment")
        fit.design.forget()
        fit = replace(_fit(cleaned, request, stated), outliers=outliers)
        raw = raw.with_phase_of(fit.design)
        misses = misses_of(raw, fit.solution.values)
        misses = replace(misses, d=misses.d - _scattered(fit))
        raw.forget()
        noise = later_noise(misses, fit.noise, flags, parameters)
        again = find_flags(misses, noise, resolution, parameters)
        if np.array_equal(again, flags):
            break
        flags = again
    return fit


def _fit(run: Run, request: Request, stated: tuple[float, ...]) -> Fit:
    """Alternate between the linear fit and the weights until they agree."""
    raw = Design(run, request, run.scale_factor)
    mode = weighting_mode(raw, request.method)
    if raw.rows <= len(raw.names) + len(set(raw.groups)):
        raise CalibrationError(
            f"the record has {raw.rows} increments, too few for {len(raw.names)} parameters",
            remedy="record longer, or leave terms out",
        )
    positions, given = Positions.of(run), _given_noise(request)
    own = () if positions.continuous or not stated else stated
    noise = replace(given or starting_noise(run.resolution, run.median_step), stated=own)
    for refit in range(_REFITS):
        design, rows = reduce_settled(raw, mode, noise)
        parts = at_phases(design, rows)
        summaries = of_segments([part.select(design.names) for part in parts], positions)
        examination = examine(design, summaries)
        refuse_if_confounded(examination)
        solution = solve(design, summaries)
        refined = raw.with_scale_factor(_scale_factor(design, solution))
        d, h = residual_increments(design, solution.values)
        levels = given or find_noise(design, d, h, solution.parameters, mode)
        step = run.median_step
        settled = refined is raw and levels.close_to(noise, step, design.rows // len(run.labels))
        if settled or refit == _REFITS - 1:
            break
        noise, raw = replace(levels, stated=own), refined
    if given is None and mode != "rates" and not positions.continuous:
        noise = find_scatter(parts, noise, design.local_names if design.has_phases else ())
    if noise.rate_variances(positions.count).any():
        summaries = of_segments(with_scatter(parts, noise), positions)
        solution = solve(design, summaries)
        d, h = residual_increments(design, solution.values)
    return Fit(design, mode, noise, rows, solution, examination, d, h)


def _scattered(fit: Fit) -> Array:
    """Increments by the likeliest rates of the positions, where they scatter; otherwise they would look like bad samples."""
    positions, m = Positions.of(fit.design.run), len(fit.design.names)
    variances, rates = fit.noise.rate_variances(positions.count), np.zeros(positions.count)
    for k, (part, segment) in enumerate(zip(fit.positions, positions.segments.tolist(), strict=True)):
        own, missed = part.factor[:, m], part.factor[:, -1] - part.factor[:, :m] @ fit.solution.values[segment]
        rates[k] = variances[k] * (own @ missed) / (1.0 + variances[k] * (own @ own))
    increments = np.repeat(rates, np.diff(positions.edges))
    increments *= np.maximum(fit.h, 0.0)
    return increments


def _given_noise(request: Request) -> Noise | None:
    if request.angle_rms is None or request.angle_random_walk is None:
        return None
    return Noise(request.angle_rms**2, request.angle_random_walk**2)


def _scale_factor(design: Design, solution: Solution) -> float:
    if not design.estimates_scale_factor:
        return design.run.scale_factor
    coupled = 1 if "p" in design.local_names else 0
    local = len(design.local_names) - 2 * coupled
    return float(solution.amplitudes[coupled + local + design.shared_names.index("scale_factor")])


def repetitions(
    design: Design, noise: Noise, parts: list[Reduction], positions: Positions | None = None
) -> tuple[Repetition, ...]:
    """The positions of a run, with their triangles, as repetitions of the measurement."""
    run, positions = design.run, positions or Positions.of(design.run)
    begin, end = positions.times(run)
    names = [run.labels[k] for k in positions.segments.tolist()]
    if positions.continuous:
        names = [f"{k + 1} of {positions.count}" for k in range(positions.count)]
    variances = noise.rate_variances(positions.count).tolist()
    columns = zip(parts, positions.segments.tolist(), variances, names, begin, end, strict=True)
    return tuple(
        Repetition(
            part, design.groups[segment], variance, name, float(t0), float(t1), block=positions.continuous
        )
        for part, segment, variance, name, t0, t1 in columns
    )


POINTS = 400
"""Points of the history; a tenth of it when every segment has its own phase."""


def history_of(fit: Fit) -> dict[str, Array]:
    """Estimate and standard uncertainty after the first samples, up to the whole record (file units)."""
    rows, samples = [], []
    keys: tuple[str, ...] = ()
    for mark, summaries in _growing(fit):
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


def _growing(fit: Fit) -> Iterator[tuple[int, list[Reduction]]]:
    """Number of samples, and one summary for each segment begun; the last item is that of the whole record."""
    design, run = fit.design, fit.design.run
    points = POINTS if not design.has_phases else POINTS // 10
    marks = np.unique(np.linspace(min(run.size, 2 * len(design.names)), run.size, points).astype(np.int64))
    edges = np.union1d(run.segment_edges(), marks)
    variances = fit.noise.rate_variances(len(run.labels)).tolist()
    parts: list[Reduction] = []
    pieces = reduce_between(design, fit.mode, fit.noise, edges)[0]
    for piece, start, stop in zip(pieces, edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if run.segment_index[start] < len(parts):
            parts[-1].merge(piece)
        else:
            parts.append(piece)
        if stop in marks:
            yield stop, [part.without((RATE,), own) for part, own in zip(parts, variances, strict=False)]
