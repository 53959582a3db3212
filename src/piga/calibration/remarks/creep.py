"""Creep after a move: a bias that decays within each position, and that the coefficients take up.

Residuals are stacked by the time since the start of the position. Each position gives an estimate of a creep
``exp(-t / time constant)`` from the shape of its residuals, its mean rate taken out. The weighted mean over the positions is
tested against their scatter (Bell and McCaffrey's rule, :mod:`piga.calibration.intervals`). The size is the same at each position,
or proportional to the change of a_x by the move. A few time constants are tried (Bonferroni).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from piga._kernels.estimation import merge_rows
from piga.calibration.intervals import sandwich
from piga.calibration.joint import JointFit
from piga.calibration.model.design import Block, Design
from piga.calibration.model.reduction import Reduction, triangle
from piga.calibration.summary import LiveRun
from piga.calibration.weights import RATE, Extra, Positions, reduce_positions, residual_increments, with_scatter
from piga.records.calibration.coefficient import Coefficient
from piga.records.calibration.diagnostics import CREEP_ALARMS, Creep
from piga.records.run import Run
from piga.results import Array
from piga.units import G0

_FEWEST = 5
"""Fewest positions that are tested: with fewer their scatter is hardly known."""
_TIMES = (1 / 48, 1 / 24, 1 / 12, 1 / 6, 1 / 3)
"""Time constants over the median length of a position."""
_NEAR = (0.7, 0.84, 1.0, 1.2, 1.4)
"""Time constants beside the best one that are then tried, relative to it."""
_SAMPLES = 2
"""Fewest samples in a time constant."""
_BINS = 24
"""Bins of the figure in a position of median length."""
_REST = 0.1
"""Largest shift of a coefficient, in its standard uncertainties, that is left after the time advised for ``settle``."""


@dataclass(frozen=True)
class _Test:
    """Estimate of a creep, its standard uncertainty, and its probability by chance; ``fall`` is that of the sum of squares.

    ``rows`` are the triangles ``[model | rate | creep | y]`` of the positions.
    """

    time: float
    by_move: bool
    rows: list[Reduction]
    size: float
    std: float
    chance: float
    fall: float


def creep_of_runs(fit: JointFit, coefficients: tuple[Coefficient, ...]) -> tuple[LiveRun, Creep] | None:
    """The likeliest creep of the runs with raw data, seen or not, and its run; None if none was tested.

    A run with too few positions, or no position long enough, is not tested. ``coefficients`` are those of the result, with
    combined standard uncertainties.
    """
    creeps = [
        (live, creep)
        for index, live in enumerate(fit.live)
        if live and (creep := _creep_of(fit, index, live, coefficients))
    ]
    if not creeps:
        return None
    live, best = max(creeps, key=lambda item: (item[1].seen, item[1].largest_shift, -item[1].probability))
    return live, replace(best, probability=min(1.0, len(creeps) * best.probability))


def _creep_of(fit: JointFit, index: int, live: LiveRun, coefficients: tuple[Coefficient, ...]) -> Creep | None:
    (design, values), positions = fit.design_of(index, live), Positions.of(live.run)
    begin, end = positions.times(live.run)
    length = float(np.median(end - begin))
    times = [part * length for part in _TIMES if part * length >= _SAMPLES * live.run.median_step]
    if positions.continuous or positions.count < _FEWEST or not times:
        return None
    tries = _tests(live, design, values, positions, times)
    if not tries:
        return None
    clear = [test for test in tries if test.chance * len(tries) < CREEP_ALARMS]
    best = min(tries, key=lambda test: test.chance)
    chance = min(1.0, best.chance * len(tries))
    if clear:
        best = max(clear, key=lambda test: test.fall)
        near = _tests(live, design, values, positions, [best.time * part for part in _NEAR])
        best = max((test for test in near if test.by_move == best.by_move), key=lambda test: test.fall)
    jacobians, first = fit.estimate.jacobians, fit.first_group(index)
    score = sum(
        jacobians[first + group].T @ part.factor[:, :-2].T @ part.factor[:, -2]
        for part, group in zip(with_scatter(best.rows, live.fit.noise), design.groups, strict=True)
    )
    shifts = zip(coefficients, fit.moved(-best.size * (fit.estimate.inverse @ score)), strict=True)
    scale = design.scale_factor * (1.0 if best.by_move else G0)
    return Creep(
        best.size / scale,
        best.std / scale,
        best.time,
        best.by_move,
        chance,
        {c.key: float(shift) / c.std for c, shift in shifts if c.std > 0.0},
        *_stacked(design, values, positions, length),
    )


def _tests(
    live: LiveRun, design: Design, values: Array, positions: Positions, times: list[float]
) -> list[_Test]:
    """The tests of all time constants [s], of the same size at each position and by the move; without those that are nowhere."""
    from scipy.special import stdtr

    names, m, force = tuple(map(str, range(len(times)))), len(design.names), live.run.f[:, 0]
    extra = Extra(names, lambda block: _decays(design, positions, block, times))
    parts = reduce_positions(design, live.fit.mode, live.fit.noise, positions, extra)
    means = np.add.reduceat(force, positions.edges[:-1]) / np.diff(positions.edges)
    tests = []
    for by_move, moves in ((False, np.ones(positions.count)), (True, np.diff(means, prepend=means[0]))):
        for name, time in zip(names, times, strict=True):
            rows = [part.select((*design.names, RATE, name)) for part in parts]
            shapes = []
            for own, segment, move in zip(rows, positions.segments.tolist(), moves, strict=True):
                own.factor[:, m + 1] *= move
                missed = own.factor[:, -1] - own.factor[:, :m] @ values[segment]
                shapes.append(triangle(np.column_stack([own.factor[:, m : m + 2], missed]))[1:, 1:])
            square = sum(float(shape[0, 0] ** 2) for shape in shapes)
            if square > 0.0:
                size = sum(float(shape[0, 0] * shape[0, 1]) for shape in shapes) / square
                (std,), (degrees,) = sandwich(shapes, None, ())
                chance = 2.0 * float(stdtr(degrees, -abs(size) / max(float(std), 1e-300)))
                tests.append(_Test(time, by_move, rows, size, float(std), chance, size**2 * square))
    return tests


def _decays(design: Design, positions: Positions, block: Block, times: list[float]) -> Array:
    """Rows ``[times | rows]`` of a block: the integral of ``exp(-age/time)`` over each interval; for a rate log its value."""
    run, constants = design.means.run, np.array(times)[:, None]
    samples = slice(block.start - (not design.point), block.stop)
    begin = design.run.t[positions.edges[block.segment]]
    out: Array = np.exp(-np.maximum(run.t[samples] - begin, 0.0) / constants)
    if not design.point:
        out = -constants * np.diff(out)
        out[:, run.begins[block.start : block.stop]] = 0.0
    if run.left_out is not None:
        left_out = run.left_out[block.start : block.stop]
        if design.point:
            out[:, left_out] = 0.0
        else:
            merge_rows(out, np.where(left_out, -1.0, block.h), left_out)
    return out


def _stacked(
    design: Design, values: Array, positions: Positions, length: float
) -> tuple[tuple[float, ...], ...]:
    """Time since the start of the position [s], mean residual rate over K [g] over the positions, and its 95 % half width."""
    from scipy.special import stdtrit

    run = design.run
    visit = np.repeat(np.arange(positions.count), np.diff(positions.edges))
    place = np.floor((run.t - run.t[positions.edges[:-1]][visit]) / length * _BINS).astype(np.int64)
    missed, interval = residual_increments(design, values)
    inside = (place >= 0) & (place < _BINS)
    shape = (positions.count, _BINS)
    d, h = (
        np.bincount((visit * _BINS + place)[inside], own[inside], math.prod(shape)).reshape(shape)
        for own in (missed, np.maximum(interval, 0.0))
    )
    mean = d.sum(axis=1) / np.maximum(h.sum(axis=1), 1e-300)
    full = h > 0.5 * h.max(axis=0)
    count = full.sum(axis=0)
    rate = np.where(full, d / np.where(full, h, 1.0) - mean[:, None], 0.0) / (design.scale_factor * G0)
    middle = rate.sum(axis=0) / np.maximum(count, 1)
    spread = (np.where(full, rate - middle, 0.0) ** 2).sum(axis=0) / np.maximum(count - 1, 1)
    band = stdtrit(np.maximum(count - 1, 1), 0.975) * np.sqrt(spread / np.maximum(count, 1))
    kept = count > 1
    time = (np.arange(_BINS) + 0.5) * length / _BINS
    return tuple(tuple(own[kept].tolist()) for own in (time, middle, band))


def creep_in_words(run: Run, creep: Creep) -> str:
    """The creep, what it does to the coefficients, and the remedy."""
    size, std = 1e6 * creep.size, 1e6 * creep.standard_uncertainty
    per = " for a change of a_x by 1 g" if creep.by_move else ""
    moved = sorted(creep.shift.items(), key=lambda item: -abs(item[1]))[:3]
    shifts = ", ".join(f"{key} by {abs(shift):.2g} u" for key, shift in moved)
    begin, end = Positions.of(run).times(run)
    wait = math.ceil(creep.time_constant * math.log(max(creep.largest_shift / _REST, math.e)))
    more = "more " if any(event.kind == "settling" for event in run.quality.events) else ""
    key = f' ([data] settle = "{wait} s")' if run.source and not more else ""
    remedy = (
        f"leave out the first {wait} s {more}of each position{key}"
        if wait < 0.5 * float(np.median(end - begin))
        else f"wait {wait} s after each move, or stay longer at each position"
    )
    return (
        f"a creep after each move: the bias begins {size:.3g} +/- {std:.2g} ug{per} off and decays in about "
        f"{creep.time_constant:.2g} s; it moves {shifts}: {remedy}"
    )
