"""Doubts about the data: a reference or an output that was read wrongly, segments that decide, and a creep after each move.

**Reading.** Every signed permutation of the reference axes is fitted to a few windows of the record with a free scale factor. The
sign of X0 and a factor of the reference then affect only the scale factor. A factor of the output also affects the phase of
the coupling, so likely factors are fitted too. Nothing is changed in the data. The advice says what is wrong with the
data and which entry of the run file to change. If a unit is 'larger' by a factor, the same numbers in the file mean
that much more.

**Leverage.** ``B_j`` is the information of segment j and ``g_j`` its score, in coordinates in which the information of all
segments is one (:mod:`piga.calibration.intervals`). Without segment j the parameters change by ``-(1 - B_j)^-1 g_j``, and their
covariance is ``(1 - B_j)^-1``. This is exact where the fit is linear, and needs no second reading of the record.

**Creep** is a bias that decays within each position, and that the coefficients take up. Residuals are stacked by the time since
the start of the position. Each position gives an estimate of a creep ``exp(-t / time constant)`` from the shape of its residuals,
its mean rate taken out. The weighted mean over the positions is tested against their scatter (Bell and McCaffrey's rule). The size
is the same at each position, or proportional to the change of a_x by the move. A few time constants are tried (Bonferroni).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, permutations, product
from typing import Any

import numpy as np

from piga._kernels.estimation import merge_rows
from piga.calibration.fit import NORMAL_MEDIAN, Fit
from piga.calibration.intervals import parameter_rows, scatter_of, unit_information, without_rate
from piga.calibration.joint import JointFit
from piga.calibration.model.design import Block, Design
from piga.calibration.model.reduction import Reduction, triangle
from piga.calibration.model.request import Request, phase_angle
from piga.calibration.model.solution import least_squares
from piga.calibration.weights import RATE, Extra, Positions, reduce_positions, stretch_angles
from piga.errors import DataError, PigaError
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.coefficient import Coefficient
from piga.records.calibration.diagnostics import CREEP_ALARMS, Creep, SegmentLeverage, scale_over_nominal
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS
from piga.results import Array
from piga.units import G0

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


_AXES = ("X0", "Y0", "Z0")
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
        swapped = [_AXES[place] for place, axis in enumerate(self.axes) if axis != place]
        if swapped:
            taken = f"X0, Y0, Z0 taken from {', '.join(_AXES[axis] for axis in self.axes)}"
            words = f"{swapped[0]} and {swapped[1]} swapped" if len(swapped) == 2 else taken
            order = ", ".join(_PLACES[axis] for axis in self.axes)
            errors[words] = f"in [data] reference list the columns in the order {order}"
        negative = " and ".join(_AXES[place] for place, sign in enumerate(self.signs) if sign < 0)
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
    parts = []
    for k in sorted({block.segment for block in blocks}):
        own = np.hstack([block.columns for block in blocks if block.segment == k])
        if free:  # the columns of the phase of the segment are eliminated
            basis = np.linalg.svd(own[:free].T, full_matrices=False)[0]
            own = own[free:] - (own[free:] @ basis) @ basis.T
        parts.append(own)
    rows = np.hstack(parts)
    linear = least_squares(rows[:-1].T, rows[-1], 1e-10)
    miss = float(np.linalg.norm(rows[-1] - linear @ rows[:-1])) / math.sqrt(rows.shape[1])
    scale = float(linear[design.names.index("scale_factor") - free]) / run.scale_factor
    return replace(reading, residual=abs(reading.output) * miss, scale=scale)


# -- segments that decide, and creep ---------------------------------------------------------------------------

_DETERMINES = 0.9
"""Share of a coefficient's information above which one segment determines it: without it u is three times larger."""
_INFLUENTIAL = 3.0
"""A segment is influential if it shifts a coefficient by more than this many standard uncertainties."""
_MOVED = 1.0
"""The same for a segment whose rate is an outlier among rates that scatter."""
_UNLIKELY = 4.5
"""Least shift in standard deviations of such a shift by noise: 1 in 150 000."""
_MOST_SEGMENTS = 500
"""Most segments for leaving out one at a time."""
_SENTENCES = 4
"""Most sentences of a kind; the table of the segments shows all."""
_ALONE = 1e-9
"""Remainder ``1 - B_j`` below which a segment alone has a combination of the parameters."""
_FEWEST = 5
"""Fewest positions that are tested: with fewer their scatter is hardly known."""
_TIMES = (1 / 48, 1 / 24, 1 / 12, 1 / 6, 1 / 3)
"""Time constants over the median length of a position."""
_NEAR = (0.7, 0.84, 1.0, 1.2, 1.4)
"""Time constants beside the best one that are then tried, relative to it."""
_FEWEST_SAMPLES = 2
"""Fewest samples in a time constant."""
_REST = 0.1
"""Largest shift of a coefficient, in its standard uncertainties, that is left after the time advised for ``settle``."""


