"""What single positions and the moves between them do to the coefficients: leverage, and creep after a move.

**Leverage.** ``B_j`` is the information of segment j and ``g_j`` its score, in coordinates in which the information of all
segments is one (:mod:`piga.calibration.intervals`). Without segment j the parameters change by ``-(1 - B_j)^-1 g_j``, and their
covariance is ``(1 - B_j)^-1``. This is exact where the fit is linear, and needs no second reading of the record.

**Creep** is a bias that decays within each position, and that the coefficients take up. Residuals are stacked by the time since
the start of the position. Each position gives an estimate of a creep ``exp(-t / time constant)`` from the shape of its residuals,
its mean rate taken out. The weighted mean over the positions is tested against their scatter (Bell and McCaffrey's rule). The size
is the same at each position, or proportional to the change of a_x by the move. A few time constants are tried (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from piga._kernels.estimation import merge_rows
from piga.calibration.fit import NORMAL_MEDIAN, Fit
from piga.calibration.intervals import parameter_rows, scatter_of, unit_information, without_rate
from piga.calibration.joint import JointFit
from piga.calibration.model.design import Block, Design
from piga.calibration.model.reduction import Reduction, triangle
from piga.calibration.weights import RATE, Extra, Positions, reduce_positions
from piga.records.calibration.coefficient import Coefficient
from piga.records.calibration.diagnostics import CREEP_ALARMS, Creep, SegmentLeverage
from piga.results import Array
from piga.units import G0

_DETERMINES = 0.9
"""Share of a coefficient's information above which one segment determines it: without it u is three times larger."""
_INFLUENTIAL = 3.0
"""A segment is influential if it shifts a coefficient by more than this many standard uncertainties."""
_MOVED = 1.0
"""The same for a segment whose rate is an outlier among rates that scatter."""
_UNLIKELY = 4.5
"""Least shift in standard deviations of such a shift by noise: 1 in 150 000."""
_MOST_SEGMENTS = 500
"""Most segments for leaving out one at a time."""
_SENTENCES = 4
"""Most sentences of a kind; the table of the segments shows all."""
_ALONE = 1e-9
"""Remainder ``1 - B_j`` below which a segment alone has a combination of the parameters."""
_FEWEST = 5
"""Fewest positions that are tested: with fewer their scatter is hardly known."""
_TIMES = (1 / 48, 1 / 24, 1 / 12, 1 / 6, 1 / 3)
"""Time constants over the median length of a position."""
_NEAR = (0.7, 0.84, 1.0, 1.2, 1.4)
"""Time constants beside the best one that are then tried, relative to it."""
_SAMPLES = 2
"""Fewest samples in a time constant."""
_REST = 0.1
"""Largest shift of a coefficient, in its standard uncertainties, that is left after the time advised for ``settle``."""


def find_leverage(
    fit: JointFit, quiet: JointFit, coefficients: tuple[Coefficient, ...]
) -> tuple[dict[str, SegmentLeverage], tuple[str, ...], tuple[tuple[float, str], ...]]:
    """Leverage of every segment by label, and sentences: segments that determine a coefficient alone, and that move one.

    Those that move one come with the shift. ``fit`` and ``quiet`` are the fit of one run, and the same without the scatter of the
    positions. If they scatter, all segments move coefficients by more than the noise explains. A segment is then named only if
    its rate is an outlier among the others. ``coefficients`` are the result: shifts are in their combined standard
    uncertainties. The leverages are together the number of parameters; a share is ``1 - (u/u_without)^2``. Empty for several
    runs, for one segment, and beyond ``_MOST_SEGMENTS``.
    """
    layout, estimate, repetitions = quiet.layout, quiet.estimate, quiet.repetitions(quiet.estimate)
    labels = fit.only.run.labels if fit.only else ()
    if not 1 < len(labels) <= _MOST_SEGMENTS:
        return {}, (), ()
    local = estimate.phases.size > 1
    at = list(range(layout.size + (0 if local else estimate.phases.size)))
    rows = [parameter_rows(layout, estimate, r, at, local=local) for r in repetitions]
    parts = [without_rate(part, r.variance) for part, r in zip(rows, repetitions, strict=True)]
    inverse, value, vector, score = unit_information(parts)
    root = inverse @ vector
    rest = 1.0 / np.maximum(1.0 - value, _ALONE)
    changes = -np.einsum("jab,jb->ja", root, rest * score)
    kept = [i for i, c in enumerate(coefficients) if c.segment is None]
    common = [coefficients[i] for i in kept]
    std = [_std(quiet, at, one)[kept] for one in np.einsum("jab,jb,jcb->jac", root, rest, root)]
    whole = _std(quiet, at, inverse @ inverse.T)[kept]
    table: dict[str, SegmentLeverage] = {}
    for j, label in enumerate(labels):
        change = np.zeros(layout.size + estimate.phases.size)
        change[at] = changes[j]
        moved, share = quiet.moved(change)[kept], np.maximum(1.0 - (whole / std[j]) ** 2, 0.0)
        only = value[j].max() > 1.0 - _ALONE
        table[label] = SegmentLeverage(
            float(value[j].sum()) + local,
            {c.name: float(own) for c, own in zip(common, share, strict=True)},
            {c.name: None if only else float(own) / c.std for c, own in zip(common, moved, strict=True)},
        )
    named, least = (labels, _INFLUENTIAL) if quiet is fit else (_odd_segments(rows, labels), _MOVED)
    noise = (whole / [c.std for c in common]).tolist()
    return table, *_in_words(table, common, noise, named, least)


