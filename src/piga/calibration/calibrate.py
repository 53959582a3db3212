"""Calibrate: from a run to coefficients with uncertainty, and everything that is known about them."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.calibration.budget import budget_row, combined, make_budget
from piga.calibration.coefficients import name_coefficients
from piga.calibration.counted import Counted, refine_counted
from piga.calibration.degrees_of_freedom import type_a_degrees
from piga.calibration.design import Design
from piga.calibration.identifiability import (
    Examination,
    examine,
    notes_in_words,
    refuse_if_confounded,
    refuse_useless,
)
from piga.calibration.noise import Information, Noise, find_noise, starting_noise
from piga.calibration.published import run_published
from piga.calibration.recursive import recursive_history
from piga.calibration.reduction import Reduction
from piga.calibration.request import Request, make_request
from piga.calibration.residuals import diagnose, find_residuals, segment_scatter, segment_table
from piga.calibration.solution import Solution, solve
from piga.calibration.weighting import reduce_segments, residual_increments, weighted_blocks, weighting_mode
from piga.errors import CalibrationError
from piga.records.calibration import Calibration, Coefficient, Provenance, Residuals
from piga.records.run import Run
from piga.records.terms import si_factor, unit_of

Array = NDArray[np.float64]

MAX_REFITS = 4
"""Fits at most: the noise levels settle after two or three."""
SMALL = 200_000
"""Records up to this many increments get the restricted likelihood; in longer ones the few parameters take
no noticeable part of the slow noise."""
RATIOS = np.linspace(-9.0, 3.0, 9)
"""Points of ``log10(q h/r)`` at which the restricted likelihood's information term is computed."""


@dataclass(frozen=True)
class Fit:
    """A finished fit: the model, its noise levels, summaries per segment, solution and covariance."""

    design: Design
    mode: str
    noise: Noise
    summaries: list[Reduction]
    solution: Solution
    covariance: Array
    examination: Examination
    counted: Counted | None = None


def calibrate(
    run: Run,
    terms: list[str] | tuple[str, ...] | None = None,
    method: str | None = None,
    *,
    phase: str | None = None,
    phase_source: str | None = None,
) -> Calibration:
    """Estimate the coefficients of an instrument from a recorded test.

    The error model of ``physics.md`` is linear in its coefficients once the measured output angle is
    used as phase: no first guess, one optimum. Increments of the angle are whitened with the noise levels
    found in the record and reduced orthogonally (``estimation.md``; own derivation in docs/theory).

    Parameters
    ----------
    run:
        The record, from :func:`piga.read_run` or :meth:`piga.Run.from_arrays`.
    terms, method, phase, phase_source:
        Override the wishes of the run file.

    Returns
    -------
    Calibration
        Coefficients with covariance, noise levels, residuals, doubts in words, provenance.

    Raises
    ------
    IdentifiabilityError
        If the record cannot determine what is asked; names the terms and the test that would.
    CalibrationError, ArgumentError
        If the request does not fit the record.
    """
    request = make_request(run, terms, method, phase, phase_source)
    if request.method == "published":
        return _published_calibration(run, request)
    per_segment = request.phase == "per-segment" and ("tan_beta" in request.terms or bool(request.harmonics))
    groups = tuple(range(len(run.labels))) if per_segment else (0,) * len(run.labels)
    fit = refine_counted(_fit(run, request, groups, per_segment), groups)
    coefficients, covariance = name_coefficients(fit.design, fit.solution, fit.covariance, per_segment)
    spread = 0.0 if run.temperature is None else float(np.ptp(run.temperature))
    refuse_useless(coefficients, float(np.abs(run.f).max()), float(np.ptp(run.t)), spread)
    type_a = np.sqrt(np.diag(covariance))
    budget, type_b = make_budget(fit, groups, per_segment, coefficients, type_a)
    covariance = covariance + type_b
    coefficients = combined(coefficients, covariance, budget, type_a_degrees(fit, groups, per_segment))
    residuals = find_residuals(fit.design, fit.solution.values, fit.noise, fit.mode)
    history = _history(fit, groups) if request.method == "recursive" else None
    scatter = segment_scatter(fit.design, residuals, fit.noise)
    notes = notes_in_words(coefficients, covariance, fit.examination.condition, request.phase, scatter)
    return _assemble(run, request, fit, coefficients, covariance, budget, residuals, notes, history)


