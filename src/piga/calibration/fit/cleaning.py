"""The record without its bad samples: what every reading is too large by, and what was found where.

A jump of the output has two sides. Three causes look alike at the jump itself: the counter slipped, and all later readings
are shifted; the few readings before it are wrong; or the few behind it are. The phase of the coupling in the other segments
tells them apart (:func:`settle_jumps`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga._kernels.estimation.outliers import correct_samples
from piga.calibration.fit.outliers import OUTLIERS, Flags, Misses, count_flags
from piga.calibration.model.design import Design
from piga.calibration.model.reduction import Reduction
from piga.calibration.noise.levels import Noise, find_noise
from piga.calibration.noise.weighting import reduce_segments, residual_increments, weighted_blocks
from piga.reading.signal_checks import largest_size
from piga.records.calibration import Event, Outlier
from piga.records.run import Run
from piga.records.spool import arrays_like, spans, steps

Array = NDArray[np.float64]


@dataclass(frozen=True)
class JumpStretch:
    """A part of the record without a gap that holds jumps, or several parts without any.

    ``edges`` are the rows at which its pieces begin and the row behind the last, ``levels`` what the readings of each piece
    were taken to be too large by, ``good`` how many of them are used; ``anew`` says that the phase is free from here on.
    """

    edges: tuple[int, ...]
    levels: tuple[float, ...]
    good: tuple[int, ...]
    anew: bool

    @property
    def longest(self) -> int:
        """Piece with the most readings."""
        return int(np.argmax(self.good))

    def choices(self, first: bool) -> list[tuple[int, int]]:
        """Pieces that the phase may come in by and go out by; at the start of a phase the longest begins it."""
        last = len(self.levels) - 1
        inward = (self.longest,) if first else (0, self.longest, last)
        pairs = [(i, k) for i in inward for k in (0, self.longest, last) if i <= k]
        return list(dict.fromkeys(pairs))

    def cost(self, choice: tuple[int, int]) -> float:
        """What a choice must gain beforehand (chi-square)."""
        inward, outward = choice
        believed = sum(self.good[k] for k in {inward, outward})
        return OUTLIERS.slip_cost * (inward != outward) + OUTLIERS.wrong_cost * (
            1.0 - believed / max(sum(self.good), 1)
        )


def leave_out(
    run: Run, misses: Misses, flags: Flags, design: Design | None = None, noise: Noise | None = None
) -> tuple[Run, tuple[Outlier, ...]]:
    """The record without bad samples, and the outliers.

    Their output becomes what the model predicts (only the coupling's phase uses it). A jump is taken off all later samples,
    or off the readings of one side alone (:func:`settle_jumps`, with the ``design`` of the fit and the ``noise`` found so far).
    """
    wrong = _corrections(run, misses, flags)
    arrays = arrays_like(run.output)
    output = arrays.empty(run.size)
    left_out, begins = arrays.empty(run.size, np.bool_), arrays.empty(run.size, np.bool_)
    lost = False
    for part in spans(run.size):
        output[part] = run.output[part] - wrong[part]
        left_out[part] = flags[part] == 1
        begins[part] = run.begins[part] | (flags[part] == 2)
        lost = _begin_later(begins[part], left_out[part], lost)
    cleaned = replace(run, output=output, begins=begins, left_out=left_out)
    one_sided: dict[int, str] = {}
    if design is not None and noise is not None and count_flags(flags, 2):
        one_sided = settle_jumps(cleaned, run.begins, wrong, flags, design, noise)
    outliers, counts, before_gap = _findings(run, flags, wrong)
    quality = run.quality
    count = count_flags(flags, 1)
    events = _events(outliers, counts, {int(run.row[at]): words for at, words in one_sided.items()}, before_gap)
    quality = replace(
        quality, used=quality.used - count, masked=quality.masked + count, events=(*quality.events, *events)
    )
    return replace(cleaned, quality=quality), outliers


def settle_jumps(
    run: Run, begins: NDArray[np.bool_], wrong: Array, flags: Flags, design: Design, noise: Noise
) -> dict[int, str]:
    """Decide for every jump which readings carry the phase on, and correct the output of ``run`` and ``wrong`` in place.

    The readings of a stretch are tied to each other; what is open is by which piece between its jumps the phase comes in
    from the readings before, and by which it goes on to those behind. Each choice turns the columns of the coupling of whole
    stretches, so that the sum of squares of every choice follows from one summary a stretch. The least wins, after
    the costs of a slip and of wrong readings. At the start of a phase, where nothing lies before, the longest piece gives
    the phase.

    Parameters
    ----------
    run:
        The record with every jump taken off all later readings.
    begins, wrong, flags:
        Where stretches begin, what readings were too large by, marks of the samples.
    design, noise:
        Model (its request), and noise levels so far.

    Returns
    -------
    dict
        Row index of every jump that was not taken off what follows, with what was done instead.
    """
    stretches = _stretches(run, begins, wrong, flags, free=design.request.phase == "per-segment")
    jumped = [k for k, stretch in enumerate(stretches) if len(stretch.levels) > 1]
    chosen: dict[int, tuple[int, int]] = {}
    for k in jumped:
        stretch = stretches[k]
        chosen[k] = min(stretch.choices(k == 0 or stretch.anew), key=stretch.cost)
    tied = bool(design.local_names) and design.request.phase == "shared" and not design.point
    if tied and len(jumped) <= OUTLIERS.judged:
        _ask_phases(design.of(run), noise, stretches, chosen)
    words: dict[int, str] = {}
    for k, (stretch, more) in enumerate(zip(stretches, _turned(stretches, chosen), strict=True)):
        if more != 0.0:
            rows = slice(stretch.edges[0], stretch.edges[-1])
            run.output[rows] -= more
            wrong[rows] += more
        if k in chosen:
            words |= _one_sided(stretch, chosen[k])
    return words


def _stretches(
    run: Run, begins: NDArray[np.bool_], wrong: Array, flags: Flags, *, free: bool
) -> list[JumpStretch]:
    """The record in order: stretches with jumps, and what lies between them; ``free``: every segment has its own phase."""
    starts = _rows_where(begins)
    own = set(run.segment_edges().tolist()) if free else set()
    jumps = _rows_where(flags == 2)
    bounds = np.append(starts, run.size)
    home = np.searchsorted(starts, jumps, side="right") - 1
    cuts = {0, run.size, *own}
    for k in home.tolist():
        cuts |= {int(bounds[k]), int(bounds[k + 1])}
    result = []
    for start, stop in pairwise(sorted(cuts)):
        inner = jumps[(jumps > start) & (jumps < stop)].tolist()
        pieces = [(a, b, *_level(wrong, flags, a, b)) for a, b in pairwise([start, *inner, stop])]
        kept = [piece for piece in pieces if piece[3]] or pieces[-1:]
        edges = (start, *(piece[0] for piece in kept[1:]), stop)
        levels, good = tuple(piece[2] for piece in kept), tuple(piece[3] for piece in kept)
        result.append(JumpStretch(edges, levels, good, start in own))
    return result


def _rows_where(marks: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Rows that are marked."""
    rows = [part.start + np.flatnonzero(np.asarray(marks[part])) for part in spans(marks.size)]
    return np.concatenate(rows).astype(np.int64)


def _level(wrong: Array, flags: Flags, start: int, stop: int) -> tuple[float, int]:
    """What the good readings of a piece are too large by, and their number."""
    count, level = 0, float(wrong[start])
    for part in spans(stop - start):
        at = np.flatnonzero(flags[start + part.start : start + part.stop] != 1)
        if at.size and not count:
            level = float(wrong[start + part.start + at[0]])
        count += at.size
    return level, count


def _turned(stretches: list[JumpStretch], chosen: dict[int, tuple[int, int]]) -> list[float]:
    """What every stretch is too large by beyond what was taken off [rad]."""
    state, result = 0.0, []
    for k, stretch in enumerate(stretches):
        inward, outward = chosen.get(k, (0, 0))
        if stretch.anew:
            state = 0.0
        result.append(state - stretch.levels[inward])
        state += stretch.levels[outward] - stretch.levels[inward]
    return result


def _ask_phases(
    design: Design, noise: Noise, stretches: list[JumpStretch], chosen: dict[int, tuple[int, int]]
) -> None:
    """Change ``chosen`` to what leaves the least sum of squares, one stretch after the other."""
    factors, rows = _factors(design, _without_phases(design, noise), stretches)
    freedom = max(rows - len(design.names), 1)

    def squares(choice: dict[int, tuple[int, int]]) -> float:
        turned = [
            _rotated(design, factor, angle)
            for factor, angle in zip(factors, _turned(stretches, choice), strict=True)
        ]
        corner: Array = np.asarray(np.linalg.qr(np.vstack(turned), mode="r"))[-1]
        return float(corner[-1] ** 2)

    for _ in range(OUTLIERS.sweeps):
        before = dict(chosen)
        for k in chosen:
            stretch = stretches[k]
            options = stretch.choices(k == 0)
            sums = [squares(chosen | {k: option}) for option in options]
            unit = max(min(sums), 1e-300) / freedom
            costs = [s / unit + stretch.cost(o) for s, o in zip(sums, options, strict=True)]
            chosen[k] = options[int(np.argmin(costs))]
        if chosen == before:
            break


def _without_phases(design: Design, noise: Noise) -> Noise:
    """Noise levels of a fit in which every segment has its own phase: no choice of sides is in them."""
    local, m = len(design.local_names), len(design.names)
    for _ in range(OUTLIERS.refits):
        factors = [part.factor[:-1] for part in reduce_segments(design, "increments", noise)]
        if len(factors) > OUTLIERS.judged:
            return noise
        rows = np.zeros((len(factors) * m, len(factors) * local + m - local))
        for k, factor in enumerate(factors):
            rows[k * m : (k + 1) * m, k * local : (k + 1) * local] = factor[:, :local]
            rows[k * m : (k + 1) * m, len(factors) * local :] = factor[:, local:m]
        scale = np.linalg.norm(rows, axis=0)
        scale[scale == 0.0] = 1.0
        right = np.concatenate([factor[:, -1] for factor in factors])
        best = np.linalg.lstsq(rows / scale, right, rcond=1e-10)[0] / scale
        own = best[: len(factors) * local].reshape(len(factors), local)
        values = np.hstack([own, np.tile(best[len(factors) * local :], (len(factors), 1))])
        d, h = residual_increments(design, values)
        noise = find_noise(
            d, h, best.size, 4.0 * np.finfo(float).eps * max(largest_size(design.run.output), 1e-3)
        )
    return noise


def _factors(design: Design, noise: Noise, stretches: list[JumpStretch]) -> tuple[list[Array], int]:
    """Triangular factor of the weighted rows of every stretch, and the number of rows."""
    starts = np.array([stretch.edges[0] for stretch in stretches])
    parts = [Reduction.empty(design.names) for _ in stretches]
    total = 0
    for block, columns in weighted_blocks(design, "increments", noise):
        total += int(np.count_nonzero(block.h > 0.0))
        first = int(np.searchsorted(starts, block.start, side="right")) - 1
        inside = [int(at) for at in starts[first + 1 :] if at < block.stop]
        for k, (a, b) in enumerate(pairwise([block.start, *inside, block.stop]), start=first):
            parts[k].absorb(np.ascontiguousarray(columns[:, a - block.start : b - block.start]))
    return [part.factor for part in parts], total


def _rotated(design: Design, factor: Array, angle: float) -> Array:
    """The factor with the output less by ``angle``: the columns of the coupling and of harmonics turn with it."""
    if angle == 0.0:
        return factor
    result, at = factor.copy(), 0
    orders = ((1,) if "p" in design.local_names else ()) + tuple(design.request.harmonics)
    for order in orders:
        cosine, sine = math.cos(order * angle), math.sin(order * angle)
        result[:, at : at + 2] = factor[:, at : at + 2] @ np.array([[cosine, sine], [-sine, cosine]])
        at += 2
    return result


def _one_sided(stretch: JumpStretch, choice: tuple[int, int]) -> dict[int, str]:
    """Jumps of a stretch whose one side alone was taken to be off, by row, in words."""
    inward, outward = choice
    words = {}
    for k, at in enumerate(stretch.edges[1:-1]):
        if k < inward:
            count = sum(stretch.good[: k + 1])
            words[at] = f"the {count} reading{'s' * (count > 1)} before it since the last gap"
        elif k >= outward:
            count = sum(stretch.good[k + 1 :])
            words[at] = f"the {count} reading{'s' * (count > 1)} from it to the next gap"
    return words


def _begin_later(begins: NDArray[np.bool_], left_out: NDArray[np.bool_], lost: bool) -> bool:
    """Where a stretch begins with samples that are left out the first good one begins it, too, in place.

    ``lost``: so it stood at the end of the block before; returned for the next.
    """
    starts = np.flatnonzero(begins & left_out)
    for start in ([0] if lost else []) + starts.tolist():
        rest = np.flatnonzero(~left_out[start:])
        if rest.size:
            begins[start + rest[0]] = True
    if starts.size == 0 and not lost:
        return False
    last = int(starts[-1]) if starts.size else 0
    return bool(left_out[last:].all())


def _corrections(run: Run, misses: Misses, flags: Flags) -> Array:
    """What every reading is too large by."""
    wrong: Array = arrays_like(run.output).zeros(run.size)
    if not misses.point:
        correct_samples(misses.d, run.begins, flags, wrong)
        return wrong
    for part in spans(run.size):
        wrong[part] = np.where(flags[part] == 0, 0.0, misses.d[part])
    return wrong


def _findings(
    run: Run, flags: Flags, wrong: Array
) -> tuple[tuple[Outlier, ...], dict[str, int], tuple[Outlier, ...]]:
    """Runs of bad samples and jumps, in order of time, at most ``listed``; numbers of jumps and of samples of each kind.

    Last those of the runs behind which a gap follows and more readings: a slip of the counter looks the same.
    """
    outliers: list[Outlier] = []
    before_gap: list[Outlier] = []
    counts: dict[str, int] = {}
    for start, stop in _runs(flags):
        kind, size = _judge(run, flags, wrong, start, stop)
        if kind == "jump" and size == 0.0:
            continue
        counts[kind] = counts.get(kind, 0) + (1 if kind == "jump" else stop - start)
        if len(outliers) < OUTLIERS.listed:
            samples = 0 if kind == "jump" else stop - start
            outliers.append(Outlier(kind, float(run.t[start]), int(run.row[start]), samples, size))
            if kind == "spike" and stop < flags.size and run.begins[stop]:
                before_gap.append(outliers[-1])
    return tuple(outliers), counts, tuple(before_gap)


def _judge(run: Run, flags: Flags, wrong: Array, start: int, stop: int) -> tuple[str, float]:
    """Kind of a run of bad samples, or of a jump, and by how much it is off [rad, rad/s]."""
    if flags[start] == 2:
        return "jump", float(abs(wrong[start] - _before(wrong, flags, start)))
    size = float(np.abs(wrong[start:stop] - wrong[max(start - 1, 0)]).max())
    if stop - start < OUTLIERS.stuck:
        return "spike", size
    still = float((steps(run.output, slice(start, stop)) == 0.0).mean())
    return "stuck" if still > 0.5 else "spike", size


def _runs(flags: Flags) -> Iterator[tuple[int, int]]:
    """First row of every run of bad samples, or of a jump, and the row behind it."""
    begun = -1
    for part in spans(flags.size):
        kind = np.asarray(flags[part])
        marks = np.flatnonzero(kind)
        edges = np.flatnonzero(np.diff(kind, prepend=np.int8(-1)) != 0) if marks.size or begun >= 0 else marks
        for edge in edges.tolist():
            at = part.start + edge
            if begun >= 0 and kind[edge] != 1:
                yield begun, at
                begun = -1
            if kind[edge] == 2:
                yield at, at + 1
            elif kind[edge] == 1 and begun < 0:
                begun = at
    if begun >= 0:
        yield begun, flags.size


def _before(wrong: Array, flags: Flags, at: int) -> float:
    """What the last good sample before was too large by."""
    good = np.flatnonzero(flags[max(0, at - 1000) : at] != 1)
    return float(wrong[max(0, at - 1000) + good[-1]]) if good.size else 0.0


def _events(
    outliers: tuple[Outlier, ...],
    counts: dict[str, int],
    one_sided: dict[int, str],
    before_gap: tuple[Outlier, ...],
) -> list[Event]:
    """What was found by kind.

    ``one_sided`` says of jumps, by file row, which readings alone they were taken off; ``before_gap`` are spikes that a gap
    follows.
    """
    words = {
        "spike": "samples off the path of the output are left out",
        "stuck": "samples during which the output stood still are left out",
        "jump": "no increment is formed across it, and it is taken off what follows",
    }
    events = []
    sides = [outlier for outlier in outliers if outlier.kind == "jump" and outlier.row in one_sided]
    if sides:
        listed = ", ".join(
            f"{outlier.time:.6g} s ({one_sided[outlier.row]})" for outlier in sides[: OUTLIERS.named]
        )
        more = " and more" if len(sides) > OUTLIERS.named else ""
        text = "no increment is formed across it, and it is taken off these readings alone: the others carry the phase"
        events.append(Event("outlier-jump", len(sides), sides[0].row, f"t = {listed}{more}: {text}"))
        counts = counts | {"jump": counts["jump"] - len(sides)}
    for kind, text in words.items():
        those = [o for o in outliers if o.kind == kind and not (kind == "jump" and o.row in one_sided)]
        if those:
            times = ", ".join(f"{outlier.time:.6g}" for outlier in those[: OUTLIERS.named])
            more = " and more" if counts[kind] > sum(max(o.samples, 1) for o in those[: OUTLIERS.named]) else ""
            also = _perhaps_a_slip(before_gap) if kind == "spike" else ""
            events.append(
                Event(f"outlier-{kind}", counts[kind], those[0].row, f"t = {times}{more} s: {text}{also}")
            )
    return events


def _perhaps_a_slip(before_gap: tuple[Outlier, ...]) -> str:
    """What is said of spikes that a gap follows."""
    if not before_gap:
        return ""
    listed = ", ".join(f"{one.samples} from t = {one.time:.6g} s" for one in before_gap[: OUTLIERS.named])
    more = " and more" if len(before_gap) > OUTLIERS.named else ""
    return (
        f". The last readings before a gap ({listed}{more}) are too few to tell wrong readings from a slip of the counter. "
        "A slip stays: the phase of what follows is then another, and phase = 'per-segment' shows it"
    )
