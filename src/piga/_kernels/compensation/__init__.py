"""Kernels of the compensation."""
