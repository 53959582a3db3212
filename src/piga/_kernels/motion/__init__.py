"""Kernels of the exact motion and of the servo twin."""
