"""Remove bad samples from a record: the error of every reading, and a list of the findings.

A jump of the output has three possible causes. The counter slipped, and all later readings are shifted; or the few
readings before the jump are wrong; or the few readings after it are wrong. The jump looks the same in all three cases. The
phase of the coupling in the other segments separates the causes (:func:`settle_jumps`).
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
from piga.calibration.model.solution import least_squares
from piga.calibration.noise.levels import Noise, find_noise, rounding
from piga.calibration.noise.weighting import reduce_segments, residual_increments, weighted_blocks
from piga.records.calibration import Event, Outlier
from piga.records.run import Run
from piga.records.spool import arrays_like, spans, steps
from piga.results import Array


@dataclass(frozen=True)
class JumpStretch:
    """A part of the record without a gap: one stretch with jumps, or several stretches without jumps.

    ``edges`` are the first rows of its pieces and the end row. ``levels`` are the assumed errors of the readings of each
    piece (reading minus truth); ``good`` is the number of used readings. ``anew`` is True if a new phase begins at this part.
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
        """Pieces by which the phase can enter and leave. At the start of a phase it enters by the longest piece."""
        last = len(self.levels) - 1
        inward = (self.longest,) if first else (0, self.longest, last)
        pairs = [(i, k) for i in inward for k in (0, self.longest, last) if i <= k]
        return list(dict.fromkeys(pairs))

    def cost(self, choice: tuple[int, int]) -> float:
        """Prior cost of a choice: the chi-square that it must gain."""
        inward, outward = choice
        believed = sum(self.good[k] for k in {inward, outward})
        return OUTLIERS.slip_cost * (inward != outward) + OUTLIERS.wrong_cost * (
            1.0 - believed / max(sum(self.good), 1)
        )


