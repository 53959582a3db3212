"""How many samples may be skipped where a record is smooth, for tests that need no full resolution."""

from __future__ import annotations

import numpy as np

from piga.records.run import Run

WINDOWS, LOOKED = 8, 1024
"""Windows spread over the record, and their samples."""
MOST = 64
"""Samples that a step spans at most."""
STRAIGHT = 1e-3
"""Distance of the force from a straight line between, over the largest force, that is taken as none."""


def smooth_step(run: Run, turn: float) -> int:
    """Step in samples over which the output turns by less than ``turn`` [rad] and the force is a straight line."""
    starts = np.unique(np.linspace(0, max(run.size - LOOKED, 0), WINDOWS).astype(np.int64))
    return min(_step(run, slice(int(start), int(start) + LOOKED), turn) for start in starts)


def _step(run: Run, window: slice, turn: float) -> int:
    inside = ~run.begins[window][1:]
    turned = np.abs(np.diff(run.output[window]))[inside]
    largest = float(np.quantile(turned, 0.95)) if turned.size else 0.0
    step = int(min(turn / largest, MOST)) if largest > 0.0 else 1
    f = run.f[window]
    limit = STRAIGHT * max(float(np.abs(f).max()), 1e-300)
    while step > 1:
        ends = f[: f.shape[0] - f.shape[0] % step : step]
        middle = f[step // 2 :: step][: ends.shape[0] - 1]
        line = ends[:-1] + (ends[1:] - ends[:-1]) * ((step // 2) / step)
        if middle.size and np.quantile(np.abs(middle - line), 0.9) < limit:
            break
        step //= 2
    return max(step, 1)
