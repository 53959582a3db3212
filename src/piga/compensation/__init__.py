"""Compensation: specific force and velocity from the output of calibrated instruments."""

from piga.compensation.compensate import compensate
from piga.compensation.compensator import Compensator
from piga.compensation.flags import FLAGS
from piga.compensation.model import Phase
from piga.compensation.mounting import Mounted
from piga.compensation.phase import PhaseFinder, identify_phase
from piga.compensation.resample import Resampler
from piga.compensation.result import Compensated, CompensatedSet
from piga.compensation.sets.published_set import PublishedSet
from piga.compensation.sets.set_compensator import SetCompensator
from piga.compensation.sets.triad import compensate_triad
from piga.compensation.step import Chunk, Step, init_state, step
from piga.compensation.validity import Limits

__all__ = [
    "FLAGS",
    "Chunk",
    "Compensated",
    "CompensatedSet",
    "Compensator",
    "Limits",
    "Mounted",
    "Phase",
    "PhaseFinder",
    "PublishedSet",
    "Resampler",
    "SetCompensator",
    "Step",
    "compensate",
    "compensate_triad",
    "identify_phase",
    "init_state",
    "step",
]
