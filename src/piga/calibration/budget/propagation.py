"""First-order intervals put to the test by Monte Carlo, and replaced where they do not hold (JCGM 101, clause 8)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.calibration.budget.monte_carlo import Contribution, propagate_distributions
from piga.calibration.budget.rows import Budget
from piga.calibration.fit.one_run import Fit
from piga.records.calibration import Coefficient
from piga.records.coverage import coverage_factor
from piga.records.terms import si_factor

Array = NDArray[np.float64]

DOUBTFUL = 6.0
"""tan_beta below this many of its standard uncertainties: its interval is no longer linear (Rice-like)."""

FAR, HALVINGS = 10.0, 60
"""Standard uncertainties above the estimate at which the upper limit is looked for, and steps of bisection."""


def put_to_the_test(
    fit: Fit, coefficients: tuple[Coefficient, ...], budget: Budget, wanted: str
) -> tuple[tuple[Coefficient, ...], dict[str, Any]]:
    """Coefficients with Monte Carlo intervals where the first order fails, and the comparison for the report.

    ``wanted`` is "gum", "monte-carlo" or "auto" (when tan_beta is not well above its noise). Several phases
    and methods other than whitened least squares are left to the first order.
    """
    coupling = [c for c in coefficients if c.name == "tan_beta"]
    weak = any(c.value < DOUBTFUL * c.std for c in coupling)
    able = fit.mode == "increments" and len(fit.solution.jacobians) == 1
    if wanted == "gum" or not able or (wanted == "auto" and not weak):
        return coefficients, {}
    results = _results(fit, coefficients)
    jacobian = fit.solution.jacobians[0]
    base = fit.solution.values[0]
    type_a = jacobian @ fit.covariance @ jacobian.T
    std = np.sqrt(np.diag(type_a))
    derivative = _derivative(results, base, std)
    sources = [
        _contribution(row, change, derivative, std)
        for row, change in zip(budget.rows[1:], budget.changes, strict=True)
    ]
    type_a = type_a - sum(
        (
            source.change.T @ source.change
            for source, stated in zip(sources, budget.in_fit, strict=True)
            if stated
        ),
        start=np.zeros_like(type_a),
    )
    degrees = min(c.degrees_of_freedom for c in coefficients)
    limits = np.array(
        [(c.value - c.coverage_factor * c.std, c.value + c.coverage_factor * c.std) for c in coefficients]
    )
    found = propagate_distributions(base, type_a, max(degrees, 3.0), sources, results, limits.T)
    table = {
        c.key: {
            "mean": float(found.mean[i]),
            "std": float(found.std[i]),
            "symmetric": found.symmetric[:, i].tolist(),
            "shortest": found.shortest[:, i].tolist(),
            "first_order": limits[i].tolist(),
            "tolerance": float(found.tolerance[i]),
            "validated": bool(found.validated[i]),
        }
        for i, c in enumerate(coefficients)
    }
    checked = tuple(
        c
        if found.validated[i]
        else replace(c, interval=(float(found.shortest[0, i]), float(found.shortest[1, i])))
        for i, c in enumerate(coefficients)
    )
    if weak:
        checked = _weak_coupling(checked)
    return checked, {"monte_carlo": {"trials": found.trials, "coefficients": table}}


def _weak_coupling(coefficients: tuple[Coefficient, ...]) -> tuple[Coefficient, ...]:
    """With the limits of a size that cannot be negative; while they hold zero, any angle may be the phase."""
    size = next(c for c in coefficients if c.name == "tan_beta")
    phase = next(c for c in coefficients if c.name == "phi")
    limits = size_limits(size.value, max(size.std, size.value * phase.std), size.degrees_of_freedom)
    circle = (phase.value - math.pi, phase.value + math.pi)
    anywhere = {"tan_beta": limits} | ({"phi": circle} if limits[0] == 0.0 else {})
    return tuple(replace(c, interval=anywhere.get(c.name, c.interval)) for c in coefficients)


def size_limits(value: float, std: float, degrees: float) -> tuple[float, float]:
    """95 % confidence limits of the size of a plane vector, estimated as ``value`` from two components of ``std`` each.

    The estimate is never zero, so that an interval about it, or one of the trials of a propagation of distributions, never
    holds a size of zero. ``(value/std)^2`` is noncentral chi-square with 2 degrees of freedom and noncentrality
    ``(size/std)^2``: the limits are the sizes for which the estimate lies at its quantiles of 97.5 and 2.5 %. The lower is 0
    where no size puts it there (value below 2.72 std): one-sided then. The upper is at least the value that a size of zero
    exceeds in 5 %. For few degrees of freedom std is multiplied by Student's factor over that of the normal distribution.

    Parameters
    ----------
    value, std:
        Estimate and standard uncertainty of a component, in the same unit.
    degrees:
        Degrees of freedom of ``std``, may be infinite.
    """
    from scipy.special import chdtri, chndtr

    unit = std * coverage_factor(degrees) / coverage_factor(math.inf)
    ratio = value / unit

    def size_at(probability: float) -> float:
        if chndtr(ratio**2, 2.0, 0.0) <= probability:
            return 0.0
        low, high = 0.0, ratio + FAR
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if chndtr(ratio**2, 2.0, middle**2) > probability else (low, middle)
        return 0.5 * (low + high)

    return size_at(0.975) * unit, max(size_at(0.025), math.sqrt(chdtri(2.0, 0.05))) * unit


def _results(fit: Fit, coefficients: tuple[Coefficient, ...]) -> Callable[[Array], Array]:
    """From column coefficients (trials, m) to coefficients in file units (trials, n), phi near its estimate."""
    design = fit.design
    at = {name: index for index, name in enumerate(design.names)}
    near = {c.name: c.value for c in coefficients}

    def results(linear: Array) -> Array:
        scale = (
            linear[:, at["scale_factor"]]
            if "scale_factor" in at
            else np.full(len(linear), design.run.scale_factor)
        )
        found = {"scale_factor": scale}
        phase = np.zeros(len(linear))
        if "p" in at:
            p, q = linear[:, at["p"]], linear[:, at["q"]]
            phase = np.arctan2(q, p)
            found["tan_beta"] = np.hypot(p, q) / scale
            found["phi"] = near["phi"] + np.angle(np.exp(1j * (phase - near["phi"])))
        for order in design.request.harmonics:
            s, c = linear[:, at[f"s{order}"]], linear[:, at[f"c{order}"]]
            cosine, sine = np.cos(order * phase), np.sin(order * phase)
            found[f"s{order}"], found[f"c{order}"] = (
                (s * cosine + c * sine) / scale,
                (c * cosine - s * sine) / scale,
            )
        for name in design.shared_names:
            found.setdefault(name, linear[:, at[name]] / scale)
        return np.stack(
            [found[c.name] / (1.0 if c.name == "phi" else si_factor(c.name)) for c in coefficients], axis=1
        )

    return results


def _derivative(results: Callable[[Array], Array], base: Array, std: Array) -> Array:
    """Derivative of the results by the column coefficients (n, m), central differences of a thousandth of u."""
    steps = np.diag(1e-3 * np.maximum(std, 1e-300))
    moved = results(base + steps) - results(base - steps)
    return (moved / (2.0 * np.diag(steps))[:, None]).T


def _contribution(row: dict[str, Any], changes: Array, derivative: Array, std: Array) -> Contribution:
    """A row of the budget, which changes the results by ``changes`` (draws, n), as changes of the column coefficients."""
    degrees = row["degrees_of_freedom"]
    return Contribution(
        (std[:, None] * np.linalg.lstsq(derivative * std, changes.T, rcond=None)[0]).T,
        row["distribution"],
        math.inf if degrees is None else float(degrees),
    )
