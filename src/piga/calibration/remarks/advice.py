"""Advice on a reference or an output that was read wrongly: swapped axes, wrong sign, wrong unit.

Every signed permutation of the reference axes is fitted to a few windows of the record with a free scale factor. The sign of
X0 and a factor of the reference then affect only the scale factor. A factor of the output also affects the phase of
the coupling, so likely factors are fitted too. Nothing is changed in the data. The advice says what is wrong with the
data and which entry of the run file to change. If a unit is 'larger' by a factor, the same numbers in the file mean
that much more.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise, permutations, product

import numpy as np

from piga.calibration.model.design import Design
from piga.calibration.model.request import Request, phase_angle
from piga.calibration.model.solution import least_squares
from piga.errors import DataError, PigaError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.verdict import COUNTED, scale_over_nominal
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS
from piga.results import Array
from piga.units import UNIT_FACTORS, UnitFactor

_FAR_BETTER = 3.0
"""Ratio of residuals above which another reading is advised."""
_AS_GOOD = 1.2
"""Ratio of residuals up to which readings cannot be separated."""
_OFF = 2.0
"""Ratio of the scale factor to the nominal one above which an error is reported, even if no reading explains it."""
_MOST_ALIKE = 3
"""Most readings named that the record cannot tell from the best one."""
_SNAP = 0.1
"""Largest relative distance of the scale factor ratio from a known factor (nominal values are close)."""
_STEPS = 1 << 16
"""Steps of the output that are looked at."""
_SAMPLES = 3000
"""Samples used, about."""
_TURN = 0.25
"""Most turn of the output between used samples [rad]."""
_LONGEST_STEP = 64
"""Most samples of the record from one used sample to the next."""


AXES = ("X0", "Y0", "Z0")
_ARRAYS = {"reference": "f (wanted in m/s^2)", "time": "t (wanted in s)"}
"""Arguments of ``Run.from_arrays`` by the key of ``[data]``."""
_PLACES = ("first", "second", "third")


@dataclass(frozen=True)
class _AdviceReading:
    """Another reading of the data: axis of the record behind each base axis, signs, divisor of the output."""

    axes: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[int, int, int] = (1, 1, 1)
    output: float = 1.0

    @property
    def changes(self) -> int:
        """Number of changes to the run file."""
        moved = sum(axis != place for place, axis in enumerate(self.axes))
        return 2 * moved + 3 * self.signs.count(-1) + (2 if self.output != 1.0 else 0)

    @property
    def negative(self) -> list[str]:
        """Names of the axes whose sign is changed."""
        return [AXES[place] for place, sign in enumerate(self.signs) if sign < 0]

    def words(self) -> str:
        """Error in the data if this reading is right."""
        parts = []
        swapped = [AXES[place] for place, axis in enumerate(self.axes) if axis != place]
        if len(swapped) == 2:
            parts.append(f"{swapped[0]} and {swapped[1]} swapped")
        elif swapped:
            parts.append(f"X0, Y0, Z0 taken from {', '.join(AXES[axis] for axis in self.axes)}")
        if self.negative:
            parts.append(f"{' and '.join(self.negative)} negative")
        if self.output < 0.0:
            parts.append("the output negative")
        elif self.output > 1.0:
            parts.append(f"the output divided by {self.output:.6g}")
        elif self.output < 1.0:
            parts.append(f"the output multiplied by {1.0 / self.output:.6g}")
        return " and ".join(parts) or "the data as they are"

    def remedy(self, run: Run) -> str:
        """Change to the run file or the data if this reading is right."""
        parts = []
        if self.axes != (0, 1, 2):
            order = ", ".join(_PLACES[axis] for axis in self.axes)
            parts.append(f"in [data] reference list the columns in the order {order}")
        if self.negative:
            parts.append(f"change the sign of {' and '.join(self.negative)} in the data file")
        if self.output < 0.0:
            parts.append("change the sign of the output in the data file")
        elif self.output != 1.0:
            parts.append(
                f"in {_output_unit(run, max(self.output, 1.0 / self.output), larger=self.output < 1.0)}"
            )
        return " and ".join(parts)


_OF_COUNTS = (4.0, 10.0)
"""Factors by which counts per revolution are wrong: edges of a quadrature encoder, a slip of the decimal point."""


def _factor_near(ratio: float, *, counted: bool = False) -> UnitFactor | None:
    """The factor close to a ratio or to its inverse; None if no factor is close. Ten is one of counts alone."""
    ratio = max(ratio, 1.0 / ratio)
    factors = [factor for factor in UNIT_FACTORS if counted or factor.value != 10.0]
    near = min(factors, key=lambda factor: abs(ratio / factor.value - 1.0))
    return near if abs(ratio / near.value - 1.0) < _SNAP else None


def _better_words(ratio: float, reading: _AdviceReading, alike: list[_AdviceReading], run: Run) -> str:
    """Advice for a reading that fits far better; ``alike`` are readings that the record cannot separate from it."""
    others = "; ".join(other.words() for other in alike)
    equal = f" (this record cannot tell it from: {others})" if others else ""
    times = f"{float(f'{ratio:.1g}'):.0f}"
    return (
        f"the data fit {times} times better with {reading.words()}{equal}: {reading.remedy(run)}; not applied"
    )


def _sign_words(*, output: bool) -> str:
    """Advice for a negative scale factor; ``output``: the sign of the output may be wrong."""
    what = "X0 of the reference or the output has" if output else "X0 of the reference has"
    return (
        f"the scale factor comes out negative: {what} the wrong sign; change it in the data file; not applied"
    )


def _unit_words(ratio: float, factor: UnitFactor, run: Run, *, output: bool) -> str:
    """Advice for a scale factor of ``ratio`` times the nominal one; ``output``: the output's unit may be wrong."""
    larger, size = ratio > 1.0, f"{factor.value:.6g}"
    mixed = [(key, factor.mixed[key]) for key in ("reference", "time") if key in factor.mixed]
    times = f"{'multiplied' if larger else 'divided'} by {size}"
    if run.source:
        places = [_change(key, units, larger=larger, rate=False) for key, units in mixed]
        if output and ("output" in factor.mixed or factor.value in _OF_COUNTS):
            places.append(_output_unit(run, factor.value, larger=not larger))
        places.append(f"[instrument] scale_factor {times}")
    else:
        places = [f"{_ARRAYS[key]} {times}" for key, _ in mixed]
        if output and "output" in factor.mixed:
            unit = run.output_unit
            places.append(f"output (wanted in {unit}) {'divided' if larger else 'multiplied'} by {size}")
        places.append(f"scale_factor {times}")
    return (
        f"the scale factor comes out {ratio:.4g} times the nominal one, near the factor {size} of "
        f"mixed-up units: check {', or '.join(places)}; not applied"
    )


