"""The instrument and the error model that a calibration describes."""

from __future__ import annotations

import math
import warnings

from piga.errors import PigaWarning
from piga.instrument.parameters import ErrorModel, Instrument, Quantity
from piga.records.calibration import Calibration

MOTION = ("scale_factor", "tan_beta", "phi")
"""Coefficients that belong to the instrument or to its output, not to the error model."""


def instrument_of(calibration: Calibration, alpha0: Quantity = 0.0) -> Instrument:
    """The instrument with the estimated scale factor and ``tan_beta``: :meth:`piga.Calibration.instrument`."""
    values = {c.name: c.value_si for c in calibration.coefficients}
    scale_factor = values.get("scale_factor", calibration.scale_factor_nominal)
    return Instrument(scale_factor, math.atan(values.get("tan_beta", 0.0)), alpha0)


def error_model_of(calibration: Calibration) -> ErrorModel:
    """The other coefficients as an error model: :meth:`piga.Calibration.error_model`.

    A calibration counts the drift ``k0_t`` from its reference time, an error model from time zero.
    """
    values = {c.key: c.value_si for c in calibration.coefficients if c.name not in MOTION}
    known = ErrorModel.__dataclass_fields__
    terms = {name: value for name, value in values.items() if name in known}
    left_out = [name for name in values if name not in known]
    if left_out:
        warnings.warn(
            f"the error model leaves out {', '.join(left_out)}: the exact motion has no such term",
            PigaWarning,
            stacklevel=4,
        )
    if "k0_t" in terms:
        terms["k0"] = terms.get("k0", 0.0) - terms["k0_t"] * calibration.time_reference
    return ErrorModel.from_terms(terms | {"T_ref": calibration.temperature_reference})
