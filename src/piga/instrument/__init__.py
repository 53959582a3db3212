"""The PIGA: parameters, exact motion, closed forms, regimes, the servo-loop twin, its readout."""

from piga.instrument.constant_input import (
    Regime,
    closed_form,
    closed_form_turns,
    dead_zone,
    fixed_points,
    locking_time,
    mean_rate,
    regime,
    revolution_period,
    separatrix_distance,
)
from piga.instrument.parameters import ErrorModel, Instrument
from piga.instrument.sampled_motion import (
    propagate,
    propagate_fleet,
    propagate_increments,
    propagate_rate,
    propagate_segments,
)
from piga.instrument.twin.electronics import Electronics

__all__ = [
    "Electronics",
    "ErrorModel",
    "Instrument",
    "Regime",
    "closed_form",
    "closed_form_turns",
    "dead_zone",
    "fixed_points",
    "locking_time",
    "mean_rate",
    "propagate",
    "propagate_fleet",
    "propagate_increments",
    "propagate_rate",
    "propagate_segments",
    "regime",
    "revolution_period",
    "separatrix_distance",
]
