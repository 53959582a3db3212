"""Records made with a known truth, for the tests of the calibration and its campaigns."""
