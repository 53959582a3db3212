"""Advice on a reference or an output that was read wrongly: swapped axes, wrong sign, wrong unit.

Every signed permutation of the axes of the reference is fitted to a thinned record with the scale factor
free. The sign of X0 and a factor of the reference then show in the scale factor alone; a factor of the
output also in the phase of the coupling, so the likely ones are fitted too. Nothing is ever applied.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.request import Request
from piga.calibration.noise.levels import starting_noise
from piga.calibration.noise.weighting import Whitener
from piga.calibration.remarks.advice_sample import Sample, sample_of
from piga.calibration.remarks.advice_words import (
    FACTORS,
    SNAP,
    Reading,
    better_words,
    factor_near,
    sign_words,
    unit_words,
)
from piga.calibration.remarks.candidate_columns import term_values
from piga.errors import PigaError
from piga.records.calibration import Calibration
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS
from piga.units import G0

Array = NDArray[np.float64]

FAR_BETTER = 3.0
"""Ratio of residuals from which another reading of the data is worth saying."""
AS_GOOD = 1.2
"""Ratio of residuals up to which readings cannot be told apart."""
OFF = 2.0
"""Ratio of the scale factor to the nominal one from which something is wrong, and no other reading is likely."""
MOST_ALIKE = 3
"""Readings named that the record cannot tell from the best."""


@dataclass(frozen=True)
class Trial:
    """A reading with the residual of its fit and its scale factor over the nominal one."""

    reading: Reading
    residual: float
    scale: float


def looks_wrong(result: Calibration) -> bool:
    """True when a finished calibration calls for trying other readings.

    Its scale factor is far from the nominal one, or its residuals are not white.
    """
    found = {c.name: c.value for c in result.coefficients}
    nominal = result.scale_factor_nominal * G0
    scale = found.get("scale_factor", nominal) / nominal + found.get("k1", 0.0)
    return not 1.0 / OFF < scale < OFF or result.diagnostics.get("verdict", "white") != "white"


def advise(run: Run, request: Request) -> tuple[str, ...]:
    """What the data would fit far better with, in words; nothing when they fit as they are.

    Parameters
    ----------
    run, request:
        As for the calibration.

    Returns
    -------
    tuple of str
        At most one sentence on axes, signs and the output, and one on a unit.
    """
    trials = [t for t in _trials(run, request, sample_of(run, request)) if math.isfinite(t.residual)]
    plain = next((t for t in trials if t.reading == Reading()), None)
    if plain is None:
        return ()
    likely = [t for t in trials if t is plain or 1.0 / OFF < abs(t.scale) < OFF]
    least = min(t.residual for t in likely)
    if plain.residual <= FAR_BETTER * least:
        return _scale_words(plain, trials, run)
    near = [t for t in likely if t.residual <= AS_GOOD * least]
    upright = [t for t in near if t.scale > 0.0] or near
    best, *others = sorted(upright, key=lambda t: (t.reading.changes, t.residual))
    alike = [t.reading for t in others[:MOST_ALIKE]]
    words = better_words(plain.residual / best.residual, best.reading, alike, run)
    return (words, *_scale_words(best, trials, run))


def with_advice(error: PigaError, words: tuple[str, ...]) -> PigaError:
    """The same error with advice in its remedy."""
    if words:
        PigaError.__init__(error, error.message, remedy="; or ".join(filter(None, (error.remedy, *words))))
    return error


def _scale_words(trial: Trial, trials: list[Trial], run: Run) -> tuple[str, ...]:
    """A scale factor that is negative, or off by the factor of a unit; the output may be what is wrong."""
    as_good = [t.reading.output for t in trials if t.residual <= AS_GOOD * trial.residual]
    found = (sign_words(output=-1.0 in as_good),) if trial.scale < 0.0 else ()
    ratio = abs(trial.scale)
    factor = factor_near(ratio) if ratio > 0.0 else None
    if factor is None:
        return found
    return (*found, unit_words(ratio, factor, run, output=any(abs(output) != 1.0 for output in as_good)))


def _trials(run: Run, request: Request, sample: Sample) -> Iterator[Trial]:
    """Fits of all permutations and of what their scale factors suggest."""
    base = Reading()
    plain = _fit(run, request, sample, base)
    for x, y, z in permutations(range(3)):
        for second, third in product((1, -1), repeat=2):
            reading = Reading((x, y, z), (1, second, third))
            trial = plain if reading == base else _fit(run, request, sample, reading)
            if trial.scale < 0.0 and reading != base:
                turned = replace(reading, signs=(-1, second, third))
                trial = replace(trial, reading=turned, scale=-trial.scale)
            yield trial
    yield _fit(run, request, sample, replace(base, output=-1.0))
    for factor in FACTORS:
        for known in (factor.value, 1.0 / factor.value):
            if abs(abs(plain.scale) / known - 1.0) < SNAP:
                yield _fit(run, request, sample, replace(base, output=known))


def _fit(run: Run, request: Request, sample: Sample, reading: Reading) -> Trial:
    """Residual of a reading: whitened root mean square, the phase of each segment free where it is so.

    A tenth of a per cent of the coupling is lost to the trapezoid, in all readings alike.
    """
    turning = ["p", "q"] if "tan_beta" in request.terms else []
    turning += [f"{kind}{order}" for order in request.harmonics for kind in ("s", "c")]
    left_out = ("scale_factor", "k1", *SERVO_TERMS)
    names = [*turning, "k1", *(n for n in request.shared_terms if n not in left_out)]
    rows = _whitened(run, sample, reading, names)
    free = len(turning) if request.phase != "shared" else 0
    if free:
        parts = [rows[:, sample.segment == segment] for segment in np.unique(sample.segment)]
        rows = np.hstack([_without(part, free) for part in parts])
    size = np.linalg.norm(rows[:-1], axis=1)
    size[size == 0.0] = 1.0
    linear = np.linalg.lstsq(rows[:-1].T / size, rows[-1], rcond=1e-10)[0] / size
    miss = float(np.linalg.norm(rows[-1] - linear @ rows[:-1])) / math.sqrt(sample.t.size)
    return Trial(
        reading, abs(reading.output) * miss, float(linear[names.index("k1") - free]) / run.scale_factor
    )


def _whitened(run: Run, sample: Sample, reading: Reading, names: list[str]) -> Array:
    """Columns of a reading and its observation (names + 1, n), whitened for angle noise."""
    a = (sample.f[:, list(reading.axes)] * np.array(reading.signs, dtype=float)).T
    turning = a - sample.base.T / run.scale_factor
    alpha = sample.phase / reading.output
    values = [term_values(name, a, sample.t, sample.warm, turning, alpha) for name in names]
    columns = sample.increments(np.stack([*values, sample.base[:, 0]]))
    columns[-1] += sample.observed / reading.output
    if sample.point:
        return columns
    noise = starting_noise(run.resolution, max(float(np.median(sample.h)), 1e-9))
    return Whitener("increments", noise, len(columns)).apply_columns(columns, sample.h)


def _without(rows: Array, free: int) -> Array:
    """Rows of a segment less what its first ``free`` columns take, and without them."""
    basis = np.linalg.svd(rows[:free].T, full_matrices=False)[0]
    return rows[free:] - (rows[free:] @ basis) @ basis.T
