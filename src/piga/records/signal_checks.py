"""What a log can have wrong that no single cell shows: limits, stuck values, lost numbers, resets, wrong units."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from piga.records.calibration import Event
from piga.units import G0

Array = NDArray[np.float64]

STUCK = 8
"""Equal extreme values in a row that are reported."""
FACTORS = {9.80665: "9.80665 (g and m/s^2)", 57.29577951: "57.2958 (deg and rad)", 1e3: "1000 (mg and g)",
           1e6: "10^6 (ug and g)", 3600.0: "3600 (per hour and per second)",
           57.29577951 * 3600: "206265 (deg/h and rad/s, or arcsec and rad)",
           9806.65: "9806.65 (mg and m/s^2)"}  # fmt: skip
"""Factors between units that are often mistaken for each other."""


def beyond_limits(
    numbers: Mapping[str, NDArray], limits: Mapping[str, tuple[float, float]], rows: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], list[Event]]:
    """Rows with a value at or beyond its declared limits (saturated), and their count for each column."""
    bad = np.zeros(rows.size, dtype=bool)
    events = []
    for name, (low, high) in limits.items():
        values = np.asarray(numbers[name], dtype=float)
        out = (values <= low) | (values >= high)
        if out.any():
            first = int(rows[np.argmax(out)])
            detail = f"column '{name}' at or beyond {low:g} to {high:g}: the row is not used"
            events.append(Event("saturated", int(out.sum()), first, detail))
            bad |= out
    return bad, events


def stuck_extremes(numbers: Mapping[str, NDArray], rows: NDArray[np.int64]) -> list[Event]:
    """Runs of the largest or smallest value in columns that otherwise move all the time."""
    events = []
    for name, column in numbers.items():
        values = np.asarray(column, dtype=float)
        values = values[np.isfinite(values)]
        if values.size < 4 * STUCK or np.count_nonzero(np.diff(values)) < 0.5 * values.size:
            continue
        for word, extreme in (("largest", values.max()), ("smallest", values.min())):
            start, length = _longest_run(np.asarray(column, dtype=float) == extreme)
            if length >= STUCK:
                detail = f"column '{name}' stays at its {word} value {extreme:g}: saturated? give its limits in [data] range"
                events.append(Event("stuck-value", length, int(rows[start]), detail))
    return events


def _longest_run(mask: NDArray[np.bool_]) -> tuple[int, int]:
    """Start and length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    if not edges.size:
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    longest = int(np.argmax(lengths))
    return int(edges[::2][longest]), int(lengths[longest])


def stopped_output(
    reading: Array, step: Array, a_x: Array, per_step: float, rows: NDArray[np.int64]
) -> list[Event]:
    """An output that stands still while the reference wants it to turn: locked, stuck, or not connected.

    Parameters
    ----------
    reading, a_x:
        Output and reference along X0 [m/s^2] of the used samples, shape (n,).
    step:
        Interval before each sample [s], zero where a stretch begins.
    per_step:
        Output units per (m/s^2) and second.
    rows:
        File row of each sample.
    """
    moves = np.abs(a_x) > 0.05 * np.abs(a_x).max()
    still = np.concatenate(([False], np.diff(reading) == 0.0)) & (step > 0.0) & moves
    start, length = _longest_run(still)
    if length < STUCK:
        return []
    part = slice(start, start + length)
    expected = abs(per_step) * float(np.sum(np.abs(a_x[part]) * step[part]))
    if expected < 10.0:
        return []
    detail = f"the output stands still, the reference wants {expected:.3g} counts: locked or stuck"
    return [Event("stopped-output", int(np.count_nonzero(still)), int(rows[start]), detail)]


def sequence_breaks(
    number: NDArray, wraps_at: int | None, rows: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], list[Event]]:
    """Samples whose sequence number does not follow the one before; lost, repeated and disordered counted."""
    step = np.diff(np.asarray(number, dtype=float))
    if wraps_at is not None:
        step = np.mod(step, wraps_at)
    breaks = np.concatenate(([False], step != 1.0))
    events = []
    lost = step > 1.0
    if lost.any():
        first = int(rows[1:][lost][0])
        detail = f"{int(step[lost].sum() - lost.sum())} samples missing; no increment is formed across it"
        events.append(Event("sequence-gap", int(lost.sum()), first, detail))
    wrong = step <= 0.0
    if wrong.any():
        first = int(rows[1:][wrong][0])
        events.append(Event("sequence-back", int(wrong.sum()), first, "no increment is formed across it"))
    return breaks, events


def resets_inside(step: Array, reading: Array, largest: float) -> NDArray[np.int64]:
    """Indices where a counter jumped to (about) zero by more than it can have moved, and went on from there.

    ``step`` is the (folded) change into each sample, zero where a stretch begins; ``largest`` the largest
    change that the reference allows. Both in counts.
    """
    size = np.abs(step)
    near_zero = np.abs(reading) <= largest + 2.0
    candidates = np.flatnonzero(near_zero & (size > 1.5 * largest + 10.0))
    return np.array([k for k in candidates if _stands_out(size, int(k))], dtype=np.int64)


def _stands_out(size: Array, k: int) -> bool:
    around = np.concatenate((size[max(0, k - 3) : k], size[k + 1 : k + 4]))
    return bool(around.size and around.max() < size[k] / 3.0)


def mistaken_unit(f: Array, row: int) -> list[Event]:
    """A static reference whose norm is not g, but is g times a factor between units."""
    norm = np.sqrt(np.einsum("ij,ij->i", f, f))
    typical = float(np.median(norm))
    if typical <= 0.0 or float(np.quantile(np.abs(norm - typical), 0.9)) > 0.01 * typical:
        return []
    for factor, words in FACTORS.items():
        for ratio, sense in ((typical / G0, "large"), (G0 / typical, "small")):
            if abs(ratio / factor - 1.0) < 0.01:
                detail = f"|f| = {typical / G0:.5g} g in all positions: too {sense} by {words}? check [data] reference unit"
                return [Event("implausible-unit", f.shape[0], row, detail)]
    return []


def mistaken_rate(f: Array, rate: Array, scale_factor: float, row: int) -> list[Event]:
    """A mean output rate [rad/s] that misses K a_x by a factor between units."""
    wanted = scale_factor * f[:, 0]
    strong = np.abs(wanted) > 0.2 * np.abs(wanted).max()
    if strong.sum() < STUCK:
        return []
    ratio = abs(float(np.median(rate[strong] / wanted[strong])))
    for factor, words in FACTORS.items():
        for value, sense in ((ratio, "large"), (1.0 / ratio if ratio else 0.0, "small")):
            if abs(value / factor - 1.0) < 0.05:
                detail = f"the output is too {sense} by {words}? check its unit, scale_factor and counts_per_revolution"
                return [Event("implausible-unit", f.shape[0], row, detail)]
    return []
