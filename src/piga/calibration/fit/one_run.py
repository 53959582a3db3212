"""The fit of one run. The linear estimate and the noise levels are computed in turn until both are stable."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from piga.calibration.fit.outliers import (
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
)
from piga.calibration.fit.servo import settled_design
from piga.calibration.model.design import Design
from piga.calibration.model.identifiability import Examination, examine, refuse_if_confounded
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request
from piga.calibration.model.solution import Solution, solve
from piga.calibration.noise.counted import Counted, fit_counted
from piga.calibration.noise.levels import (
    Information,
    Noise,
    find_noise,
    is_long,
    natural_spline,
    rounding,
    starting_noise,
)
from piga.calibration.noise.settings import NOISE
from piga.calibration.noise.weighting import (
    NoiseColumns,
    Whitener,
    reduce_segments,
    residual_increments,
    weighted_blocks,
    weighting_mode,
)
from piga.errors import CalibrationError
from piga.records.calibration import Outlier
from piga.records.run import Run
from piga.records.spool import square_sum
from piga.results import Array


@dataclass(frozen=True)
class FitSettings:
    """Settings of the fit of one run (own choices)."""

    refits: int = 4
    """Most fits; the noise levels are usually stable after two or three."""
    rounds: int = 5
    """Most rounds of leaving samples out and fitting again; two or three are usual."""
    joined_fits: int = 3
    """Fits of joined rows for the first weights of a long record."""


FIT = FitSettings()


@dataclass(frozen=True)
class FaintWalk:
    """A random walk that is not significant.

    ``walk`` [rad^2/s] is its likely variance; it is negative if the slow values scatter less than white noise. ``part`` is
    the covariance of the fit added per unit of walk. ``information`` (2, 2) is the Fisher information of white noise and walk.
    """

    walk: float
    part: Array
    information: Array


@dataclass(frozen=True)
class Colour:
    """Coloured noise of the rate, in the covariance of a fit and not in its weights.

    ``name`` is the likeliest component, ``variance`` its level, ``deviation`` the standard uncertainty of that, ``time``
    its correlation time [s] (0: it has none), ``gain`` the gain of twice the log-likelihood. ``walk`` [rad^2/s] is what
    is added to the random walk of the weights, ``rms`` [rad/s] the standard deviation of the rate of a part. ``degrees``
    are the degrees of freedom of the coefficients. ``walk_deviation`` is the standard uncertainty of ``walk``,
    ``walk_shared`` its covariance with ``variance``.
    """

    name: str
    variance: float
    deviation: float
    time: float
    gain: float
    walk: float
    rms: float
    degrees: Array = field(repr=False)
    walk_deviation: float = 0.0
    walk_shared: float = 0.0


@dataclass(frozen=True)
class Fit:
    """A finished fit: the model, its noise levels, summaries per segment, solution and covariance.

    ``d`` and ``h`` are the residual increments and their intervals; ``outliers`` are the samples left out.
    ``slow_deviation`` is the standard uncertainty of ``noise.slow``. ``slow_part`` is the covariance added per unit of
    slow noise if the weights do not include it. ``faint`` is a random walk that is not significant. ``colour`` is coloured
    noise in the covariance.
    """

    design: Design
    mode: str
    noise: Noise
    summaries: list[Reduction]
    solution: Solution
    covariance: Array
    examination: Examination
    d: Array = field(repr=False)
    h: Array = field(repr=False)
    outliers: tuple[Outlier, ...] = ()
    counted: Counted | None = None
    slow_deviation: float = 0.0
    slow_part: Array | None = field(default=None, repr=False)
    faint: FaintWalk | None = field(default=None, repr=False)
    colour: Colour | None = None

    @property
    def seeks_noise(self) -> bool:
        """True if every kind of noise is searched for: no level is given; the method is whitened least squares in one pass."""
        return self.design.request.method == "information" and self.design.request.angle_rms is None

    @property
    def weights(self) -> Noise:
        """The noise levels in the weights of the rows."""
        return self.noise if self.slow_part is None else self.noise.without_slow()

    def reduce(self, design: Design) -> list[Reduction]:
        """One summary per segment of a record with the same sampling, with the weights of the fit."""
        if self.counted is not None:
            return self.counted.reduce(design)
        return reduce_segments(design, self.mode, self.weights)

    @property
    def levels(self) -> Noise:
        """The noise levels in the covariance."""
        return self.noise if self.faint is None else replace(self.noise, walk=self.faint.walk)

    @property
    def coloured_rms(self) -> float:
        """Standard deviation of the rate by coloured noise [rad/s]; 0 without it."""
        return 0.0 if self.colour is None else self.colour.rms

    @property
    def sample_variance(self) -> float:
        """Variance of a sample of a rate log [rad^2/s^2]."""
        return self.noise.walk / self.design.run.median_step


def fit_run(
    run: Run,
    request: Request,
) -> Fit:
    """Fit a run. Samples that do not lie on the path of the output are left out first.

    Raises
    ------
    DataError
        If more than ``OUTLIERS.largest_share`` of the samples are bad.
    """
    fit = plain = _fit(run, request)
    parameters = fit.solution.parameters
    if request.phase_source == "input" or not suspicious(fit.d, fit.h, fit.mode, fit.noise, run, parameters):
        return fit
    plain.design.forget()
    raw = Design(run, request, run.scale_factor, plain.design.servo)
    resolution = resolution_of(run)
    misses = misses_of(raw, robust_values(raw))
    raw.forget()
    noise = first_noise(misses, parameters)
    flags = find_flags(misses, noise, resolution, parameters)
    for _ in range(FIT.rounds):
        if not flags.any() or is_misfit(run, misses, flags) or is_too_many(flags):
            return plain
        cleaned, outliers = leave_out(run, misses, flags, free=request.phases == "per-segment")
        fit.design.forget()
        fit = replace(_fit(cleaned, request), outliers=outliers)
        raw = raw.with_phase_of(fit.design)
        misses = misses_of(raw, fit.solution.values)
        raw.forget()
        noise = later_noise(misses, fit.noise, flags, parameters)
        again = find_flags(misses, noise, resolution, parameters)
        if np.array_equal(again, flags):
            break
        flags = again
    return fit


def _fit(
    run: Run,
    request: Request,
) -> Fit:
    """Alternate between the linear fit and the noise levels until they agree."""
    design = Design(run, request, run.scale_factor)
    mode = weighting_mode(design, request.method)
    if design.rows <= len(design.names) + len(set(design.groups)):
        raise CalibrationError(
            f"the record has {design.rows} increments, too few for {len(design.names)} parameters",
            remedy="record longer, or leave terms out",
        )
    given = _given_noise(request)
    step = run.median_step
    noise = given or starting_noise(run.resolution, step)
    if given is None and mode == "increments" and is_long(design.rows):
        noise = _noise_of_joined(design, mode, noise)
    information = None
    for refit in range(FIT.refits):
        design = settled_design(design, mode, noise)
        summaries = reduce_segments(design, mode, noise)
        examination = examine(design, summaries)
        refuse_if_confounded(examination)
        solution = solve(design, summaries)
        refined = design.with_scale_factor(_scale_factor(design, solution))
        if refit == 0 and given is None:
            information = _information(design, mode, step)
        d, h = residual_increments(design, solution.values)
        levels = given or _levels(
            design, d, h, solution.parameters, mode, noise if refit else None, information
        )
        settled = refined is design and (mode != "increments" or levels.close_to(noise, step, design.rows))
        if settled:
            noise = noise if mode == "increments" else levels
            break
        noise, design = levels, refined
    covariance = _covariance(design, mode, noise, solution)
    return Fit(
        design=design,
        mode=mode,
        noise=noise,
        summaries=summaries,
        solution=solution,
        covariance=covariance,
        examination=examination,
        d=d,
        h=h,
    )


def _noise_of_joined(design: Design, mode: str, noise: Noise) -> Noise:
    """Noise levels of a long record from joined rows. Joined increments have the same noise over longer intervals."""
    for _ in range(FIT.joined_fits):
        whitener = Whitener(mode, noise, len(design.names) + 1)
        summaries = [Reduction.empty(design.names) for _ in design.run.labels]
        for joined in design.joined():
            summaries[joined.segment].absorb(whitener.apply_columns(joined.columns, joined.h))
        if examine(design, summaries).null_terms:
            return noise
        solution = solve(design, summaries)
        d = [one.columns[-1] - solution.values[one.segment] @ one.columns[:-1] for one in design.joined()]
        h = np.concatenate([one.h for one in design.joined()])
        step = float(np.median(h[h > 0.0]))
        noise = find_noise(np.concatenate(d), h, step, solution.parameters, rounding(design.run))
    return noise


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


def _information(design: Design, mode: str, step: float) -> Information | None:
    """``log|X' V^-1 X|`` as a smooth function of ``log10(q h/r)``; None for long records, which do not need it."""
    if mode != "increments" or design.rows > NOISE.restricted_rows:
        return None
    values = []
    for ratio in NOISE.information_ratios:
        noise = Noise(1.0, 10.0**ratio / step)
        values.append(-log_determinant(solve(design, reduce_segments(design, mode, noise))))
    return natural_spline(np.array(NOISE.information_ratios), np.array(values))


