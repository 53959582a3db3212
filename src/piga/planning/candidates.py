"""Candidates of a plan, and the prediction of its result.

Positions and levels, and the information from a visit of given duration.
The information is that of the estimator. The stand and the exact motion give a noiseless record of visits to all candidates.
Its regressors are whitened with the noise model of the calibration.

A result is predicted by calibrating the noiseless record of the test, with the covariance of the estimator. The rounding of
counts is not white where the output turns evenly: what is then stated is that of records with counts and noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from piga.calibration.joint import JointFit, effects, merge_runs, with_sources
from piga.calibration.model.design import Design
from piga.calibration.summary import RunSummary
from piga.calibration.weights import (
    RATE,
    Extra,
    Noise,
    counted_rates,
    reduce_positions,
    weighting_mode,
)
from piga.errors import CalibrationError, IdentifiabilityError
from piga.planning.plan_file import PlanRequest, request_of
from piga.records.calibration.coefficient import Coefficient, coverage_factor
from piga.records.run import Run
from piga.results import Array, Result
from piga.stand import Composite, simulate_test
from piga.stand.profile import NONE, Stand
from piga.stand.scenario import (
    CentrifugeTable,
    DividingHeadTable,
    SimpleStand,
)

_COUNTED_RECORDS = 24
"""Records with counts and noise whose stated uncertainties are those of a plan (own choice)."""
_STEP = 1e-6
"""Change of a coefficient [SI] by which the internal parameters are turned into those of the file."""
_SAMPLES = 1 << 18
"""Most samples of a record of candidates, moves counted: more candidates are simulated in several records."""


@dataclass(frozen=True)
class Candidate:
    """One position or level: ``table`` is the stand with only this one; ``force`` [m/s^2] (3,) in base axes.

    ``margin`` is ``|u_x|/(u_t tan_beta)``: below 1 the instrument is locked. ``revolution`` [s] is the time
    of one revolution of the gimbal. Both are infinite for a direct instrument.
    """

    label: str
    table: SimpleStand
    force: tuple[float, float, float]
    margin: float
    revolution: float

    def stand(self, dwell: float, request: PlanRequest) -> Stand:
        """The stand held here for ``dwell`` [s]."""
        table = msgspec.structs.replace(self.table, dwell=f"{dwell!r} s")
        return table.build(request.path.parent)


def find_candidates(request: PlanRequest) -> tuple[Candidate, ...]:
    """All positions and levels of the stand, in its order."""
    return tuple(
        candidate_of(request, label, table)
        for stand in request.stands
        for label, table in _single(request, stand)
    )


def _single(request: PlanRequest, stand: SimpleStand) -> list[tuple[str, SimpleStand]]:
    """Tables with one position or level each."""
    built = stand.build(request.path.parent)
    replace = msgspec.structs.replace
    if isinstance(stand, DividingHeadTable):
        degrees = [round(math.degrees(x), 9) for x in built.positions]  # type: ignore[attr-defined]
        roll = f" roll {stand.roll}" if stand.roll else ""
        return [(f"{x:.6g} deg{roll}", replace(stand, positions=(f"{x!r} deg",))) for x in degrees]
    if isinstance(stand, CentrifugeTable) and stand.levels is not None:
        sign = "-" if stand.outward else ""
        return [(f"{sign}{level}", replace(stand, levels=(level,), down=False)) for level in stand.levels]
    rates = getattr(stand, "rates", None)
    down = {"down": False} if isinstance(stand, CentrifugeTable) else {}
    return [(f"{rate}", replace(stand, rates=(rate,), **down)) for rate in rates or ()]


def candidate_of(request: PlanRequest, label: str, table: SimpleStand) -> Candidate:
    """A candidate with its force, its distance from the lock zone and its time of revolution."""
    specimen = request.scenario.specimen
    K, tangent = specimen.instrument.scale_factor, abs(specimen.instrument.tan_beta)
    stand = msgspec.structs.replace(table, dwell="60 s").build(request.path.parent)
    force, rate = stand.motion(np.arange(61.0), NONE)
    x, y, z = (float(value) for value in force.mean(axis=0))
    if specimen.direct:
        return Candidate(label, table, (x, y, z), math.inf, math.inf)
    u = K * force - rate
    along, across = np.abs(u[:, 0]), tangent * np.hypot(u[:, 1], u[:, 2])
    margin = float(np.min(along / np.maximum(across, 1e-300))) if across.any() else math.inf
    mean = float(np.mean(np.sqrt(np.maximum(along**2 - across**2, 0.0))))
    revolution = 2.0 * math.pi / mean if mean > 0.0 else math.inf
    return Candidate(label, table, (x, y, z), margin, revolution)


def _noise_of(request: PlanRequest) -> Noise:
    """Noise of the output as the estimator models it: quantisation and angle noise, random walk."""
    e = request.scenario.electronics
    count = (1.0 if request.direct else 2.0 * math.pi / e.counts_per_revolution) if e.kind == "counts" else 0.0
    white = 0.0 if e.kind == "rate" else e.angle_noise**2 + count**2 / 12.0
    noise = Noise(white, e.angle_random_walk**2)
    if noise.white + noise.walk == 0.0 or (e.kind == "rate" and noise.walk == 0.0):
        raise CalibrationError(
            "[electronics] has no noise: every plan is perfect",
            remedy="give angle_random_walk or angle_noise, e.g. from [noise] of a calibration",
        )
    return noise


def coefficient_names(request: PlanRequest) -> tuple[str, ...]:
    """Coefficients common to all positions, in the order of the request; ``phi`` follows tan_beta if it is common."""
    names: list[str] = []
    for name in request.model.terms:
        names += [name, "phi"] if name == "tan_beta" and request.model.phases == "shared" else [name]
    return tuple(names)


def whole_samples(request: PlanRequest, dwell: float) -> float:
    """The dwell [s], cut to whole samples."""
    interval = request.scenario.electronics.interval
    return round(math.floor(dwell / interval + 1e-6) * interval, 9)


@dataclass(frozen=True)
class Visit:
    """A candidate held for ``dwell`` [s]."""

    candidate: Candidate
    dwell: float


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Result):
    """Predicted result of a test.

    ``coefficients`` have standard uncertainties of Type A and the degrees of freedom that the scatter of
    the positions will have. ``type_b`` (n,) is the standard uncertainty by the stand. File units. ``refusal`` gives the reason if
    there is no result, or if :func:`piga.calibrate` would refuse the record. ``covariance`` is that of the weights: visits are
    chosen by it, because a scatter that few positions show is often too small by chance.
    """

    name: str
    visits: tuple[Visit, ...]
    duration: float
    coefficients: tuple[Coefficient, ...] = ()
    covariance: Array | None = None
    type_b: Array | None = None
    refusal: str = ""

    @property
    def recorded(self) -> float:
        """Sum of the dwells [s]."""
        return sum(visit.dwell for visit in self.visits)

    def _own(self, name: str) -> tuple[float, float, float]:
        """Standard uncertainties of a coefficient of Type A and by the stand, and the degrees of freedom of the first."""
        by_stand = np.zeros(len(self.coefficients)) if self.type_b is None else self.type_b
        for c, u in zip(self.coefficients, by_stand.tolist(), strict=True):
            if c.name == name:
                return (c.std if c.segment is None else math.inf), u, float(c.degrees_of_freedom or math.inf)
        return math.inf, 0.0, 0.0

    def std(self, name: str) -> float:
        """Type A standard uncertainty of a coefficient; infinite if it is not determined."""
        return self._own(name)[0]

    def by_stand(self, name: str) -> float:
        """Standard uncertainty of a coefficient by the stand."""
        return self._own(name)[1]

    def combined(self, name: str) -> float:
        """Combined standard uncertainty of a coefficient."""
        return float(np.hypot(*self._own(name)[:2]))

    def degrees(self, name: str) -> float:
        """Degrees of freedom of the Type A standard uncertainty of a coefficient."""
        return self._own(name)[2]

    def expanded(self, name: str) -> float:
        """Half width of the 95 % interval that the calibration will state: Student's t, Welch and Satterthwaite."""
        whole = self.combined(name)
        if not math.isfinite(whole):
            return math.inf
        return coverage_factor(self.degrees(name) * (whole / max(self.std(name), 1e-300)) ** 4) * whole


