"""Units at the edges: text such as ``"0.8884 rad/s/g"`` to SI floats and back.

Inside the package every number is SI (metre, second, radian, kilogram, kelvin). The unit ``g`` is
exactly 9.80665 m/s^2 wherever it stands. Angle counts as a dimension of its own, so that a time
given in degrees, or an angle given in ppm, is refused.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import lru_cache

from piga.errors import UnitError

G0 = 9.80665
"""Standard gravity [m/s^2], exact by definition: the unit ``g``."""

ARCSEC = math.pi / 648000.0
"""One second of arc [rad]."""

ARCMIN = 60.0 * ARCSEC
"""One minute of arc [rad]."""

MICRO_G = 1e-6 * G0
"""A millionth of standard gravity [m/s^2]: the unit of figures and tables."""

DAY = 86400.0
"""One day [s]."""

_BASE = ("m", "s", "rad", "kg", "K", "V", "count", "A")
_DIMENSIONLESS = (0.0,) * len(_BASE)


def _dim(**powers: float) -> tuple[float, ...]:
    return tuple(float(powers.get(base, 0.0)) for base in _BASE)


_ANGLE = {
    "rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "nrad": 1e-9, "deg": math.pi / 180.0, "arcmin": math.pi / 10800.0,
    "arcsec": ARCSEC, "mas": ARCSEC * 1e-3, "rev": 2.0 * math.pi,
}  # fmt: skip
_FORCE_PER_MASS = {"g": G0, "mg": G0 * 1e-3, "ug": G0 * 1e-6, "ng": G0 * 1e-9, "mGal": 1e-5, "uGal": 1e-8}
_TIME = {
    "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "hr": 3600.0, "d": DAY, "day": DAY,
    "year": 365.25 * DAY,
}  # fmt: skip
_KINDS = (
    (_DIMENSIONLESS, {"1": 1.0, "%": 1e-2, "ppm": 1e-6, "ppb": 1e-9}),
    (_dim(m=1), {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}),
    (_dim(s=1), _TIME),
    (_dim(s=-1), {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6}),
    (_dim(rad=1), _ANGLE),
    (_dim(rad=1, s=-1), {"rpm": 2.0 * math.pi / 60.0}),
    (_dim(m=1, s=-2), _FORCE_PER_MASS),
    (_dim(kg=1), {"kg": 1.0, "gram": 1e-3}),
    (_dim(m=1, s=-2, kg=1), {"N": 1.0, "mN": 1e-3}),
    (_dim(m=2, s=-2, kg=1), {"Nm": 1.0, "mNm": 1e-3, "uNm": 1e-6}),
    (_dim(kg=1, m=-1, s=-2), {"Pa": 1.0, "hPa": 1e2, "kPa": 1e3}),
    (_dim(K=1), {"K": 1.0, "degC": 1.0}),
    (_dim(V=1), {"V": 1.0, "mV": 1e-3, "uV": 1e-6}),
    (_dim(A=1), {"A": 1.0, "mA": 1e-3, "uA": 1e-6}),
    (_dim(count=1), {"count": 1.0, "counts": 1.0}),
)
"""Units by their kind: powers of the base units, and SI value of each unit."""
_ATOMS = {name: (factor, dimension) for dimension, units in _KINDS for name, factor in units.items()}
_ALIASES = {
    "°": "deg", "′": "arcmin", "″": "arcsec", "µg": "ug", "μg": "ug", "µrad": "urad", "μrad": "urad",
    "µs": "us", "μs": "us", "micro-g": "ug", "°C": "degC", "℃": "degC", "kelvin": "K",
    "minute": "min", "minutes": "min", "hour": "h", "hours": "h", "days": "d", "second": "s",
    "seconds": "s", "degree": "deg", "degrees": "deg", "turn": "rev", "turns": "rev", "r": "rev",
    "dph": "deg/h", "m/s²": "m/s^2", "m/s2": "m/s^2", "N·m": "Nm", "N*m": "Nm", "N m": "Nm",
    "Grad": "deg", "Sek": "s", "Umdr": "rev", "U/min": "rpm",
    "tr/min": "rpm", "°/s²": "deg/s^2", "rad/s²": "rad/s^2", "度": "deg", "秒": "s", "毫秒": "ms", "转/分": "rpm",
    "度/秒": "deg/s", "个": "count", "脉冲": "count", "Imp": "count", "imp": "count", "Impulse": "count", "Inkr": "count",
    "pulses": "count", "pulse": "count", "impulsions": "count", "LSB": "count",
}  # fmt: skip
_FACTOR = re.compile(r"\s*([*/·]?)\s*([A-Za-z%µμ°′″℃][A-Za-z%]*|1|#[0-9]+)\s*(?:\^\s*(-?[0-9]+(?:\.[0-9]+)?))?")
_INNER = re.compile(r"((?<![A-Za-z%µμ°′″℃])sqrt)?\s*\(([^()]*)\)")
_DECIMAL_COMMA = re.compile(r"\s*[-+]?[0-9.]*,[0-9]")
_QUANTITY = re.compile(r"^\s*([-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s*(.*?)\s*$")


_OF_NUMBER = re.compile(rf"(?<=[0-9)]) (?=(?:u|sqrt|{'|'.join(map(re.escape, _ATOMS))})(?![A-Za-z0-9]))")
"""The space between a number and its unit, or the u of an uncertainty."""
_UNIT_REMEDY = f"use one of: {' '.join(_ATOMS)}; combine with * / ^ sqrt()"
_MOST_LETTERS = 200
"""Most characters of a unit."""
LARGEST = 1e100
"""Largest number of any quantity: squares of it, and products with units, stay finite."""


@dataclass(frozen=True)
class Unit:
    """A parsed unit: SI value of one unit, and powers of (m, s, rad, kg, K, V, count, A)."""

    text: str
    factor: float
    dimension: tuple[float, ...]

    def __str__(self) -> str:
        return self.text


_Size = tuple[float, tuple[float, ...]]
"""SI value and powers of the base units."""


def _product(text: str, inner: list[_Size]) -> _Size:
    """Factors with ``*``, ``/`` or a blank between them, each with its ``^power``; ``#2`` stands for ``inner[2]``."""
    factor, dimension, at = 1.0, _DIMENSIONLESS, 0
    while match := _FACTOR.match(text, at):
        operator, name, power = match.groups()
        if operator and at == 0:
            break
        size, powers = inner[int(name[1:])] if name[0] == "#" else _ATOMS[_ALIASES.get(name, name)]
        exponent, sign = float(power or 1.0), -1.0 if operator == "/" else 1.0
        factor *= (size**exponent) ** sign
        dimension = tuple(a + sign * exponent * b for a, b in zip(dimension, powers, strict=True))
        at = match.end()
    if at == 0 or text[at:].strip():
        raise ValueError(text[at:].strip())
    return factor, dimension


