"""A plan as files: the scenario that ``piga simulate`` runs, and one JSON document."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from piga._version import __version__
from piga.planning.mounting import Mounting
from piga.planning.plan import Cheapest, Plan
from piga.planning.prediction import Prediction, stand_table
from piga.records.terms import unit_of
from piga.stand.write_run import given_values, toml_table

PLAN_SCHEMA = "piga.plan/1"
_TABLES = (
    "instrument", "truth", "electronics", "run", "temperature", "imperfections", "model", "estimation",
    "uncertainty",
)  # fmt: skip


def scenario_text(plan: Plan) -> str:
    """The planned test as a scenario file (TOML)."""
    whole = given_values(msgspec.to_builtins(plan.request.table))
    whole["model"] = {
        "phase": plan.request.model.phase,
        **whole["model"],
        "terms": list(plan.request.model.terms),
    }
    tables = {name: whole[name] for name in _TABLES if whole.get(name)}
    tables["stand"] = stand_table(plan.request, plan.best.visits)
    comment = (
        f"# Test planned by piga {__version__} from {plan.request.path.name}: {len(plan.best.visits)} visits.\n"
    )
    return comment + "\n".join(toml_table(name, table) for name, table in tables.items())


def plan_document(plan: Plan, mounting: Mounting | None) -> dict[str, Any]:
    """The plan as one JSON document (schema ``piga.plan/1``); standard uncertainties in file units."""
    best = plan.best
    document: dict[str, Any] = {
        "schema": PLAN_SCHEMA,
        "criterion": plan.request.settings.criterion,
        "duration_s": best.duration,
        "recorded_s": best.recorded,
        "visits": [
            {"position": v.candidate.label, "dwell_s": v.dwell, "revolutions": v.dwell / v.candidate.revolution}
            for v in best.visits
        ],
        "excluded": [{"position": e.candidate.label, "reason": e.reason} for e in plan.excluded],
        "largest_derivative": plan.largest_derivative,
        "efficiency": plan.efficiency,
        "planned": _prediction(plan, best),
        "standard": [_prediction(plan, p) for p in plan.standard],
        "software": f"piga {__version__}",
    }
    if plan.cheapest is not None:
        document["cheapest"] = _cheapest(plan, plan.cheapest)
    if mounting is not None:
        document["mounting"] = {
            "skew_deg": math.degrees(mounting.skew),
            "clock_deg": math.degrees(mounting.clock),
            "margin": _finite(mounting.margin),
            "margin_wanted": mounting.limit,
            "acceptable_skews_deg": [round(math.degrees(float(s)), 9) for s in mounting.acceptable],
        }
    return document


def _prediction(plan: Plan, prediction: Prediction) -> dict[str, Any]:
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
            "unit": unit_of(name),
        }
        for name in plan.names
    }
    return entry


def _cheapest(plan: Plan, cheapest: Cheapest) -> dict[str, Any]:
    entry: dict[str, Any] = {"wanted": plan.request.wanted, "bound_s": _finite(cheapest.bound)}
    if cheapest.plan is None:
        return entry | {"refusal": cheapest.refusal}
    return entry | {
        "duration_s": cheapest.plan.duration,
        "visits": [{"position": v.candidate.label, "dwell_s": v.dwell} for v in cheapest.plan.visits],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