def find_leverage(
    fit: JointFit, quiet: JointFit, coefficients: tuple[Coefficient, ...]
) -> tuple[dict[str, SegmentLeverage], tuple[str, ...], tuple[tuple[float, str], ...]]:
    """Leverage of every segment by label, and sentences: segments that determine a coefficient alone, and that move one.

    Those that move one come with the shift. ``fit`` and ``quiet`` are the fit of one run, and the same without the scatter of the
    positions. If they scatter, all segments move coefficients by more than the noise explains. A segment is then named only if
    its rate is an outlier among the others. ``coefficients`` are the result: shifts are in their combined standard
    uncertainties. The leverages are together the number of parameters; a share is ``1 - (u/u_without)^2``. Empty for several
    runs, for one segment, and beyond ``_MOST_SEGMENTS``.
    """
    layout, estimate, repetitions = quiet.layout, quiet.estimate, quiet.repetitions(quiet.estimate)
    labels = fit.only.design.run.labels if fit.only else ()
    if not 1 < len(labels) <= _MOST_SEGMENTS:
        return {}, (), ()
    local = estimate.phases.size > 1
    at = list(range(layout.size + (0 if local else estimate.phases.size)))
    rows = [parameter_rows(layout, estimate, r, at, local=local) for r in repetitions]
    parts = [without_rate(part, r.variance) for part, r in zip(rows, repetitions, strict=True)]
    inverse, value, vector, score = unit_information(parts)
    root = inverse @ vector
    rest = 1.0 / np.maximum(1.0 - value, _ALONE)
    changes = -np.einsum("jab,jb->ja", root, rest * score)
    kept = [i for i, c in enumerate(coefficients) if c.segment is None]
    common = [coefficients[i] for i in kept]
    std = [_std(quiet, at, one)[kept] for one in np.einsum("jab,jb,jcb->jac", root, rest, root)]
    whole = _std(quiet, at, inverse @ inverse.T)[kept]
    table: dict[str, SegmentLeverage] = {}
    for j, label in enumerate(labels):
        change = np.zeros(layout.size + estimate.phases.size)
        change[at] = changes[j]
        moved, share = quiet.moved(change)[kept], np.maximum(1.0 - (whole / std[j]) ** 2, 0.0)
        only = value[j].max() > 1.0 - _ALONE
        table[label] = SegmentLeverage(
            float(value[j].sum()) + local,
            {c.name: float(own) for c, own in zip(common, share, strict=True)},
            {c.name: None if only else float(own) / c.std for c, own in zip(common, moved, strict=True)},
        )
    named, least = (labels, _INFLUENTIAL) if quiet is fit else (_odd_segments(rows, labels), _MOVED)
    noise = (whole / [c.std for c in common]).tolist()
    return table, *_in_words(table, common, noise, named, least)


def _in_words(
    table: dict[str, SegmentLeverage],
    common: list[Coefficient],
    noise: list[float],
    named: Sequence[str],
    least: float,
) -> tuple[tuple[str, ...], tuple[tuple[float, str], ...]]:
    """Segments that determine a coefficient alone, and those of ``named`` that move one by more than ``least``, beyond noise.

    ``noise``: the part of the noise in the standard uncertainty of each coefficient.
    """
    alone, moving = list[str](), list[tuple[float, str]]()
    for label, row in table.items():
        sole = [c.name for c in common if row.share[c.name] > _DETERMINES]
        if sole:
            words = (
                f"{', '.join(sole)} {'rests' if len(sole) == 1 else 'rest'} on segment '{label}' alone (more than "
                f"{100.0 * _DETERMINES:.0f} % of the information): no residual shows an error there; "
                "add a position or level like it"
            )
            alone.append(words)
        for c, part in zip(common, noise, strict=True):
            share, shift = row.share[c.name], row.shift[c.name]
            if label not in named or shift is None or share > _DETERMINES or abs(shift) <= least:
                continue
            usual = part * math.sqrt(share / (1.0 - share))
            if abs(shift) > _UNLIKELY * usual:
                words = (
                    f"without segment '{label}' {c.name} changes by {shift:+.1f} standard uncertainties (noise would "
                    f"explain {usual:.1g}): look at that segment"
                )
                moving.append((abs(shift), words))
    moving.sort(key=lambda item: -item[0])
    return tuple(alone[:_SENTENCES]), tuple(moving[:_SENTENCES])


