"""Labelled equations of the theory pages, the twin and the platform, evaluated literally beside what the library computes.

An entry returns pairs ``(literal, library, tolerance)``; both sides are arrays or numbers, the tolerance is absolute. The
literal side is the formula as it is printed, in plain NumPy or SciPy.
"""

from . import axis_and_locking, calibration, compensation, motion, platform, servo, twin
from .registry import EQUATIONS

__all__ = [
    "EQUATIONS",
    "axis_and_locking",
    "calibration",
    "compensation",
    "motion",
    "platform",
    "servo",
    "twin",
]
