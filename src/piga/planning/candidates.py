"""The plan file (TOML), its candidates, and the prediction of a test.

A plan file is a scenario: ``[truth]`` gives the expected instrument, ``[stand]`` the candidate positions or levels,
``[electronics]`` the noise. ``[plan]`` has the wishes for the test.

The information of a visit is that of the estimator: stand and exact motion give a noiseless record of visits to all candidates,
whose regressors are whitened with the noise model of the calibration. A result is predicted by calibrating the noiseless record
of the test. The rounding of counts is not white where the output turns evenly: what is then stated is that of records with counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from piga.calibration.joint import JointFit, effects, merge_runs, with_sources
from piga.calibration.model.design import Design
from piga.calibration.model.request import Request, check_servo, with_phase
from piga.calibration.summary import RunSummary
from piga.calibration.weights import RATE, Extra, Noise, counted_rates, reduce_positions
from piga.errors import CalibrationError, IdentifiabilityError, PigaError, RunFileError, UnitError
from piga.instrument.electronics import Electronics
from piga.records.calibration.coefficient import Coefficient, coverage_factor
from piga.records.run import Run
from piga.records.run_file import ModelTable, Quantity, Seconds, TomlTable, UncertaintyTable
from piga.records.terms import GYRO, check_terms, scale_factor_in, si_factor, unit_of
from piga.results import Array, Result
from piga.stand import Composite, simulate_test
from piga.stand.profile import NONE
from piga.stand.scenario import (
    CentrifugeTable,
    CompositeTable,
    DividingHeadTable,
    NoiseTable,
    ProfileTable,
    RateTableTable,
    Scenario,
    ScenarioTable,
    SimpleStand,
    head_positions,
    output_unit,
    scenario_of,
)
from piga.terms import LOGGED_TERMS
from piga.text_files import convert_table, read_toml
from piga.units import to_si

_COUNTED_RECORDS = 24
"""Records with counts and noise whose stated uncertainties are those of a plan (own choice)."""
_STEP = 1e-6
"""Change of a coefficient [SI] by which the internal parameters are turned into those of the file."""
_SAMPLES = 1 << 18
"""Most samples of a record of candidates, moves counted: more are in several records, which need little memory."""
_PlannedStand = DividingHeadTable | CentrifugeTable | RateTableTable
"""Stands whose positions or levels can be chosen one by one."""
_TIMELY = ("k0_t", *LOGGED_TERMS)
"""Terms whose information depends on the time of a visit, not only on its duration."""


class PlanSettings(TomlTable, frozen=True):
    """``[plan]``: time, limits and criterion.

    ``criterion`` D: least volume of the uncertainty ellipsoid of ``coefficients``; A: least mean variance,
    each over its ``wanted`` (or equal-time) variance; c: least variance of ``combination``; wanted: least
    largest ratio to ``wanted``.
    """

    duration: Seconds
    criterion: Literal["D", "A", "c", "wanted"] = "D"
    coefficients: tuple[str, ...] | None = None
    combination: dict[str, float] = msgspec.field(default_factory=dict)
    wanted: dict[str, Quantity] = msgspec.field(default_factory=dict)
    move: Seconds | None = None
    minimum_dwell: Seconds = "30 s"
    longest_dwell: Seconds = "600 s"
    margin: float = 2.0
    whole_revolutions: bool = True
    shuffle: bool = True


class MountingTable(TomlTable, frozen=True):
    """``[mounting]``: a profile of the platform, and the skew angles to try."""

    profile: ProfileTable | _PlannedStand
    skew: str = "0:91:1 deg"
    clock: str = "0:360:15 deg"
    step: Seconds = "0.1 s"
    margin: float = 2.0


class PlanTable(ScenarioTable, frozen=True, kw_only=True):
    """A whole plan file."""

    plan: PlanSettings
    mounting: MountingTable | None = None

    @property
    def stands(self) -> tuple[SimpleStand, ...]:
        """The parts of the stand, one unless it is a composite."""
        return self.stand.parts if isinstance(self.stand, CompositeTable) else (self.stand,)


@dataclass(frozen=True, eq=False, repr=False)
class PlanRequest(Result):
    """A plan file in SI; times in s, ``wanted`` by coefficient key in file units. ``move`` is in whole samples."""

    path: Path
    table: PlanTable
    scenario: Scenario
    model: ModelTable
    uncertainty: UncertaintyTable
    duration: float
    move: float
    minimum_dwell: float
    longest_dwell: float
    wanted: dict[str, float]

    @property
    def unit(self) -> str:
        """Unit of the output rate."""
        return self.scenario.specimen.unit

    @property
    def direct(self) -> bool:
        """True for a direct instrument: it has no lock zone and no revolutions."""
        return self.scenario.specimen.direct

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficients common to all positions; ``phi`` follows tan_beta if it is common."""
        phase = {"tan_beta": ("tan_beta", "phi")} if self.model.phases == "shared" else {}
        return tuple(name for term in self.model.terms for name in phase.get(term, (term,)))

    def whole_samples(self, dwell: float) -> float:
        """The dwell [s], cut to whole samples."""
        interval = self.scenario.electronics.interval
        return round(math.floor(dwell / interval + 1e-6) * interval, 9)


