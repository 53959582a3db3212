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
from functools import partial
from itertools import pairwise, permutations, product
from typing import Any

import numpy as np

from piga.calibration.model.design import Design
from piga.calibration.model.request import Request, phase_angle
from piga.calibration.model.solution import least_squares
from piga.calibration.residuals import stretch_angles
from piga.errors import DataError, PigaError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.diagnostics import scale_over_nominal
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS
from piga.results import Array

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
_PLACES = ("first", "second", "third")


@dataclass(frozen=True)
class _Reading:
    """A reading of the data: axis of the record behind each base axis, signs, divisor of the output.

    ``residual`` is that of its fit, ``scale`` its scale factor over the nominal one.
    """

    axes: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[int, int, int] = (1, 1, 1)
    output: float = 1.0
    residual: float = math.inf
    scale: float = 1.0

    @property
    def changes(self) -> int:
        """Number of changes to the run file."""
        moved = sum(axis != place for place, axis in enumerate(self.axes))
        return 2 * moved + 3 * self.signs.count(-1) + (2 if self.output != 1.0 else 0)

    def errors(self, run: Run) -> dict[str, str]:
        """Errors in the data if this reading is right, each with the change to the run file or the data."""
        errors: dict[str, str] = {}
        swapped = [AXES[place] for place, axis in enumerate(self.axes) if axis != place]
        if swapped:
            taken = f"X0, Y0, Z0 taken from {', '.join(AXES[axis] for axis in self.axes)}"
            words = f"{swapped[0]} and {swapped[1]} swapped" if len(swapped) == 2 else taken
            order = ", ".join(_PLACES[axis] for axis in self.axes)
            errors[words] = f"in [data] reference list the columns in the order {order}"
        negative = " and ".join(AXES[place] for place, sign in enumerate(self.signs) if sign < 0)
        if negative:
            errors[f"{negative} negative"] = f"change the sign of {negative} in the data file"
        if self.output < 0.0:
            errors["the output negative"] = "set direction = -1 in [data] output"
        elif self.output != 1.0:
            size, larger = max(self.output, 1.0 / self.output), self.output < 1.0
            words = f"the output {'multiplied' if larger else 'divided'} by {size:.6g}"
            errors[words] = f"in {_output_unit(run, size, larger=larger)}"
        return errors

    def words(self, run: Run) -> str:
        """Errors in the data if this reading is right."""
        return " and ".join(self.errors(run)) or "the data as they are"


_OF_COUNTS = (4.0, 10.0)
"""Factors by which counts per revolution are wrong: edges of a quadrature encoder, a slip of the decimal point."""
_MIXED: dict[float, dict[str, tuple[str, str]]] = {
    9.80665: {"reference": ("g", "m/s^2")},
    1e3: {"reference": ("g", "mg"), "output": ("rad", "mrad"), "time": ("s", "ms")},
    1e6: {"reference": ("g", "ug"), "output": ("rad", "urad"), "time": ("s", "us")},
    9806.65: {},
    180.0 / math.pi: {"output": ("rad", "deg")},
    3600.0: {"output": ("deg", "arcsec"), "time": ("h", "s")},
    648000.0 / math.pi: {"output": ("rad", "arcsec")},
    2.0 * math.pi: {"output": ("rev", "rad")},
    360.0: {"output": ("rev", "deg")},
} | {factor: {} for factor in _OF_COUNTS}
"""Factors between units that are often confused, and these (larger, smaller) by the key of ``[data]``."""


def _factor_near(ratio: float, *, counted: bool = False) -> float | None:
    """The factor close to a ratio or to its inverse; None if no factor is close. Ten is one of counts alone."""
    ratio = max(ratio, 1.0 / ratio)
    factors = [factor for factor in _MIXED if counted or factor != 10.0]
    near = min(factors, key=lambda factor: abs(ratio / factor - 1.0))
    return near if abs(ratio / near - 1.0) < _SNAP else None