def log_determinant(solution: Solution) -> float:
    """Log-determinant of the covariance, with rows and columns scaled to one first."""
    std = np.sqrt(np.diag(solution.covariance))
    return float(np.linalg.slogdet(solution.covariance / np.outer(std, std))[1] + 2.0 * np.log(std).sum())


def noise_of(design: Design, solution: Solution, mode: str) -> Noise:
    """Noise levels of the residuals of a solution."""
    d, h = residual_increments(design, solution.values)
    return _levels(design, d, h, solution.parameters, mode)


def _levels(
    design: Design,
    d: Array,
    h: Array,
    parameters: int,
    mode: str,
    near: Noise | None = None,
    information: Information | None = None,
) -> Noise:
    if mode == "samples":
        variance = square_sum(d) / max(design.rows - parameters, 1)
        return Noise(0.0, variance * design.run.median_step)
    return find_noise(d, h, design.run.median_step, parameters, rounding(design.run), near, information)


def _covariance(design: Design, mode: str, noise: Noise, solution: Solution) -> Array:
    """Covariance of the internal parameters; for the rate method it includes the colour of the noise."""
    if mode == "increments":
        return solution.covariance
    if mode == "samples":
        return solution.covariance * (noise.walk / design.run.median_step)
    size, m = solution.covariance.shape[0], len(design.names)
    meat = np.zeros((size, size))
    for block, columns in weighted_blocks(design, mode, noise):
        x = columns[:m]
        inverse = np.divide(1.0, block.h, out=np.zeros_like(block.h), where=block.h > 0.0)
        variance = (noise.walk * block.h + 2.0 * noise.white) * inverse**2
        cross = (x[:, :-1] * inverse[:-1]) @ (x[:, 1:] * inverse[1:]).T * noise.white
        jacobian = solution.jacobians[design.groups[block.segment]]
        meat += jacobian.T @ ((x * variance) @ x.T - cross - cross.T) @ jacobian
    covariance: Array = solution.inverse @ meat @ solution.inverse
    if solution.shift is not None:
        variance = solution.cost / max(design.rows - solution.parameters, 1)
        covariance = covariance + variance * np.outer(solution.shift, solution.shift)
    return covariance


