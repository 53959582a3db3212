"""Plan a test: the positions or levels, and the dwell in each, that give the smallest uncertainties.

A visit of duration tau at candidate j gives the information ``M_j(tau)`` and costs ``tau + move``. The search finds pairs of
visits (:mod:`piga.planning.search`).
The estimator predicts the reported uncertainties from the noiseless record of the test.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import msgspec

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
from piga.results import Plotted, Reported, Result, finite
from piga.stand.scenario import DividingHeadTable
from piga.text_files import toml_text
from piga.threads import one_thread
from piga.units import G0
from piga.upper import doors

_STANDARD = (4, 6, 12, 24)
"""Numbers of evenly spaced positions in the standard plans."""


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Reported, Plotted, Result):
    """A planned test and its comparison plans.

    ``plot()`` shows chosen positions and the time in each: two panels. ``usable`` candidates keep the margin from the lock
    zone. ``cheapest`` is the shortest test found that reaches the wanted uncertainties.
    """

    request: PlanRequest
    candidates: tuple[Candidate, ...]
    usable: tuple[Candidate, ...]
    best: Prediction
    standard: tuple[Prediction, ...]
    cheapest: Prediction | None = None

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
    )


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