def _unit_words(ratio: float, factor: float, run: Run, *, output: bool) -> str:
    """Advice for a scale factor of ``ratio`` times the nominal one; ``output``: the output's unit may be wrong."""
    larger, size, units_of = ratio > 1.0, f"{factor:.6g}", _MIXED[factor]
    mixed = [(key, units_of[key]) for key in ("reference", "time") if key in units_of]
    times = f"{'multiplied' if larger else 'divided'} by {size}"
    places = [f"f (wanted in m/s^2), t (wanted in s), output (wanted in {run.output_unit})"]
    if run.source:
        places = [_change(key, units, larger=larger, rate=False) for key, units in mixed]
        if output and ("output" in units_of or factor in _OF_COUNTS):
            places.append(_output_unit(run, factor, larger=not larger))
    places.append(f"{'[instrument] ' if run.source else ''}scale_factor {times}")
    return (
        f"the scale factor comes out {ratio:.4g} times the nominal one, near the factor {size} of "
        f"mixed-up units: check {', or '.join(places)}; not applied"
    )


def _output_unit(run: Run, value: float, *, larger: bool) -> str:
    """Change of the output's unit by a factor."""
    if run.resolution > 0.0:
        return f"[instrument] counts_per_revolution {'divided' if larger else 'multiplied'} by {value:.6g}"
    factor = _factor_near(value)
    if factor is None or "output" not in _MIXED[factor]:
        return f"[data] output a unit {value:.6g} times {'larger' if larger else 'smaller'}"
    return _change("output", _MIXED[factor]["output"], larger=larger, rate=run.kind == "rate")


def _change(key: str, units: tuple[str, str], *, larger: bool, rate: bool) -> str:
    """Advice to replace one of two units by the other in ``[data] key``."""
    right, wrong = (f"'{unit}/s'" if rate else f"'{unit}'" for unit in (units if larger else units[::-1]))
    return f"[data] {key} unit = {right} where it says {wrong}"


def looks_wrong(result: Calibration) -> bool:
    """True if other readings should be tried for a finished calibration.

    The scale factor is far from the nominal one, or the residuals correlate: also those that rounding may correlate.
    """
    return result.diagnostics.verdict not in (None, "white") or not _likely(scale_over_nominal(result))


def _likely(scale: float) -> bool:
    return 1.0 / _OFF < scale < _OFF


def advise(run: Run, request: Request, scale: float | None = None) -> tuple[str, ...]:
    """Readings that fit the data far better, in words: at most one sentence on axes, signs and the output, and one on a unit.

    ``scale`` is the scale factor of the whole record over the nominal one. If it is likely, a few windows say nothing of a unit.
    """
    readings = [one for one in _readings(run, request) if math.isfinite(one.residual)]
    plain = next((one for one in readings if not one.changes), None)
    if plain is None:
        return ()
    likely = [one for one in readings if one is plain or _likely(abs(one.scale))]
    least = min(one.residual for one in likely)
    if plain.residual <= _FAR_BETTER * least:
        return () if scale is not None and _likely(scale) else _scale_words(plain, readings, run)
    near = [one for one in likely if one.residual <= _AS_GOOD * least]
    upright = [one for one in near if one.scale > 0.0] or near
    best, *others = sorted(upright, key=lambda one: (one.changes, one.residual))
    alike = "; ".join(other.words(run) for other in others[:_MOST_ALIKE])
    equal = f" (this record cannot tell it from: {alike})" if alike else ""
    times = f"{float(f'{plain.residual / best.residual:.1g}'):.0f}"
    remedy = " and ".join(best.errors(run).values())
    words = f"the data fit {times} times better with {best.words(run)}{equal}: {remedy}; not applied"
    return (words, *_scale_words(best, readings, run))


def with_advice(error: PigaError, words: tuple[str, ...]) -> PigaError:
    """The same error with advice added to its remedy."""
    if words:
        PigaError.__init__(error, error.message, remedy="; or ".join((error.remedy, *words)))
    return error


