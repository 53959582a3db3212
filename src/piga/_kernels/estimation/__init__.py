"""Kernels of the calibration: regressors, whitening, reduction."""
