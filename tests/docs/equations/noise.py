"""Equations of docs/theory/noise.md."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

import piga
from piga.calibration.fit.one_run import fit_run
from piga.calibration.model.request import make_request
from piga.calibration.model.solution import name_coefficients
from piga.calibration.noise.components import RATES, RateBins
from piga.calibration.noise.likelihood import Contrasts, ProfileLikelihood
from piga.calibration.remarks.unseen_noise import slow_rates, unseen_noise
from piga.units import G0
from tests.calibration.made.coloured_truth import LOG
from tests.calibration.made.independent import head

from .registry import Pair, equation


@equation("noise-limit")
def _limit() -> Iterator[Pair]:
    bins = RateBins(np.array([np.linspace(30.0 * k, 30.0 * k + 20.0, 5) for k in range(12)]))
    flicker, n, fast = RATES["flicker"](bins, 0.0), bins.count, 2000
    y = np.random.default_rng(5).standard_normal(n)

    def D(r: float, v: float) -> float:
        V = r * np.eye(n) + v * flicker
        return float(np.linalg.slogdet(V)[1] + fast * np.log(r) + y @ np.linalg.solve(V, y) + fast / r)

    v95 = (
        ProfileLikelihood.of(Contrasts(y, np.eye(n)[None], float(fast), fast, np.eye(n)), None)
        .limit(flicker, 0.95)
        .level
    )
    least = minimize(lambda x: D(*np.exp(x)), [0.0, -3.0], method="Nelder-Mead").fun
    there = minimize(lambda x: D(float(np.exp(x[0])), v95), [0.0], method="Nelder-Mead").fun
    yield there - min(least, D(1.0, 0.0)), 1.645**2, 0.05


@equation("noise-growth")
def _growth() -> Iterator[Pair]:
    """A rate log: its samples are rows of equal weight, and the rates of the parts are their means."""
    test = replace(LOG, forces=head(12), seconds=20.0, pause=10.0)
    run = test.record(2)
    coefficients = piga.calibrate(run, test.terms).coefficients
    fit = fit_run(run, make_request(run, test.terms))
    found = unseen_noise(slow_rates(fit, fit), coefficients)
    assert found is not None
    assert found.kind == "drift"
    bins = RateBins.of(run, coarse=True)
    x = np.hstack([block.columns[:-1] for block in fit.design.blocks()])
    parts = np.hstack(list(_of_segments(bins, run.t)))
    J = fit.solution.jacobians[0]
    c = np.linalg.inv(J.T @ x @ x.T @ J) @ J.T @ x @ parts.T
    R = RATES["drift"](bins, 0.0)
    v95 = (found.size * fit.design.scale_factor * G0) ** 2 / np.diag(R).mean()
    white, slow = (
        np.diag(name_coefficients(fit.design, fit.solution, part)[1])
        for part in (fit.solution.covariance * fit.sample_variance, c @ R @ c.T)
    )
    at = [one.name for one in coefficients].index(found.coefficient)
    u_B = 0.0
    literal = 1.96 / coefficients[at].expanded * np.sqrt(u_B**2 + white[at] + v95 * slow[at])
    yield literal, found.growth, 1e-3 * found.growth


def _of_segments(bins: RateBins, t: np.ndarray) -> Iterator[np.ndarray]:
    """For each segment the part (parts, samples) in which a sample lies."""
    for edges, k in zip(bins.edges, range(len(bins.edges)), strict=True):
        own = t[(t >= edges[0]) & (t <= edges[-1])]
        inside = np.clip(np.searchsorted(edges, own, side="right") - 1, 0, bins.size - 1)
        yield (np.arange(bins.count)[:, None] == k * bins.size + inside).astype(float)
