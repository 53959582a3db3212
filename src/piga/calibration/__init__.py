"""Coefficients with uncertainty from a recorded run. The entry point is ``piga.calibrate``.

A module is imported only when one of its names is used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from piga.calibration.allan import AllanDeviation, allan_deviation
    from piga.calibration.choice.model_choice import ModelComparison, TermSet, compare_models
    from piga.calibration.choice.prospects import TermProspect, term_prospects
    from piga.calibration.joint.summary import RunSummary
    from piga.calibration.model.reduction import Reduction

_LAZY = {
    "AllanDeviation": "allan",
    "allan_deviation": "allan",
    "ModelComparison": "choice.model_choice",
    "Reduction": "model.reduction",
    "RunSummary": "joint.summary",
    "TermProspect": "choice.prospects",
    "TermSet": "choice.model_choice",
    "compare_models": "choice.model_choice",
    "term_prospects": "choice.prospects",
}

__all__ = [
    "AllanDeviation",
    "ModelComparison",
    "Reduction",
    "RunSummary",
    "TermProspect",
    "TermSet",
    "allan_deviation",
    "compare_models",
    "term_prospects",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"piga.calibration.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'piga.calibration' has no attribute '{name}'")
