"""From a run to coefficients with uncertainty."""

from piga.calibration.calibrate import calibrate
from piga.calibration.model_choice import compare_models
from piga.calibration.model_comparison import ModelComparison, TermSet
from piga.calibration.reduction import Reduction
from piga.calibration.summary import RunSummary

__all__ = ["ModelComparison", "Reduction", "RunSummary", "TermSet", "calibrate", "compare_models"]
