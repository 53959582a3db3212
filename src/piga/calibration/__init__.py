"""Coefficients with uncertainty from a recorded run. The entry point is ``piga.calibrate``."""

from piga.calibration.allan import AllanDeviation, allan_deviation
from piga.calibration.choice.model_choice import ModelComparison, TermSet, compare_models
from piga.calibration.choice.prospects import TermProspect, term_prospects
from piga.calibration.joint.summary import RunSummary
from piga.calibration.model.reduction import Reduction

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
