"""What a fit is compared with: dense covariances, and the same estimate of records that are turned a little."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

import piga
from piga.calibration.fit import Fit
from piga.calibration.model.design import Design
from piga.calibration.model.solution import solve
from piga.calibration.weights import Noise
from tests.calibration.made.scenarios import Array, Scenario


def increments_covariance(noise: Noise, steps: int, h: float) -> Array:
    """Dense covariance (steps, steps) of the increments of one stretch."""
    neighbours = np.diag(np.ones(steps - 1), 1) + np.diag(np.ones(steps - 1), -1)
    result: Array = np.diag(np.full(steps, noise.walk * h + 2.0 * noise.white)) - noise.white * neighbours
    return result


def dense_sums(scenario: Scenario, run: piga.Run, noise: Noise) -> tuple[Array, Array]:
    """``X'W X`` and ``X'W V W X`` of all increments of a run, W without the drift and V with it."""
    steps, h, count = round(scenario.seconds * scenario.rate), 1.0 / scenario.rate, len(scenario.forces)
    one = increments_covariance(noise, steps, h)
    outputs = [run.output[run.segment_index == s] + scenario.phi for s in range(count)]
    X = np.concatenate([scenario._derivatives(output, s, h) for s, output in enumerate(outputs)])
    white = np.kron(np.eye(count), np.linalg.inv(one)) @ X
    t = scenario._times().ravel()
    together = np.minimum.outer(np.abs(t), np.abs(t)) * (np.multiply.outer(t, t) > 0.0)
    whole = np.kron(np.eye(count), one) + noise.drift * h**2 * together
    return X.T @ white, white.T @ whole @ white


def moved_by_turning(fit: Fit, angles: Iterable[Array]) -> Array:
    """Changes of the parameters of a counted fit by each angle (n,) in its output, (parameters, angles); weights as they are."""
    run, counted, size = fit.design.run, fit.counted, 1e-9
    assert counted is not None

    def estimate(turned: Array) -> Array:
        output = run.output + turned
        design = Design(replace(run, output=output), fit.design.request, fit.design.scale_factor)
        design.phase_angle = fit.design.phase_angle
        solution = solve(design, counted.reduce(design))
        return np.append(solution.amplitudes, solution.phases)

    start = estimate(np.zeros(run.size))
    return np.array([(estimate(size * angle) - start) / size for angle in angles]).T