@lru_cache(maxsize=512)
def parse_unit(text: str) -> Unit:
    """Parse a unit such as ``rad/s/g``, ``g/g^2`` or ``rad/sqrt(s)``.

    Raises
    ------
    UnitError
        If the text is empty or holds an unknown unit.
    """
    stripped = _ALIASES.get(text.strip(), text.strip())
    if not stripped:
        raise UnitError("a unit is missing", remedy="write the unit, e.g. 'rad/s', or '1' for a plain number")
    if len(stripped) > _MOST_LETTERS:
        raise UnitError(f"unit '{stripped[:40]}...' has {len(stripped)} characters", remedy="e.g. 'rad/s/g'")
    rest, inner = stripped, list[_Size]()
    try:
        while match := _INNER.search(rest):  # what stands in parentheses
            size, powers = _product(match[2], inner)
            inner.append((math.sqrt(size), tuple(p / 2 for p in powers)) if match[1] else (size, powers))
            rest = f"{rest[: match.start()]} #{len(inner) - 1} {rest[match.end() :]}"
        factor, dimension = _product(rest, inner)
    except KeyError as error:
        raise UnitError(f"unknown unit {error} in '{text}'", remedy=_UNIT_REMEDY) from None
    except ValueError as error:
        raise UnitError(f"unit '{text}' cannot be read at '{error}'", remedy=_UNIT_REMEDY) from None
    except (ArithmeticError, IndexError):
        factor, dimension = math.nan, _DIMENSIONLESS
    if not (0.0 < factor < math.inf and all(map(math.isfinite, dimension))):
        raise UnitError(f"unit '{text}' is too large or too small to compute with", remedy="e.g. 'rad/s/g'")
    return Unit(stripped, factor, dimension)


def conversion_factor(unit: str, to: str, *, what: str = "quantity") -> float:
    """Factor that turns a number in ``unit`` into a number in ``to``.

    Raises
    ------
    UnitError
        If the two units do not measure the same kind of quantity; the message names ``what``.
    """
    try:
        source, target = parse_unit(unit), parse_unit(to)
    except UnitError as error:
        raise UnitError(f"{what}: {error.message}", remedy=error.remedy) from None
    if source.dimension != target.dimension:
        raise UnitError(
            f"{what}: unit '{unit}' does not measure the same quantity as '{to}'",
            remedy=f"give it in '{to}' or a multiple of it",
        )
    return source.factor / target.factor


def offset_to_si(unit: str) -> float:
    """Offset [K] to add after scaling from ``unit``: 273.15 for ``degC``, otherwise 0."""
    return 273.15 if parse_unit(unit).text == "degC" else 0.0


