"""Advice on a reference or an output that was read wrongly: swapped axes, wrong sign, wrong unit.

Every signed permutation of the reference axes is fitted to a thinned record with a free scale factor. The sign of
X0 and a factor of the reference then affect only the scale factor. A factor of the output also affects the phase of
the coupling, so likely factors are fitted too. Nothing is changed in the data. The advice says what is wrong with the
data and which entry of the run file to change. If a unit is 'larger' by a factor, the same numbers in the file mean
that much more.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from piga.calibration.model.design import Design
from piga.calibration.model.request import Request
from piga.calibration.model.solution import least_squares
from piga.calibration.remarks.missing_terms import smooth_step, term_values
from piga.calibration.weights import Whitener, starting_noise
from piga.errors import PigaError
from piga.records.calibration import Calibration
from piga.records.calibration.verdict import COUNTED
from piga.records.run import Run
from piga.records.spool import gathered
from piga.records.terms import SERVO_TERMS
from piga.results import Array, Result
from piga.units import G0


@dataclass(frozen=True)
class AdviceSettings:
    """Limits for advice on another reading of the data, and the samples used (own choices)."""

    far_better: float = 3.0
    """Ratio of residuals above which another reading is advised."""
    as_good: float = 1.2
    """Ratio of residuals up to which readings cannot be separated."""
    off: float = 2.0
    """Ratio of the scale factor to the nominal one above which an error is reported, even if no reading explains it."""
    most_alike: int = 3
    """Most readings named that the record cannot tell from the best one."""
    snap: float = 0.1
    """Largest relative distance of the scale factor ratio from a known factor (nominal values are close)."""
    samples: int = 2000
    """Samples used."""
    window: int = 60
    """Most consecutive samples of a stretch."""
    turn: float = 0.25
    """Turn of the output between used samples [rad]."""


ADVICE = AdviceSettings()


AXES = ("X0", "Y0", "Z0")
_ARRAYS = {"reference": "f (wanted in m/s^2)", "time": "t (wanted in s)"}
"""Arguments of ``Run.from_arrays`` by the key of ``[data]``."""
_PLACES = ("first", "second", "third")


@dataclass(frozen=True, eq=False, repr=False)
class Factor(Result):
    """A factor between two units; ``units`` (larger, smaller) by the key of ``[data]`` if units are mixed up."""

    value: float
    units: dict[str, tuple[str, str]] = field(default_factory=dict)


FACTORS = (
    Factor(9.80665, {"reference": ("g", "m/s^2")}),
    Factor(1000.0, {"reference": ("g", "mg"), "output": ("rad", "mrad"), "time": ("s", "ms")}),
    Factor(1e6, {"reference": ("g", "ug"), "output": ("rad", "urad"), "time": ("s", "us")}),
    Factor(180.0 / math.pi, {"output": ("rad", "deg")}),
    Factor(3600.0, {"output": ("deg", "arcsec"), "time": ("h", "s")}),
    Factor(648000.0 / math.pi, {"output": ("rad", "arcsec")}),
    Factor(2.0 * math.pi, {"output": ("rev", "rad")}),
    Factor(360.0, {"output": ("rev", "deg")}),
    Factor(4.0),
)
"""Factors between units that are often mixed up, and the four edges of a quadrature encoder."""


@dataclass(frozen=True)
class AdviceReading:
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


def factor_near(ratio: float) -> Factor | None:
    """The factor close to a ratio or to its inverse; None if no factor is close."""
    ratio = max(ratio, 1.0 / ratio)
    near = min(FACTORS, key=lambda factor: abs(ratio / factor.value - 1.0))
    return near if abs(ratio / near.value - 1.0) < ADVICE.snap else None


def better_words(ratio: float, reading: AdviceReading, alike: list[AdviceReading], run: Run) -> str:
    """Advice for a reading that fits far better; ``alike`` are readings that the record cannot separate from it."""
    others = "; ".join(other.words() for other in alike)
    equal = f" (this record cannot tell it from: {others})" if others else ""
    times = f"{float(f'{ratio:.1g}'):.0f}"
    return (
        f"the data fit {times} times better with {reading.words()}{equal}: {reading.remedy(run)}; not applied"
    )


def sign_words(*, output: bool) -> str:
    """Advice for a negative scale factor; ``output``: the sign of the output may be wrong."""
    what = "X0 of the reference or the output has" if output else "X0 of the reference has"
    return (
        f"the scale factor comes out negative: {what} the wrong sign; change it in the data file; not applied"
    )


def unit_words(ratio: float, factor: Factor, run: Run, *, output: bool) -> str:
    """Advice for a scale factor of ``ratio`` times the nominal one; ``output``: the output's unit may be wrong."""
    larger, size = ratio > 1.0, f"{factor.value:.6g}"
    mixed = [(key, factor.units[key]) for key in ("reference", "time") if key in factor.units]
    times = f"{'multiplied' if larger else 'divided'} by {size}"
    if run.source:
        places = [_change(key, units, larger=larger, rate=False) for key, units in mixed]
        if output and ("output" in factor.units or factor.value == 4.0):
            places.append(_output_unit(run, factor.value, larger=not larger))
        places.append(f"[instrument] scale_factor {times}")
    else:
        places = [f"{_ARRAYS[key]} {times}" for key, _ in mixed]
        if output and "output" in factor.units:
            unit = "rad/s" if run.kind == "rate" else "rad"
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
    factor = factor_near(value)
    if factor is None or "output" not in factor.units:
        return f"[data] output a unit {value:.6g} times {'larger' if larger else 'smaller'}"
    return _change("output", factor.units["output"], larger=larger, rate=run.kind == "rate")


