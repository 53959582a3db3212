"""Recursive estimation: the history of the whitened estimate, and the published recursion for comparison.

The published recursion [Wei2024, eq. 12-18, 22-24] uses rates. It predicts the phase from the input instead of
reading it, takes ``a_t`` along the direction of the first transverse force, and needs a first guess. It can
converge to a wrong solution. This implementation does not hide that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.sequential import absorb_rows, published_recursion
from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.model.request import Request
from piga.calibration.noise.levels import Noise
from piga.calibration.noise.weighting import weighted_blocks
from piga.records.run import Run
from piga.results import Array
from piga.units import G0

HISTORY = 400
"""Points of the stored history; a tenth of it when every segment has its own phase."""


def recursive_history(design: Design, mode: str, noise: Noise) -> Iterator[tuple[int, list[Reduction]]]:
    """Summaries of the rows so far, at ``HISTORY`` samples spread over the record.

    Yields the number of samples and one summary for each segment begun. The last item is that of the whole record: there
    the recursive estimate equals the batch estimate.
    """
    total = design.run.size
    points = HISTORY if not design.has_phases else HISTORY // 10
    marks = np.unique(np.linspace(min(total, 2 * len(design.names)), total, points).astype(np.int64))
    size = len(design.names) + 1
    summaries: list[Reduction] = []
    factor = np.zeros((size, size))
    current = -1
    for block, columns in weighted_blocks(design, mode, noise):
        if block.segment != current:
            current, factor = block.segment, np.zeros((size, size))
            summaries.append(Reduction.empty(design.names))
        inside = marks[(marks > block.start) & (marks <= block.stop)]
        snapshots = np.empty((inside.size, size, size))
        absorb_rows(factor, columns, inside - block.start, snapshots)
        for mark, snapshot in zip(inside, snapshots, strict=True):
            yield int(mark), [*summaries[:-1], Reduction.of_rows(design.names, snapshot, size)]
        summaries[-1] = Reduction.of_rows(design.names, factor, size)


X0 = (4.5e-3, 0.4)
"""First guess of the published run: tan_beta, phi [rad]."""
P0 = 1e10
"""Diagonal of the first covariance of the published run."""


@dataclass(frozen=True)
class PublishedResult:
    """States ``[tan_beta, phi, k0, k1, k2]`` (g units; first two or all), covariance, history."""

    names: tuple[str, ...]
    state: Array
    covariance: Array
    samples: NDArray[np.int64]
    history: Array


def run_published(run: Run, request: Request) -> PublishedResult:
    """Run the recursion over a record.

    The indicated acceleration is the increment (or rate) of the output plus the base rotation about X0, divided by
    the nominal K. The phase is ``s = int K a_x`` from the start. ``gamma`` is the constant direction of the
    transverse force; the recursion estimates ``phi - gamma``, and ``gamma`` is added afterwards.
    """
    indicated, force, s = _series(run)
    gamma = _direction(force)
    a_t = (force[1] * np.cos(gamma) + force[2] * np.sin(gamma)) / G0
    names = ("tan_beta", "phi") if len(request.terms) == 1 else ("tan_beta", "phi", "k0", "k1", "k2")
    state = np.zeros(len(names))
    state[:2] = X0
    if request.x0 is not None:
        state[:] = request.x0
    state[1] -= gamma
    covariance = np.eye(state.size) * (request.P0 if request.P0 is not None else P0)
    marks = np.unique(np.linspace(1, s.size, min(HISTORY, s.size)).astype(np.int64))
    history = np.empty((marks.size, state.size))
    total = published_recursion(indicated / G0, force[0] / G0, a_t, s, state, covariance, marks, history)
    state[1] += gamma
    history[:, 1] += gamma
    covariance = 0.5 * (covariance + covariance.T) * total / (s.size - state.size)
    return PublishedResult(names, state, covariance, marks, history)


def _series(run: Run) -> tuple[Array, Array, Array]:
    """Indicated acceleration [m/s^2], force (3, n) and predicted phase, per sample or mid-interval."""
    omega = np.zeros(run.size) if run.base_rate is None else run.base_rate[:, 0]
    h = np.diff(run.t)
    h[run.begins[1:]] = 0.0
    step = run.scale_factor * h * 0.5 * (run.f[1:, 0] + run.f[:-1, 0])
    s = np.concatenate(([0.0], np.cumsum(step)))
    if run.kind == "rate":
        return (run.output + omega) / run.scale_factor, run.f.T, s
    formed = h > 0.0
    rate = np.diff(run.output)[formed] / h[formed] + 0.5 * (omega[1:] + omega[:-1])[formed]
    force = 0.5 * (run.f[1:] + run.f[:-1])[formed].T
    return rate / run.scale_factor, force, 0.5 * (s[1:] + s[:-1])[formed]


def _direction(force: Array) -> float:
    """Direction of the transverse force at its largest size [rad]."""
    at = int(np.argmax(force[1] ** 2 + force[2] ** 2))
    return float(np.arctan2(force[2, at], force[1, at]))
