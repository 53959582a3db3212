"""Plan a test: the positions or levels, and the dwell in each, that give the smallest uncertainties.

A visit of duration tau at candidate j gives the information ``M_j(tau)`` and costs ``tau + move``. The search finds pairs of
visits (:mod:`piga.planning.search`).
The estimator predicts the reported uncertainties from the noiseless record of the test.

The mounting question: which skew keeps the instrument out of the lock zone over a profile. With ``u = K f - Omega``
it runs where ``u_x^2 > u_t^2 tan^2(beta)`` [Wei2024]. A skew ``sigma`` towards the direction at ``clock`` about the platform's
X axis makes ``u_x = u . (cos sigma, sin sigma cos clock, sin sigma sin clock)``; the margin of a mounting is the least
``|u_x|/(u_t tan(beta))`` of the profile, and it must exceed 1 (own formulation).
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

from piga._version import __version__
from piga.errors import CalibrationError
from piga.planning.candidates import (
    Candidate,
    PlanRequest,
    Prediction,
    Visit,
    candidate_of,
    find_candidates,
    predict,
    stand_table,
)
from piga.planning.search import Search, in_order
from piga.progress import Progress, Steps
from piga.records.terms import unit_of
from piga.results import Array, Plotted, Reported, Result, finite
from piga.stand.machines import angles_of_range
from piga.stand.profile import NONE
from piga.stand.scenario import DividingHeadTable
from piga.text_files import toml_text
from piga.threads import one_thread
from piga.units import G0
from piga.upper import doors

_STANDARD = (4, 6, 12, 24)
"""Numbers of evenly spaced positions in the standard plans."""


@dataclass(frozen=True, eq=False, repr=False)
class Mounting(Result):
    """Margins of all mountings over a profile, (skews, directions); ``limit`` is the wanted one.

    ``skew`` and ``clock`` [rad] are those of the largest ``margin``; ``clock`` is the direction about X, from Y towards Z.
    ``margin_history`` (n,) holds ``|u_x|/(u_t tan(beta))`` at times ``t`` [s], ``unskewed_history`` that without skew.
    """

    skews: Array
    margins: Array
    limit: float
    skew: float
    clock: float
    t: Array
    margin_history: Array
    unskewed_history: Array

    @property
    def margin(self) -> float:
        """Largest margin."""
        return float(self.margins.max())

    @property
    def acceptable(self) -> Array:
        """Skews [rad] that reach the wanted margin at their best direction."""
        return self.skews[self.margins.max(axis=1) >= self.limit]


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Reported, Plotted, Result):
    """A planned test and its comparison plans.

    ``plot()`` shows chosen positions and the time in each: two panels. ``usable`` candidates keep the margin from the lock
    zone. ``cheapest`` is the shortest test found that reaches the wanted uncertainties. ``mounting`` answers ``[mounting]``.
    """

    request: PlanRequest
    candidates: tuple[Candidate, ...]
    usable: tuple[Candidate, ...]
    best: Prediction
    standard: tuple[Prediction, ...]
    cheapest: Prediction | None = None
    mounting: Mounting | None = None

    @property
    def excluded(self) -> tuple[tuple[Candidate, str], ...]:
        """Candidates in the lock zone or near it, each with the reason."""
        limit, left_out = self.request.table.plan.margin, []
        for candidate in (c for c in self.candidates if c not in self.usable):
            word = "locked" if candidate.margin < 1.0 else f"within {limit:g} times the lock zone"
            left_out.append((candidate, f"{word}: |a_x| is {candidate.margin:.2g} of a_t tan(beta)"))
        return tuple(left_out)

    def _subject(self) -> ModuleType:
        return doors().shown_plan()


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
        If every candidate is in the lock zone.
    """
    steps = Steps(progress, 4)
    steps("listing positions")
    mounting = plan_mounting(request)
    candidates, margin = find_candidates(request), request.table.plan.margin
    usable = tuple(c for c in candidates if not c.margin < margin)
    if not usable:
        raise CalibrationError(
            f"every position is within {margin:g} times the lock zone",
            remedy="add positions with a larger a_x, or lower [plan] margin",
        )
    steps("information of each position")
    search = Search.of(request, usable)
    steps("standard plans")
    standard = _standard(request, usable)
    steps("choosing visits")
    best = search.best(standard)
    return Plan(
        request=request,
        candidates=candidates,
        usable=usable,
        best=best,
        standard=standard,
        cheapest=search.cheapest(best) if request.wanted else None,
        mounting=mounting,
    )


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
    table, instrument = request.table.mounting, request.scenario.specimen.instrument
    if table is None:
        return None
    if instrument.tan_beta == 0.0:
        raise CalibrationError(
            "[mounting] needs [truth] beta: without it there is no lock zone",
            remedy="add the expected size, e.g. beta = '20 arcsec'",
        )
    skews = np.array(angles_of_range(table.skew, "[mounting] skew", "0:91:1 deg"))
    clocks = np.array(angles_of_range(table.clock, "[mounting] clock", "0:360:15 deg"))
    stand, step = table.profile.build(request.path.parent), table.in_si("[mounting] ")["step"]
    begin, end = stand.segments()[0].start, stand.segments()[-1].stop
    t = np.minimum(np.arange(begin, end + 0.5 * step, step), end)
    force, rate = stand.motion(t, NONE)
    u = instrument.scale_factor * force - rate

    def ratios(skew: float, towards: Array) -> Array:
        """Ratio at each time and direction; 0 where ``u_x`` changed its sign since the time before: it crossed the lock zone."""
        across_x = math.sin(skew) * np.array([np.cos(towards), np.sin(towards)])
        along = u @ np.vstack([np.full(towards.size, math.cos(skew)), across_x])
        across = np.sqrt(np.maximum(np.sum(u * u, axis=1)[:, None] - along**2, 0.0)) * abs(instrument.tan_beta)
        found = np.divide(np.abs(along), across, out=np.full(along.shape, np.inf), where=across > 0.0)
        found[1:][along[1:] * along[:-1] < 0.0] = 0.0
        return found

    margins = np.array([ratios(skew, clocks).min(axis=0) for skew in skews.tolist()])
    at, towards = np.unravel_index(np.argmax(margins), margins.shape)
    skew, clock = float(skews[at]), clocks[[towards]]
    histories = ratios(skew, clock)[:, 0], ratios(0.0, clock)[:, 0]
    return Mounting(skews, margins, table.margin, skew, float(clock[0]), t, *histories)


