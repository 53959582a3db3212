"""From a run to coefficients with uncertainty."""
