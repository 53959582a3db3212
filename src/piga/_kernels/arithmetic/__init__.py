"""Scalar and vector arithmetic that several kernels share."""
