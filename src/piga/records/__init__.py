"""Plain data in and out: run files, runs, calibration records."""