def _too_large(what: str, value: str) -> UnitError:
    return UnitError(
        f"{what}: {value[:42]} is not a finite number, or too large to compute with",
        remedy=f"give a number of at most {LARGEST:g} in SI",
    )


_NUMBERS_ARE_SI = ContextVar("numbers are SI", default=False)


@contextmanager
def numbers_are_si(old: bool) -> Iterator[None]:
    """Take plain numbers as SI inside, if ``old``: the rule of files of piga 0.1 and 0.2."""
    token = _NUMBERS_ARE_SI.set(old)
    try:
        yield
    finally:
        _NUMBERS_ARE_SI.reset(token)


def si_or_text(value: str | float, like: str, *, what: str = "quantity") -> float:
    """SI value of an argument in Python, as :func:`to_si`; but a plain number is SI."""
    with numbers_are_si(True):
        return to_si(value, like, what=what)


def _without_unit(what: str, number: str, like: str) -> UnitError:
    return UnitError(
        f"{what}: {number} has no unit",
        remedy=f'write its unit{", e.g. deg" if like == "rad" else ""}; piga 0.2 took it as "{number} {like}"',
    )


def to_si(value: str | float, like: str, *, what: str = "quantity", unit: str | None = None) -> float:
    """SI value of a quantity written by a person.

    Parameters
    ----------
    value:
        ``"1000 arcsec"``. A plain number needs no unit if it is zero (but for a temperature), or if ``like`` is ``"1"``.
    like:
        A unit of the kind of quantity expected, e.g. ``"rad"``, ``"rad/s/g"``; ``"ppm"`` for a relative size.
    what:
        Name of the quantity for messages, e.g. ``"[instrument] scale_factor"``.
    unit:
        Unit of a plain number, where something else states it.

    Raises
    ------
    UnitError
        If there is no number, no unit, or a unit of another kind; or the number is not finite.
    """
    expected = parse_unit(like)
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise UnitError(f"{what}: {value!r} is not a quantity", remedy=f"write e.g. '1 {like}'")
    if not isinstance(value, str):
        if not abs(value) <= LARGEST:
            raise _too_large(what, str(value))
        if unit is not None and not _NUMBERS_ARE_SI.get():
            return to_si(f"{value!r} {unit}", like, what=what)
        if like != "1" and (value != 0.0 or like in ("K", "degC")) and not _NUMBERS_ARE_SI.get():
            raise _without_unit(what, str(value), like)
        return float(value)
    match = _QUANTITY.match(value)
    if match is None:
        raise UnitError(f"{what}: '{value}' is not a number with a unit", remedy=f"write e.g. '1 {like}'")
    number, unit_text = float(match.group(1)), match.group(2)
    if _DECIMAL_COMMA.match(value):
        raise UnitError(
            f"{what}: '{value[:40]}' has a comma in the number",
            remedy=f"write a decimal point, e.g. '1.5 {like}'",
        )
    if not abs(number) <= LARGEST:
        raise _too_large(what, f"'{value[:40]}'")
    if not unit_text:
        if like == "1" or (_NUMBERS_ARE_SI.get() and expected.dimension == _DIMENSIONLESS):
            return number
        raise _without_unit(what, match.group(1), like)
    try:
        written = parse_unit(unit_text)
    except UnitError as error:
        raise UnitError(f"{what}: {error.message}", remedy=error.remedy) from None
    if written.dimension != expected.dimension:
        raise UnitError(
            f"{what}: '{value}' is given in '{unit_text}', but a quantity in '{like}' is needed",
            remedy=f"give it in '{like}' or a multiple of it",
        )
    result = number * written.factor + offset_to_si(unit_text)
    if not abs(result) <= LARGEST:
        raise _too_large(what, f"'{value[:40]}'")
    return result


def written_quantity(text: str) -> tuple[str, str]:
    """Number and unit of a quantity as text."""
    match = _QUANTITY.match(text)
    if match is None:
        raise UnitError(f"'{text}' does not begin with a number", remedy="write e.g. '20.1 degC'")
    return match[1], match[2]


def from_si(value: float, unit: str) -> float:
    """Number of ``unit`` in an SI value (``degC`` with its offset)."""
    return (value - offset_to_si(unit)) / parse_unit(unit).factor


def wrapped(text: str, width: int, first: str = "", later: str = "") -> list[str]:
    """A text in lines of at most ``width`` letters, which begin with ``first`` and ``later``.

    No name is broken, and no number with its unit.

    Examples
    --------
    >>> wrapped("the bias moved by 12 ug", 21)
    ['the bias moved by', '12 ug']
    """
    lines = textwrap.wrap(
        _OF_NUMBER.sub("\xa0", text),
        width,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\xa0", " ") for line in lines]
