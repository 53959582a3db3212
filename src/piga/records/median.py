"""The exact median of numbers that need not fit into memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WHOLE = 1 << 21
"""Up to this many numbers are sorted at once."""
_BITS = (21, 21, 22)


def exact_median(parts: Callable[[], Iterable[Array]]) -> float:
    """Median of numbers that are not negative; 0 when there is none.

    Parameters
    ----------
    parts:
        Gives the numbers, in parts; called again for every pass. Long ones are found digit by digit: the bits of a
        float that is not negative are in the order of its value.
    """
    held: list[Array] = []
    count = 0
    for part in parts():
        count += part.size
        if count <= WHOLE:
            held.append(part)
    if count == 0:
        return 0.0
    if count <= WHOLE:
        return float(np.median(np.concatenate(held)))
    del held
    low = _selected(parts, (count - 1) // 2)
    high = low if count % 2 else _selected(parts, count // 2)
    return float(np.mean([low, high]))


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
            counts += np.bincount((keys >> above) & ((1 << bits) - 1), minlength=1 << bits)
        below = np.cumsum(counts)
        digit = int(np.searchsorted(below, rank, side="right"))
        rank -= int(below[digit - 1]) if digit else 0
        prefix = (prefix << bits) | digit
    return float(np.array([prefix], dtype=np.int64).view(np.float64)[0])
