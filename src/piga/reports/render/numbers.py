"""Numbers for people: rounded by their uncertainty, in units that keep them short.

Uncertainties are given with two significant digits and the value to the same decimal place, as the
GUM (JCGM 100, 7.2.6) recommends; ``3.5876(12) × 10⁻⁴`` puts the uncertainty in units of the last digits. All pages, tables
and certificates take their numbers from here, with a true minus sign; :func:`ascii_text` turns them into plain text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Container, Sequence
from dataclasses import dataclass
from decimal import ROUND_HALF_EVEN, Decimal

from piga.units import ARCSEC

_DIGITS, _RAISED = "-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"
_RAISE, _LOWER = str.maketrans(_DIGITS, _RAISED), str.maketrans(_RAISED, _DIGITS)
_ASCII = str.maketrans({
    "−": "-", "–": "-", "±": "+/-", "×": "x", "∞": "inf", "µ": "u", "²": "^2", "³": "^3", "\u00a0": "", "\u202f": "",
    "″": "arcsec", "°": "deg", "→": "->", "…": "...", "ν": "nu", "β": "beta", "φ": "phi", "χ": "chi", "ψ": "psi",
})  # fmt: skip
_MINUS, _EXPONENT = re.compile(r"(?<![\w)])-(?=\d)"), re.compile(r"(?<=[\d)])e(-?\d+)\b")
_PRETTY = (("^2", "²"), ("^3", "³"), ("sqrt(s)", "√s"), ("sqrt(Hz)", "√Hz"), ("arcsec", "″"), ("degC", "°C"))


def shown_output(unit: str) -> tuple[float, str]:
    """Unit in which an output is shown, and its size: an angle in seconds of arc, all others as they are."""
    return (ARCSEC, unit.replace("rad", "arcsec", 1)) if unit.startswith("rad") else (1.0, unit)


@dataclass(frozen=True)
class Rounded:
    """Text of a value and of its uncertainty, both to the same decimal place and power of ten; and both in one, two ways."""

    value: str
    uncertainty: str
    concise: str
    interval: str


def _place(uncertainty: Decimal, digits: int) -> int:
    """Decimal exponent of the last kept digit (after rounding, which may carry: 0.0996 becomes 0.10)."""
    place = uncertainty.adjusted() - digits + 1
    rounded = uncertainty.quantize(Decimal(1).scaleb(place), ROUND_HALF_EVEN)
    return rounded.adjusted() - digits + 1


def _fixed(number: Decimal, place: int) -> str:
    return f"{number.quantize(Decimal(1).scaleb(place), ROUND_HALF_EVEN):f}"


def _is_plain(leading: int, place: int) -> bool:
    return -3 <= leading < 6 and place <= 0


_LEAST_RATIO = 1e-25
"""Smallest ratio of an uncertainty to its value that is shown with it."""


def rounded(value: float, uncertainty: float, *, digits: int = 2) -> Rounded:
    """Round a value by its uncertainty.

    Parameters
    ----------
    value, uncertainty:
        In the same unit. If the uncertainty is zero, negative or not finite, the value gets six significant digits
        and the uncertainty a dash.
    digits:
        Significant digits of the uncertainty.
    """
    if not math.isfinite(value):
        return Rounded("not finite", "–", "not finite", "not finite")
    if not (math.isfinite(uncertainty) and uncertainty > _LEAST_RATIO * abs(value)):
        text = significant(value)
        return Rounded(text, "–", text, f"{text} ± –")
    number, spread = Decimal(repr(float(value))), Decimal(repr(float(uncertainty)))
    place = _place(spread, digits)
    number = number.quantize(Decimal(1).scaleb(place), ROUND_HALF_EVEN)
    number = number if number else abs(number)
    spread = spread.quantize(Decimal(1).scaleb(place), ROUND_HALF_EVEN)
    leading = max(number.adjusted() if number else place, spread.adjusted())
    exponent = 0 if _is_plain(leading, place) else leading
    number, spread, place = number.scaleb(-exponent), spread.scaleb(-exponent), place - exponent
    times = _times(exponent)
    value_text, spread_text = printed(_fixed(number, place)), _fixed(spread, place)
    last = spread_text if spread >= 1 and place < 0 else str(int(spread.scaleb(-place)))
    interval = f"{value_text} ± {spread_text}"
    interval = f"({interval}){times}" if exponent else interval
    return Rounded(value_text + times, spread_text + times, f"{value_text}({last}){times}", interval)


def significant(value: float, digits: int = 6, *, zeros: bool = False) -> str:
    """A number with this many significant digits; trailing zeros only on request. Never ``-0`` or ``nan``."""
    if not math.isfinite(value):
        return "–"
    number = Decimal(f"{value + 0.0:.{digits - 1}e}")
    exponent = 0 if _is_plain(number.adjusted(), 0) or not number else number.adjusted()
    text = f"{number.scaleb(-exponent):f}"
    text = text.rstrip("0").rstrip(".") if "." in text and not zeros else text
    return printed(text) + _times(exponent)


def _times(exponent: int) -> str:
    """Times a power of ten, as it is printed; nothing for the power 0."""
    return f"\u00a0×\u00a010{str(exponent).translate(_RAISE)}" if exponent else ""


def fixed(value: float, decimals: int) -> str:
    """A number with this many decimals. A number that rounds to zero has no sign."""
    return printed(f"{round(value, decimals) + 0.0:.{decimals}f}")


def signed(value: float, decimals: int) -> str:
    """A number with its sign and this many decimals. A number that rounds to zero has no sign."""
    text = fixed(value, decimals)
    return f"+{text}" if round(value, decimals) > 0.0 else text


def short(value: float, digits: int = 3) -> str:
    """A number of three significant digits for tables and tiles; powers of ten only when far from 1."""
    if not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    if 1e3 <= abs(value) < 1e7:
        return count(round(value))
    return significant(value, digits, zeros=True)


def count(number: int) -> str:
    """A whole number with thin unbreakable spaces between thousands, from five digits on."""
    return printed(f"{number:,}".replace(",", " ") if abs(number) >= 10000 else str(number))


def duration(seconds: float) -> str:
    """A duration in seconds, minutes or hours."""
    factor, unit = (1.0, "s") if seconds < 120.0 else (60.0, "min") if seconds < 7200.0 else (3600.0, "h")
    return f"{significant(seconds / factor, 3)} {unit}"


def relative(value: float, uncertainty: float) -> str:
    """Uncertainty as a share of the value, in %, ppm or ppb."""
    if not (value and math.isfinite(uncertainty) and math.isfinite(value)):
        return "–"
    share = abs(uncertainty / value)
    if share > 1.0:
        return "> 100 %"
    scale, name = (1e2, "%") if share >= 1e-3 else (1e6, "ppm") if share >= 1e-7 else (1e9, "ppb")
    return f"{significant(share * scale, 2, zeros=True)} {name}"


def printed(number: str) -> str:
    """Numbers of a text as they are printed: ``3.5876(12)e-4`` becomes ``3.5876(12) × 10⁻⁴``, with a true minus sign."""
    return _EXPONENT.sub(lambda found: _times(int(found[1])), _MINUS.sub("−", number))


def ascii_text(text: str) -> str:
    """A printed text for any terminal."""
    text = re.sub(rf"\s*×\s*10([{_RAISED}]+)", lambda found: f"e{found[1].translate(_LOWER)}", text)
    return re.sub("√(Hz|s)", r"sqrt(\1)", text).translate(_ASCII)


def aligned(rows: Sequence[Sequence[str]], left: Container[int] = ()) -> list[str]:
    """Rows of a table for the terminal, two spaces between columns. Those of ``left`` begin alike, the others end alike.

    Examples
    --------
    >>> aligned([("k0", "1.5"), ("tan_beta", "12")], left={0})
    ['k0        1.5', 'tan_beta   12']
    """
    width = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            text.ljust(wide) if k in left else text.rjust(wide)
            for k, (text, wide) in enumerate(zip(row, width, strict=True))
        )
        for row in rows
    ]


def pretty_unit(unit: str) -> str:
    """Unit as it is printed: ``ug/g^2`` becomes ``µg/g²``; the plain number ``1`` is left empty."""
    if unit in ("", "1"):
        return ""
    text = unit
    for plain, printed in _PRETTY:
        text = text.replace(plain, printed)
    for name in ("ug", "urad", "us"):
        if text == name or text.startswith((f"{name}/", f"{name}·")):
            text = "µ" + text[1:]
    return text
