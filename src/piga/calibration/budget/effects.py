"""Effects of the sources that nobody stated: the change of each coefficient by one unit, from one pass over the record.

The estimate is linear in the increments. A source changes the modelled rate by its derivatives by specific force, temperature and
time, times the change of these. The estimate of this change, with the weights of the fit, is the effect of the source (first
order; the derivatives are those at the middle of each interval).
"""

from __future__ import annotations

import numpy as np

from piga._kernels.estimation import merge_rows
from piga.calibration.budget.sources import Source, listed, sources, with_effects, with_units
from piga.calibration.fit.one_run import Fit
from piga.calibration.model.design import Block, Design
from piga.calibration.model.solution import moved_values, name_coefficients
from piga.calibration.weights import Extra, Positions, reduce_positions, with_scatter
from piga.records.calibration import StandSource
from piga.records.terms import SERVO_TERMS
from piga.results import Array
from piga.terms import PRODUCTS


def sources_of_stand(fit: Fit) -> tuple[StandSource, ...]:
    """The sources of the stand, and the change of each coefficient by one unit of those that are not stated."""
    run = fit.design.run
    units = [s for s in sources(with_units(fit.design.means.run)) if "servo" not in s.fields]
    named, _ = name_coefficients(fit.design, fit.solution, fit.solution.covariance)
    effects = {}
    if units:
        for source, change in zip(units, _changes(fit, units).T, strict=True):
            effects[source.name] = moved_values(fit.design, fit.solution, change)
    return with_effects(listed(run), effects, [c.key for c in named])


def _changes(fit: Fit, units: list[Source]) -> Array:
    """Change of the internal parameters (parameters, sources) by each source."""
    design, positions, m = fit.design, Positions.of(fit.design.run), len(fit.design.names)
    extra = Extra(tuple(source.name for source in units), lambda block: _increments(fit, block, units))
    parts = with_scatter(reduce_positions(design, fit.mode, fit.noise, positions, extra), fit.noise)
    total = sum(
        fit.solution.jacobians[design.groups[segment]].T @ part.factor[:, :m].T @ part.factor[:, m:-1]
        for part, segment in zip(parts, positions.segments.tolist(), strict=True)
    )
    return np.asarray(fit.solution.inverse @ total)


def _increments(fit: Fit, block: Block, units: list[Source]) -> Array:
    """Change of the observed less the modelled increments (sources, n) of a block."""
    design, run = fit.design.means, fit.design.means.run
    samples = slice(block.start - (not design.point), block.stop)
    slopes, ages = _slopes(fit, block.segment, samples)
    h, turn = np.ones(block.h.size), np.zeros(block.h.size)
    if not design.point:
        h, turn = np.diff(run.t[samples]), np.diff(run.output[samples])
        h[run.begins[block.start : block.stop]] = 0.0
        turn[h == 0.0] = 0.0
    out = np.empty((len(units), h.size))
    for number, source in enumerate(units):
        rate = source.warmth * slopes["T"] + source.stretch * ages * slopes["t"]
        for axis, change in zip("xyz", () if source.force is None else source.force(samples).T, strict=False):
            if change.any():
                rate += slopes[axis] * _middle(design, change)
        out[number] = -h * rate
        if source.stretch:
            out[number] -= source.stretch * turn
    if run.left_out is not None:
        left_out = run.left_out[block.start : block.stop]
        if design.point:
            out[:, left_out] = 0.0
        else:
            merge_rows(out, h, left_out)
    return out


def _middle(design: Design, values: Array) -> Array:
    """Mean of the values at both ends of each interval; for a rate log the values."""
    return values if design.point else 0.5 * (values[..., 1:] + values[..., :-1])


def _slopes(fit: Fit, segment: int, samples: slice) -> tuple[dict[str, Array], Array]:
    """Derivatives of the modelled rate by x, y, z, T and t at the middle of each interval, and t there."""
    design, run = fit.design.means, fit.design.means.run
    values = dict(zip(design.names, fit.solution.values[segment].tolist(), strict=True))
    values = {"scale_factor": run.scale_factor} | design.known_servo | values
    force = _middle(design, run.f[samples].T)
    age = _middle(design, run.t[samples]) - design.time_reference
    warm = age if run.temperature is None else _middle(design, run.temperature[samples])
    inputs = dict(zip("xyz", force, strict=True)) | {"|x|": np.abs(force[0]), "t": age}
    inputs["T"] = warm - design.request.temperature_reference
    slopes = {name: np.zeros(age.size) for name in "xyzTt"}
    for name, value in values.items():
        factors = PRODUCTS.get(name, ())
        for k, factor in enumerate(factors):
            slope = value * np.sign(inputs["x"]) if factor == "|x|" else value
            for other in (*factors[:k], *factors[k + 1 :]):
                slope = slope * inputs[other]
            slopes[factor.strip("|")] += slope
    if "p" in values:
        psi = design.phase_angle[samples]
        sine, cosine = np.sin(_middle(design, psi)), np.cos(_middle(design, psi))
        even = 1.0 if design.point else np.sinc(0.5 * np.diff(psi) / np.pi)
        slopes["y"] += even * (values["p"] * sine + values["q"] * cosine)
        slopes["z"] += even * (values["q"] * sine - values["p"] * cosine)
        if set(SERVO_TERMS) & set(values):
            _add_servo(slopes, values, force, sine, cosine)
    return slopes, age


def _add_servo(
    slopes: dict[str, Array], values: dict[str, float], force: Array, sine: Array, cosine: Array
) -> None:
    """Add the derivatives of the servo terms, ``-2 servo x v^2 - servo_damping x^2 u``; u and v turn with the output."""
    stiffness, damping = (values.get(name, 0.0) for name in SERVO_TERMS)
    size = np.hypot(values.get("p", 0.0), values.get("q", 0.0)) or 1.0
    c, s = values.get("p", 0.0) / size, values.get("q", 0.0) / size
    cosine, sine = c * cosine - s * sine, c * sine + s * cosine
    x, y, z = force
    u, v = y * cosine + z * sine, z * cosine - y * sine
    slopes["x"] -= 2.0 * stiffness * v * v + 2.0 * damping * x * u
    slopes["y"] += 4.0 * stiffness * x * v * sine - damping * x * x * cosine
    slopes["z"] -= 4.0 * stiffness * x * v * cosine + damping * x * x * sine
