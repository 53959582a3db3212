"""Coefficients with uncertainty from a recorded run. The entry point is ``piga.calibrate``."""

from piga.calibration.choice.model_choice import ModelComparison, TermSet, compare_models
from piga.calibration.choice.prospects import TermProspect, term_prospects
from piga.calibration.joint.summary import RunSummary
from piga.calibration.model.reduction import Reduction

__all__ = [
    "ModelComparison",
    "Reduction",
    "RunSummary",
    "TermProspect",
    "TermSet",
    "compare_models",
    "term_prospects",
]
