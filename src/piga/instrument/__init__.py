"""The PIGA: parameters, exact motion, closed form, regimes, the servo-loop twin, its readout."""

from piga.instrument.electronics import Electronics
from piga.instrument.motion import (
    Regime,
    closed_form,
    dead_zone,
    fixed_points,
    locking_time,
    mean_rate,
    propagate,
    propagate_fleet,
    propagate_segments,
    regime,
    revolution_period,
)
from piga.instrument.parameters import ErrorModel, Instrument

__all__ = [
    "Electronics",
    "ErrorModel",
    "Instrument",
    "Regime",
    "closed_form",
    "dead_zone",
    "fixed_points",
    "locking_time",
    "mean_rate",
    "propagate",
    "propagate_fleet",
    "propagate_segments",
    "regime",
    "revolution_period",
]
