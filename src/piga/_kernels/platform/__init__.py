"""Kernels of the platform."""