def _fit(run: Run, request: Request, groups: tuple[int, ...], per_segment: bool) -> Fit:
    """Alternate between the linear fit and the noise levels until they agree."""
    design = Design(run, request, run.scale_factor)
    mode = weighting_mode(design, request.method)
    if design.rows <= len(design.names) + len(set(groups)):
        raise CalibrationError(
            f"the record has {design.rows} increments for {len(design.names)} parameters",
            remedy="record longer",
        )
    given = _given_noise(request)
    steps = np.diff(run.t)[~run.begins[1:]]
    noise = given or starting_noise(run.resolution, float(np.median(steps)))
    information = None
    for refit in range(MAX_REFITS):
        summaries = reduce_segments(design, mode, noise)
        examination = examine(design, summaries, per_segment)
        refuse_if_confounded(examination)
        solution = solve(design, summaries, groups)
        refined = design.with_scale_factor(_scale_factor(design, solution))
        if refit == 0 and given is None:
            information = _information(design, mode, groups, float(np.median(steps)))
        found = given or _noise_of(design, solution, mode, noise if refit else None, information)
        settled = refined is design and (mode != "increments" or found.close_to(noise, float(np.median(steps))))
        if settled:
            noise = noise if mode == "increments" else found
            break
        noise, design = found, refined
    covariance = _covariance(design, mode, noise, solution, groups)
    return Fit(design, mode, noise, summaries, solution, covariance, examination)


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


def _information(design: Design, mode: str, groups: tuple[int, ...], step: float) -> Information | None:
    """``log|X' V^-1 X|`` as a smooth function of ``log10(q h/r)``, for records that are small enough to need it."""
    if mode != "increments" or design.rows > SMALL:
        return None
    from scipy.interpolate import CubicSpline

    values = []
    for ratio in RATIOS:
        noise = Noise(1.0, 10.0**ratio / step)
        values.append(-_log_determinant(solve(design, reduce_segments(design, mode, noise), groups)))
    return cast("Information", CubicSpline(RATIOS, values, bc_type="natural"))


def _log_determinant(solution: Solution) -> float:
    """Of the covariance, its rows and columns scaled to one first."""
    std = np.sqrt(np.diag(solution.covariance))
    return float(np.linalg.slogdet(solution.covariance / np.outer(std, std))[1] + 2.0 * np.log(std).sum())


def _noise_of(
    design: Design,
    solution: Solution,
    mode: str,
    near: Noise | None = None,
    information: Information | None = None,
) -> Noise:
    d, h = residual_increments(design, solution.values)
    parameters = len(solution.amplitudes) + len(solution.phases)
    if mode == "samples":
        variance = float(d @ d) / max(d.size - parameters, 1)
        step = float(np.median(np.diff(design.run.t)[~design.run.begins[1:]]))
        return Noise(0.0, variance * step)
    scale = float(np.abs(design.run.output).max())
    return find_noise(d, h, parameters, 4.0 * np.finfo(float).eps * max(scale, 1e-3), near, information)


def _covariance(design: Design, mode: str, noise: Noise, solution: Solution, groups: tuple[int, ...]) -> Array:
    """Covariance of the internal parameters; the rate method accounts for the colour of its noise."""
    if mode == "increments":
        return solution.covariance
    if mode == "samples":
        step = float(np.median(np.diff(design.run.t)[~design.run.begins[1:]]))
        return solution.covariance * (noise.walk / step)
    size, m = solution.covariance.shape[0], len(design.names)
    meat = np.zeros((size, size))
    for block, columns in weighted_blocks(design, mode, noise):
        x = columns[:m]
        inverse = np.divide(1.0, block.h, out=np.zeros_like(block.h), where=block.h > 0.0)
        variance = (noise.walk * block.h + 2.0 * noise.white) * inverse**2
        cross = (x[:, :-1] * inverse[:-1]) @ (x[:, 1:] * inverse[1:]).T * noise.white
        jacobian = solution.jacobians[groups[block.segment]]
        meat += jacobian.T @ ((x * variance) @ x.T - cross - cross.T) @ jacobian
    return solution.covariance @ meat @ solution.covariance


def _history(fit: Fit, groups: tuple[int, ...]) -> dict[str, Array]:
    """Estimate and standard uncertainty after 2 m .. n samples, for the convergence plot (file units)."""
    rows, samples = [], []
    keys: tuple[str, ...] = ()
    for mark, summaries, seen in recursive_history(fit.design, fit.mode, fit.noise, groups):
        if examine(fit.design, summaries, max(groups) > 0).null_terms:
            continue
        solution = solve(fit.design, summaries, seen)
        named, covariance = name_coefficients(fit.design, solution, solution.covariance, per_segment=False)
        plain = [i for i, c in enumerate(named) if c.name != "phi" or max(groups) == 0]
        keys = tuple(named[i].key for i in plain)
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        rows.append([*(named[i].value for i in plain), *std[plain]])
        samples.append(mark)
    table = np.array(rows)
    result = {"sample": np.array(samples, dtype=float)}
    for i, key in enumerate(keys):
        result[key] = table[:, i]
        result[f"u({key})"] = table[:, len(keys) + i]
    return result