def _std(fit: JointFit, at: list[int], covariance: Array) -> Array:
    """Standard uncertainties of the coefficients (file units) from the covariance of some parameters."""
    whole = np.zeros((fit.layout.size + fit.estimate.phases.size,) * 2)
    whole[np.ix_(at, at)] = covariance
    return np.array([c.std for c in fit.named(fit.estimate, whole)[0]])


def _odd_segments(rows: Sequence[Array], labels: Sequence[str]) -> tuple[str, ...]:
    """Labels of the segments whose residual rate is far from the others, in terms of their median deviation."""
    rate = np.array(
        [part[:, -2] @ part[:, -1] / max(float(part[:, -2] @ part[:, -2]), 1e-300) for part in rows]
    )
    away = np.abs(rate - np.median(rate))
    odd = away > _UNLIKELY * np.median(away) / NORMAL_MEDIAN
    return tuple(label for label, far in zip(labels, odd, strict=True) if far)


@dataclass(frozen=True)
class _Test:
    """Estimate of a creep, its standard uncertainty, and its probability by chance; ``fall`` is that of the sum of squares.

    ``rows`` are the triangles ``[model | rate | creep | y]`` of the positions.
    """

    time: float
    by_move: bool
    rows: list[Reduction]
    size: float
    std: float
    chance: float
    fall: float


def find_creep(fit: JointFit, coefficients: tuple[Coefficient, ...]) -> tuple[Creep | None, str]:
    """The likeliest creep of the runs with raw data, and a sentence if it is seen; None if none was tested.

    A run with too few positions, or no position long enough, is not tested. ``coefficients`` are those of the result, with
    combined standard uncertainties.
    """
    tested = [(k, _creep_of(fit, k, live, coefficients)) for k, live in enumerate(fit.live) if live]
    creeps = [(k, creep) for k, creep in tested if creep]
    if not creeps:
        return None, ""
    index, best = max(creeps, key=lambda item: (item[1].seen, item[1].largest_shift, -item[1].probability))
    best, live = replace(best, probability=min(1.0, len(creeps) * best.probability)), fit.live[index]
    return best, _creep_in_words(fit.summaries[index].name, live, best) if live and best.seen else ""


def _creep_of(fit: JointFit, index: int, live: Fit, coefficients: tuple[Coefficient, ...]) -> Creep | None:
    (design, values), positions = fit.design_of(index, live), Positions.of(live.design.run)
    begin, end = positions.times(live.design.run)
    length = float(np.median(end - begin))
    times = [part * length for part in _TIMES if part * length >= _FEWEST_SAMPLES * live.design.run.median_step]
    if positions.continuous or positions.count < _FEWEST or not times:
        return None
    tries = _tests(live, design, values, positions, times)
    if not tries:
        return None
    clear = [test for test in tries if test.chance * len(tries) < CREEP_ALARMS]
    best = min(tries, key=lambda test: test.chance)
    chance = min(1.0, best.chance * len(tries))
    if clear:
        best = max(clear, key=lambda test: test.fall)
        near = _tests(live, design, values, positions, [best.time * part for part in _NEAR])
        best = max((test for test in near if test.by_move == best.by_move), key=lambda test: test.fall)
    jacobians, first = fit.estimate.jacobians, fit.first_group(index)
    variances, score = live.noise.rate_variances(positions.count).tolist(), np.zeros(fit.estimate.parameters)
    for own, variance, group in zip(best.rows, variances, design.groups, strict=True):
        part = own.without((RATE,), variance)
        score += jacobians[first + group].T @ part.factor[:, :-2].T @ part.factor[:, -2]
    shifts = zip(coefficients, fit.moved(-best.size * (fit.estimate.inverse @ score)), strict=True)
    scale = design.scale_factor * (1.0 if best.by_move else G0)
    return Creep(
        best.size / scale,
        best.std / scale,
        best.time,
        best.by_move,
        chance,
        {c.key: float(shift) / c.std for c, shift in shifts if c.std > 0.0},
    )