def _reduced(request: PlanRequest, run: Run) -> tuple[Design, str, RunSummary]:
    """Columns of the noiseless record of a test, mode of its weights, and its summary."""
    noise, wish = _noise_of(request), request_of(request.model)
    noise = replace(noise, counted=counted_rates(run, noise.white))
    design = Design(run, wish, run.scale_factor)
    mode = weighting_mode(design, "information")
    return design, mode, RunSummary.of_rows(design, noise, reduce_positions(design, mode, noise))


def _reduced_tests(request: PlanRequest, candidates: tuple[Candidate, ...], dwells: Array) -> list[RunSummary]:
    """Summary of a noiseless test of all candidates for each of the ``dwells``: the longest, cut to the shorter ones.

    It is in several records, so that many candidates need little memory.
    """
    interval, longest = request.scenario.electronics.interval, float(dwells[-1])
    records = math.ceil(len(candidates) * (longest + request.move) / interval / _SAMPLES)
    parts = []
    for chosen in np.array_split(np.arange(len(candidates)), max(min(records, len(candidates) // 2), 1)):
        run = noiseless_run(request, tuple(Visit(candidates[k], longest) for k in chosen))
        reduced = []
        for dwell in dwells[::-1]:
            since = run.t - run.t[run.segment_edges()[:-1]][run.segment_index]
            late = since > dwell + 0.5 * interval
            run = run.without(late) if late.any() else run
            reduced.append(_reduced(request, run)[2])
        parts.append(reduced[::-1])
    return [_joined(request, of_dwell) for of_dwell in zip(*parts, strict=True)]


def _joined(request: PlanRequest, parts: Sequence[RunSummary]) -> RunSummary:
    """One summary of records with one zero of the output, one after the other."""
    labels, positions, counted = parts[0].labels, parts[0].positions, parts[0].noise.counted
    for part in parts[1:]:
        start, group = positions[-1].end + request.move, 0
        if request.model.phases != "shared":
            group, labels = len(labels), labels + part.labels
        positions += tuple(
            replace(one, group=one.group + group, begin=one.begin + start, end=one.end + start)
            for one in part.positions
        )
        counted += part.noise.counted
    noise = replace(parts[0].noise, counted=counted)
    return replace(parts[0], noise=noise, labels=labels, positions=positions)


def _solved(request: PlanRequest, summary: RunSummary) -> JointFit:
    return merge_runs([summary], tuple(request.model.terms))


def information_tables(request: PlanRequest, candidates: tuple[Candidate, ...], dwells: Array) -> Array:
    """Information on the coefficients from a visit of each of the ``dwells`` (d,) [s] at each candidate, (n, d, m, m).

    Coefficients in the order of :func:`coefficient_names`, file units; a phase per segment is eliminated (Schur complement).

    Raises
    ------
    IdentifiabilityError
        If all candidates together, each visited twice, cannot determine the terms.
    """
    tests = _reduced_tests(request, candidates, dwells)
    try:
        fit = _solved(request, _joined(request, 2 * tests[:1]))
    except IdentifiabilityError as error:
        raise IdentifiabilityError(_of_plan(error), remedy=error.remedy) from None
    m = len(coefficient_names(request))
    common = [k for k, c in enumerate(fit.coefficients) if c.segment is None]
    step = _STEP * fit.summaries[0].scale_factor
    by_name = np.linalg.inv(
        [fit.moved(step * row)[common] / step for row in np.eye(fit.estimate.parameters)[:m]]
    ).T
    tables = np.empty((len(candidates), len(dwells), m, m))
    for k, summary in enumerate(tests):
        once = replace(fit, summaries=(summary,))
        for place, position in enumerate(once.positions(0, fit.estimate)):
            factor = position.part.without((RATE,), position.variance).factor[:, :-1]
            rows = factor @ fit.estimate.jacobians[position.group]
            own = rows[:, m + position.group :][:, :1]  # the phase of the visit alone; empty if it is common
            rows = rows[:, :m] - own @ (own.T @ rows[:, :m]) / max(float(np.sum(own**2)), 1e-300)
            tables[place, k] = by_name.T @ rows.T @ rows @ by_name
    return tables


def _of_plan(error: IdentifiabilityError) -> str:
    return error.message.replace("record", "plan", 1)


def predict(request: PlanRequest, name: str, visits: tuple[Visit, ...]) -> Prediction:
    """Predicted uncertainty of a test, from the estimator itself; ``refusal`` if the calibration would refuse the record."""
    duration = sum(visit.dwell for visit in visits) + request.move * (len(visits) - 1)
    try:
        design, mode, summary = _reduced(request, noiseless_run(request, visits))
        fit = _solved(request, summary)
    except IdentifiabilityError as error:
        return Prediction(name, visits, duration, refusal=_of_plan(error))
    named, covariance = fit.named(fit.estimate, fit.estimate.covariance)
    if design.run.resolution > 0.0:
        stated = _stated_with_counts(request, design, mode, fit)
        named = tuple(replace(c, std=float(u)) for c, u in zip(named, stated, strict=True))
    coefficients = tuple(
        replace(c, degrees_of_freedom=float(nu)) for c, nu in zip(named, fit.degrees, strict=True)
    )
    values = fit.values_in_segments(design, fit.estimate)
    moved = replace(fit, summaries=(with_sources(summary, design, design, values, mode),))
    squares = sum(
        (np.sum(change**2, axis=0) for _, change in effects(moved, stated=True)), np.zeros(len(named))
    )
    return Prediction(name, visits, duration, coefficients, covariance, np.sqrt(squares))


def _stated_with_counts(request: PlanRequest, design: Design, mode: str, fit: JointFit) -> Array:
    """Root mean square of the Type A standard uncertainties that records with counts and noise state (file units).

    What the counts add to the noiseless output of each record is one more column of the same reduction.
    """
    e, whole, summary = request.scenario.electronics, design.run, fit.summaries[0]
    rng, count = np.random.default_rng(0), whole.resolution
    walk = e.angle_random_walk * math.sqrt(whole.median_step)
    rows, changes = design.means, []
    for _ in range(_COUNTED_RECORDS):
        noisy = whole.output + rng.uniform(0.0, count) + walk * np.cumsum(rng.standard_normal(whole.size))
        noisy += e.angle_noise * rng.standard_normal(whole.size)
        added = np.round(noisy / count) * count - whole.output
        changes.append(np.diff(rows.means_of(added), prepend=0.0))
    columns = np.where(rows.run.begins, 0.0, changes)
    names = tuple(f"record {k}" for k in range(_COUNTED_RECORDS))
    extra = Extra(names, lambda block: columns[:, block.start : block.stop])
    parts, stated = reduce_positions(design, mode, summary.noise, extra=extra), []
    model = (*design.names, RATE)
    for k in range(_COUNTED_RECORDS):
        matrix = np.zeros((len(model) + _COUNTED_RECORDS + 1, len(model) + 1))
        matrix[: len(model), : len(model)] = np.eye(len(model))
        matrix[[len(model) + k, -1], -1] = 1.0
        pairs = zip(summary.positions, parts, strict=True)
        record = tuple(replace(position, part=part.mixed(model, matrix)) for position, part in pairs)
        counted = merge_runs([replace(summary, positions=record)], fit.terms)
        stated.append([c.std for c in counted.coefficients])
    return np.asarray(np.sqrt(np.mean(np.square(stated), axis=0)))


def noiseless_run(request: PlanRequest, visits: tuple[Visit, ...]) -> Run:
    """The record of the test without noise and imperfections, with the data for its budget."""
    stand = Composite(tuple(visit.candidate.stand(visit.dwell, request) for visit in visits), request.move)
    e = request.scenario.electronics
    quiet = replace(
        e,
        kind="rate" if e.kind == "rate" else "angle",
        angle_noise=0.0,
        angle_random_walk=0.0,
        clock_offset=0.0,
        clock_jitter=0.0,
        counter_bits=None,
    )
    log = simulate_test(stand, request.scenario.specimen, quiet).log
    run = Run.from_arrays(
        log.t,
        log.output,
        log.reference,
        scale_factor=request.scenario.specimen.instrument.scale_factor,
        kind=quiet.kind,
        base_rate=None if request.direct else log.base_rate,
        segment=log.segment,
        unit=request.unit,
        serial=request.table.instrument.serial,
        units="SI",
    )
    servo = request.table.instrument.servo
    return replace(
        run,
        servo=run.servo if servo is None else servo.parameters(),
        uncertainty=request.uncertainty,
        stand=stand_table(request, visits),
        source=str(request.path),
        resolution=2.0 * math.pi / e.counts_per_revolution
        if e.kind == "counts" and not request.direct
        else 0.0,
    )


def stand_table(request: PlanRequest, visits: tuple[Visit, ...]) -> dict[str, Any]:
    """``[stand]`` of a scenario that visits these candidates: a composite with one part each."""
    parts = []
    for visit in visits:
        table = msgspec.structs.replace(visit.candidate.table, dwell=f"{visit.dwell!r} s")
        parts.append(msgspec.to_builtins(table))
    return {"kind": "composite", "pause": f"{request.move!r} s", "parts": parts}