def _assemble(
    run: Run,
    request: Request,
    fit: Fit,
    coefficients: tuple[Coefficient, ...],
    covariance: Array,
    budget: tuple[dict[str, Any], ...],
    residuals: Residuals,
    notes: tuple[str, ...],
    history: dict[str, Array] | None,
) -> Calibration:
    rows = fit.design.rows
    return Calibration(
        serial=run.serial,
        scale_factor_nominal=run.scale_factor,
        terms=request.terms,
        phase=request.phase,
        phase_source=request.phase_source,
        method=request.method,
        coefficients=coefficients,
        covariance=covariance,
        degrees_of_freedom=float(rows - len(coefficients)),
        angle_rms=fit.noise.angle_rms,
        angle_random_walk=fit.noise.angle_random_walk,
        residual_rms=_rms(residuals.after),
        residual_rms_before=_rms(residuals.before),
        residual_max_before=float(np.abs(residuals.before).max()),
        residual_max_after=float(np.abs(residuals.after).max()),
        quality=run.quality,
        condition=fit.examination.condition,
        notes=notes,
        budget=budget,
        diagnostics={"residual_kind": run.kind, "range": _range(run)}
        | diagnose(residuals)
        | segment_scatter(fit.design, residuals, fit.noise),
        segments=segment_table(fit.design, residuals),
        provenance=_provenance(run, request),
        temperature_reference=request.temperature_reference,
        time_reference=fit.design.time_reference,
        residuals=residuals,
        history=history,
    )


def _range(run: Run) -> dict[str, list[float]]:
    """Range in which the calibration holds (SI): axial and transverse force, temperature."""
    transverse = np.hypot(run.f[:, 1], run.f[:, 2])
    found = {"a_x": run.f[:, 0], "a_t": transverse}
    if run.temperature is not None:
        found["temperature"] = run.temperature
    return {name: [float(values.min()), float(values.max())] for name, values in found.items()}


def _rms(values: Array) -> float:
    return float(np.sqrt(values @ values / values.size))


def _provenance(run: Run, request: Request) -> Provenance:
    created = dt.datetime.now(dt.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    options = {"source": run.source, "noise_given": request.angle_rms is not None}
    return Provenance(dict(run.input_sha256), f"piga {__version__}", created, options)


def _published_calibration(run: Run, request: Request) -> Calibration:
    """The published recursion in the same result; its residuals are those of its own solution."""
    found = run_published(run, request)
    values, covariance = found.state.copy(), found.covariance
    if values[0] < 0.0:
        values[0], values[1] = -values[0], values[1] + np.pi
        flip = np.ones(values.size)
        flip[0] = -1.0
        covariance = covariance * np.outer(flip, flip)
    values[1] = np.pi - np.mod(np.pi - values[1], 2.0 * np.pi)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    coefficients = tuple(
        Coefficient(n, float(v), float(s), unit_of(n)) for n, v, s in zip(found.names, values, std, strict=True)
    )
    linear_request = replace(request, phase="shared", phase_source="input")
    design = Design(run, linear_request, run.scale_factor)
    linear = _linear_values(design, dict(zip(found.names, values, strict=True)))
    mode = weighting_mode(design, "rate")
    noise = _noise_of(design, _fixed_solution(design, linear), mode)
    residuals = find_residuals(design, np.tile(linear, (len(run.labels), 1)), noise, mode)
    fit = Fit(
        design, mode, noise, [], _fixed_solution(design, linear), covariance, Examination(float("nan"), ())
    )
    history = {"sample": found.samples.astype(float)}
    history |= {name: found.history[:, i] for i, name in enumerate(found.names)}
    notes = ("the published recursion depends on its first guess and predicts the phase from the input",)
    std_budget = (budget_row("fit residuals (repeatability)", "A", "normal", None, "", list(found.names), std),)
    return _assemble(run, linear_request, fit, coefficients, covariance, std_budget, residuals, notes, history)


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
    return Solution(linear, np.zeros(0), np.zeros((m, m)), values, 0.0, (np.eye(m),))