def leave_out(
    run: Run, misses: Misses, flags: Flags, design: Design | None = None, noise: Noise | None = None
) -> tuple[Run, tuple[Outlier, ...]]:
    """The record without bad samples, and the outliers.

    The output of bad samples is replaced by the prediction of the model; only the phase of the coupling uses it. A jump
    is subtracted from all later samples, or from the readings of one side only (:func:`settle_jumps`, with the
    ``design`` of the fit and its ``noise``).
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
    """Decide for every jump which readings continue the phase; correct the output of ``run`` and ``wrong`` in place.

    The readings between two jumps have one common error. For each stretch two pieces are unknown: the piece that continues the
    phase of the readings before, and the piece from which the readings after it continue. A choice turns the columns of the
    coupling of whole stretches. So one summary per stretch gives the sum of squares of every choice. The costs of a slip
    and of wrong readings are added. The choice with the least sum wins. At the start of a phase there are no
    readings before, and the longest piece gives the phase.

    Parameters
    ----------
    run:
        The record with every jump subtracted from all later readings.
    begins, wrong, flags:
        First samples of stretches, errors of the readings, marks of the samples.
    design, noise:
        Model (with its request), and noise levels so far.

    Returns
    -------
    dict
        Row index of every jump that was not subtracted from all later readings, and what was done instead.
    """
    stretches = _stretches(run, begins, wrong, flags, free=design.request.phases == "per-segment")
    jumped = [k for k, stretch in enumerate(stretches) if len(stretch.levels) > 1]
    chosen: dict[int, tuple[int, int]] = {}
    for k in jumped:
        stretch = stretches[k]
        chosen[k] = min(stretch.choices(k == 0 or stretch.anew), key=stretch.cost)
    tied = bool(design.local_names) and design.request.phases == "shared" and not design.point
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
    """The record in order: stretches with jumps, and the parts between them; ``free``: one phase per segment."""
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
    """Error of the good readings of a piece, and their number."""
    count, level = 0, float(wrong[start])
    for part in spans(stop - start):
        at = np.flatnonzero(flags[start + part.start : start + part.stop] != 1)
        if at.size and not count:
            level = float(wrong[start + part.start + at[0]])
        count += at.size
    return level, count


def _turned(stretches: list[JumpStretch], chosen: dict[int, tuple[int, int]]) -> list[float]:
    """Error of every stretch beyond what was already subtracted [rad]."""
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
    """Set ``chosen`` to the choices with the least sum of squares, one stretch after the other."""
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
    """Noise levels of a fit with one phase per segment; they do not depend on the choice of sides."""
    local, m = len(design.local_names), len(design.names)
    for _ in range(OUTLIERS.refits):
        factors = [part.factor[:-1] for part in reduce_segments(design, "increments", noise)]
        if len(factors) > OUTLIERS.judged:
            return noise
        rows = np.zeros((len(factors) * m, len(factors) * local + m - local))
        for k, factor in enumerate(factors):
            rows[k * m : (k + 1) * m, k * local : (k + 1) * local] = factor[:, :local]
            rows[k * m : (k + 1) * m, len(factors) * local :] = factor[:, local:m]
        right = np.concatenate([factor[:, -1] for factor in factors])
        best = least_squares(rows, right, 1e-10)
        own = best[: len(factors) * local].reshape(len(factors), local)
        values = np.hstack([own, np.tile(best[len(factors) * local :], (len(factors), 1))])
        d, h = residual_increments(design, values)
        noise = find_noise(d, h, design.run.median_step, best.size, rounding(design.run))
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
    """The factor after ``angle`` is subtracted from the output; columns of coupling and harmonics turn with it."""
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
    """Jumps of a stretch that were subtracted on one side only, by row, in words."""
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
    """If the first sample of a stretch is left out, the first good sample begins the stretch instead. In place.

    ``lost``: a beginning is pending from the previous block. The state is returned for the next block.
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
    """Error of every reading."""
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
    """Runs of bad samples and jumps in order of time (at most ``listed``), and the number of jumps and samples by kind.

    The last result lists the runs that are followed by a gap and more readings. A slip of the counter looks the same.
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
    """Kind of a run of bad samples or of a jump, and its size [rad, rad/s]."""
    if flags[start] == 2:
        return "jump", float(abs(wrong[start] - _before(wrong, flags, start)))
    size = float(np.abs(wrong[start:stop] - wrong[max(start - 1, 0)]).max())
    if stop - start < OUTLIERS.stuck:
        return "spike", size
    still = float((steps(run.output, slice(start, stop)) == 0.0).mean())
    return "stuck" if still > 0.5 else "spike", size


def _runs(flags: Flags) -> Iterator[tuple[int, int]]:
    """First row and end row of every run of bad samples and of every jump."""
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
    """Error of the last good sample before a row."""
    good = np.flatnonzero(flags[max(0, at - 1000) : at] != 1)
    return float(wrong[max(0, at - 1000) + good[-1]]) if good.size else 0.0


def _events(
    outliers: tuple[Outlier, ...],
    counts: dict[str, int],
    one_sided: dict[int, str],
    before_gap: tuple[Outlier, ...],
) -> list[Event]:
    """Events for the findings, by kind.

    ``one_sided`` gives, by file row, the jumps that were subtracted on one side only. ``before_gap`` are spikes that are
    followed by a gap.
    """
    words = {
        "spike": "samples off the path of the output are left out",
        "stuck": "samples during which the output stood still are left out",
        "jump": "no increment is formed across it, and all later readings are corrected by it",
    }
    events = []
    sides = [outlier for outlier in outliers if outlier.kind == "jump" and outlier.row in one_sided]
    if sides:
        listed = ", ".join(
            f"{outlier.time:.6g} s ({one_sided[outlier.row]})" for outlier in sides[: OUTLIERS.named]
        )
        more = " and more" if len(sides) > OUTLIERS.named else ""
        text = (
            "no increment is formed across it, and only these readings are corrected by it: the others "
            "carry the phase"
        )
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
    """Remark on spikes that are followed by a gap."""
    if not before_gap:
        return ""
    listed = ", ".join(f"{one.samples} from t = {one.time:.6g} s" for one in before_gap[: OUTLIERS.named])
    more = " and more" if len(before_gap) > OUTLIERS.named else ""
    return (
        f". The last readings before a gap ({listed}{more}) are too few to separate wrong readings "
        "from a slip of the counter. If the counter slipped, the phase after it is another one: "
        "phases = 'per-segment' shows it"
    )
