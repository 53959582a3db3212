"""Checks of a log beyond single cells, and the output in SI.

Limits, stuck values, lost samples, a stopped output, wrong units. A counter or a folded angle becomes the output, or an error
with the reason (:func:`unwrapped`). A rate is integrated to the angle that the coupling turns with.
The column of a stand tells where it stands still (:func:`positions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, Where
from piga.reading.columns import RawColumns
from piga.records.arrays import changes, largest_size, norms, scaled, stored
from piga.records.calibration.diagnostics import Event
from piga.records.run import TimeBase
from piga.records.run_file import LeftOutTable
from piga.results import Array
from piga.units import G0, UNIT_FACTORS

_STUCK = 8
"""Fewest equal extreme values in a row that are reported (own choice)."""
_RESTING = 6.0
"""Steps by which a reading falls beside a run of equal extreme values that is no turning point: twice those of one."""
SAMPLED = 1 << 17
"""Rows of a long record that are examined for wrong units (own choice)."""


def _longest_run(mask: NDArray[np.bool_]) -> tuple[int, int]:
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    if not edges.size:
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    longest = int(np.argmax(lengths))
    return int(edges[2 * longest]), int(lengths[longest])


def leave_out_ranges(raw: RawColumns, wanted: Sequence[LeftOutTable]) -> None:
    """Do not use the rows that the run file leaves out. Each range is an event with its reason."""
    for entry in wanted:
        low, high = entry.rows
        inside = (raw.rows >= low) & (raw.rows <= high)
        if not inside.any():
            remedy = f"give the first and the last row to leave out, from {raw.rows[0]} to {raw.rows[-1]}"
            words = f"{raw.path}: [data] leave_out: the file has no rows {low} to {high}"
            raise DataError(words, remedy=remedy, where=Where(raw.path, low))
        raw.leave_out("left-out", inside, f"rows {low} to {high} are not used: {entry.reason}")


def leave_out_repeats(raw: RawColumns, t: Array) -> None:
    """Do not use rows with a repeated time (n,): the second of two identical rows, both of two conflicting rows."""
    index = np.flatnonzero(raw.usable)
    same = (np.diff(t[index]) == 0.0) & (np.diff(raw.segment[index]) == 0)
    first, second = index[:-1][same], index[1:][same]
    identical = np.all([column[first] == column[second] for column in raw.numbers.values()], axis=0)
    raw.usable[second] = False
    raw.usable[first[~identical]] = False
    raw.note("repeated-row", second[identical], "the copy is not used")
    raw.note("conflicting-row", second[~identical], "same time, other values: neither is used")


def note_stuck(raw: RawColumns, name: str, limits: tuple[float, float]) -> None:
    """Report runs of the largest or smallest value in a column that otherwise changes all the time.

    A slow reading rests at its turning points and at its end until it has moved by one step. Such a plateau is expected
    and not reported: a parabola whose rounded top has the length l falls by three steps at most within l/2 beside it.
    A run at or beyond the declared ``limits`` is not reported either: it counts as saturated.
    """
    values = raw.numbers[name]
    finite = np.isfinite(values)
    good = values if finite.all() else values[finite]  # a long column is not copied for nothing
    if good.size < 4 * _STUCK or np.count_nonzero(good[1:] != good[:-1]) < 0.5 * good.size:
        return
    for word, extreme in (("largest", float(good.max())), ("smallest", float(good.min()))):
        start, length = _longest_run(values == extreme)
        if length < _STUCK or not limits[0] < extreme < limits[1]:
            continue
        beside = np.arange(max(start - length // 2, 0), min(start + 3 * length // 2, values.size))
        near = values[beside[raw.segment[beside] == raw.segment[start]]]
        steps = np.abs(np.diff(near))
        step = float(np.min(steps, where=steps > 0.0, initial=np.inf))
        if float(np.nanmax(np.abs(near - extreme))) > _RESTING * step:
            detail = f"column '{name}' stays at its {word} value {extreme:g}: saturated? give its limits in [data] range"
            raw.note("stuck-value", np.arange(start, start + length), detail)


def note_sequence(raw: RawColumns, number: Array, wraps_at: int | None, begins: NDArray[np.bool_]) -> None:
    """Begin a stretch where a sequence number does not follow the one before. Lost and disordered numbers are counted."""
    step = changes(number)
    step[0] = 1.0
    if wraps_at is not None:
        np.mod(step, wraps_at, out=step)
    begins |= step != 1.0
    gaps, backs = np.flatnonzero(step > 1.0), np.flatnonzero(step <= 0.0)
    missing = int(min(step[gaps].sum() - gaps.size, 1e18))
    none = "no increment is formed across it"
    raw.note("sequence-gap", gaps, f"{missing} samples missing; {none}")
    raw.note("sequence-back", backs, none)


@dataclass(frozen=True)
class OutputScale:
    """Conversion from a reading to the output.

    ``factor``: SI per unit of the reading. ``span``: range after which the reading folds back, in its own unit
    (None: never). ``keeps_phase``: the span is a whole number of revolutions. ``counts``: the reading is a count. ``unit`` is
    that of the output: rad, or count for a direct instrument, which has no phase.
    """

    factor: float
    span: float | None = None
    keeps_phase: bool = True
    counts: bool = False
    unit: str = "rad"


def note_doubtful(
    raw: RawColumns, rate: bool, t: Array, output: Array, f: Array, base: TimeBase, K: float, scale: OutputScale
) -> None:
    """Report units that are probably wrong and an output that does not turn. Nothing is changed. ``K``: nominal scale factor."""
    at = np.arange(0, t.size, max(1, -(-t.size // SAMPLED)))
    if rate:
        _note_rate(raw, K * f[at, 0], output[at], t.size, scale)
        return
    at = at[~base.begins[at]]
    slope = (output[at] - output[at - 1]) / (t[at] - t[at - 1])
    _note_rate(raw, K * f[at, 0], slope, t.size - int(np.count_nonzero(base.begins)), scale)
    _note_stopped(raw, output, t, base.begins, f[:, 0], K / (scale.factor if scale.counts else 1e-3))


def note_norm(raw: RawColumns, f: Array) -> None:
    """Report a static reference (n, 3) whose norm is g times a factor between units."""
    norm = norms(f[:: max(1, -(-len(f) // SAMPLED))])
    typical = float(np.median(norm))
    if typical > 0.0 and float(np.quantile(np.abs(norm - typical), 0.9)) <= 0.01 * typical:
        what = f"|f| = {typical / G0:.5g} g in all positions:"
        _note_unit(raw, raw.count, typical / G0, 0.01, what, "[data] reference unit")


def _note_rate(raw: RawColumns, wanted: Array, rate: Array, count: int, scale: OutputScale) -> None:
    strong = np.abs(wanted) > 0.2 * np.abs(wanted).max(initial=0.0)
    if strong.sum() >= _STUCK:
        ratio = abs(float(np.median(rate[strong] / wanted[strong])))
        keys = ", scale_factor and counts_per_revolution" if scale.unit == "rad" else " and scale_factor"
        _note_unit(raw, count, ratio, 0.05, "the output is", f"its unit{keys}")


def _note_unit(raw: RawColumns, count: int, ratio: float, tolerance: float, what: str, check: str) -> None:
    """Report a ratio that is a factor between units."""
    for factor in UNIT_FACTORS:
        for value, sense in ((ratio, "large"), (1.0 / ratio if ratio else 0.0, "small")):
            if factor.words and abs(value / factor.value - 1.0) < tolerance:
                detail = f"{what} too {sense} by {factor.words}? check {check}"
                raw.events.append(Event("implausible-unit", count, int(raw.rows[0]), detail))


def _note_stopped(
    raw: RawColumns, output: Array, t: Array, begins: NDArray[np.bool_], a_x: Array, per_step: float
) -> None:
    """Report an output that stands still although the reference demands rotation: locked, stuck or not connected.

    ``a_x`` (n,) is the reference along X0 [m/s^2], ``per_step`` the output units per (m/s^2) and second.
    """
    still = ~begins & (np.abs(a_x) > 0.05 * largest_size(a_x))
    still[1:] &= output[1:] == output[:-1]  # the first row begins a stretch
    start, length = _longest_run(still)
    run = slice(start, start + length)
    expected = abs(per_step) * float(np.abs(a_x[run]) @ np.diff(t[run], prepend=t[start - 1]))
    if length >= _STUCK and expected >= 10.0:
        detail = f"the output stands still, but the reference expects {expected:.3g} counts: locked or stuck"
        raw.events.append(Event("stopped-output", int(np.count_nonzero(still)), int(raw.rows[start]), detail))


def unwrapped(
    raw: RawColumns, name: str, base: TimeBase, scale: OutputScale, largest: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Unwrapped output angle [rad] of a column, and the samples at which the number of turns was lost.

    A folded reading is unwrapped to the nearest turn inside stretches. Between samples it must move by less
    than half its range. The check uses ``largest``: the largest output step [rad] between samples that the reference
    allows; nan without a reference. A jump that only a folded counter or a reset can make is refused.
    """
    values, begins, span, unit = raw.numbers[name], base.begins, scale.span, scale.unit
    lost = np.zeros(values.size, np.bool_)

    def refusal(words: str, remedy: str, at: int | None = None, key: str = "") -> DataError:
        return raw.refusal(f"column '{name}': {words}", remedy, name, at=at, key=key)

    whole = (values == np.rint(values)) & (np.abs(values) < 2.0**53) if scale.counts else np.ones(1, np.bool_)
    if not whole.all():
        at = int(np.argmin(whole))
        remedy = "set kind to 'angle' or 'rate' with its unit, or name the column of the counts"
        raise refusal(f"{values[at]:.15g} is not a whole count", remedy, at)
    step = changes(values) if scale.counts or span is not None else values
    if span is None:
        psi = scaled(values, scale.factor)
    else:
        top = int(np.argmax(values))
        if values[top] - values.min() > span:
            words = f"{values[top]:.17g} lies outside the range of {span:.17g}"
            raise refusal(words, "correct [instrument] counter_bits (or wraps_at)", top, "counter_bits")
        folds = np.round(step / span)
        wraps = int(np.count_nonzero(folds[~begins]))
        step -= np.multiply(folds, span, out=folds)
        if wraps:
            raw.events.append(Event("counter-roll-over", wraps, None, "unwrapped"))
        fastest, half = largest, 0.5 * span * scale.factor
        if np.isnan(largest):
            fastest = 1.2 * scale.factor * float(np.abs(step[~begins]).max(initial=0.0))
        if fastest >= half:
            words = (
                f"between samples the output may move by {fastest:.3g} {unit}, more than half of the counter's range "
                f"({2.0 * half:.3g} {unit}): a roll-over cannot be recognised"
            )
            rate = 1.2 * fastest / base.nominal / half
            raise refusal(words, f"sample at {rate:.3g} Hz or more, or use a wider counter")
        psi = stored(np.cumsum(step))
        psi += values[0]
        psi *= scale.factor
        lost[1:] = begins[1:] & (not scale.keeps_phase)
    size = np.abs(changes(psi))
    size[begins] = 0.0
    at = int(np.argmax(size))
    if size[at] > 10.0 * largest + 2.0:
        words = f"the output jumps by {size[at]:.4g} {unit} in one sample, the reference allows {largest:.3g} {unit}"
        remedy = (
            "if the counter wraps, give [instrument] counter_bits (for an angle: wraps_at); "
            "if it was reset, start a new segment there; otherwise check scale_factor and the units"
        )
        raise refusal(words, remedy, at, "counter_bits")
    if resets := _resets(values, step, begins, largest / scale.factor) if scale.counts else []:
        more = ", ".join(str(raw.rows[at]) for at in resets[1:100])
        also = f", and in rows {more}" if more else ""
        phases = " and use phases = 'per-segment'" if unit == "rad" else ""
        at = resets[0]
        words = f"the counter goes to {values[at]:.17g}, by {step[at]:+.0f} counts{also}: it was reset there"
        remedy = f"start a new segment there (a segment column){phases}; if it wrapped instead, give [instrument] counter_bits"
        raise refusal(words, remedy, at, "counter_bits")
    return psi, stored(lost)