def _in_words(
    table: dict[str, SegmentLeverage],
    common: list[Coefficient],
    noise: list[float],
    named: Sequence[str],
    least: float,
) -> tuple[tuple[str, ...], tuple[tuple[float, str], ...]]:
    """Segments that determine a coefficient alone, and those of ``named`` that move one by more than ``least``, beyond noise.

    ``noise``: the part of the noise in the standard uncertainty of each coefficient.
    """
    alone, moving = list[str](), list[tuple[float, str]]()
    for label, row in table.items():
        sole = [c.name for c in common if row.share[c.name] > _DETERMINES]
        if sole:
            words = (
                f"{', '.join(sole)} {'rests' if len(sole) == 1 else 'rest'} on segment '{label}' alone (more than "
                f"{100.0 * _DETERMINES:.0f} % of the information): no residual shows an error there; "
                "add a position or level like it"
            )
            alone.append(words)
        for c, part in zip(common, noise, strict=True):
            share, shift = row.share[c.name], row.shift[c.name]
            if label not in named or shift is None or share > _DETERMINES or abs(shift) <= least:
                continue
            usual = part * math.sqrt(share / (1.0 - share))
            if abs(shift) > _UNLIKELY * usual:
                words = (
                    f"without segment '{label}' {c.name} changes by {shift:+.1f} standard uncertainties (noise would "
                    f"explain {usual:.1g}): look at that segment"
                )
                moving.append((abs(shift), words))
    moving.sort(key=lambda item: -item[0])
    return tuple(alone[:_SENTENCES]), tuple(moving[:_SENTENCES])


def _std(fit: JointFit, at: list[int], covariance: Array) -> Array:
    """Standard uncertainties of the coefficients (file units) from the covariance of some parameters."""
    whole = np.zeros((fit.layout.size + fit.estimate.phases.size,) * 2)
    whole[np.ix_(at, at)] = covariance
    return np.array([c.std for c in fit.named(fit.estimate, whole)[0]])


def _odd_segments(rows: Sequence[Array], labels: Sequence[str]) -> tuple[str, ...]:
    """Labels of the segments whose residual rate is far from the others, in terms of their median deviation."""
    rate = np.array(
        [part[:, -2] @ part[:, -1] / max(float(part[:, -2] @ part[:, -2]), 1e-300) for part in rows]
    )
    away = np.abs(rate - np.median(rate))
    odd = away > _UNLIKELY * np.median(away) / NORMAL_MEDIAN
    return tuple(label for label, far in zip(labels, odd, strict=True) if far)


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


def find_creep(fit: JointFit, coefficients: tuple[Coefficient, ...]) -> tuple[Creep | None, str]:
    """The likeliest creep of the runs with raw data, and a sentence if it is seen; None if none was tested.

    A run with too few positions, or no position long enough, is not tested. ``coefficients`` are those of the result, with
    combined standard uncertainties.
    """
    tested = [(k, _creep_of(fit, k, live, coefficients)) for k, live in enumerate(fit.live) if live]
    creeps = [(k, creep) for k, creep in tested if creep]
    if not creeps:
        return None, ""
    index, best = max(creeps, key=lambda item: (item[1].seen, item[1].largest_shift, -item[1].probability))
    best, live = replace(best, probability=min(1.0, len(creeps) * best.probability)), fit.live[index]
    return best, _creep_in_words(fit.summaries[index].name, live, best) if live and best.seen else ""


def _creep_of(fit: JointFit, index: int, live: Fit, coefficients: tuple[Coefficient, ...]) -> Creep | None:
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
    variances, score = live.noise.rate_variances(positions.count).tolist(), np.zeros(fit.estimate.parameters)
    for own, variance, group in zip(best.rows, variances, design.groups, strict=True):
        part = own.without((RATE,), variance)
        score += jacobians[first + group].T @ part.factor[:, :-2].T @ part.factor[:, -2]
    shifts = zip(coefficients, fit.moved(-best.size * (fit.estimate.inverse @ score)), strict=True)
    scale = design.scale_factor * (1.0 if best.by_move else G0)
    return Creep(
        best.size / scale,
        best.std / scale,
        best.time,
        best.by_move,
        chance,
        {c.key: float(shift) / c.std for c, shift in shifts if c.std > 0.0},
    )


def _tests(live: Fit, design: Design, values: Array, positions: Positions, times: list[float]) -> list[_Test]:
    """The tests of all time constants [s], of the same size at each position and by the move; without those that are nowhere."""
    from scipy.special import stdtr

    names, m, force = tuple(map(str, range(len(times)))), len(design.names), live.run.f[:, 0]
    extra = Extra(names, lambda block: _decays(design, positions, block, times))
    parts = reduce_positions(design, live.noise, positions, extra)
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
                (std,), (degrees,), _ = scatter_of(shapes)
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


def _creep_in_words(name: str, live: Fit, creep: Creep) -> str:
    """The creep of a run, what it does to the coefficients, and the remedy."""
    run, run_words = live.run, f"run '{name}': " if name else ""
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
        f"{run_words}a creep after each move: the bias begins {size:.3g} +/- {std:.2g} ug{per} off and decays in about "
        f"{creep.time_constant:.2g} s; it moves {shifts}: {remedy}"
    )
