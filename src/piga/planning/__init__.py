"""Plan a test: positions or levels, dwells, mounting, and the uncertainties that it will give.

>>> from piga.planning import PlanSettings
>>> PlanSettings(duration="2 h").criterion
'D'

A module is imported only when one of its names is used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from piga.planning.candidates import Candidate, Prediction, Visit, predict
    from piga.planning.mounting import Mounting, plan_mounting
    from piga.planning.plan import Plan, plan_document, plan_test, scenario_text
    from piga.planning.plan_file import PlanRequest, PlanSettings, read_plan

_LAZY = {
    "Candidate": "candidates",
    "Mounting": "mounting",
    "Plan": "plan",
    "PlanRequest": "plan_file",
    "PlanSettings": "plan_file",
    "Prediction": "candidates",
    "Visit": "candidates",
    "plan_document": "plan",
    "plan_mounting": "mounting",
    "plan_test": "plan",
    "predict": "candidates",
    "read_plan": "plan_file",
    "scenario_text": "plan",
}

__all__ = [
    "Candidate",
    "Mounting",
    "Plan",
    "PlanRequest",
    "PlanSettings",
    "Prediction",
    "Visit",
    "plan_document",
    "plan_mounting",
    "plan_test",
    "predict",
    "read_plan",
    "scenario_text",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"piga.planning.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'piga.planning' has no attribute '{name}'")
