"""The fit of one run. Linear estimate and weights are computed in turn until both are stable; then the intervals."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from piga.calibration.intervals import parameter_rows
from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request
from piga.calibration.model.solution import Estimate
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
from piga.calibration.summary import MergedRuns, RunSummary
from piga.calibration.weights import (
    RATE,
    Noise,
    Positions,
    find_noise,
    find_scatter,
    reduce_positions,
    residual_increments,
    starting_noise,
    weighting_mode,
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

    ``runs`` holds the triangles of the positions.
    ``values`` (segments, m) are the column coefficients, ``d`` and ``h`` the residual increments and their intervals.
    ``outliers`` are the samples left out.
    """

    design: Design
    mode: str
    runs: MergedRuns
    values: Array
    estimate: Estimate
    d: Array = field(repr=False)
    h: Array = field(repr=False)
    outliers: tuple[Outlier, ...] = ()

    @property
    def run(self) -> Run:
        """The record as used."""
        return self.design.run

    @property
    def request(self) -> Request:
        """The request with the terms of the fit."""
        return self.design.request

    @property
    def summary(self) -> RunSummary:
        """The triangles ``[model | rate | y]`` of the positions, with what is needed to solve them."""
        return replace(self.runs.summaries[0], outliers=self.outliers)

    @property
    def noise(self) -> Noise:
        """The levels that weigh the rows."""
        return self.runs.summaries[0].noise


def fit_run(run: Run, request: Request, stated: tuple[float, ...] = ()) -> Fit:
    """Fit a run. Samples that do not lie on the path of the output are left out first.

    ``stated`` [rad^2/s^2] is the variance of the rate of each segment by the run file.

    Raises
    ------
    DataError
        If more than two in five of the samples are bad.
    """
    fit = plain = _fit(run, request, stated)
    parameters = fit.estimate.parameters
    d = fit.d - _scattered(fit)
    if request.phase_source == "input" or not suspicious(d, fit.h, fit.mode, fit.noise, run, parameters):
        return fit
    plain.design.forget()
    raw = Design(run, request, run.scale_factor)
    resolution = resolution_of(run)
    misses = misses_of(raw, robust_values(raw, plain.runs.layout))
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
        misses = misses_of(raw, fit.values)
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
    positions, given = Positions.of(run), None
    if request.angle_rms is not None and request.angle_random_walk is not None:
        given = Noise(request.angle_rms**2, request.angle_random_walk**2)
    own = () if positions.continuous or not stated else stated
    noise = replace(given or starting_noise(run.resolution, run.median_step), stated=own)
    for refit in range(_REFITS):
        of_rows = replace(noise, scatter=0.0, stated=(), counted=())
        summary = RunSummary.of_rows(raw, of_rows, reduce_positions(raw, mode, noise))
        fit = _solved(raw, mode, summary)
        refined = raw.with_scale_factor(fit.runs.scale_factor_of(fit.estimate))
        levels = given or find_noise(fit.design, fit.d, fit.h, fit.estimate.parameters, mode)
        step = run.median_step
        settled = refined is raw and levels.close_to(noise, step, raw.rows // len(run.labels))
        if settled or refit == _REFITS - 1:
            break
        noise, raw = replace(levels, stated=own), refined
    if given is None and mode != "rates" and not positions.continuous:
        noise = find_scatter(_linear_parts(fit), noise, phases=raw.has_phases)
    weighted = summary.weighted(noise)
    if noise.rate_variances(positions.count).any():
        return _solved(raw, mode, weighted)
    return replace(fit, runs=replace(fit.runs, summaries=(weighted,)))


def _solved(raw: Design, mode: str, summary: RunSummary) -> Fit:
    """The fit with these weights; raises if the record cannot determine what is asked."""
    runs = MergedRuns.of([summary], raw.request.terms)
    _, estimate = runs.solved()
    values = runs.values_in_segments(raw, estimate)
    d, h = residual_increments(raw, values)
    return Fit(raw, mode, runs, values, estimate, d, h)


def _linear_parts(fit: Fit) -> list[Reduction]:
    """Triangles ``[parameters | rate | residual]`` of the positions about the fit, each without a phase of its own."""
    layout, estimate = fit.runs.layout, fit.estimate
    at = list(range(layout.size + (0 if fit.design.has_phases else estimate.phases.size)))
    names, positions = (*map(str, at), RATE), fit.runs.positions(0, estimate)
    return [
        Reduction(names, parameter_rows(layout, estimate, p, at, local=fit.design.has_phases), p.part.count)
        for p in positions
    ]


def _scattered(fit: Fit) -> Array:
    """Increments by the likeliest rates of the positions, where they scatter; otherwise they would look like bad samples."""
    positions, m = Positions.of(fit.design.run), len(fit.design.names)
    rates = np.zeros(positions.count)
    pairs = zip(fit.runs.positions(0, fit.estimate), positions.segments.tolist(), strict=True)
    for k, (position, segment) in enumerate(pairs):
        rows, variance = position.part.factor, position.variance
        own, missed = rows[:, m], rows[:, -1] - rows[:, :m] @ fit.values[segment]
        rates[k] = variance * (own @ missed) / (1.0 + variance * (own @ own))
    increments = np.repeat(rates, np.diff(positions.edges))
    increments *= np.maximum(fit.h, 0.0)
    return increments
