"""The PIGA: parameters, exact motion, closed forms, regimes, the servo-loop twin, its readout."""

from piga.instrument.closed_form import closed_form, closed_form_turns
from piga.instrument.parameters import ErrorModel, Instrument
from piga.instrument.propagate import propagate
from piga.instrument.published import published_closed_form
from piga.instrument.regime import Regime, regime

__all__ = [
    "ErrorModel",
    "Instrument",
    "Regime",
    "closed_form",
    "closed_form_turns",
    "propagate",
    "published_closed_form",
    "regime",
]
