"""Checks of a log beyond single cells, and the output in SI.

Limits, stuck values, lost samples, a stopped output, wrong units. A counter, a folded angle or a rate becomes the output, or an
error with the reason (:class:`Reading`). A rate is integrated to the angle that the coupling turns with (:class:`RateAngle`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.records.calibration import Event, Tally
from piga.records.run_file import LeftOutTable
from piga.records.spool import Arrays, spans, steps
from piga.results import Array
from piga.units import G0


@dataclass(frozen=True)
class SignalCheckSettings:
    """Limits for doubtful signals (own choices)."""

    stuck: int = 8
    """Fewest equal extreme values in a row that are reported."""
    resting: float = 2.0
    """Steps that a run of equal extreme values may hide because of rounding."""
    shoulder: int = 1 << 16
    """Most rows beside such a run that are examined."""
    sampled: int = 1 << 17
    """Rows of a long record that are examined for wrong units."""


SIGNAL_CHECKS = SignalCheckSettings()


FACTORS = {9.80665: "9.80665 (g and m/s^2)", 57.29577951: "57.2958 (deg and rad)", 1e3: "1000 (mg and g)",
           1e6: "10^6 (ug and g)", 3600.0: "3600 (per hour and per second)",
           57.29577951 * 3600: "206265 (deg/h and rad/s, or arcsec and rad)",
           9806.65: "9806.65 (mg and m/s^2)"}  # fmt: skip
"""Factors between units that are often confused."""


@dataclass
class LongestRun:
    """Longest run of True in a sequence of masks: its ``start`` and ``length``. ``count`` is the number of all True."""

    start: int = 0
    length: int = 0
    count: int = 0
    _open: int = 0
    _next: int = 0

    def see(self, mask: NDArray[np.bool_], offset: int) -> None:
        """Add the mask of the rows from ``offset`` on."""
        held = self._open if offset == self._next else 0
        self._next, self._open = offset + mask.size, 0
        at = np.flatnonzero(mask)
        if not at.size:
            return
        ends = np.flatnonzero(np.diff(at) != 1)
        starts = at[np.concatenate(([0], ends + 1))]
        lengths = at[np.append(ends, at.size - 1)] - starts + 1
        self.count += at.size
        if at[-1] == mask.size - 1:
            self._open = int(lengths[-1]) + (held if starts[-1] == 0 else 0)
        if starts[0] == 0:
            starts[0], lengths[0] = -held, lengths[0] + held
        starts = starts + offset
        longest = int(np.argmax(lengths))
        if lengths[longest] > self.length:
            self.start, self.length = int(starts[longest]), int(lengths[longest])


def beyond_limits(
    numbers: Mapping[str, NDArray],
    limits: Mapping[str, tuple[float, float]],
    usable: NDArray[np.bool_],
    rows: NDArray[np.int64],
) -> list[Event]:
    """Clear ``usable`` for saturated rows: a value is at or beyond its declared limits. They are counted by column."""
    events: list[Event] = []
    for name, (low, high) in limits.items():
        saturated = Tally()
        for part in spans(rows.size):
            out = (numbers[name][part] <= low) | (numbers[name][part] >= high)
            saturated.see(part.start + np.flatnonzero(out))
            usable[part] &= ~out
        detail = f"column '{name}' at or beyond {low:g} to {high:g}: the row is not used"
        events += saturated.events("saturated", rows, detail)
    return events


def left_out_rows(
    wanted: Sequence[LeftOutTable], usable: NDArray[np.bool_], rows: NDArray[np.int64], path: Path
) -> list[Event]:
    """Clear ``usable`` for the rows that the run file leaves out. Each range is an event with its reason.

    Raises
    ------
    DataError
        If a range ends before it begins, or holds no row of the file.
    """
    events = []
    for entry in wanted:
        low, high = entry.rows
        begin, end = np.searchsorted(rows, low), np.searchsorted(rows, high, side="right")
        if low > high or begin == end:
            raise DataError(
                f"{path}: [data] leave_out: the file has no rows {low} to {high}",
                remedy=f"give the first and the last row to leave out, from {rows[0]} to {rows[-1]}",
            )
        usable[begin:end] = False
        detail = f"rows {low} to {high} are not used: {entry.reason}"
        events.append(Event("left-out", int(end - begin), int(rows[begin]), detail))
    return events


@dataclass
class Extremes:
    """Smallest and largest value of each block of a column, number of changes, and number of non-finite values."""

    lows: list[float]
    highs: list[float]
    size: int = 0
    changes: int = 0
    bad: list[tuple[slice, NDArray[np.bool_]]] = field(default_factory=list)

    @classmethod
    def of(cls, values: Array) -> Extremes:
        """Examine a column."""
        extremes = cls([], [])
        last = np.zeros(0)
        for part in spans(values.size):
            block = values[part]
            finite = np.isfinite(block)
            if not finite.all():
                extremes.bad.append((part, finite))
                block = block[finite]
            extremes.lows.append(float(block.min()) if block.size else np.nan)
            extremes.highs.append(float(block.max()) if block.size else np.nan)
            extremes.size += block.size
            extremes.changes += int(np.count_nonzero(block[1:] != block[:-1]))
            if block.size:
                extremes.changes += int(np.count_nonzero(last != block[0]))
                last = block[-1:]
        return extremes

    def mask(self, usable: NDArray[np.bool_]) -> None:
        """Clear ``usable`` for rows without a finite value."""
        for part, finite in self.bad:
            usable[part] &= finite
        self.bad.clear()


def stuck_extremes(
    name: str,
    values: Array,
    extremes: Extremes,
    rows: NDArray[np.int64],
    segment: NDArray[np.int32],
    declared: tuple[float, float],
) -> list[Event]:
    """Runs of the largest or smallest value in a column that otherwise changes all the time.

    A slow reading rests at its turning points and at its end until it has moved by one step. Such a plateau is expected
    and not reported. A run at or beyond the ``declared`` limits is not reported either: it counts as saturated.
    """
    if extremes.size < 4 * SIGNAL_CHECKS.stuck or extremes.changes < 0.5 * extremes.size:
        return []
    events = []
    for word, bounds, best in (("largest", extremes.highs, np.nanmax), ("smallest", extremes.lows, np.nanmin)):
        extreme, run = float(best(bounds)), LongestRun()
        if not declared[0] < extreme < declared[1]:
            continue
        for part, bound in zip(spans(values.size), bounds, strict=True):
            if bound == extreme:
                run.see(values[part] == extreme, part.start)
        if (
            run.length >= SIGNAL_CHECKS.stuck
            and cut_off(values, segment, run.start, run.length, extreme) > SIGNAL_CHECKS.resting
        ):
            detail = f"column '{name}' stays at its {word} value {extreme:g}: saturated? give its limits in [data] range"
            events.append(Event("stuck-value", run.length, int(rows[run.start]), detail))
    return events


def cut_off(values: Array, segment: NDArray[np.int32], start: int, length: int, extreme: float) -> float:
    """Estimate how far the reading went beyond a run of its extreme value, in its smallest steps.

    A parabola is laid through the two ends of the run and the neighbourhood. If it has fallen by ``s`` at the
    distance ``d`` from a run of half width ``w``, its top is ``s / ((1 + d/w)^2 - 1)`` above the run. A run that
    comes from rounding hides at most one step. The neighbourhood ends with the ``segment``, because the speed of the
    reading in the next position does not apply to an output that is locked in this one.
    """
    reach, last = min(length, SIGNAL_CHECKS.shoulder), start + length - 1
    left, right = slice(max(start - reach, 0), start), slice(last + 1, last + 1 + reach)
    sides = (
        values[left][::-1][np.logical_and.accumulate(segment[left][::-1] == segment[start])],
        values[right][np.logical_and.accumulate(segment[right] == segment[last])],
    )
    moves = np.abs(np.diff(np.concatenate((sides[0][::-1], [extreme], sides[1]))))
    step = float(np.min(moves, where=moves > 0.0, initial=np.inf))
    if not np.isfinite(step):
        return 0.0
    tops = [0.0]
    for side in sides:
        far = np.arange(side.size // 2, side.size)
        fallen = np.abs(side[far] - extreme)
        tops.append(float(np.nanmax(fallen / ((1.0 + 2.0 * (far + 1) / length) ** 2 - 1.0), initial=0.0)))
    return max(tops) / step


def stopped_output(
    output: Array, t: Array, begins: NDArray[np.bool_], a_x: Array, per_step: float, rows: NDArray[np.int64]
) -> list[Event]:
    """Report an output that stands still although the reference demands rotation: locked, stuck or not connected.

    Parameters
    ----------
    output, t, a_x:
        Output, time [s] and reference along X0 [m/s^2] of the used samples, shape (n,).
    begins:
        True where a stretch begins.
    per_step:
        Output units per (m/s^2) and second.
    rows:
        File row of each sample.
    """
    least, run = 0.05 * largest_size(a_x), LongestRun()
    for part in spans(t.size):
        still = (steps(output, part) == 0.0) & ~begins[part]
        if still.any():
            run.see(still & (np.abs(a_x[part]) > least), part.start)
    if run.length < SIGNAL_CHECKS.stuck:
        return []
    expected = 0.0
    for part in spans(run.length):
        rows_of_run = slice(run.start + part.start, run.start + part.stop)
        expected += float(np.sum(np.abs(a_x[rows_of_run]) * steps(t, rows_of_run)))
    expected *= abs(per_step)
    if expected < 10.0:
        return []
    detail = f"the output stands still, but the reference expects {expected:.3g} counts: locked or stuck"
    return [Event("stopped-output", run.count, int(rows[run.start]), detail)]


def largest_size(values: Array) -> float:
    """Largest absolute value; nan if a value is nan."""
    largest = 0.0
    for part in spans(values.shape[0]):
        largest = float(np.maximum(largest, np.maximum(values[part].max(), -values[part].min())))
    return largest


def sequence_breaks(
    number: Array, wraps_at: int | None, begins: NDArray[np.bool_], rows: NDArray[np.int64]
) -> list[Event]:
    """Begin a stretch where a sequence number does not follow the one before. Lost and disordered numbers are counted."""
    gaps, backs, missing = Tally(), Tally(), 0
    for part in spans(number.size):
        step = steps(number, part)
        if part.start == 0:
            step[0] = 1.0
        if wraps_at is not None:
            step = np.mod(step, wraps_at)
        wrong = step != 1.0
        if not wrong.any():
            continue
        begins[part] |= wrong
        gaps.see(part.start + np.flatnonzero(step > 1.0))
        backs.see(part.start + np.flatnonzero(step <= 0.0))
        missing += int(min(step[step > 1.0].sum() - np.count_nonzero(step > 1.0), 1e18))
    none = "no increment is formed across it"
    lost = gaps.events("sequence-gap", rows, f"{missing} samples missing; {none}")
    return lost + backs.events("sequence-back", rows, none)


def sampled(count: int) -> NDArray[np.int64]:
    """Every row of a short record; equally spaced rows of a long one."""
    return np.arange(0, count, max(1, -(-count // SIGNAL_CHECKS.sampled)))


def mistaken_unit(f: Array, count: int, row: int) -> list[Event]:
    """Report a static reference whose norm is g times a factor between units."""
    norm = np.sqrt(np.einsum("ij,ij->i", f, f))
    typical = float(np.median(norm))
    if typical <= 0.0 or float(np.quantile(np.abs(norm - typical), 0.9)) > 0.01 * typical:
        return []
    for factor, words in FACTORS.items():
        for ratio, sense in ((typical / G0, "large"), (G0 / typical, "small")):
            if abs(ratio / factor - 1.0) < 0.01:
                detail = f"|f| = {typical / G0:.5g} g in all positions: too {sense} by {words}? check [data] reference unit"
                return [Event("implausible-unit", count, row, detail)]
    return []


def mistaken_rate(a_x: Array, rate: Array, scale_factor: float, count: int, row: int) -> list[Event]:
    """Report a mean output rate [rad/s] that differs from K a_x by a factor between units."""
    wanted = scale_factor * a_x
    strong = np.abs(wanted) > 0.2 * np.abs(wanted).max(initial=0.0)
    if strong.sum() < SIGNAL_CHECKS.stuck:
        return []
    ratio = abs(float(np.median(rate[strong] / wanted[strong])))
    for factor, words in FACTORS.items():
        for value, sense in ((ratio, "large"), (1.0 / ratio if ratio else 0.0, "small")):
            if abs(value / factor - 1.0) < 0.05:
                detail = f"the output is too {sense} by {words}? check its unit, scale_factor and counts_per_revolution"
                return [Event("implausible-unit", count, row, detail)]
    return []


@dataclass(frozen=True)
class OutputScale:
    """Conversion from a reading to the output.

    ``factor``: SI per unit of the reading. ``span``: range after which the reading folds back, in its own unit
    (None: never). ``keeps_phase``: the span is a whole number of revolutions. ``counts``: the reading is a count.
    """

    factor: float
    span: float | None = None
    keeps_phase: bool = True
    counts: bool = False


@dataclass(frozen=True)
class Reading:
    """A logged output with the data that its checks need.

    ``values`` (n,) are in the unit of the column ``name``. ``rows`` are file rows. ``begins`` marks the first samples of
    stretches. ``largest`` is the largest output step [rad] between samples that the reference allows, nan without a
    reference. ``nominal`` is the nominal step [s].
    """

    path: Path
    name: str
    values: Array
    rows: NDArray[np.int64]
    begins: NDArray[np.bool_]
    largest: float
    nominal: float
    scale: OutputScale

    def output(self, arrays: Arrays) -> tuple[Array, NDArray[np.bool_], list[Event]]:
        """Unwrapped output angle [rad], samples at which the number of turns was lost, and events.

        A folded reading is unwrapped to the nearest turn inside stretches. Between samples it must move by less
        than half its range. The check uses the largest rate that the reference allows.

        Raises
        ------
        DataError
            If the reading is not a whole number, is outside its range, is too fast to unwrap, jumps, or was reset.
        """
        if self.scale.counts:
            self._check_counts()
        if self.scale.span is not None:
            self._check_span(self.scale.span)
        lost = arrays.zeros(self.values.size, np.bool_)
        psi, wraps, jump, resets = self._unwrap(arrays, lost)
        if self.scale.span is None:
            self._check_jump(jump)
        self._check_resets(resets)
        self._check_jump(jump)
        events = [Event("counter-roll-over", wraps, None, "unwrapped")] if wraps else []
        return psi, lost, events

    def _unwrap(
        self, arrays: Arrays, lost: NDArray[np.bool_]
    ) -> tuple[Array, int, tuple[float, int], list[int]]:
        """The output; number of roll-overs; largest step inside a stretch and its place; possible resets of the counter."""
        span, factor = self.scale.span, self.scale.factor
        psi = arrays.empty(self.values.size)
        wraps, turned, start = 0, 0.0, float(self.values[0])
        jump, resets = (0.0, 0), []
        for part in spans(self.values.size):
            inside = ~self.begins[part]
            if span is None:
                psi[part] = self.values[part] * factor
            else:
                step = steps(self.values, part)
                folded = self._folded(part)
                wraps += int(np.count_nonzero((np.abs(step - folded) > 0.5 * span) & inside))
                folded[0] += turned
                turns = np.cumsum(folded)
                turned = float(turns[-1])
                psi[part] = (start + turns) * factor
                if not self.scale.keeps_phase:
                    lost[part] = ~inside
            size = np.abs(steps(psi, part))
            size *= inside
            at = int(np.argmax(size))
            if size[at] > jump[0]:
                jump = float(size[at]), part.start + at
            if self.scale.counts and size[at] > 1.4 * self.largest + 9.0 * factor:
                resets += self._reset_candidates(part)
        lost[0] = False
        return psi, wraps, jump, resets

    def _folded(self, part: slice) -> Array:
        """Change from the sample before, without roll-over."""
        step = steps(self.values, part)
        span = self.scale.span
        return step if span is None else step - span * np.round(step / span)

    def _check_counts(self) -> None:
        for part in spans(self.values.size):
            reading = self.values[part]
            bad = (reading != np.rint(reading)) | (np.abs(reading) >= 2.0**53)
            if bad.any():
                at = int(np.argmax(bad))
                raise DataError(
                    f"{self.path}: row {self.rows[part][at]}, column '{self.name}': {reading[at]!r} is not a whole count",
                    remedy="set kind to 'angle' or 'rate' with its unit",
                )

    def _check_span(self, span: float) -> None:
        low, high, at = np.inf, -np.inf, 0
        fastest = 0.0
        for part in spans(self.values.size):
            reading = self.values[part]
            low = min(low, float(reading.min()))
            top = int(np.argmax(reading))
            if reading[top] > high:
                high, at = float(reading[top]), part.start + top
            if np.isnan(self.largest):
                fastest = max(fastest, float(np.abs(self._folded(part) * ~self.begins[part]).max()))
        if high - low > span:
            raise DataError(
                f"{self.path}: row {self.rows[at]}, column '{self.name}': {high:.17g} lies outside the range of "
                f"{span:.17g}",
                remedy="correct [instrument] counter_bits (or wraps_at)",
            )
        factor = self.scale.factor
        largest = 1.2 * factor * fastest if np.isnan(self.largest) else self.largest
        if largest >= 0.5 * span * factor:
            rate = largest / self.nominal / (0.5 * span * factor)
            raise DataError(
                f"{self.path}: column '{self.name}': between samples the output may move by {largest:.3g} "
                f"rad, more than half of the counter's range ({span * factor:.3g} rad): a roll-over cannot be "
                "recognised",
                remedy=f"sample at {1.2 * rate:.3g} Hz or more, or use a wider counter",
            )

    def _check_jump(self, jump: tuple[float, int]) -> None:
        """Refuse an output with a jump that only a folded counter or a reset can make."""
        size, at = jump
        if size > 10.0 * self.largest + 2.0:
            raise DataError(
                f"{self.path}: row {self.rows[at]}, column '{self.name}': the output jumps by "
                f"{size:.4g} rad in one sample, the reference allows {self.largest:.3g} rad",
                remedy="if the counter wraps, give [instrument] counter_bits (for an angle: wraps_at); "
                "if it was reset, start a new segment there; otherwise check scale_factor and the units",
            )

    def _reset_candidates(self, part: slice) -> list[int]:
        """Rows where a counter jumped to about zero, by more than it can have moved, and continued from there."""
        largest = self.largest / self.scale.factor
        size = np.abs(self._folded(part)) * ~self.begins[part]
        sudden = (size > 1.5 * largest + 10.0) & (np.abs(self.values[part]) <= largest + 2.0)
        return [part.start + at for at in np.flatnonzero(sudden).tolist() if self._stands_out(part.start + at)]

    def _stands_out(self, k: int) -> bool:
        window = slice(max(k - 3, 0), min(k + 4, self.values.size))
        size = np.abs(self._folded(window)) * ~self.begins[window]
        around = np.delete(size, k - window.start)
        return bool(around.size and around.max() < size[k - window.start] / 3.0)

    def _check_resets(self, resets: list[int]) -> None:
        """Refuse a counter that returned to zero inside a stretch without roll-over or motion."""
        if not resets:
            return
        listed = "; ".join(
            f"row {self.rows[k]}, column '{self.name}': the counter goes to {self.values[k]:.17g}, by "
            f"{self._folded(slice(k, k + 1))[0]:+.0f} counts"
            for k in resets[:100]
        )
        raise DataError(
            f"{self.path}: {listed}: it was reset there",
            remedy="start a new segment there (a segment column) and use phases = 'per-segment'; "
            "if it wrapped instead, give [instrument] counter_bits",
        )


def integrated_rate(t: Array, rate: Array, begins: NDArray[np.bool_]) -> Array:
    """Angle [rad] from a rate: trapezoid with end correction; see :class:`RateAngle`."""
    follower = RateAngle()
    return np.concatenate((follower.push(t, rate, begins), follower.finish()))


class RateAngle:
    """Angle from a rate, chunk by chunk: trapezoid with end correction, slopes by central differences.

    The last sample is held back until the next one arrives. The result does not depend on the chunks, to the bit.
    """

    def __init__(self) -> None:
        self._t, self._rate, self._begins = np.zeros(0), np.zeros(0), np.zeros(0, dtype=np.bool_)
        self._angle, self._slope = 0.0, 0.0
        self._given = False

    def push(self, t: Array, rate: Array, begins: NDArray[np.bool_]) -> Array:
        """Angles [rad] of the held-back sample and of all new samples but the last."""
        self._t, self._rate = np.concatenate((self._t, t)), np.concatenate((self._rate, rate))
        self._begins = np.concatenate((self._begins, begins))
        return self._go(self._t.size - 1)

    def finish(self) -> Array:
        """Angle of the held-back sample."""
        return self._go(self._t.size)

    def _go(self, stop: int) -> Array:
        """Angles of new samples up to ``stop``; the sample before ``stop`` is kept for the next slopes."""
        first = 1 if self._given else 0
        if stop <= first:
            return np.zeros(0)
        slope = self._slopes()[:stop]
        if self._given:
            slope[0] = self._slope
        step = np.where(self._begins[1:stop], 0.0, np.diff(self._t[:stop]))
        rate = self._rate[:stop]
        turns = 0.5 * step * (rate[1:] + rate[:-1]) + step**2 / 12.0 * (slope[:-1] - slope[1:])
        angle = np.cumsum(np.concatenate(([self._angle], turns)))
        self._angle, self._slope, self._given = float(angle[-1]), float(slope[-1]), True
        self._t, self._rate, self._begins = (
            self._t[stop - 1 :],
            self._rate[stop - 1 :],
            self._begins[stop - 1 :],
        )
        return angle[first:]

    def _slopes(self) -> Array:
        """Slope at every sample, one-sided at both ends of a stretch."""
        step = np.diff(self._t)
        joined = ~self._begins[1:] & (step > 0.0)
        each = np.where(joined, np.diff(self._rate) / np.where(joined, step, 1.0), 0.0)
        each, step = np.pad(each, 1), np.pad(np.where(joined, step, 0.0), 1)
        left, right, before, behind = each[:-1], each[1:], step[:-1], step[1:]
        inner = (before > 0.0) & (behind > 0.0)
        return np.where(
            inner, (left * behind + right * before) / np.where(inner, before + behind, 1.0), left + right
        )
