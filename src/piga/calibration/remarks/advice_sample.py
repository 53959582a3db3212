"""Samples of a record that other readings of it are tried on: few, and spread over the whole of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.design import Design
from piga.calibration.model.request import Request
from piga.calibration.remarks.missing_terms import smooth_step
from piga.records.run import Run
from piga.records.spool import gathered

Array = NDArray[np.float64]

ROWS = 2000
"""Samples that are looked at."""
WINDOW = 60
"""Samples of a stretch in a row, at most."""
TURN = 0.25
"""Turn of the output between samples looked at [rad]."""


@dataclass(frozen=True)
class Sample:
    """Samples of a record: ``h`` [s] the interval into each, 0 where a window begins (1 for a log of rates).

    ``t`` and ``warm`` are from their references, ``phase`` [rad] is the angle of the output at the samples,
    ``observed`` the increments of the output into them (the rates of a log of rates), ``base`` (n, 3) the
    base rate [rad/s].
    """

    t: Array
    h: Array
    phase: Array
    observed: Array
    f: Array
    base: Array
    warm: Array
    segment: NDArray[np.int32]
    point: bool

    def increments(self, values: Array) -> Array:
        """Integrals of values (.., n) over the intervals by the trapezoid; the values of a log of rates."""
        if self.point:
            return values
        result = np.zeros_like(values)
        result[..., 1:] = 0.5 * self.h[1:] * (values[..., 1:] + values[..., :-1])
        return result


def sample_of(run: Run, request: Request) -> Sample:
    """Windows spread over the record, samples skipped while the output turns little and the force is straight."""
    index, begins = _thinned(run)
    point = run.kind == "rate"
    output = gathered(run.output, index)
    read = replace(request, phase_source="output")
    phase = gathered(Design(run, read, run.scale_factor).phase_angle, index) if point else output
    t, h = gathered(run.t, index), np.ones(index.size)
    if not point:
        h[1:] = np.diff(t)
        h[begins] = 0.0
    observed = output if point else np.where(h > 0.0, np.diff(output, prepend=output[0]), 0.0)
    return Sample(
        t=t - 0.5 * float(run.t[0] + run.t[-1]),
        h=h,
        phase=phase,
        observed=observed,
        f=gathered(run.f, index),
        base=np.zeros((index.size, 3)) if run.base_rate is None else gathered(run.base_rate, index),
        warm=t if run.temperature is None else gathered(run.temperature, index) - request.temperature_reference,
        segment=gathered(run.segment, index),
        point=point,
    )


def _thinned(run: Run) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Rows to look at, and where windows of them begin."""
    begun: NDArray[np.int64] = np.unique(np.append(np.flatnonzero(run.begins), 0))
    starts = begun[:: max(1, math.ceil(begun.size * 12 / ROWS))].tolist()
    ends = np.append(np.flatnonzero(run.begins)[1:], run.size)
    skip = 1 if run.kind == "rate" else smooth_step(run, TURN)
    share = max(12, ROWS // len(starts))
    chosen: list[NDArray[np.int64]] = []
    for start in starts:
        end = int(ends[np.searchsorted(ends, start, side="right")])
        held = (end - start) // skip
        windows = max(1, min(share, held) // WINDOW)
        length = min(share // windows, held // windows)
        for first in np.linspace(start, max(start, end - length * skip), windows).astype(np.int64):
            part = np.arange(first, min(end, first + length * skip), skip)
            chosen.append(part if run.left_out is None else part[~run.left_out[part]])
    kept = [part for part in chosen if part.size > 1]
    begins = [np.arange(part.size) == 0 for part in kept]
    return np.concatenate(kept), np.concatenate(begins)
