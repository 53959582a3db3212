"""The PIGA: parameters, exact motion, closed forms, regimes, the servo-loop twin, its readout."""
