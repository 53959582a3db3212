"""The request of a calibration as linear equations, and their solution."""