def _output_unit(run: Run, value: float, *, larger: bool) -> str:
    """Change of the output's unit by a factor."""
    if run.resolution > 0.0:
        return f"[instrument] counts_per_revolution {'divided' if larger else 'multiplied'} by {value:.6g}"
    factor = _factor_near(value)
    if factor is None or "output" not in factor.mixed:
        return f"[data] output a unit {value:.6g} times {'larger' if larger else 'smaller'}"
    return _change("output", factor.mixed["output"], larger=larger, rate=run.kind == "rate")


def _change(key: str, units: tuple[str, str], *, larger: bool, rate: bool) -> str:
    """Advice to replace one of two units by the other in ``[data] key``."""
    right, wrong = (f"'{unit}/s'" if rate else f"'{unit}'" for unit in (units if larger else units[::-1]))
    return f"[data] {key} unit = {right} where it says {wrong}"


@dataclass(frozen=True)
class Trial:
    """A reading with the residual of its fit and its scale factor over the nominal one."""

    reading: _AdviceReading
    residual: float
    scale: float


def looks_wrong(result: Calibration) -> bool:
    """True if other readings should be tried for a finished calibration.

    The scale factor is far from the nominal one, or the residuals are not white.
    """
    white = result.diagnostics.verdict in (None, "white", COUNTED)
    return not (white and _likely(scale_over_nominal(result)))


