"""Compensation: specific force and velocity from the output of calibrated instruments."""

from piga.compensation.compensator import Compensator, compensate
from piga.compensation.model import FLAGS, Limits, Phase, PhaseFinder, identify_phase
from piga.compensation.result import Compensated, CompensatedSet, Resampler
from piga.compensation.sets import Mounted, SetCompensator, compensate_set

__all__ = [
    "FLAGS",
    "Compensated",
    "CompensatedSet",
    "Compensator",
    "Limits",
    "Mounted",
    "Phase",
    "PhaseFinder",
    "Resampler",
    "SetCompensator",
    "compensate",
    "compensate_set",
    "identify_phase",
]
