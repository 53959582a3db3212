"""Coefficients with uncertainty from a recorded run. The entry point is ``piga.calibrate``.

Limits are constants at the top of each module. Those without a source are own choices.
"""

from piga.calibration.model.reduction import Reduction
from piga.calibration.model_choice import (
    ModelComparison,
    TermProspect,
    TermSet,
    compare_models,
    term_prospects,
)
from piga.calibration.summary import RunSummary

__all__ = [
    "ModelComparison",
    "Reduction",
    "RunSummary",
    "TermProspect",
    "TermSet",
    "compare_models",
    "term_prospects",
]
