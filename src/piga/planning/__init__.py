"""Plan a test: positions or levels, dwells, mounting, and the uncertainties that it will give.

>>> from piga.planning import PlanSettings
>>> PlanSettings(duration="2 h").criterion
'D'
"""

from piga.planning.candidates import Candidate, PlanRequest, PlanSettings, Prediction, Visit, predict, read_plan
from piga.planning.plan import Mounting, Plan, plan_document, plan_mounting, plan_test, scenario_text

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
