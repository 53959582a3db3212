"""The PIGA: parameters, exact motion, closed forms, regimes, the servo-loop twin, its readout."""

from piga.instrument.motion.constant_motion import closed_form, closed_form_turns
from piga.instrument.motion.fleet import propagate_fleet
from piga.instrument.motion.function_input import propagate_function
from piga.instrument.motion.input_forms import propagate_increments, propagate_segments
from piga.instrument.motion.motion_analysis import (
    dead_zone,
    fixed_points,
    locking_time,
    mean_rate,
    revolution_period,
    separatrix_distance,
)
from piga.instrument.motion.sampled_motion import propagate, propagate_rate
from piga.instrument.motion.sensitivity import SENSITIVITY_NAMES, Sensitivities, sensitivities
from piga.instrument.parameters import ErrorModel, Instrument
from piga.instrument.published import published_closed_form
from piga.instrument.regimes import Regime, regime

__all__ = [
    "SENSITIVITY_NAMES",
    "ErrorModel",
    "Instrument",
    "Regime",
    "Sensitivities",
    "closed_form",
    "closed_form_turns",
    "dead_zone",
    "fixed_points",
    "locking_time",
    "mean_rate",
    "propagate",
    "propagate_fleet",
    "propagate_function",
    "propagate_increments",
    "propagate_rate",
    "propagate_segments",
    "published_closed_form",
    "regime",
    "revolution_period",
    "sensitivities",
    "separatrix_distance",
]