def read_plan(path: str | Path, *, content: str | None = None) -> PlanRequest:
    """Read a plan file.

    ``content`` is the text of the file, for one that is not on disk. ``path`` is then its name in messages, and where the files
    that it names are looked for.

    Raises
    ------
    RunFileError
        For an unknown key, a wrong unit or a request that cannot be planned; names file and key.
    """
    path = Path(path)
    table = read_toml(path, PlanTable, None if content is None else content.encode())
    try:
        model: ModelTable = convert_table("model", table.model, ModelTable)
        uncertainty: UncertaintyTable = convert_table("uncertainty", table.uncertainty, UncertaintyTable)
        check_terms(model.terms, where="[model] terms", output=output_unit(table))
        times = table.plan.in_si("[plan] ")
        moves = [one.in_si("[stand] ") for one in (table.stand, *table.stands)]
        longest = max((si[key] for si in moves for key in ("move", "ramp", "pause") if key in si), default=0.0)
        times.setdefault("move", longest)
        _refuse(table, model, times)
        check_servo(request_of(model))
        wanted, scenario = _wanted(table), scenario_of(path, table)
        interval = scenario.electronics.interval
        times["move"] = round(math.ceil(times["move"] / interval - 1e-6) * interval, 9)
        return PlanRequest(path, table, scenario, model, uncertainty, wanted=wanted, **times)
    except (PigaError, UnitError) as error:
        if error.message.startswith(f"{path}:"):
            raise
        raise RunFileError(f"{path}: {error.message}", remedy=error.remedy) from None


def request_of(model: ModelTable) -> Request:
    """The request that the calibration of the test will make."""
    return Request(tuple(model.terms), model.phases, model.phase_source, "information", None, None, 293.15)


def _refuse(table: PlanTable, model: ModelTable, times: dict[str, float]) -> None:
    """Refuse what the information of single positions cannot answer, and times that hold no test."""
    timely = ", ".join(name for name in model.terms if name in _TIMELY)
    fixed = [str(one.__struct_config__.tag) for one in table.stands if not isinstance(one, _PlannedStand)]
    electronics, phase, plan = table.electronics, "tan_beta" in model.terms, table.plan
    mounting = table.mounting
    known = [*model.terms, *(["phi"] if phase and model.phases == "shared" else [])]
    wished = {"coefficients": plan.coefficients or (), "combination": plan.combination, "wanted": plan.wanted}
    no_rate = electronics.output == "rate" and model.phases == "shared" and with_phase(model.terms)
    for refused, words, remedy in (
        (mounting is not None and output_unit(table) != GYRO,
         "[mounting] belongs to a gyro accelerometer, and the instrument is direct", "leave it out"),
        (mounting is not None and not mounting.in_si("[mounting] ")["step"] > 0.0,
         "[mounting] step is not positive", "give a time above 0 s, e.g. '0.1 s'"),
        (timely, f"[model] terms: '{timely}' depends on when a position is taken and cannot be planned",
         "leave it out of the plan; it can still be estimated from the test"),
        (phase and not {"beta", "tan_beta"} & {*table.truth},
         "[truth] lacks beta: the uncertainty of its phase depends on the size of tan_beta",
         'add the expected size, e.g. beta = "20 arcsec"'),
        (no_rate, "[model] phases = 'shared': a log of rates does not tell how far the output turned in a move",
         "set phases = 'per-segment', or plan with output = 'counts' or 'angle'"),
        (electronics.bias_random_walk != 0.0, "[electronics] bias_random_walk is not part of the noise model of the estimator",
         "leave it out of the plan"),
        (table.noise != NoiseTable(), "[noise] is not part of the noise model of a plan: white noise and random walk are",
         "leave [noise] out of the plan"),
        (fixed, f"[stand] kind '{', '.join(fixed)}' has no positions or levels to choose from",
         "plan with a dividing head, centrifuge, rate table, or a composite of these"),
        *((name not in known, f"[plan] {key}: '{name}' is not estimated", f"estimated are: {', '.join(known)}")
          for key, names in wished.items() for name in names),
        *((plan.criterion == kind and not wished[key], f"[plan] criterion '{kind}' needs {key}",
           f"add {key} = {{ k0 = ... }}") for kind, key in (("c", "combination"), ("wanted", "wanted"))),
        *((not seconds > 0.0, f"[plan] {key}: {seconds:g} s is not positive", "give a time above 0 s")
          for key, seconds in times.items()),
        (times["longest_dwell"] < times["minimum_dwell"], "[plan] longest_dwell is below minimum_dwell",
         "make longest_dwell at least as long"),
        (times["duration"] < 2.0 * times["minimum_dwell"] + times["move"],
         "[plan] duration is below minimum_dwell twice with a move between: each position is visited twice",
         "give it more time"),
    ):  # fmt: skip
        if refused:
            raise RunFileError(words, remedy=remedy)