def _scale_words(reading: _Reading, readings: list[_Reading], run: Run) -> tuple[str, ...]:
    """Advice for a scale factor that is negative or off by the factor of a unit."""
    as_good = [one.output for one in readings if one.residual <= _AS_GOOD * reading.residual]
    sentences: tuple[str, ...] = ()
    if reading.scale < 0.0:
        what, change = "X0 of the reference", "change it in the data file"
        if -1.0 in as_good:
            what, change = f"{what} or the output", f"{change}, or set direction = -1 in [data] output"
        sentences = (f"the scale factor comes out negative: {what} has the wrong sign; {change}; not applied",)
    ratio = abs(reading.scale)
    factor = _factor_near(ratio, counted=run.resolution > 0.0) if ratio > 0.0 else None
    if factor is None:
        return sentences
    return (*sentences, _unit_words(ratio, factor, run, output=any(abs(output) != 1.0 for output in as_good)))


def _readings(run: Run, request: Request) -> Iterator[_Reading]:
    """Fits of all permutations and of the factors that their scale factors suggest."""
    request = replace(
        request,
        phase_source="output",
        terms=("scale_factor", *(n for n in request.terms if n not in ("scale_factor", "k1", *SERVO_TERMS))),
    )
    fitted = partial(_fitted, *_windows(run, request), request)
    plain = fitted(_Reading())
    for axes in permutations(range(3)):
        for second, third in product((1, -1), repeat=2):
            reading = fitted(_Reading((axes[0], axes[1], axes[2]), (1, second, third)))
            if reading.scale < 0.0 and reading.changes:
                reading = replace(reading, signs=(-1, second, third), scale=-reading.scale)
            yield reading
    yield fitted(_Reading(output=-1.0))
    for factor in () if run.direct else _MIXED:  # K alone takes up a factor where nothing turns
        for known in (factor, 1.0 / factor):
            if abs(abs(plain.scale) / known - 1.0) < _SNAP:
                yield fitted(_Reading(output=known))


def _windows(run: Run, request: Request) -> tuple[Run, Array]:
    """Windows spread over the record, and their phase angle [rad]. Samples are skipped while the output turns little."""
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
    held = {name: values for name, values in vars(run).items() if isinstance(values, np.ndarray)}
    taken: dict[str, Any] = {name: np.ascontiguousarray(values[index]) for name, values in held.items()}
    taken |= {"begins": np.concatenate(begins), "left_out": None, "servo": ()}
    return replace(run, **taken), np.ascontiguousarray(phase[index])


def _fitted(run: Run, phase: Array, request: Request, reading: _Reading) -> _Reading:
    """The reading with its root-mean-square residual of the angle; with one phase per segment if the request has it."""
    f = np.ascontiguousarray(run.f[:, list(reading.axes)] * np.array(reading.signs, dtype=float))
    try:
        design = Design(replace(run, f=f, output=run.output / reading.output), request, run.scale_factor)
    except DataError:
        return reading
    design.phase_angle = phase / reading.output
    blocks = list(design.blocks())
    for block in () if design.point else blocks:  # angles have equal weight if their noise is white
        stretch_angles(block.columns, block.h == 0.0)
    free = len(design.local_names) if request.phases != "shared" else 0
    parts = [
        _without(np.hstack([block.columns for block in blocks if block.segment == k]), free)
        for k in sorted({block.segment for block in blocks})
    ]
    rows = np.hstack(parts)
    linear = least_squares(rows[:-1].T, rows[-1], 1e-10)
    miss = float(np.linalg.norm(rows[-1] - linear @ rows[:-1])) / math.sqrt(rows.shape[1])
    scale = float(linear[design.names.index("scale_factor") - free]) / run.scale_factor
    return replace(reading, residual=abs(reading.output) * miss, scale=scale)


def _without(rows: Array, free: int) -> Array:
    """Rows of a segment after its first ``free`` columns are eliminated."""
    if not free:
        return rows
    basis = np.linalg.svd(rows[:free].T, full_matrices=False)[0]
    return rows[free:] - (rows[free:] @ basis) @ basis.T