def refine_counted(fit: Fit) -> Fit:
    """The same fit with the covariance of coarse counts; unchanged if plain whitening is right."""
    refined = fit_counted(fit.design, fit.mode, fit.noise, fit.solution, fit.d)
    if refined is None:
        return fit
    return replace(fit, **vars(refined), covariance=refined.solution.covariance)


def whitened_rows(fit: Fit, design: Design, noise: Noise, basis: NoiseColumns) -> Iterator[tuple[int, Array]]:
    """Segment and whitened columns (m + size + 1, n) of model, slow noise and observation, piece by piece.

    ``noise`` whitens the increments. Coarse counts use their own covariance.
    """
    if fit.counted is not None:
        yield from fit.counted.whitened(design, basis)
        return
    for block, columns in weighted_blocks(design, fit.mode, noise, basis):
        yield block.segment, columns


def without_slow(fit: Fit) -> Fit:
    """The fit with the weights of white noise and random walk only; one summary per segment."""
    if fit.colour is not None:
        covariance = _covariance(fit.design, fit.mode, fit.noise, fit.solution)
        return replace(fit, covariance=covariance, colour=None)
    if fit.noise.slow == 0.0:
        return fit
    noise = fit.noise.without_slow()
    if fit.slow_part is not None:
        return replace(fit, noise=noise, covariance=fit.solution.covariance)
    summaries = reduce_segments(fit.design, fit.mode, noise)
    solution = solve(fit.design, summaries)
    return replace(fit, noise=noise, summaries=summaries, solution=solution, covariance=solution.covariance)