def _wanted(table: PlanTable) -> dict[str, float]:
    """Wanted standard uncertainties in file units."""
    wanted = {}
    for name, value in table.plan.wanted.items():
        what, scale = f"[plan] wanted.{name}", name == "scale_factor"
        si = (
            scale_factor_in(value, output_unit(table), what)
            if scale
            else to_si(value, unit_of(name), what=what)
        )
        if not si > 0.0:
            raise RunFileError(f"{what}: must be positive", remedy="give a standard uncertainty")
        wanted[name] = si / si_factor(name)
    return wanted


# -- candidates -------------------------------------------------------------------------------------------------


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


@dataclass(frozen=True)
class Visit:
    """A candidate held for ``dwell`` [s]."""

    candidate: Candidate
    dwell: float

    @property
    def table(self) -> SimpleStand:
        """The stand held here."""
        return msgspec.structs.replace(self.candidate.table, dwell=f"{self.dwell!r} s")


def find_candidates(request: PlanRequest) -> tuple[Candidate, ...]:
    """All positions and levels of the stand, in its order."""
    single: list[tuple[str, SimpleStand]] = []
    replace = msgspec.structs.replace
    for stand in request.table.stands:
        once = {"down": False} if isinstance(stand, CentrifugeTable) else {}
        if isinstance(stand, DividingHeadTable):
            roll = f" roll {stand.roll}" if stand.roll else ""
            degrees = [round(math.degrees(x), 9) for x in head_positions(stand.positions)]
            single += [(f"{x:.6g} deg{roll}", replace(stand, positions=(f"{x!r} deg",))) for x in degrees]
        elif isinstance(stand, CentrifugeTable) and stand.levels is not None:
            sign = "-" if stand.outward else ""
            single += [(f"{sign}{level}", replace(stand, levels=(level,), **once)) for level in stand.levels]
        else:
            single += [
                (f"{rate}", replace(stand, rates=(rate,), **once)) for rate in getattr(stand, "rates", ())
            ]
    return tuple(candidate_of(request, label, table) for label, table in single)


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


def stand_table(request: PlanRequest, visits: tuple[Visit, ...]) -> dict[str, Any]:
    """``[stand]`` of a scenario that visits these candidates: a composite with one part each."""
    parts = [msgspec.to_builtins(visit.table) for visit in visits]
    return {"kind": "composite", "pause": f"{request.move!r} s", "parts": parts}


# -- prediction -------------------------------------------------------------------------------------------------


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
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    type_b: Array = field(default_factory=lambda: np.zeros(0))
    refusal: str = ""

    @property
    def recorded(self) -> float:
        """Sum of the dwells [s]."""
        return sum(visit.dwell for visit in self.visits)

    def uncertainty(self, name: str) -> tuple[float, float, float]:
        """Standard uncertainties of a coefficient of Type A and by the stand, and the degrees of freedom of the first.

        The first is infinite if the coefficient is not determined.
        """
        for c, u in zip(self.coefficients, self.type_b.tolist(), strict=True):
            if c.key == name:
                return c.std, u, float(c.degrees_of_freedom or math.inf)
        return math.inf, 0.0, 0.0

    def std(self, name: str) -> float:
        """Type A standard uncertainty of a coefficient; infinite if it is not determined."""
        return self.uncertainty(name)[0]

    def combined(self, name: str) -> float:
        """Combined standard uncertainty of a coefficient."""
        return float(np.hypot(*self.uncertainty(name)[:2]))

    def expanded(self, name: str) -> float:
        """Half width of the 95 % interval that the calibration will state: Student's t, Welch and Satterthwaite."""
        whole, (std, _, degrees) = self.combined(name), self.uncertainty(name)
        if not math.isfinite(whole):
            return math.inf
        return coverage_factor(degrees * (whole / max(std, 1e-300)) ** 4) * whole