def _likely(scale: float) -> bool:
    return 1.0 / _OFF < scale < _OFF


def advise(run: Run, request: Request, scale: float | None = None) -> tuple[str, ...]:
    """Readings that fit the data far better, in words; empty if the data fit as they are.

    Parameters
    ----------
    run, request:
        As for the calibration.
    scale:
        The scale factor of the whole record over the nominal one. If it is likely, a few windows say nothing of a unit.

    Returns
    -------
    tuple of str
        At most one sentence on axes, signs and the output, and one on a unit.
    """
    trials = [t for t in _trials(run, request) if math.isfinite(t.residual)]
    plain = next((t for t in trials if t.reading == _AdviceReading()), None)
    if plain is None:
        return ()
    likely = [t for t in trials if t is plain or _likely(abs(t.scale))]
    least = min(t.residual for t in likely)
    if plain.residual <= _FAR_BETTER * least:
        return () if scale is not None and _likely(scale) else _scale_words(plain, trials, run)
    near = [t for t in likely if t.residual <= _AS_GOOD * least]
    upright = [t for t in near if t.scale > 0.0] or near
    best, *others = sorted(upright, key=lambda t: (t.reading.changes, t.residual))
    alike = [t.reading for t in others[:_MOST_ALIKE]]
    words = _better_words(plain.residual / best.residual, best.reading, alike, run)
    return (words, *_scale_words(best, trials, run))


def with_advice(error: PigaError, words: tuple[str, ...]) -> PigaError:
    """The same error with advice added to its remedy."""
    if words:
        PigaError.__init__(error, error.message, remedy="; or ".join((error.remedy, *words)))
    return error


def _scale_words(trial: Trial, trials: list[Trial], run: Run) -> tuple[str, ...]:
    """Advice for a scale factor that is negative or off by the factor of a unit."""
    as_good = [t.reading.output for t in trials if t.residual <= _AS_GOOD * trial.residual]
    sentences = (_sign_words(output=-1.0 in as_good),) if trial.scale < 0.0 else ()
    ratio = abs(trial.scale)
    factor = _factor_near(ratio, counted=run.resolution > 0.0) if ratio > 0.0 else None
    if factor is None:
        return sentences
    return (*sentences, _unit_words(ratio, factor, run, output=any(abs(output) != 1.0 for output in as_good)))


def _trials(run: Run, request: Request) -> Iterator[Trial]:
    """Fits of all permutations and of the factors that their scale factors suggest."""
    sample, base = _sample_of(run, request), _AdviceReading()
    plain = _fit(sample, base)
    for x, y, z in permutations(range(3)):
        for second, third in product((1, -1), repeat=2):
            reading = _AdviceReading((x, y, z), (1, second, third))
            trial = plain if reading == base else _fit(sample, reading)
            if trial.scale < 0.0 and reading != base:
                turned = replace(reading, signs=(-1, second, third))
                trial = replace(trial, reading=turned, scale=-trial.scale)
            yield trial
    yield _fit(sample, replace(base, output=-1.0))
    for factor in () if run.direct else UNIT_FACTORS:  # K alone takes up a factor where nothing turns
        for known in (factor.value, 1.0 / factor.value):
            if abs(abs(plain.scale) / known - 1.0) < _SNAP:
                yield _fit(sample, replace(base, output=known))


@dataclass(frozen=True)
class Sample:
    """Windows of a record as a record of its own, the request for it, and the phase angle of its samples [rad]."""

    run: Run
    request: Request
    phase: Array