def _change(key: str, units: tuple[str, str], *, larger: bool, rate: bool) -> str:
    """Advice to replace one of two units by the other in ``[data] key``."""
    right, wrong = (f"'{unit}/s'" if rate else f"'{unit}'" for unit in (units if larger else units[::-1]))
    return f"[data] {key} unit = {right} where it says {wrong}"


@dataclass(frozen=True)
class Trial:
    """A reading with the residual of its fit and its scale factor over the nominal one."""

    reading: AdviceReading
    residual: float
    scale: float


def looks_wrong(result: Calibration) -> bool:
    """True if other readings should be tried for a finished calibration.

    The scale factor is far from the nominal one, or the residuals are not white.
    """
    values = {c.name: c.value for c in result.coefficients}
    nominal = result.scale_factor_nominal * G0
    scale = values.get("scale_factor", nominal) / nominal + values.get("k1", 0.0)
    white = result.diagnostics.verdict in (None, "white", COUNTED)
    return not (white and 1.0 / ADVICE.off < scale < ADVICE.off)


def advise(run: Run, request: Request) -> tuple[str, ...]:
    """Readings that fit the data far better, in words; empty if the data fit as they are.

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
    plain = next((t for t in trials if t.reading == AdviceReading()), None)
    if plain is None:
        return ()
    likely = [t for t in trials if t is plain or 1.0 / ADVICE.off < abs(t.scale) < ADVICE.off]
    least = min(t.residual for t in likely)
    if plain.residual <= ADVICE.far_better * least:
        return _scale_words(plain, trials, run)
    near = [t for t in likely if t.residual <= ADVICE.as_good * least]
    upright = [t for t in near if t.scale > 0.0] or near
    best, *others = sorted(upright, key=lambda t: (t.reading.changes, t.residual))
    alike = [t.reading for t in others[: ADVICE.most_alike]]
    words = better_words(plain.residual / best.residual, best.reading, alike, run)
    return (words, *_scale_words(best, trials, run))


def with_advice(error: PigaError, words: tuple[str, ...]) -> PigaError:
    """The same error with advice added to its remedy."""
    if words:
        PigaError.__init__(error, error.message, remedy="; or ".join((error.remedy, *words)))
    return error


def _scale_words(trial: Trial, trials: list[Trial], run: Run) -> tuple[str, ...]:
    """Advice for a scale factor that is negative or off by the factor of a unit."""
    as_good = [t.reading.output for t in trials if t.residual <= ADVICE.as_good * trial.residual]
    sentences = (sign_words(output=-1.0 in as_good),) if trial.scale < 0.0 else ()
    ratio = abs(trial.scale)
    factor = factor_near(ratio) if ratio > 0.0 else None
    if factor is None:
        return sentences
    return (*sentences, unit_words(ratio, factor, run, output=any(abs(output) != 1.0 for output in as_good)))


def _trials(run: Run, request: Request, sample: Sample) -> Iterator[Trial]:
    """Fits of all permutations and of the factors that their scale factors suggest."""
    base = AdviceReading()
    plain = _fit(run, request, sample, base)
    for x, y, z in permutations(range(3)):
        for second, third in product((1, -1), repeat=2):
            reading = AdviceReading((x, y, z), (1, second, third))
            trial = plain if reading == base else _fit(run, request, sample, reading)
            if trial.scale < 0.0 and reading != base:
                turned = replace(reading, signs=(-1, second, third))
                trial = replace(trial, reading=turned, scale=-trial.scale)
            yield trial
    yield _fit(run, request, sample, replace(base, output=-1.0))
    for factor in FACTORS:
        for known in (factor.value, 1.0 / factor.value):
            if abs(abs(plain.scale) / known - 1.0) < ADVICE.snap:
                yield _fit(run, request, sample, replace(base, output=known))


def _fit(run: Run, request: Request, sample: Sample, reading: AdviceReading) -> Trial:
    """Whitened root-mean-square residual of a reading; with one phase per segment if the request has it.

    The trapezoid loses 0.1 % of the coupling, equally in all readings.
    """
    turning = ["p", "q"] if "tan_beta" in request.terms else []
    turning += [f"{kind}{order}" for order in request.harmonics for kind in ("s", "c")]
    left_out = ("scale_factor", "k1", *SERVO_TERMS)
    names = [*turning, "k1", *(n for n in request.shared_terms if n not in left_out)]
    rows = _whitened(run, sample, reading, names)
    free = len(turning) if request.phases != "shared" else 0
    if free:
        parts = [rows[:, sample.segment == segment] for segment in np.unique(sample.segment)]
        rows = np.hstack([_without(part, free) for part in parts])
    linear = least_squares(rows[:-1].T, rows[-1], 1e-10)
    miss = float(np.linalg.norm(rows[-1] - linear @ rows[:-1])) / math.sqrt(sample.t.size)
    return Trial(
        reading, abs(reading.output) * miss, float(linear[names.index("k1") - free]) / run.scale_factor
    )


def _whitened(run: Run, sample: Sample, reading: AdviceReading, names: list[str]) -> Array:
    """Columns of a reading and its observation (names + 1, n), whitened for angle noise."""
    a = (sample.f[:, list(reading.axes)] * np.array(reading.signs, dtype=float)).T
    turning = a - sample.base.T / run.scale_factor
    alpha = sample.phase / reading.output
    values = term_values(names, a, sample.t, sample.warm, turning, alpha)
    columns = sample.increments(np.vstack([values, sample.base[:, 0]]))
    columns[-1] += sample.observed / reading.output
    if sample.point:
        return columns
    noise = starting_noise(run.resolution, max(float(np.median(sample.h)), 1e-9))
    return Whitener("increments", noise, len(columns)).apply(columns, sample.h)


def _without(rows: Array, free: int) -> Array:
    """Rows of a segment after its first ``free`` columns are eliminated."""
    basis = np.linalg.svd(rows[:free].T, full_matrices=False)[0]
    return rows[free:] - (rows[free:] @ basis) @ basis.T


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
    """Windows spread over the record. Samples are skipped while the output turns little and the force is straight."""
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
        segment=gathered(run.segment_index, index),
        point=point,
    )


def _thinned(run: Run) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Rows to use, and the first row of each window."""
    begun: NDArray[np.int64] = np.unique(np.append(np.flatnonzero(run.begins), 0))
    starts = begun[:: max(1, math.ceil(begun.size * 12 / ADVICE.samples))].tolist()
    ends = np.append(np.flatnonzero(run.begins)[1:], run.size)
    skip = 1 if run.kind == "rate" else smooth_step(run, ADVICE.turn)
    share = max(12, ADVICE.samples // len(starts))
    chosen: list[NDArray[np.int64]] = []
    for start in starts:
        end = int(ends[np.searchsorted(ends, start, side="right")])
        held = (end - start) // skip
        windows = max(1, min(share, held) // ADVICE.window)
        length = min(share // windows, held // windows)
        for first in np.linspace(start, max(start, end - length * skip), windows).astype(np.int64):
            part = np.arange(first, min(end, first + length * skip), skip)
            chosen.append(part if run.left_out is None else part[~run.left_out[part]])
    kept = [part for part in chosen if part.size > 1]
    begins = [np.arange(part.size) == 0 for part in kept]
    return np.concatenate(kept), np.concatenate(begins)