def _standard(request: PlanRequest, usable: tuple[Candidate, ...]) -> tuple[Prediction, ...]:
    """Standard plans that fit the time: evenly spaced positions, or equal time on all without a dividing head."""
    head = next((stand for stand in request.table.stands if isinstance(stand, DividingHeadTable)), None)
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
        dwell = request.whole_samples((request.duration + request.move) / len(chosen) - request.move)
        if dwell > 0.0:
            visits = in_order(request, tuple(Visit(candidate, dwell) for candidate in chosen))
            plans.append(predict(request, name, visits))
    return tuple(plans)


# -- documents --------------------------------------------------------------------------------------------------

_TABLES = (
    "instrument", "truth", "electronics", "run", "temperature", "imperfections", "model", "estimation", "uncertainty",
)  # fmt: skip
"""Tables of the plan file that the scenario has, too."""


def scenario_text(plan: Plan) -> str:
    """The planned test as a scenario file (TOML)."""
    whole = msgspec.to_builtins(plan.request.table)
    model = plan.request.model
    whole["model"] = {"phases": model.phases, **whole["model"], "terms": list(model.terms)}
    if plan.request.direct:
        del whole["instrument"]["counts_per_revolution"], whole["model"]["phases"]
    tables = {name: whole[name] for name in _TABLES if whole.get(name)}
    tables["stand"] = stand_table(plan.request, plan.best.visits)
    made = f"# Test planned by piga {__version__} from {plan.request.path.name}"
    return f"{made}: {len(plan.best.visits)} visits.\n{toml_text(tables)}"


_CSV_COLUMNS = ("step", "begin_s", "hold_s", "stand", "position", "a_x_g", "a_Y_g", "a_Z_g", "revolutions")
"""Columns of the program of the stand; a direct instrument has no revolutions."""


def program_csv(plan: Plan) -> str:
    """The program of the stand as CSV: one row a visit, in order, with the move before the next one left as a gap in time."""
    begin, rows = 0.0, [list(_CSV_COLUMNS)]
    for step, visit in enumerate(plan.best.visits, start=1):
        candidate, dwell = visit.candidate, visit.dwell
        kind = str(candidate.table.__struct_config__.tag)
        force = [f"{value / G0 + 0.0:.9f}" for value in candidate.force]
        turns = f"{dwell / candidate.revolution:.4f}"
        rows.append([str(step), f"{begin:.3f}", f"{dwell:.3f}", kind, candidate.label, *force, turns])
        begin += dwell + plan.request.move
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(row[: -1 if plan.request.direct else None] for row in rows)
    return text.getvalue()


def plan_document(plan: Plan) -> dict[str, Any]:
    """The plan as one JSON document (schema ``piga.plan/1``); standard uncertainties in file units."""
    best = plan.best
    document: dict[str, Any] = {
        "schema": "piga.plan/1",
        "criterion": plan.request.table.plan.criterion,
        "duration_s": best.duration,
        "recorded_s": best.recorded,
        "visits": [
            {"position": v.candidate.label, "dwell_s": v.dwell}
            | ({} if plan.request.direct else {"revolutions": v.dwell / v.candidate.revolution})
            for v in best.visits
        ],
        "excluded": [{"position": one.label, "reason": reason} for one, reason in plan.excluded],
        "planned": _prediction_document(plan, best),
        "standard": [_prediction_document(plan, p) for p in plan.standard],
        "software": f"piga {__version__}",
    }
    if plan.cheapest is not None:
        visits = [{"position": v.candidate.label, "dwell_s": v.dwell} for v in plan.cheapest.visits]
        told = {"duration_s": plan.cheapest.duration, "visits": visits}
        refused = {"refusal": plan.cheapest.refusal}
        document["cheapest"] = {
            "wanted": plan.request.wanted,
            **(refused if plan.cheapest.refusal else told),
        }
    if plan.mounting is not None:
        document["mounting"] = {
            "skew_deg": math.degrees(plan.mounting.skew),
            "clock_deg": math.degrees(plan.mounting.clock),
            "margin": finite(plan.mounting.margin),
            "margin_wanted": plan.mounting.limit,
            "acceptable_skews_deg": [
                round(math.degrees(skew), 9) for skew in plan.mounting.acceptable.tolist()
            ],
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
            "degrees_of_freedom": finite(prediction.uncertainty(name)[2]),
            "unit": unit_of(name, plan.request.unit),
        }
        for name in plan.request.names
    }
    return entry
