"""The instrument's parameters: the cross-coupled ideal instrument, and the errors of a real one. A calibration gives both."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError, PigaWarning
from piga.records.calibration.calibration import Calibration
from piga.records.terms import unit_of
from piga.terms import MOTION, PRODUCTS, THERMAL_TERMS
from piga.units import si_or_text

_MAX_BETA = 0.5 * math.pi
Quantity = float | str
"""A number in SI, or text with its unit such as ``"0.8884 rad/s/g"``."""


def _set(instance: object, name: str, value: float) -> None:
    object.__setattr__(instance, name, value)


@dataclass(frozen=True)
class Instrument:
    """A PIGA whose rotor axis is not orthogonal to its outer-gimbal axis, free of other errors.

    Every argument takes a number in SI or text with a unit; the fields are SI numbers.

    Parameters
    ----------
    scale_factor:
        ``K = ml/H`` [(rad/s)/(m/s^2)]: pendulosity over rotor angular momentum. Positive; 0.055 to
        0.09, i.e. 0.55 to 0.89 (rad/s)/g, is usual.
    beta:
        Non-orthogonality of rotor axis and outer-gimbal axis [rad], between -pi/2 and pi/2;
        1e-5 to 5e-3 is usual.
    alpha0:
        Outer-gimbal angle at the start [rad], from ``Y0`` towards ``Z0``. Any number of turns.

    Raises
    ------
    ArgumentError
        If the scale factor is not positive, or ``beta`` reaches a right angle.
    UnitError
        If a text has no unit or one of another kind, or a number is not finite.

    Examples
    --------
    >>> inst = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec")
    >>> round(inst.tan_beta, 9)
    0.004848175
    """

    scale_factor: float
    beta: float = 0.0
    alpha0: float = 0.0

    def __init__(self, scale_factor: Quantity, beta: Quantity = 0.0, alpha0: Quantity = 0.0) -> None:
        _set(self, "scale_factor", si_or_text(scale_factor, "rad/s/g", what="Instrument scale_factor"))
        _set(self, "beta", si_or_text(beta, "rad", what="Instrument beta"))
        _set(self, "alpha0", si_or_text(alpha0, "rad", what="Instrument alpha0"))
        if self.scale_factor <= 0.0:
            raise ArgumentError(
                f"Instrument scale_factor: {scale_factor!r} is not positive",
                remedy="use a positive value; reverse the input axis instead",
            )
        if abs(self.beta) >= _MAX_BETA:
            raise ArgumentError(
                f"Instrument beta: {beta!r} is not between -90 and 90 degrees",
                remedy="give the small angle by which rotor axis and outer axis miss 90 degrees",
            )

    @property
    def tan_beta(self) -> float:
        """Tangent of ``beta``, the cross-coupling coefficient [1]."""
        return math.tan(self.beta)


@dataclass(frozen=True)
class ErrorModel:
    r"""Errors of a real instrument, as a specific force that is added along the input axis.

    .. math::

       e = k_0 + k_1 a_x + k_2 a_x^2 + k_3 a_x^3 + k_{2o} a_x |a_x| + k_{1a} |a_x| + m_Y a_Y + m_Z a_Z
         + k_{XY} a_x a_Y + k_{XZ} a_x a_Z + k_{YY} a_Y^2 + k_{ZZ} a_Z^2 + k_{YZ} a_Y a_Z
         + s_1 \sin\alpha + c_1 \cos\alpha + k_{0t} t + (k_{0T} + k_{1T} a_x)(T - T_{ref})

    and the gimbal turns with ``alpha' = u_x + tan(beta)(u_Y sin(alpha) - u_Z cos(alpha)) + K e``.
    Numbers are SI (``k2`` in (m/s^2)/(m/s^2)^2, ``k0`` in m/s^2, ``T_ref`` in kelvin); text carries
    its unit (``k2="2e-6 g/g^2"``, ``T_ref="20 degC"``). Names follow IEEE 1293 by analogy; that
    standard excludes this instrument. An unknown name is refused.

    ``s1`` and ``c1`` act like a transverse specific force and are propagated exactly. The two-by-two matrices of the
    exact motion cannot hold harmonics of second and higher order. These can be calibrated (``piga.calibrate``) but
    not propagated, and are not fields of this class.

    ``t`` is the time as given to :func:`piga.propagate` (not counted from its first sample).
    """

    k0: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k2o: float = 0.0
    k1a: float = 0.0
    m_Y: float = 0.0
    m_Z: float = 0.0
    k_XY: float = 0.0
    k_XZ: float = 0.0
    k_YY: float = 0.0
    k_ZZ: float = 0.0
    k_YZ: float = 0.0
    s1: float = 0.0
    c1: float = 0.0
    k0_t: float = 0.0
    k0_T: float = 0.0
    k1_T: float = 0.0
    T_ref: float = 293.15

    def __init__(self, **terms: Quantity) -> None:
        unknown = [name for name in terms if name not in self.__dataclass_fields__]
        if unknown:
            raise ArgumentError(
                f"ErrorModel: term '{unknown[0]}' cannot be propagated",
                remedy=f"known terms: {' '.join(self.__dataclass_fields__)}; higher harmonics are only calibrated",
            )
        for field in fields(self):
            unit = "degC" if field.name == "T_ref" else unit_of(field.name)
            value = terms.get(field.name, getattr(type(self), field.name))
            _set(self, field.name, si_or_text(value, unit, what=f"ErrorModel {field.name}"))

    @property
    def needs_temperature(self) -> bool:
        """True if a temperature must be given with the specific force."""
        return any(getattr(self, name) != 0.0 for name in THERMAL_TERMS)

    def specific_force(
        self,
        t: NDArray[np.float64],
        f: NDArray[np.float64],
        temperature: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """The part of ``e`` [m/s^2] that does not depend on alpha, shape (n,).

        ``t`` (n,) [s], ``f`` (n, 3) [m/s^2], ``temperature`` (n,) [K].
        """
        inputs = {"x": f[:, 0], "|x|": np.abs(f[:, 0]), "y": f[:, 1], "z": f[:, 2], "t": t}
        if temperature is not None:
            inputs["T"] = temperature - self.T_ref
        error = np.zeros(f.shape[0])
        for name, factors in PRODUCTS.items():
            coefficient = getattr(self, name, 0.0)
            if coefficient != 0.0 and inputs.keys() >= set(factors):
                error += math.prod((inputs[factor] for factor in factors), start=coefficient)
        return error


def instrument_of(calibration: Calibration, alpha0: Quantity = 0.0) -> Instrument:
    """The instrument with the estimated scale factor and ``tan_beta``: :meth:`piga.Calibration.instrument`."""
    calibration.require_gimbal("the motion of an instrument")
    values = {c.name: c.value_si for c in calibration.coefficients}
    scale_factor = values.get("scale_factor", calibration.scale_factor_nominal)
    return Instrument(scale_factor, math.atan(values.get("tan_beta", 0.0)), alpha0)


def error_model_of(calibration: Calibration) -> ErrorModel:
    """The other coefficients as an error model: :meth:`piga.Calibration.error_model`.

    A calibration counts drifts, as ``k0_t``, from its reference time, an error model from time zero.
    """
    values = {c.key: c.value_si for c in calibration.coefficients if c.name not in MOTION}
    available = ErrorModel.__dataclass_fields__
    terms = {name: value for name, value in values.items() if name in available}
    missing = [name for name in values if name not in available]
    if missing:
        warnings.warn(
            f"the error model leaves out {', '.join(missing)}: the exact motion has no such term",
            PigaWarning,
            stacklevel=4,
        )
    for drift in [name for name in terms if "t" in PRODUCTS.get(name, ())]:
        rest = tuple(factor for factor in PRODUCTS[drift] if factor != "t")
        base = next(name for name in available if PRODUCTS.get(name) == rest)
        terms[base] = terms.get(base, 0.0) - terms[drift] * calibration.time_reference
    return ErrorModel(**terms | {"T_ref": calibration.temperature_reference})
