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

from piga.calibration.design import Design
from piga.calibration.noise import starting_noise
from piga.calibration.reduction import Reduction
from piga.calibration.request import Request
from piga.calibration.weighting import reduce_segments, weighting_mode
from piga.errors import PigaError
from piga.records.calibration import Calibration
from piga.records.run import Run
from piga.units import G0

Array = NDArray[np.float64]

FAR_BETTER = 10.0
"""Ratio of residuals from which another reading of the data is worth saying."""
AS_GOOD = 1.2
"""Ratio of residuals up to which readings cannot be told apart."""
POOR = 0.02
"""Residual over that of the nominal instrument, from which a fit that is not white is looked at."""
SNAP = 0.1
"""Relative distance of the scale factor from a known factor that is taken for it (nominal values are close)."""
ROWS = 2000
"""Samples that are looked at."""
WINDOW = 60
"""Samples of a stretch in a row, at most."""
TURN = 0.25
"""Turn of the output between samples looked at [rad]."""
FACTORS = (
    (9.80665, "a unit g for m/s^2"),
    (1000.0, "a factor 1000 (milli)"),
    (1e6, "a factor 1e6 (micro)"),
    (180.0 / math.pi, "degrees for radians"),
    (3600.0, "a factor 3600 (arcsec for deg)"),
    (648000.0 / math.pi, "arcsec for radians"),
    (2.0 * math.pi, "revolutions for radians"),
    (4.0, "quadrature counts"),
)
AXES = ("X0", "Y0", "Z0")


@dataclass(frozen=True)
class Reading:
    """Another reading of the data: axis of the record behind each base axis, signs, divisor of the output."""

    axes: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[int, int, int] = (1, 1, 1)
    output: float = 1.0

    @property
    def changes(self) -> int:
        """How much of the run file would have to change."""
        moved = sum(axis != place for place, axis in enumerate(self.axes))
        return 2 * moved + 3 * self.signs.count(-1) + (2 if self.output != 1.0 else 0)

    def words(self) -> str:
        """What is wrong if this reading is right."""
        parts = []
        swapped = [AXES[place] for place, axis in enumerate(self.axes) if axis != place]
        if len(swapped) == 2:
            parts.append(f"{swapped[0]} and {swapped[1]} swapped")
        elif swapped:
            order = ", ".join(AXES[axis] for axis in self.axes)
            parts.append(f"the columns of X0, Y0, Z0 taken from those of {order}")
        negative = [AXES[place] for place, sign in enumerate(self.signs) if sign < 0]
        if negative:
            parts.append(f"{' and '.join(negative)} negative")
        if self.output < 0.0:
            parts.append("the output negative")
        if abs(self.output) != 1.0:
            parts.append(f"the output divided by {abs(self.output):.6g} ({_factor_words(abs(self.output))})")
        return " and ".join(parts) or "the data as they are"


@dataclass(frozen=True)
class Trial:
    """A reading with the residual of its fit and its scale factor over the nominal one."""

    reading: Reading
    residual: float
    scale: float


def _factor_words(factor: float) -> str:
    ratio = max(factor, 1.0 / factor)
    return next((words for known, words in FACTORS if abs(ratio / known - 1.0) < SNAP), "a factor")


def looks_wrong(result: Calibration) -> bool:
    """True when a finished calibration calls for trying other readings.

    Its scale factor is far from the nominal one, or its residuals are neither small nor white.
    """
    found = {c.name: c.value for c in result.coefficients}
    scale = found.get("scale_factor", result.scale_factor_nominal * G0) / (result.scale_factor_nominal * G0)
    if not 0.5 < scale + found.get("k1", 0.0) < 2.0:
        return True
    poor = result.residual_rms > POOR * result.residual_rms_before
    return poor and result.diagnostics.get("verdict", "white") != "white"


def advise(run: Run, request: Request) -> tuple[str, ...]:
    """What the data would fit far better with, in words; nothing when they fit as they are.

    Parameters
    ----------
    run, request:
        As for the calibration.

    Returns
    -------
    tuple of str
        At most one sentence on axes, signs and the output, and one on the unit of the reference.
    """
    index, begins = _thinned(run)
    trials = [t for t in _trials(run, request, index, begins) if math.isfinite(t.residual)]
    plain = next((t for t in trials if t.reading == Reading()), None)
    if plain is None or not trials:
        return ()
    least = min(t.residual for t in trials)
    if plain.residual <= FAR_BETTER * least:
        best, alike = plain, []
        better = 1.0
    else:
        near = [t for t in trials if t.residual <= AS_GOOD * least]
        fitting = sorted(
            [t for t in near if t.scale > 0.0] or near, key=lambda t: (t.reading.changes, t.residual)
        )
        best, alike, better = fitting[0], fitting[1:4], plain.residual / fitting[0].residual
    found = []
    if best is not plain:
        others = "; ".join(t.reading.words() for t in alike)
        equal = f" (this record cannot tell it from: {others})" if others else ""
        found.append(
            f"the data fit {_times(better)} times better with {best.reading.words()}{equal}: check [data] reference "
            "and output in the run file; not applied"
        )
    return (*found, *_scale_words(best))


def with_advice(error: PigaError, words: tuple[str, ...]) -> PigaError:
    """The same error with advice in its remedy."""
    if words:
        PigaError.__init__(error, error.message, remedy="; or ".join(filter(None, (error.remedy, *words))))
    return error