def predict(request: PlanRequest, name: str, visits: tuple[Visit, ...]) -> Prediction:
    """Predicted uncertainty of a test, from the estimator itself; ``refusal`` if the calibration would refuse the record."""
    duration = sum(visit.dwell for visit in visits) + request.move * (len(visits) - 1)
    try:
        design, summary = _reduced(request, noiseless_run(request, visits))
        fit = _solved(request, summary)
    except IdentifiabilityError as error:
        return Prediction(name, visits, duration, refusal=error.message)
    named, covariance = fit.named(fit.estimate, fit.estimate.covariance)
    if design.run.resolution > 0.0:
        stated = _stated_with_counts(request, design, fit)
        named = tuple(replace(c, std=float(u)) for c, u in zip(named, stated, strict=True))
    coefficients = tuple(
        replace(c, degrees_of_freedom=float(nu)) for c, nu in zip(named, fit.degrees, strict=True)
    )
    values = fit.values_in_segments(design, fit.estimate)
    moved = replace(fit, summaries=(with_sources(summary, design, design, values),))
    squares = sum(
        (np.sum(change**2, axis=0) for _, change in effects(moved, stated=True)), np.zeros(len(named))
    )
    return Prediction(name, visits, duration, coefficients, covariance, np.sqrt(squares))


def information_tables(request: PlanRequest, candidates: tuple[Candidate, ...], dwells: Array) -> Array:
    """Information on the coefficients from a visit of each of the ``dwells`` (d,) [s] at each candidate, (n, d, m, m).

    Coefficients in the order of ``request.names``, file units; a phase per segment is eliminated (Schur complement). The terms
    must be determined by all candidates together, each visited twice.
    """
    tests = _reduced_tests(request, candidates, dwells)
    fit, m = _solved(request, _joined(request, 2 * tests[:1])), len(request.names)
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


def _reduced_tests(request: PlanRequest, candidates: tuple[Candidate, ...], dwells: Array) -> list[RunSummary]:
    """Summary of a noiseless test of all candidates for each of the ``dwells``: the longest, cut to the shorter ones."""
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
            reduced.append(_reduced(request, run)[1])
        parts.append(reduced[::-1])
    return [_joined(request, of_dwell) for of_dwell in zip(*parts, strict=True)]


def _joined(request: PlanRequest, parts: Sequence[RunSummary]) -> RunSummary:
    """One summary of records with one zero of the output; of a phase per segment, each position is a group of its own."""
    positions = tuple(one for part in parts for one in part.positions)
    labels, counted = parts[0].labels, [count for part in parts for count in part.noise.counted]
    if request.model.phases != "shared":
        labels = tuple(str(k) for k in range(len(positions)))
        positions = tuple(replace(one, group=k) for k, one in enumerate(positions))
    noise = replace(parts[0].noise, counted=tuple(counted))
    return replace(parts[0], noise=noise, labels=labels, positions=positions)


def _solved(request: PlanRequest, summary: RunSummary) -> JointFit:
    try:
        return merge_runs([summary], tuple(request.model.terms))
    except IdentifiabilityError as error:
        message = error.message.replace("record", "plan", 1)
        raise IdentifiabilityError(message, remedy=error.remedy) from None


def _reduced(request: PlanRequest, run: Run) -> tuple[Design, RunSummary]:
    """Columns of the noiseless record of a test, and its summary."""
    noise, wish = _noise_of(request), request_of(request.model)
    noise = replace(noise, counted=counted_rates(run, noise.white))
    design = Design(run, wish, run.scale_factor)
    return design, RunSummary.of_rows(design, noise, reduce_positions(design, noise))


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


def noiseless_run(request: PlanRequest, visits: tuple[Visit, ...]) -> Run:
    """The record of the test without noise and imperfections, with the data for its budget."""
    stand = Composite(tuple(visit.table.build(request.path.parent) for visit in visits), request.move)
    e, specimen = request.scenario.electronics, request.scenario.specimen
    quiet = Electronics(e.sample_rate, "rate" if e.kind == "rate" else "angle", zero=e.zero)
    log = simulate_test(stand, specimen, quiet).log
    run = Run.from_arrays(
        log.t, log.output, log.reference, scale_factor=specimen.instrument.scale_factor, kind=quiet.kind,
        base_rate=None if request.direct else log.base_rate, segment=log.segment, unit=request.unit,
        serial=request.table.instrument.serial, units="SI",
    )  # fmt: skip
    servo, counted = request.table.instrument.servo, e.kind == "counts" and not request.direct
    return replace(
        run,
        servo=run.servo if servo is None else servo.parameters(),
        uncertainty=request.uncertainty,
        stand=stand_table(request, visits),
        source=str(request.path),
        resolution=2.0 * math.pi / e.counts_per_revolution if counted else 0.0,
    )


def _stated_with_counts(request: PlanRequest, design: Design, fit: JointFit) -> Array:
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
    parts, stated = reduce_positions(design, summary.noise, extra=extra), []
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
