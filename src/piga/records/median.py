"""The exact median of numbers that need not fit into memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WHOLE = 1 << 21
"""Up to this many different numbers are kept."""
_BITS = (21, 21, 22)


def exact_median(parts: Callable[[], Iterable[Array]]) -> float:
    """Median of numbers that are not negative; 0 when there is none.

    Parameters
    ----------
    parts:
        Gives the numbers, in parts. Of a long record that is sampled regularly only the few different numbers are kept,
        and how often each was met. Where most differ the parts are asked for again, once for each digit: the bits of a
        float that is not negative are in the order of its value.
    """
    held: list[tuple[Array, NDArray[np.int64]]] = []
    count = different = 0
    for part in parts():
        count += part.size
        if different <= WHOLE:
            held.append(np.unique(part, return_counts=True))
            different += held[-1][0].size
            if different > WHOLE and len(held) > 1:
                held = [_merged(held)]
                different = held[0][0].size if 2 * held[0][0].size < WHOLE else WHOLE + 1
    if count == 0:
        return 0.0
    ranks = ((count - 1) // 2, count // 2)
    if different > WHOLE:
        del held
        return float(np.mean([_selected(parts, rank) for rank in ranks[: 1 + (count % 2 == 0)]]))
    values, counts = _merged(held)
    return float(np.mean(values[np.searchsorted(np.cumsum(counts), ranks, side="right")]))


def _merged(held: list[tuple[Array, NDArray[np.int64]]]) -> tuple[Array, NDArray[np.int64]]:
    """Different numbers, rising, and how often each was met in all."""
    values, where = np.unique(np.concatenate([some for some, _ in held]), return_inverse=True)
    counts = np.zeros(values.size, dtype=np.int64)
    np.add.at(counts, where, np.concatenate([times for _, times in held]))
    return values, counts


def _selected(parts: Callable[[], Iterable[Array]], rank: int) -> float:
    """The number of a rank (from 0), a group of bits at a time."""
    prefix, above = 0, 64
    for bits in _BITS:
        above -= bits
        counts = np.zeros(1 << bits, dtype=np.int64)
        for part in parts():
            keys = part.view(np.int64) if part.flags.c_contiguous else np.ascontiguousarray(part).view(np.int64)
            if above + bits < 64:
                keys = keys[keys >> (above + bits) == prefix]
            digits, times = np.unique((keys >> above) & ((1 << bits) - 1), return_counts=True)
            counts[digits] += times
        below = np.cumsum(counts)
        digit = int(np.searchsorted(below, rank, side="right"))
        rank -= int(below[digit - 1]) if digit else 0
        prefix = (prefix << bits) | digit
    return float(np.array([prefix], dtype=np.int64).view(np.float64)[0])