def _times(ratio: float) -> str:
    return f"{float(f'{ratio:.1g}'):.0f}"


def _scale_words(trial: Trial) -> tuple[str, ...]:
    """A scale factor that is negative, or off by the factor of a unit."""
    found = []
    if trial.scale < 0.0:
        found.append(
            "the scale factor comes out negative: X0 of the reference or the output has the wrong sign; check [data] "
            "in the run file; not applied"
        )
    ratio = abs(trial.scale)
    for factor, words in FACTORS:
        for known, what in ((factor, "too small"), (1.0 / factor, "too large")):
            if abs(ratio / known - 1.0) < SNAP:
                found.append(
                    f"the scale factor is {ratio:.4g} times the nominal one: the reference is {factor:.6g} times {what} "
                    f"or the output the other way ({words}): check the units in [data]; not applied"
                )
    return tuple(found)


def _trials(run: Run, request: Request, index: NDArray[np.int64], begins: NDArray[np.bool_]) -> Iterator[Trial]:
    """Fits of all permutations and of what their scale factors suggest."""
    base = Reading()
    for axes in permutations(range(3)):
        for signs in product((1, -1), repeat=2):
            reading = Reading((axes[0], axes[1], axes[2]), (1, *signs))
            trial = _fit(run, request, index, begins, reading)
            if trial.scale < 0.0 and reading != base:
                turned = replace(reading, signs=(-1, *signs))
                trial = replace(trial, reading=turned, scale=-trial.scale)
            yield trial
    yield _fit(run, request, index, begins, replace(base, output=-1.0))
    plain = _fit(run, request, index, begins, base)
    for factor, _ in FACTORS:
        for known in (factor, 1.0 / factor):
            if abs(abs(plain.scale) / known - 1.0) < SNAP:
                yield _fit(run, request, index, begins, replace(base, output=known))


def _fit(
    run: Run, request: Request, index: NDArray[np.int64], begins: NDArray[np.bool_], reading: Reading
) -> Trial:
    """Residual of a reading: whitened root mean square, the phase of each segment free where it is so."""
    force = run.f[index][:, list(reading.axes)] * np.array(reading.signs, dtype=float)
    thin = replace(
        run,
        t=run.t[index], output=run.output[index] / reading.output, f=np.ascontiguousarray(force),
        base_rate=None if run.base_rate is None else run.base_rate[index],
        temperature=None if run.temperature is None else run.temperature[index],
        segment=run.segment[index], begins=begins, row=run.row[index], left_out=None,
    )  # fmt: skip
    terms = ("scale_factor", *(name for name in request.terms if name not in ("scale_factor", "k1")))
    try:
        design = Design(thin, replace(request, terms=terms, phase_source="output"), run.scale_factor)
        noise = starting_noise(run.resolution, max(run.median_step, 1e-9))
        summaries = reduce_segments(design, weighting_mode(design, "information"), noise)
        free = len(design.local_names) if request.phase != "shared" else 0
        total = Reduction.empty(design.names[free:])
        for summary in summaries:
            total.absorb(summary.factor[free:, free:].T, count=summary.count)
        factor = total.factor
        size = np.linalg.norm(factor[:, :-1], axis=0)
        size[size == 0.0] = 1.0
        linear = np.linalg.lstsq(factor[:, :-1] / size, factor[:, -1], rcond=1e-10)[0] / size
    except (PigaError, np.linalg.LinAlgError):
        return Trial(reading, math.inf, 1.0)
    miss = factor[:, -1] - factor[:, :-1] @ linear
    scale = float(linear[design.names[free:].index("scale_factor")]) / run.scale_factor
    return Trial(reading, abs(reading.output) * float(np.linalg.norm(miss)) / math.sqrt(index.size), scale)


def _thinned(run: Run) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Samples to look at, and where stretches of them begin: windows spread over the record.

    Samples are skipped as long as the output turns little and the force stays a straight line between.
    """
    starts = np.flatnonzero(run.begins) if run.begins.any() else np.zeros(1, dtype=np.int64)
    starts = starts[:: max(1, math.ceil(starts.size * 12 / ROWS))]
    ends = np.append(np.flatnonzero(run.begins)[1:], run.size)
    skip = 1 if run.kind == "rate" else _skip(run)
    share = max(12, ROWS // starts.size)
    chosen: list[Array] = []
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


def _skip(run: Run) -> int:
    """Step of the thinning."""
    inside = ~run.begins[1 : 1 + 4096]
    turn = np.abs(np.diff(run.output[: 1 + 4096]))[: inside.size][inside]
    largest = float(np.quantile(turn, 0.95)) if turn.size else 0.0
    skip = int(min(TURN / largest, 64.0)) if largest > 0.0 else 1
    f = run.f[:4096]
    while skip > 1:
        ends = f[: f.shape[0] - f.shape[0] % skip : skip]
        middle = f[skip // 2 :: skip][: ends.shape[0] - 1]
        line = ends[:-1] + (ends[1:] - ends[:-1]) * ((skip // 2) / skip)
        if np.quantile(np.abs(middle - line), 0.9) < 1e-3 * max(float(np.abs(f).max()), 1e-300):
            break
        skip //= 2
    return max(skip, 1)
