"""The fit of one run. Linear estimate and weights are computed in turn until both are stable; then the intervals."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from piga.calibration.merged import MergedRuns, RunTriangles, Wish
from piga.calibration.model.design import Design, ServoState
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
from piga.calibration.weights import (
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

    ``design`` has the servo columns at the phases of the fit, ``runs`` holds the triangles of the positions without a phase.
    ``values`` (segments, m) are the column coefficients, ``d`` and ``h`` the residual increments and their intervals.
    ``outliers`` are the samples left out.
    """

    design: Design
    mode: str
    runs: MergedRuns
    servo: ServoState | None
    values: Array
    estimate: Estimate
    d: Array = field(repr=False)
    h: Array = field(repr=False)
    noise: Noise
    outliers: tuple[Outlier, ...] = ()

    @property
    def triangles(self) -> RunTriangles:
        """The triangles ``[model | rate | y]`` of the positions."""
        return self.runs.summaries[0]


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
    positions, given = Positions.of(run), _given_noise(request)
    own = () if positions.continuous or not stated else stated
    noise = replace(given or starting_noise(run.resolution, run.median_step), stated=own)
    for refit in range(_REFITS):
        triangles = RunTriangles.of_rows("", raw, _of_rows(noise), reduce_positions(raw, mode, noise))
        fit = _solved(raw, mode, triangles)
        refined = raw.with_scale_factor(_scale_factor(fit))
        levels = given or find_noise(fit.design, fit.d, fit.h, fit.estimate.parameters, mode)
        step = run.median_step
        settled = refined is raw and levels.close_to(noise, step, raw.rows // len(run.labels))
        if settled or refit == _REFITS - 1:
            break
        noise, raw = replace(levels, stated=own), refined
    if given is None and mode != "rates" and not positions.continuous:
        parts = [position.part for position in fit.runs.positions(0, fit.servo)]
        noise = find_scatter(parts, noise, raw.local_names if raw.has_phases else ())
    if noise.rate_variances(positions.count).any():
        fit = _solved(raw, mode, triangles.weighted(noise))
    return replace(fit, noise=noise)


def _of_rows(noise: Noise) -> Noise:
    """The levels of the rows within positions."""
    return replace(noise, scatter=0.0, stated=(), counted=())


def _solved(raw: Design, mode: str, triangles: RunTriangles) -> Fit:
    """The fit with these weights; raises if the record cannot determine what is asked."""
    runs = MergedRuns.of(Wish.of_one(raw.request.terms), [triangles])
    state, _, estimate = runs.solved()
    design, values = runs.design_at(raw, estimate, state)
    d, h = residual_increments(design, values)
    return Fit(design, mode, runs, state, values, estimate, d, h, triangles.noise)


def _scattered(fit: Fit) -> Array:
    """Increments by the likeliest rates of the positions, where they scatter; otherwise they would look like bad samples."""
    positions, m = Positions.of(fit.design.run), len(fit.design.names)
    rates = np.zeros(positions.count)
    pairs = zip(fit.runs.positions(0, fit.servo), positions.segments.tolist(), strict=True)
    for k, (position, segment) in enumerate(pairs):
        rows, variance = position.part.factor, position.variance
        own, missed = rows[:, m], rows[:, -1] - rows[:, :m] @ fit.values[segment]
        rates[k] = variance * (own @ missed) / (1.0 + variance * (own @ own))
    increments = np.repeat(rates, np.diff(positions.edges))
    increments *= np.maximum(fit.h, 0.0)
    return increments


def _given_noise(request: Request) -> Noise | None:
    if request.angle_rms is None or request.angle_random_walk is None:
        return None
    return Noise(request.angle_rms**2, request.angle_random_walk**2)


def _scale_factor(fit: Fit) -> float:
    keys = fit.runs.layout.amplitude_keys
    if ("scale_factor", None) not in keys:
        return fit.design.run.scale_factor
    return float(fit.estimate.amplitudes[keys.index(("scale_factor", None))])