def _sample_of(run: Run, request: Request) -> Sample:
    """Windows spread over the record. Samples are skipped while the output turns little."""
    request = replace(
        request,
        phase_source="output",
        terms=("scale_factor", *(n for n in request.terms if n not in ("scale_factor", "k1", *SERVO_TERMS))),
    )
    phase = phase_angle(run, request, run.scale_factor)
    ends = np.arange(1, run.size, max(1, run.size // _STEPS))
    ends = ends[~run.begins[ends]]
    turned = np.abs(phase[ends] - phase[ends - 1])
    most = float(np.quantile(turned, 0.95)) if turned.size else 0.0
    starts = np.flatnonzero(run.begins)
    edges = list(pairwise([*starts.tolist(), run.size]))
    longest = min(_LONGEST_STEP, int(np.median(np.diff([*starts, run.size]))) // 12)
    skip = 1 if run.kind == "rate" else int(max(1, min(_TURN / max(most, 1e-300), longest)))
    edges = edges[:: max(1, math.ceil(len(edges) * 12 / _SAMPLES))]
    length = max(_SAMPLES // len(edges), 12) * skip
    rows, begins = [], []
    for start, stop in edges:
        count = max(1, min(3, (stop - start) // (2 * length)))
        for first in np.linspace(start, max(start, stop - length // count), count).astype(np.int64):
            part = np.arange(first, min(stop, first + length // count), skip)
            part = part if run.left_out is None else part[~run.left_out[part]]
            if part.size > 1 or run.kind == "rate":
                rows.append(part)
                begins.append(np.arange(part.size) == 0)
    index = np.concatenate(rows)
    thin = replace(
        run,
        t=np.ascontiguousarray(run.t[index]),
        output=np.ascontiguousarray(run.output[index]),
        f=np.ascontiguousarray(run.f[index]),
        base_rate=None if run.base_rate is None else np.ascontiguousarray(run.base_rate[index]),
        temperature=None if run.temperature is None else np.ascontiguousarray(run.temperature[index]),
        vibration=None if run.vibration is None else np.ascontiguousarray(run.vibration[index]),
        segment_index=run.segment_index[index],
        begins=np.concatenate(begins),
        row=run.row[index],
        left_out=None,
        servo=(),
    )
    return Sample(thin, request, np.ascontiguousarray(phase[index]))


def _fit(sample: Sample, reading: _AdviceReading) -> Trial:
    """Root-mean-square residual of the angle for a reading; with one phase per segment if the request has it."""
    run, request = sample.run, sample.request
    f = np.ascontiguousarray(run.f[:, list(reading.axes)] * np.array(reading.signs, dtype=float))
    try:
        design = Design(replace(run, f=f, output=run.output / reading.output), request, run.scale_factor)
    except DataError:
        return Trial(reading, math.inf, 1.0)
    design.phase_angle = sample.phase / reading.output
    blocks = list(design.blocks())
    free = len(design.local_names) if request.phases != "shared" else 0
    parts = [
        _without(np.hstack([_angles(b.columns, b.h, design.point) for b in blocks if b.segment == k]), free)
        for k in sorted({block.segment for block in blocks})
    ]
    rows = np.hstack(parts)
    linear = least_squares(rows[:-1].T, rows[-1], 1e-10)
    miss = float(np.linalg.norm(rows[-1] - linear @ rows[:-1])) / math.sqrt(rows.shape[1])
    scale = float(linear[design.names.index("scale_factor") - free]) / run.scale_factor
    return Trial(reading, abs(reading.output) * miss, scale)


def _angles(columns: Array, h: Array, point: bool) -> Array:
    """Increments summed up to angles, less their mean in each window: rows of equal weight if the angle has white noise."""
    if point:
        return columns
    edges = [*np.flatnonzero(h == 0.0).tolist(), h.size]
    if edges[0] != 0:
        edges.insert(0, 0)
    whole = np.cumsum(columns, axis=1)
    return np.hstack([whole[:, a:b] - whole[:, a:b].mean(axis=1, keepdims=True) for a, b in pairwise(edges)])


def _without(rows: Array, free: int) -> Array:
    """Rows of a segment after its first ``free`` columns are eliminated."""
    if not free:
        return rows
    basis = np.linalg.svd(rows[:free].T, full_matrices=False)[0]
    return rows[free:] - (rows[free:] @ basis) @ basis.T