def _tests(live: Fit, design: Design, values: Array, positions: Positions, times: list[float]) -> list[_Test]:
    """The tests of all time constants [s], of the same size at each position and by the move; without those that are nowhere."""
    from scipy.special import stdtr

    names, m, force = tuple(map(str, range(len(times)))), len(design.names), live.design.run.f[:, 0]
    extra = Extra(names, lambda block: _decays(design, positions, block, times))
    parts = reduce_positions(design, live.noise, positions, extra)
    means = np.add.reduceat(force, positions.edges[:-1]) / np.diff(positions.edges)
    tests = []
    for by_move, moves in ((False, np.ones(positions.count)), (True, np.diff(means, prepend=means[0]))):
        for name, time in zip(names, times, strict=True):
            rows = [part.select((*design.names, RATE, name)) for part in parts]
            shapes = []
            for own, segment, move in zip(rows, positions.segments.tolist(), moves, strict=True):
                own.factor[:, m + 1] *= move
                missed = own.factor[:, -1] - own.factor[:, :m] @ values[segment]
                shapes.append(triangle(np.column_stack([own.factor[:, m : m + 2], missed]))[1:, 1:])
            square = sum(float(shape[0, 0] ** 2) for shape in shapes)
            if square > 0.0:
                size = sum(float(shape[0, 0] * shape[0, 1]) for shape in shapes) / square
                (std,), (degrees,), _ = scatter_of(shapes)
                chance = 2.0 * float(stdtr(degrees, -abs(size) / max(float(std), 1e-300)))
                tests.append(_Test(time, by_move, rows, size, float(std), chance, size**2 * square))
    return tests


def _decays(design: Design, positions: Positions, block: Block, times: list[float]) -> Array:
    """Rows ``[times | rows]`` of a block: the integral of ``exp(-age/time)`` over each interval; for a rate log its value."""
    run, constants = design.means.run, np.array(times)[:, None]
    samples = slice(block.start - (not design.point), block.stop)
    begin = design.run.t[positions.edges[block.segment]]
    out: Array = np.exp(-np.maximum(run.t[samples] - begin, 0.0) / constants)
    if not design.point:
        out = -constants * np.diff(out)
        out[:, run.begins[block.start : block.stop]] = 0.0
    if run.left_out is not None:
        left_out = run.left_out[block.start : block.stop]
        if design.point:
            out[:, left_out] = 0.0
        else:
            merge_rows(out, np.where(left_out, -1.0, block.h), left_out)
    return out


def _creep_in_words(name: str, live: Fit, creep: Creep) -> str:
    """The creep of a run, what it does to the coefficients, and the remedy."""
    run, run_words = live.design.run, f"run '{name}': " if name else ""
    size, std = 1e6 * creep.size, 1e6 * creep.standard_uncertainty
    per = " for a change of a_x by 1 g" if creep.by_move else ""
    moved = sorted(creep.shift.items(), key=lambda item: -abs(item[1]))[:3]
    shifts = ", ".join(f"{key} by {abs(shift):.2g} u" for key, shift in moved)
    begin, end = Positions.of(run).times(run)
    wait = math.ceil(creep.time_constant * math.log(max(creep.largest_shift / _REST, math.e)))
    more = "more " if any(event.kind == "settling" for event in run.quality.events) else ""
    key = f' ([data] settle = "{wait} s")' if run.source and not more else ""
    remedy = (
        f"leave out the first {wait} s {more}of each position{key}"
        if wait < 0.5 * float(np.median(end - begin))
        else f"wait {wait} s after each move, or stay longer at each position"
    )
    return (
        f"{run_words}a creep after each move: the bias begins {size:.3g} +/- {std:.2g} ug{per} off and decays in about "
        f"{creep.time_constant:.2g} s; it moves {shifts}: {remedy}"
    )