def _resets(values: Array, step: Array, begins: NDArray[np.bool_], largest: float) -> list[int]:
    """Where a counter jumped to about zero inside a stretch, by more than it can have moved, and went on from there.

    No other step within three samples is a third as large.
    """
    resets = []
    sudden = np.flatnonzero((np.abs(step) > 1.5 * largest + 10.0) & ~begins & (np.abs(values) <= largest + 2.0))
    for at in sudden.tolist():
        window = slice(max(at - 3, 0), at + 4)
        size = np.sort(np.abs(step[window]) * ~begins[window])
        if size.size > 1 and size[-2] < abs(step[at]) / 3.0:
            resets.append(at)
    return resets


_BLOCKS = 4000
"""Blocks into which a column is divided, at most; an edge of a position is known to one block."""
_NOISE = 6.0
"""A block farther than this many standard deviations of a block mean from its position is outside."""
_SAME = 1e-4
"""Share of the range of the column within which it stands still, whatever its noise."""
_SHORT = 0.05
"""Positions shorter than this share of the longest one are parts of a move."""
_LEAST_STILL = 0.2
"""Least share of the rows in positions; below it the stand is taken to move all the time."""
_LEAST_ROWS = 16
"""Fewest rows of a position."""
_QUARTILE = 0.3186 * 6.0**0.5
"""Lower quartile of the second difference of three values of a normal distribution, in its standard deviations."""


