"""From a run to coefficients with uncertainty."""

from piga.calibration.calibrate import calibrate
from piga.calibration.reduction import Reduction

__all__ = ["Reduction", "calibrate"]
