"""Commands that start from a recorded test: draft its run file, check it, calibrate it, compensate it."""