def positions(x: Array) -> list[tuple[int, int]]:
    """First row and row after the last of each position of a column (n,). Rows without a number belong to none.

    The column is averaged over short blocks of rows. A position is a run of blocks whose mean stays within a tolerance of the
    mean of the position so far: the noise of the column, or 1e-4 of its range. So a jump and a move end a position. A run that
    drifts through its tolerance is a ramp. Runs much shorter than the longest one belong to moves.
    The list is empty if the column nowhere stands still.
    """
    rows = np.flatnonzero(np.isfinite(x))
    if rows.size < 2 * _LEAST_ROWS:
        return []
    width = max(rows.size // _BLOCKS, 1)
    count = rows.size // width
    means = x[rows[: count * width]].reshape(count, width).mean(axis=1)
    tolerance = _tolerance(means, x[rows])
    still, start, total = [], 0, float(means[0])
    for k in range(1, count + 1):
        if k == count or abs(means[k] - total / (k - start)) > tolerance:
            third = max((k - start) // 3, 1)
            drift = abs(float(means[k - third : k].mean() - means[start : start + third].mean()))
            if (k - start) * width >= _LEAST_ROWS and drift <= 0.5 * tolerance:
                still.append((start, k))
            start, total = k, 0.0
        total += float(means[min(k, count - 1)])
    longest = max((b - a for a, b in still), default=0)
    kept = [_trimmed(means, a, b) for a, b in still if b - a >= _SHORT * longest]
    if sum(b - a for a, b in kept) < _LEAST_STILL * count:
        return []
    return [(int(rows[a * width]), int(rows[b * width - 1]) + 1) for a, b in kept if b > a]


def _trimmed(means: Array, start: int, stop: int) -> tuple[int, int]:
    """A run without the blocks at its ends that belong to a move, by the scatter of the run itself."""
    run = means[start:stop]
    middle = float(np.median(run))
    limit = _NOISE * 1.4826 * float(np.median(np.abs(run - middle))) + 1e-12 * abs(middle)
    inside = np.flatnonzero(np.abs(run - middle) <= limit)
    first, last = start + int(inside[0]), start + int(inside[-1]) + 1
    return first + (first > 0), last - (last < means.size)


def _tolerance(means: Array, x: Array) -> float:
    """Largest distance of the mean of a block from that of its position."""
    steps = np.abs(np.diff(x))
    resolution = float(np.min(steps, where=steps > 0.0, initial=np.inf))
    noise = float(np.quantile(np.abs(np.diff(means, 2)), 0.25)) / _QUARTILE  # a straight move has none
    quantum = 1.5 * resolution if noise > 0.0 and np.isfinite(resolution) else 0.0
    return max(_NOISE * noise, _SAME * float(np.ptp(means)), min(quantum, 0.01 * float(np.ptp(means))))


def find_positions(raw: RawColumns, name: str) -> None:
    """Segments of a record without a column that numbers them: where the stand, whose column is ``name``, stands still."""
    spans = positions(raw.numbers[name])
    if not spans:
        words = f"column '{name}' nowhere stands still, so it tells no position"
        remedy = (
            "name the column that logs the angle or the speed of the stand, or one that numbers the positions"
        )
        raise raw.refusal(words, remedy, name)
    raw.segment = np.full(raw.count, -1, np.int32)
    for k, (start, stop) in enumerate(spans):
        raw.segment[start:stop] = k
    raw.labels = tuple(str(k + 1) for k in range(len(spans)))
    detail = f"'{name}' does not stand still: rows between the {len(spans)} positions are not used"
    raw.leave_out("moving", raw.segment < 0, detail)


def leave_out_settling(raw: RawColumns, t: Array, seconds: float) -> None:
    """Do not use the rows within the first ``seconds`` of each visit of a position. ``t`` (n,) is the time [s]."""
    begins = np.diff(raw.segment, prepend=raw.segment[0] - 1) != 0
    early = (t - t[begins][np.cumsum(begins) - 1] < seconds) & (raw.segment >= 0)
    raw.leave_out("settling", early, f"the first {seconds:g} s of each position are not used")
