"""Plan a test: the positions or levels, and the dwell in each, that give the smallest uncertainties.

A visit of duration tau at candidate j gives the information ``M_j(tau)`` and costs ``tau + move``. The search finds pairs of
visits (:mod:`piga.planning.search`). The least value of any mixture of visits per second of test is a lower bound for every test.
The reported uncertainties are predicted by the estimator on the noiseless record of the exported test. The export is a scenario
for ``piga simulate`` and one JSON document.

The mounting question: which skew keeps the instrument out of the lock zone over a profile. With ``u = K f - Omega``
the instrument runs where ``u_x^2 > u_t^2 tan^2(beta)`` [Wei2024]. Turning the instrument by a skew ``sigma`` towards
the direction at ``clock`` about the platform's X axis makes ``u_x = u . (cos sigma, sin sigma cos clock, sin sigma
sin clock)``; the margin of a mounting is the least ``|u_x|/(u_t tan(beta))`` of the profile, and it must exceed 1
(own formulation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga._version import __version__
from piga.errors import ArgumentError, CalibrationError, IdentifiabilityError
from piga.planning.candidates import (
    Candidate,
    Prediction,
    Visit,
    candidate_of,
    coefficient_names,
    find_candidates,
    information_tables,
    predict,
    stand_table,
    whole_samples,
)
from piga.planning.plan_file import PlanRequest
from piga.planning.search import LARGEST_POWER, Criterion, Search
from piga.progress import Progress, Steps
from piga.records.terms import unit_of
from piga.records.text_files import toml_text
from piga.results import Array, Plotted, Reported, Result, finite
from piga.stand.machines import angles_of_range
from piga.stand.profile import NONE
from piga.stand.scenario import DividingHeadTable
from piga.threads import one_thread
from piga.units import G0
from piga.upper import doors

if TYPE_CHECKING:
    from types import ModuleType


_STANDARD = (4, 6, 12, 24)
"""Numbers of evenly spaced positions in the standard plans."""
_STRIDE = 0.381966
"""Step from one visit to the next in shuffled order, as a share of the visits (the golden section)."""
_DWELLS = 6
"""Dwells of the tables of information, from the shortest to the longest."""
_ATTEMPTS = 20
"""Most durations tried to reach a wanted uncertainty."""
_LONGER = 1.2
"""Factor on the duration after a test that the calibration would refuse."""


@dataclass(frozen=True)
class _Excluded:
    """An excluded candidate and the reason."""

    candidate: Candidate
    reason: str


@dataclass(frozen=True)
class CheapestTest:
    """The shortest test found that reaches the wanted uncertainties.

    ``bound`` [s] is a lower bound of the duration for these candidates and dwells. ``plan`` is None if the
    uncertainty of the stand prevents it; ``refusal`` then names the uncertainty.
    """

    bound: float
    plan: Prediction | None
    refusal: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Result, Plotted, Reported):
    """A planned test and its comparison plans.

    ``plot()`` shows chosen positions and the time in each: two panels.

    ``largest_derivative`` belongs to the mixture that gives the bound (at its optimum the number of coefficients for D, else 1).
    ``efficiency`` is the ratio of variances between the bound and the plan, at most 1.
    """

    request: PlanRequest
    candidates: tuple[Candidate, ...]
    usable: tuple[Candidate, ...]
    excluded: tuple[_Excluded, ...]
    names: tuple[str, ...]
    largest_derivative: float
    efficiency: float
    best: Prediction
    standard: tuple[Prediction, ...]
    cheapest: CheapestTest | None

    def _subject(self) -> ModuleType:
        return doors().shown_plan()

    def in_brief(self) -> list[tuple[str, str]]:
        """What a notebook shows of the plan."""
        best = self.best
        return [
            ("visits", ", ".join(f"{v.candidate.label}: {v.dwell:.4g} s" for v in best.visits)),
            ("duration", f"{best.duration:.6g} s, {best.recorded:.6g} s recorded"),
            ("efficiency", f"{100.0 * self.efficiency:.1f} % of the bound"),
            ("left out", f"{len(self.excluded)} of {len(self.candidates)} candidates"),
            *(
                (f"u({name})", f"{best.std(name):.3g} {unit_of(name, self.request.unit)}")
                for name in self.names
            ),
        ]


def _criterion(request: PlanRequest, scale: Array, kind: str) -> Criterion:
    """The criterion in scaled parameters."""
    plan, names = request.settings, coefficient_names(request)
    rows = np.diag(scale)
    if kind == "c":
        return Criterion(np.array([[plan.combination.get(n, 0.0) for n in names]]) * scale, 1.0)
    if kind == "wanted":
        chosen = [names.index(n) for n in request.wanted]
        return Criterion(rows[chosen] / np.array(list(request.wanted.values()))[:, None], LARGEST_POWER)
    chosen = [names.index(n) for n in plan.coefficients or names]
    sizes = np.array([request.wanted.get(n, scale[names.index(n)]) for n in names])
    return Criterion((rows / sizes[:, None])[chosen], 0.0 if kind == "D" else 1.0)


@one_thread()
def plan_test(request: PlanRequest, *, progress: Progress | None = None) -> Plan:
    """Plan a test.

    ``progress`` is called as ``progress(done, total, what)`` before each step; it returns False to stop
    (:mod:`piga.progress`).

    Raises
    ------
    IdentifiabilityError
        If no plan of these candidates can separate the terms.
    CalibrationError
        If the time is too short, or every candidate is in the lock zone.
    """
    steps = Steps(progress, 4)
    steps("listing positions")
    candidates = find_candidates(request)
    margin = request.settings.margin
    excluded = tuple(_excluded(c, margin) for c in candidates if c.margin < margin)
    usable = tuple(c for c in candidates if not c.margin < margin)
    _check(request, usable)
    steps("information of each position")
    search = _prepare(request, usable)
    steps("standard plans")
    standard = _standard(request, usable)
    if not standard:
        raise CalibrationError(
            f"[plan] duration = {request.duration:g} s is too short: no usual test fits into it",
            remedy="lengthen [plan] duration, or shorten minimum_dwell or the moves",
        )
    steps("choosing visits")
    best, value = _best(search, standard)
    criterion, (_, bound, derivative) = search.criterion, search.mixture
    bound -= math.log(request.duration + request.move)
    return Plan(
        request=request,
        candidates=candidates,
        usable=usable,
        excluded=excluded,
        names=coefficient_names(request),
        largest_derivative=derivative * (criterion.rows.shape[0] if criterion.power == 0.0 else 1),
        efficiency=math.exp(min(0.0, bound - value)),
        best=best,
        standard=standard,
        cheapest=_cheapest(search, best) if request.wanted else None,
    )


def _excluded(candidate: Candidate, limit: float) -> _Excluded:
    """A candidate in the lock zone or near it."""
    word = "locked" if candidate.margin < 1.0 else f"within {limit:g} times the lock zone"
    return _Excluded(candidate, f"{word}: |a_x| is {candidate.margin:.2g} of a_t tan(beta)")


def _check(request: PlanRequest, usable: tuple[Candidate, ...]) -> None:
    """Refuse a request that cannot be planned."""
    if not usable:
        raise CalibrationError(
            f"every position is within {request.settings.margin:g} times the lock zone",
            remedy="add positions with a larger a_x, or lower [plan] margin",
        )
    if request.duration < 2.0 * request.minimum_dwell + request.move:
        raise CalibrationError(
            "[plan] duration is below minimum_dwell twice with a move between: each position is visited twice",
            remedy="give it more time",
        )
    interval = request.scenario.electronics.interval
    if abs(request.move / interval - round(request.move / interval)) > 1e-6:
        raise CalibrationError(
            f"the move time {request.move:g} s is not a multiple of the sample interval {interval:g} s",
            remedy="change it, or sample_rate",
        )


def _prepare(request: PlanRequest, usable: tuple[Candidate, ...]) -> Search:
    """Tables scaled by the uncertainty of equal time on all candidates; refuses confounded terms."""
    longest = min(request.longest_dwell, request.duration)
    dwells = np.unique(
        [whole_samples(request, d) for d in np.geomspace(request.minimum_dwell, longest, _DWELLS)]
    )
    tables = information_tables(request, usable, dwells)
    equal = tables[:, -1].mean(axis=0)
    plain = 1.0 / np.sqrt(np.diag(equal))
    covariance = np.linalg.inv(equal * np.outer(plain, plain)) * np.outer(plain, plain)
    scale = np.sqrt(np.diag(covariance))
    criterion = _criterion(request, scale, request.settings.criterion)
    return Search(request, usable, dwells, tables * np.outer(scale, scale), scale, criterion)


def _standard(request: PlanRequest, usable: tuple[Candidate, ...]) -> tuple[Prediction, ...]:
    """Standard plans: evenly spaced positions, or equal time on all without a dividing head."""
    head = next((stand for stand in request.stands if isinstance(stand, DividingHeadTable)), None)
    places = {"all levels": usable}
    if head is not None:
        places = {
            f"{count} positions": tuple(
                candidate_of(request, f"{x:g} deg", msgspec.structs.replace(head, positions=(f"{x!r} deg",)))
                for x in (360.0 * k / count for k in range(count))
            )
            for count in _STANDARD
        }
    plans = []
    for name, chosen in places.items():
        dwell = whole_samples(request, (request.duration + request.move) / len(chosen) - request.move)
        if dwell > 0.0:
            visits = _ordered(request, tuple(Visit(candidate, dwell) for candidate in chosen))
            plans.append(predict(request, name, visits))
    return tuple(plans)


def _best(search: Search, standard: tuple[Prediction, ...]) -> tuple[Prediction, float]:
    """The best test for the duration; a standard plan that keeps the margin if no test is better."""
    request = search.request
    planned = _search_visits(search, "planned", request.duration)
    value = _value(search, planned)
    for prediction in standard:
        other = _value(search, prediction)
        safe = all(visit.candidate.margin >= request.settings.margin for visit in prediction.visits)
        if safe and other < value:
            planned, value = replace(prediction, name="planned"), other
    if not math.isfinite(value):
        raise IdentifiabilityError(
            planned.refusal, remedy="give the test more time, a shorter minimum_dwell, or fewer terms"
        )
    return planned, value


def _value(search: Search, prediction: Prediction) -> float:
    """The criterion of a predicted covariance."""
    if prediction.covariance is None:
        return math.inf
    keep = [k for k, c in enumerate(prediction.coefficients) if c.segment is None]
    covariance = prediction.covariance[np.ix_(keep, keep)] / np.outer(search.scale, search.scale)
    return float(search.criterion.values(np.asarray(np.linalg.inv(covariance), dtype=np.float64)))


def _search_visits(search: Search, name: str, duration: float) -> Prediction:
    """The best test of this duration that the calibration does not refuse."""
    for visits in search.tests(duration):
        planned = predict(search.request, name, _ordered(search.request, visits))
        if not planned.refusal:
            break
    return planned


def _ordered(request: PlanRequest, visits: tuple[Visit, ...]) -> tuple[Visit, ...]:
    """The visits of each stand in shuffled order, unless the plan asks for that of the stand.

    A slow change of the bias then moves no coefficient as a whole: the next position lies 0.38 of the test further on, as
    near to the golden section as the number of visits allows. Where only neighbours have such a distance (4 and 6 visits), every
    second visit comes first. The same plan has the same order.
    """
    if not request.settings.shuffle:
        return visits
    ordered: list[Visit] = []
    for _, group in groupby(visits, key=lambda visit: type(visit.candidate.table)):
        part = list(group)
        step = max(round(_STRIDE * len(part)), 1)
        while math.gcd(step, len(part)) > 1:
            step += 1
        if step < len(part) - 1:
            ordered += [part[(step * k) % len(part)] for k in range(len(part))]
        else:
            ordered += [*part[::2], *part[1::2]]
    return tuple(ordered)


def _cheapest(search: Search, best: Prediction) -> CheapestTest:
    """The shortest test that reaches the wanted standard uncertainties, including Type B of the stand."""
    request, targets = search.request, {}
    for name, wanted in request.wanted.items():
        by_stand = best.by_stand(name)
        if by_stand >= wanted:
            refusal = (
                f"the stand alone adds {by_stand:.2g} {unit_of(name, request.unit)} to {name}: {wanted:.2g} cannot be "
                "reached in any time"
            )
            return CheapestTest(math.inf, None, refusal)
        targets[name] = math.sqrt(wanted**2 - by_stand**2)
    request_within = replace(request, wanted=targets)
    search = replace(search, criterion=_criterion(request_within, search.scale, "wanted"))
    bound = math.exp(search.mixture[1]) - request.move
    duration = max(bound, 2.0 * request.minimum_dwell + request.move)
    for _ in range(_ATTEMPTS):
        plan = _search_visits(search, "cheapest", duration)
        ratio = max(plan.combined(name) / wanted for name, wanted in request.wanted.items())
        if ratio <= 1.0:
            return CheapestTest(max(bound, 0.0), plan)
        duration *= _LONGER if plan.refusal else min(max(ratio**2, 1.005), 2.0)
    return CheapestTest(bound, None, "no test was found that reaches it: add positions or allow longer dwells")


# -- mounting ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, repr=False)
class Mounting(Result):
    """Margins of all mountings (skews, clocks). ``limit`` is the wanted one.

    ``best`` is the index of the best one. ``margin_history`` (n,) is its ``|u_x|/(u_t tan(beta))`` at times ``t`` [s];
    ``unskewed_history`` is that of the instrument without skew.
    """

    skews: Array
    clocks: Array
    margins: Array
    limit: float
    t: Array
    margin_history: Array
    unskewed_history: Array
    best: tuple[int, int]

    @property
    def skew(self) -> float:
        """Best skew [rad]."""
        return float(self.skews[self.best[0]])

    @property
    def clock(self) -> float:
        """Direction of the best skew about X, from Y towards Z [rad]."""
        return float(self.clocks[self.best[1]])

    @property
    def margin(self) -> float:
        """Least ``|u_x|/(u_t tan(beta))`` of the best mounting."""
        return float(self.margins[self.best])

    @property
    def acceptable(self) -> Array:
        """Skews [rad] that reach the wanted margin at their best direction."""
        return self.skews[self.margins.max(axis=1) >= self.limit]


@one_thread()
def plan_mounting(request: PlanRequest) -> Mounting | None:
    """Best skew for the profile of ``[mounting]``; None when the plan has none.

    Raises
    ------
    CalibrationError
        If tan_beta is zero: there is no lock zone.
    ArgumentError
        If a range of angles is empty.
    """
    table = request.table.mounting
    if table is None:
        return None
    instrument = request.scenario.specimen.instrument
    tangent = abs(instrument.tan_beta)
    if tangent == 0.0:
        raise CalibrationError(
            "[mounting] needs [truth] beta: without it there is no lock zone",
            remedy="add the expected size, e.g. beta = '20 arcsec'",
        )
    stand = table.profile.build(request.path.parent)
    segments = stand.segments()
    step = table.in_si("[mounting] ")["step"]
    if not step > 0.0:
        raise ArgumentError("[mounting] step: must be positive", remedy="e.g. '0.1 s'")
    t = np.arange(segments[0].start, segments[-1].stop + 0.5 * step, step)
    force, rate = stand.motion(np.minimum(t, segments[-1].stop), NONE)
    u = instrument.scale_factor * force - rate
    skews, clocks = (
        np.array(angles_of_range(getattr(table, name), f"[mounting] {name}", "0:91:1 deg"))
        for name in ("skew", "clock")
    )
    margins = np.array([_ratios(u, _axes(skew, clocks), tangent).min(axis=0) for skew in skews.tolist()])
    best = int(np.argmax(margins) // clocks.size), int(np.argmax(margins) % clocks.size)
    axes = _axes(skews[best[0]], clocks[[best[1]]])
    return Mounting(
        skews=skews,
        clocks=clocks,
        margins=margins,
        limit=table.margin,
        t=t,
        margin_history=_ratios(u, axes, tangent)[:, 0],
        unskewed_history=_ratios(u, np.array([[1.0], [0.0], [0.0]]), tangent)[:, 0],
        best=best,
    )


def _axes(skew: float, clocks: Array) -> Array:
    """Input axes in platform axes for one skew, (3, clocks)."""
    s = math.sin(skew)
    return np.array([np.full(clocks.size, math.cos(skew)), s * np.cos(clocks), s * np.sin(clocks)])


def _ratios(u: Array, axes: Array, tangent: float) -> Array:
    """``|u_x|/(u_t tan(beta))`` per row and axis; infinite without transverse input.

    0 if ``u_x`` changed its sign since the previous row: the profile crossed the lock zone.
    """
    signed = u @ axes
    along = np.abs(signed)
    across = np.sqrt(np.maximum(np.sum(u * u, axis=1)[:, None] - along**2, 0.0)) * tangent
    ratios = np.divide(along, across, out=np.full(along.shape, np.inf), where=across > 0.0)
    ratios[1:][signed[1:] * signed[:-1] < 0.0] = 0.0
    return ratios


# -- documents --------------------------------------------------------------------------------------------------

_PLAN_SCHEMA = "piga.plan/1"
_TABLES = (
    "instrument", "truth", "electronics", "run", "temperature", "imperfections", "model", "estimation",
    "uncertainty",
)  # fmt: skip


def scenario_text(plan: Plan) -> str:
    """The planned test as a scenario file (TOML)."""
    whole = msgspec.to_builtins(plan.request.table)
    whole["model"] = {
        "phases": plan.request.model.phases,
        **whole["model"],
        "terms": list(plan.request.model.terms),
    }
    if plan.request.direct:
        del whole["instrument"]["counts_per_revolution"], whole["model"]["phases"]
    tables = {name: whole[name] for name in _TABLES if whole.get(name)}
    tables["stand"] = stand_table(plan.request, plan.best.visits)
    comment = (
        f"# Test planned by piga {__version__} from {plan.request.path.name}: {len(plan.best.visits)} visits.\n"
    )
    return comment + toml_text(tables)


_CSV_COLUMNS = ("step", "begin_s", "hold_s", "stand", "position", "a_x_g", "a_Y_g", "a_Z_g", "revolutions")
"""Columns of the program of the stand; a direct instrument has no revolutions."""


def program_csv(plan: Plan) -> str:
    """The program of the stand as CSV: one row a visit, in order, with the move before the next one left as a gap in time."""
    last = -1 if plan.request.direct else None
    begin, rows = 0.0, [",".join(_CSV_COLUMNS[:last])]
    for step, visit in enumerate(plan.best.visits, start=1):
        candidate = visit.candidate
        kind = str(msgspec.to_builtins(candidate.table)["kind"])
        force = [f"{value / G0 + 0.0:.9f}" for value in candidate.force]
        label = f'"{candidate.label}"' if "," in candidate.label else candidate.label
        turns = f"{visit.dwell / candidate.revolution:.4f}"
        cells = (str(step), f"{begin:.3f}", f"{visit.dwell:.3f}", kind, label, *force, turns)
        rows.append(",".join(cells[:last]))
        begin += visit.dwell + plan.request.move
    return "\n".join(rows) + "\n"


def plan_document(plan: Plan, mounting: Mounting | None) -> dict[str, Any]:
    """The plan as one JSON document (schema ``piga.plan/1``); standard uncertainties in file units."""
    best = plan.best
    document: dict[str, Any] = {
        "schema": _PLAN_SCHEMA,
        "criterion": plan.request.settings.criterion,
        "duration_s": best.duration,
        "recorded_s": best.recorded,
        "visits": [
            {"position": v.candidate.label, "dwell_s": v.dwell}
            | ({} if plan.request.direct else {"revolutions": v.dwell / v.candidate.revolution})
            for v in best.visits
        ],
        "excluded": [{"position": e.candidate.label, "reason": e.reason} for e in plan.excluded],
        "largest_derivative": plan.largest_derivative,
        "efficiency": plan.efficiency,
        "planned": _prediction_document(plan, best),
        "standard": [_prediction_document(plan, p) for p in plan.standard],
        "software": f"piga {__version__}",
    }
    if plan.cheapest is not None:
        document["cheapest"] = _cheapest_document(plan, plan.cheapest)
    if mounting is not None:
        document["mounting"] = {
            "skew_deg": math.degrees(mounting.skew),
            "clock_deg": math.degrees(mounting.clock),
            "margin": finite(mounting.margin),
            "margin_wanted": mounting.limit,
            "acceptable_skews_deg": [round(math.degrees(float(s)), 9) for s in mounting.acceptable],
        }
    return document


def _prediction_document(plan: Plan, prediction: Prediction) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": prediction.name,
        "positions": len(prediction.visits),
        "duration_s": prediction.duration,
        "recorded_s": prediction.recorded,
    }
    if prediction.refusal:
        return entry | {"refusal": prediction.refusal}
    entry["standard_uncertainty"] = {
        name: {
            "type_a": prediction.std(name),
            "combined": prediction.combined(name),
            "expanded": finite(prediction.expanded(name)),
            "degrees_of_freedom": finite(prediction.degrees(name)),
            "unit": unit_of(name, plan.request.unit),
        }
        for name in plan.names
    }
    return entry


def _cheapest_document(plan: Plan, cheapest: CheapestTest) -> dict[str, Any]:
    entry: dict[str, Any] = {"wanted": plan.request.wanted, "bound_s": finite(cheapest.bound)}
    if cheapest.plan is None:
        return entry | {"refusal": cheapest.refusal}
    return entry | {
        "duration_s": cheapest.plan.duration,
        "visits": [{"position": v.candidate.label, "dwell_s": v.dwell} for v in cheapest.plan.visits],
    }
