"""The angle that the coupling turns with: as read, integrated from a log of rates, or predicted from the input."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.request import Request
from piga.records.median import exact_median
from piga.records.run import Run
from piga.records.spool import arrays_like, means, spans, steps

Array = NDArray[np.float64]

PLAUSIBLE = 0.3
"""Part of ``K |a|`` by which the rate of a sound instrument may differ from ``K a_x - Omega_x``."""
GROSS = 10.0
"""Medians of that difference beyond which a rate is a spike, too."""


def phase_angle(run: Run, request: Request, scale_factor: float) -> Array:
    """The angle that the coupling turns with: as read, integrated from a rate, or predicted from input."""
    predicted = request.phase_source == "input"
    if not predicted and run.kind != "rate":
        return run.output
    rate = run.output if predicted else steady_rates(run)
    angle: Array = arrays_like(run.t).empty(run.size)
    turned = 0.0
    for part in spans(run.size):
        h = steps(run.t, part)
        h[run.begins[part]] = 0.0
        if predicted:
            increments = scale_factor * h * means(run.f[:, 0], part)
        else:
            increments = h * means(rate, part) + _corrected(run, rate, part)
        increments[0] += turned
        angle[part] = np.cumsum(increments)
        turned = float(angle[part.stop - 1])
    return angle


def _corrected(run: Run, rate: Array, part: slice) -> Array:
    """End correction of the interval into each row of a slice; it takes two rows before and one after."""
    window = slice(max(part.start - 2, 0), min(part.stop + 1, run.size))
    step = np.diff(run.t[window])
    step[run.begins[window][1:]] = 0.0
    into = np.concatenate(([0.0], _end_correction(rate[window], step)))
    return into[part.start - window.start : part.stop - window.start]


def _end_correction(rate: Array, step: Array) -> Array:
    """End correction of the trapezoid, ``h^2/12 (r0' - r1')``, slopes by central differences."""
    slope = np.zeros(rate.size)
    inner = (step[1:] > 0.0) & (step[:-1] > 0.0)
    span = np.where(inner, step[1:] + step[:-1], 1.0)
    slope[1:-1] = np.where(inner, (rate[2:] - rate[:-2]) / span, 0.0)
    both = (slope[:-1] != 0.0) & (slope[1:] != 0.0)
    return np.where(both, step**2 / 12.0 * (slope[:-1] - slope[1:]), 0.0)


def steady_rates(run: Run) -> Array:
    """Rates of a log with those replaced by ``K a_x - Omega_x`` that no motion explains; the log's own if there is none.

    Integrated, a spike would turn the phase of all that follows.
    """
    if not any((_surplus(run, part) > _plausible(run, part)).any() for part in spans(run.size)):
        return run.output
    least = GROSS * exact_median(lambda: (_surplus(run, part) for part in spans(run.size)))
    rate: Array = arrays_like(run.output).empty(run.size)
    for part in spans(run.size):
        spikes = _surplus(run, part) > np.maximum(_plausible(run, part), least)
        rate[part] = np.where(spikes, _expected(run, part), run.output[part])
    return rate


def _expected(run: Run, part: slice) -> Array:
    """``K a_x - Omega_x``, K nominal."""
    expected: Array = run.scale_factor * run.f[part, 0]
    return expected if run.base_rate is None else expected - run.base_rate[part, 0]


def _surplus(run: Run, part: slice) -> Array:
    """By how much the rate differs from what is expected."""
    found: Array = np.abs(run.output[part] - _expected(run, part))
    return found


def _plausible(run: Run, part: slice) -> Array:
    """How large that may be."""
    found: Array = PLAUSIBLE * abs(run.scale_factor) * np.linalg.norm(run.f[part], axis=1)
    return found if run.base_rate is None else found + np.linalg.norm(run.base_rate[part], axis=1)
