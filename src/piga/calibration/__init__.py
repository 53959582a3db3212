"""From a run to coefficients with uncertainty."""

from piga.calibration.calibrate import calibrate
from piga.calibration.reduction import Reduction
from piga.calibration.summary import RunSummary

__all__ = ["Reduction", "RunSummary", "calibrate"]
