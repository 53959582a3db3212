"""Gross errors of the output: found against a robust fit and left out, sample by sample.

In increments of an angle one bad sample spoils two increments and a jump one for good; so samples are
judged, not increments: a spike's sample goes and the increment reaches across it, a jump begins a new
stretch, a stuck reading is left out as long as it lasts. The reference is taken as right.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga._kernels.outliers import scan_samples
from piga.calibration.design import Design
from piga.calibration.noise import Noise
from piga.calibration.reduction import Reduction
from piga.calibration.solution import solve
from piga.calibration.weighting import Whitener, residual_increments
from piga.errors import DataError
from piga.records.calibration import Event, Outlier
from piga.records.run import Run

Array = NDArray[np.float64]
Flags = NDArray[np.int8]

FALSE_ALARMS = 0.05
"""Good samples left out per record, expected."""
MOST = 0.4
"""Share of bad samples from which a record is refused."""
ROWS = 200_000
"""Increments that the robust fit looks at."""
STUCK = 4
"""Equal readings in a row, off the path, that count as stuck."""
NARROW = 0.6
"""Core of the residual increments over their spread from which bad samples are suspected; 1 for normal noise."""
LEAST = 1e-7
"""Smallest miss [rad, or rad/s] that makes a sample bad: 0.02 arcsec, finer than any readout."""
PAIRS, SMOOTH = 100, 0.8
"""Neighbouring bad increments, and the share of them that miss to the same side, from which the model is at fault."""
SHOWN = 6
"""Times named in an event."""


@dataclass(frozen=True)
class Misses:
    """Residual increments (samples of a rate log) ``d`` (n,) and their intervals ``h``."""

    d: Array
    h: Array
    point: bool

    @property
    def formed(self) -> NDArray[np.bool_]:
        """Where there is an increment."""
        return self.h > 0.0

    @property
    def step(self) -> float:
        """Usual interval [s]."""
        return float(np.median(self.h[self.formed]))


def limit(count: int) -> float:
    """Standard deviations beyond which a sample is bad: FALSE_ALARMS of ``count`` normal ones are."""
    from scipy.special import ndtri

    return float(-ndtri(0.5 * FALSE_ALARMS / max(count, 100)))


def suspicious(d: Array, h: Array, mode: str, noise: Noise, run: Run) -> bool:
    """True when the residuals of a plain fit have tails, or a core, that normal noise has not.

    Cheap: one pass. Half the limit is enough for the tails where the core is narrower than the noise found,
    for bad samples inflate that; so do equal ones without tails, which a core far narrower than all shows.
    """
    formed = h > 0.0
    if float(np.abs(d).max()) <= LEAST:
        return False
    part = np.abs(d[formed])[:: max(1, d.size // 100_000)]
    spread = float(np.sqrt(np.mean(part**2)))
    narrow = float(np.median(part)) / 0.6745 < NARROW * spread and spread > 10.0 * LEAST
    if narrow and spread > 1.5 * resolution_of(run):
        return True
    if mode == "samples":
        whitened = d[formed] / (np.sqrt(np.mean(d[formed] ** 2)) or 1.0)
    else:
        whitened = Whitener("increments", noise, 1).apply_columns(d[None, :], h)[0]
    size = np.abs(whitened)
    part = size[:: max(1, size.size // 100_000)]
    core = float(np.median(part[part > 0.0])) / 0.6745 if part.any() else 1.0
    return bool(size.max() > limit(size.size) * min(max(core, 0.5), 1.0))


def robust_values(design: Design, groups: tuple[int, ...]) -> Array:
    """Column coefficients (segments, m) of a fit that bad samples do not move.

    Least absolute residuals by reweighting: a spike spoils two increments by opposite amounts, so that bad
    increments are symmetric whatever the spikes are. Then the half that fits best, alone, twice.
    """
    parts = _thinned(design)
    every = np.concatenate([columns[-1] for _, columns in parts])
    scale = float(np.median(np.abs(every - np.median(every)))) or 1.0
    values = _weighted(design, parts, groups, None, scale)
    for _ in range(40):
        values = _weighted(design, parts, groups, values, scale)
        size = np.concatenate([np.abs(_miss(columns, values[s])) for s, columns in parts])
        smaller = float(np.quantile(size, 0.25)) / 3.0
        if smaller <= 0.0 or smaller > 0.98 * scale:
            break
        scale = smaller
    for _ in range(3):
        bound = float(np.quantile(np.concatenate([np.abs(_miss(c, values[s])) for s, c in parts]), 0.4))
        values = _trimmed(design, parts, groups, values, max(bound, 1e-300))
    return values


def _thinned(design: Design) -> list[tuple[int, Array]]:
    """Columns of at most about ROWS increments, each divided by the root of its interval; with their segment."""
    every = max(1, design.rows // ROWS)
    parts = []
    for block in design.blocks():
        formed = np.flatnonzero(block.h > 0.0)[::every]
        parts.append((block.segment, block.columns[:, formed] / np.sqrt(block.h[formed])))
    return parts


def _miss(columns: Array, values: Array) -> Array:
    return columns[-1] - values @ columns[:-1]


def _weighted(
    design: Design, parts: list[tuple[int, Array]], groups: tuple[int, ...], values: Array | None, scale: float
) -> Array:
    """One step towards the least absolute residuals; from the nominal instrument when there is none before."""
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    for segment, columns in parts:
        weight = np.ones(columns.shape[1])
        if values is not None:
            weight = 1.0 / np.sqrt(np.maximum(np.abs(_miss(columns, values[segment])), scale))
        summaries[segment].absorb(columns * weight)
    return solve(design, summaries, groups).values


def _trimmed(
    design: Design, parts: list[tuple[int, Array]], groups: tuple[int, ...], values: Array, bound: float
) -> Array:
    """Least squares of the increments that missed by no more than ``bound``."""
    summaries = [Reduction.empty(design.names) for _ in design.run.labels]
    for segment, columns in parts:
        near = np.abs(_miss(columns, values[segment])) <= bound
        summaries[segment].absorb(np.ascontiguousarray(columns[:, near]))
    try:
        return solve(design, summaries, groups).values
    except np.linalg.LinAlgError:
        return values


def misses_of(design: Design, values: Array) -> Misses:
    """Residuals of the raw record under given column coefficients."""
    d, h = residual_increments(design, values)
    return Misses(d, h, design.point)


def first_noise(misses: Misses) -> Noise:
    """Levels for the first look: the core of the increments, half of it angle noise and half random walk."""
    size = np.abs(misses.d[misses.formed])
    sigma = float(np.quantile(size, 0.25)) / 0.3186
    if misses.point:
        return Noise(0.0, sigma**2)
    return Noise(sigma**2 / 3.0, sigma**2 / (3.0 * misses.step))


def later_noise(misses: Misses, noise: Noise, flags: Flags) -> Noise:
    """Levels of a fit without bad samples, by the core of what it leaves: none left over inflates them."""
    if misses.point:
        good = misses.d[misses.formed & (flags == 0)]
        return Noise(0.0, (float(np.median(np.abs(good))) / 0.6745) ** 2)
    h = np.where(flags == 2, 0.0, np.where(flags == 1, -1.0, misses.h))
    angle = np.cumsum(misses.d)
    d = np.zeros(misses.d.size)
    kept = np.flatnonzero(flags != 1)
    d[kept[1:]] = np.diff(angle[kept])
    h[kept[1:]] = np.where(h[kept[1:]] == 0.0, 0.0, np.diff(np.cumsum(np.maximum(misses.h, 0.0))[kept]))
    d[h <= 0.0] = 0.0
    whitened = np.abs(Whitener("increments", noise, 1).apply_columns(d[None, :], h)[0][h > 0.0])
    core = float(np.median(whitened)) / 0.6745 if whitened.size else 1.0
    factor = min(max(core, 0.2), 1.0) ** 2
    return Noise(noise.white * factor, noise.walk * factor)


def find_flags(misses: Misses, noise: Noise, resolution: float) -> Flags:
    """0 good, 1 left out, 2 first after a jump, for every sample."""
    flags = np.zeros(misses.d.size, dtype=np.int8)
    bound = limit(misses.d.size)
    if misses.point:
        flags[np.abs(misses.d) > max(bound * float(np.sqrt(noise.walk)), LEAST)] = 1
    else:
        floor = max(1.05 * resolution, LEAST)
        scan_samples(misses.d, misses.h, noise.white, noise.walk, bound, floor, flags)
    return flags


def is_misfit(run: Run, misses: Misses, flags: Flags) -> bool:
    """True when what was marked is the model's failure, not the reading's: it misses by smooth waves.

    A bad reading changes sign from increment to increment or not at all; increments that go on missing to
    the same side while the reading moves are of a motion that the model does not hold.
    """
    moves = np.concatenate(([False], np.diff(run.output) != 0.0)) & (flags == 1) & misses.formed
    pairs = moves[1:] & moves[:-1]
    same = np.sign(misses.d[1:]) == np.sign(misses.d[:-1])
    return int(pairs.sum()) > PAIRS and float(same[pairs].mean()) > SMOOTH


def refuse_if_too_many(flags: Flags) -> None:
    """Raise when more than MOST of the samples are bad.

    Raises
    ------
    DataError
        With the share.
    """
    share = float(np.mean(flags == 1))
    if share > MOST:
        raise DataError(
            f"{100.0 * share:.0f} % of the samples do not lie on any path that the reference allows; up to "
            f"{100.0 * MOST:.0f} % would be left out",
            remedy="check the wiring of the output, its unit and the reference; calibrate a part that is sound",
        )


def resolution_of(run: Run) -> float:
    """Angle of a count, also where the record does not say so but repeats its readings."""
    if run.resolution > 0.0 or run.kind == "rate":
        return run.resolution
    size = np.abs(np.diff(run.output))
    moved = size[size > 0.0]
    return float(np.quantile(moved, 0.01)) if moved.size and moved.size < 0.95 * size.size else 0.0


def leave_out(run: Run, misses: Misses, flags: Flags) -> tuple[Run, tuple[Outlier, ...]]:
    """The record without bad samples, and what was found.

    Their output becomes what the model predicts (only the coupling's phase uses it); a jump is taken off all
    later samples.
    """
    wrong = misses.d.copy() if misses.point else _corrections(run, misses, flags)
    if misses.point:
        wrong[flags == 0] = 0.0
    left_out = flags == 1
    begins = run.begins | (flags == 2)
    for start in np.flatnonzero(run.begins & left_out):
        rest = np.flatnonzero(~left_out[start:])
        if rest.size:
            begins[start + rest[0]] = True
    found = _findings(run, flags, wrong)
    quality = run.quality
    events = (*quality.events, *_events(found))
    count = int(left_out.sum())
    cleaned = replace(
        run,
        output=run.output - wrong,
        begins=begins,
        left_out=left_out,
        quality=replace(quality, used=quality.used - count, masked=quality.masked + count, events=events),
    )
    return cleaned, found


def _corrections(run: Run, misses: Misses, flags: Flags) -> Array:
    """What every reading is too large by: jumps so far, and spikes against their good neighbours."""
    angle = np.cumsum(misses.d)
    starts = np.flatnonzero(run.begins)
    stretch = np.cumsum(run.begins) - 1
    angle -= angle[starts][stretch]
    jumps = np.zeros(angle.size)
    for at in np.flatnonzero(flags == 2):
        before = np.flatnonzero(flags[starts[stretch[at]] : at] == 0)
        if before.size:
            jumps[at] = angle[at] - angle[starts[stretch[at]] + before[-1]]
    shifted = np.cumsum(jumps)
    wrong = shifted.copy()
    ends = np.append(starts[1:], angle.size)
    for number in np.unique(stretch[flags == 1]):
        inside = np.arange(starts[number], ends[number])
        good = inside[flags[inside] != 1]
        if good.size:
            own = shifted - shifted[starts[number]]
            bad = inside[flags[inside] == 1]
            wanted = np.interp(bad, good, angle[good] - own[good])
            wrong[bad] = angle[bad] - wanted + shifted[starts[number]]
    return wrong


def _findings(run: Run, flags: Flags, wrong: Array) -> tuple[Outlier, ...]:
    """Runs of bad samples and jumps, in order of time."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], (flags == 1).astype(np.int8), [0]))))
    still = np.concatenate(([False], np.diff(run.output) == 0.0))
    found = []
    for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        stuck = stop - start >= STUCK and float(still[start:stop].mean()) > 0.5
        size = float(np.abs(wrong[start:stop] - wrong[max(start - 1, 0)]).max())
        found.append((start, "stuck" if stuck else "spike", stop - start, size))
    steps = {
        at: float(abs(wrong[at] - _before(wrong, flags, at))) for at in np.flatnonzero(flags == 2).tolist()
    }
    found += [(at, "jump", 0, size) for at, size in steps.items() if size > 0.0]
    found.sort()
    return tuple(Outlier(kind, float(run.t[at]), int(run.row[at]), n, size) for at, kind, n, size in found)


def _before(wrong: Array, flags: Flags, at: int) -> float:
    """What the last good sample before was too large by."""
    good = np.flatnonzero(flags[max(0, at - 1000) : at] != 1)
    return float(wrong[max(0, at - 1000) + good[-1]]) if good.size else 0.0


def _events(found: tuple[Outlier, ...]) -> list[Event]:
    words = {
        "spike": "samples off the path of the output are left out",
        "stuck": "samples during which the output stood still are left out",
        "jump": "no increment is formed across it, and it is taken off what follows",
    }
    events = []
    for kind, text in words.items():
        those = [outlier for outlier in found if outlier.kind == kind]
        if those:
            times = ", ".join(f"{outlier.time:.6g}" for outlier in those[:SHOWN])
            more = f" and {len(those) - SHOWN} more" if len(those) > SHOWN else ""
            count = len(those) if kind == "jump" else sum(outlier.samples for outlier in those)
            events.append(Event(f"outlier-{kind}", count, those[0].row, f"t = {times}{more} s: {text}"))
    return events
