"""Plan tests: positions, durations and expected uncertainties."""
