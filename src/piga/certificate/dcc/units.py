r"""Units and numbers of the Digital System of Units (D-SI 2.2.1), in which a certificate is written.

All units are SI. The unit ``g`` is exactly 9.80665 m/s^2, a decimal fraction. Numbers are converted with decimal arithmetic and
written with 17 significant digits.
"""

from __future__ import annotations

from decimal import Context, Decimal
from functools import lru_cache
from urllib.parse import quote

from piga.errors import DataError
from piga.units import parse_unit

_SAFE = "[]_.,:;+-=()/*"


def label_of(key: str) -> str:
    """A coefficient's key without spaces (segment labels may contain spaces)."""
    return quote(key, safe=_SAFE)


G = Decimal("9.80665")
"""Standard gravity [m/s^2], exact."""
DIGITS = 17
"""Significant digits of converted numbers: enough to distinguish any two floats."""

_EXACT = Context(prec=60)
_SHOWN = Context(prec=DIGITS)
_POWERS = {"rad/s/g": -1, "1": 0, "rad": 0, "g": 1, "g/g^2": -1, "g/g^3": -2, "g/s": 1, "g/K": 1, "1/K": 0}
"""Power of ``g`` in each unit of a coefficient."""
_BASE = (r"\metre", r"\second", r"\radian", r"\kilogram", r"\kelvin")


def power_of_g(unit: str) -> int:
    """Power of ``g`` in a coefficient's unit: ``value_SI = value * 9.80665**power``."""
    return _POWERS[unit]


@lru_cache(maxsize=256)
def dsi_unit(*units: str) -> str:
    r"""D-SI text of a unit, or of the product of several units.

    Examples
    --------
    >>> dsi_unit("g/g^2"), dsi_unit("g", "rad")
    ('\\metre\\tothe{-1}\\second\\tothe{2}', '\\metre\\second\\tothe{-2}\\radian')
    """
    totals = [sum(column) for column in zip(*(parse_unit(unit).dimension for unit in units), strict=True)]
    if any(totals[len(_BASE) :]):
        raise DataError(
            f"unit '{' '.join(units)}' is not made of SI base units and the radian",
            remedy="write the quantity in units that are",
        )
    parts = [_powered(name, power) for name, power in zip(_BASE, totals, strict=False) if power]
    return "".join(parts) or r"\one"


def _powered(name: str, power: float) -> str:
    return name if power == 1.0 else f"{name}\\tothe{{{power:g}}}"


def to_dsi(value: float, *units: str) -> str:
    """SI text of a number in the product of these units."""
    power = sum(power_of_g(unit) for unit in units)
    if power == 0:
        return repr(float(value))
    return str(_SHOWN.plus(_EXACT.multiply(Decimal(value), _EXACT.power(G, power))))


def significant_digit(half_width: Decimal, value: Decimal) -> int:
    """Power of ten of the last significant digit. U has two significant digits. Without U (a given value) all digits count."""
    return half_width.adjusted() - 1 if half_width else value.adjusted() - (DIGITS - 1)
