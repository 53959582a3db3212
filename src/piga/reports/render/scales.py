"""Scale of an axis: shown range, position of a value, ticks and their labels."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.reports.render.figure import Axis
from piga.reports.render.numbers import fixed, power, printed, significant
from piga.units import DAY

Array = NDArray[np.float64]

MARGIN = 0.04
"""Share of the range that is left empty beyond the data on both sides."""
FLAT = 1e-13
"""Spread of values, relative to their size, below which they count as equal."""
LARGEST_PLAIN, SMALLEST_PLAIN = 6, -3
"""Labels are written out for largest values from ``10^SMALLEST_PLAIN`` to below ``10^LARGEST_PLAIN``."""
OFFSET_STEP = 1e-6
"""Step between ticks, relative to the largest tick, below which a common origin is taken off the labels."""
_STEPS = (1, 2, 5, 10, 20, 50)
_DEGREES = (15, 30, 45, 90, 180, 360)
_SHOWN_DECADES = range(-2, 5)
_CALENDAR = (
    ("s", (1, 2, 5, 10, 15, 30)),
    ("m", (1, 2, 5, 10, 15, 30)),
    ("h", (1, 2, 3, 6, 12)),
    ("D", (1, 2, 4, 7, 14)),
    ("M", (1, 2, 3, 6)),
    ("Y", (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)),
)
_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "D": DAY, "M": 28.0 * DAY, "Y": 365.0 * DAY}


@dataclass(frozen=True)
class Scale:
    """The range ``low`` to ``high`` of an axis, drawn from position ``start`` to position ``end``."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def place(self, values: ArrayLike) -> Array:
        """Positions of values. NaN for gaps and for values below zero on a logarithmic axis."""
        shown, low, high = np.asarray(values, dtype=float), self.low, self.high
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            if self.log:
                shown, low, high = np.log10(np.where(shown > 0.0, shown, np.nan)), *np.log10((low, high))
            share = (shown - low) / (high - low)
            return np.where(np.isfinite(share), self.start + share * (self.end - self.start), np.nan)


@dataclass(frozen=True)
class Ticks:
    """Marked values and their labels; ``minor`` values have a small mark only.

    The labels are values less ``origin``, divided by ``10^exponent``: both are to be named by the axis label.
    """

    at: Array
    words: tuple[str, ...]
    minor: Array
    exponent: int = 0
    origin: float = 0.0


def extent(axis: Axis, values: Iterable[Array], *, from_zero: bool = False) -> tuple[float, float]:
    """Lowest and highest value that an axis shows: its limits, or the data with a margin.

    ``from_zero`` begins at 0 where no value lies below it (bars).
    """
    if axis.limits is not None and _is_usable(axis.limits, log=axis.log):
        return axis.limits
    seen = [v[np.isfinite(v) & ((v > 0.0) | (not axis.log))] for v in values]
    seen = [v for v in seen if v.size]
    if not seen:
        return (1.0, 10.0) if axis.log else (0.0, 1.0)
    low, high = min(float(v.min()) for v in seen), max(float(v.max()) for v in seen)
    if axis.log:
        low, high = _widened(math.log10(low), math.log10(high), 0.2)
        return 10.0**low, 10.0**high
    if from_zero and low >= 0.0 and high > 0.0:
        return 0.0, high * (1.0 + MARGIN)
    if axis.dates:
        return _widened(low, high, 0.5 if high == low else 10.0 / DAY)
    return _widened(low, high, 0.05 * abs(high) or 1.0)


def _is_usable(limits: tuple[float, float], *, log: bool) -> bool:
    low, high = limits
    return math.isfinite(low) and math.isfinite(high) and low < high and not (log and low <= 0.0)


def _widened(low: float, high: float, least: float) -> tuple[float, float]:
    """A margin on both sides; ``least`` where all values are equal."""
    spread = high - low
    room = MARGIN * spread if spread > FLAT * max(abs(low), abs(high)) else least
    return low - room, high + room


def axis_ticks(axis: Axis, scale: Scale, most: int, *, whole: bool = False) -> Ticks:
    """At most about ``most`` ticks at round values.

    ``whole``: the data are whole numbers, and nothing lies between them.
    """
    if axis.dates:
        return _date_ticks(scale.low, scale.high, most)
    if axis.log:
        return _log_ticks(scale.low, scale.high, most)
    factors = _DEGREES if axis.unit == "deg" and scale.high - scale.low >= 90.0 else ()
    return _linear_ticks(scale.low, scale.high, most, least=1.0 if whole else 0.0, factors=factors)


def fitting_ticks(
    axis: Axis, scale: Scale, width: Callable[[str], float], gap: float, *, whole: bool = False
) -> Ticks:
    """As many ticks of a horizontal axis as their labels have room for, ``gap`` between two of them."""
    ticks = axis_ticks(axis, scale, 2, whole=whole)
    for most in range(10, 2, -1):
        ticks = axis_ticks(axis, scale, most, whole=whole)
        x, half = scale.place(ticks.at), np.array([0.5 * width(word) for word in ticks.words])
        if np.all(np.diff(x) >= half[1:] + half[:-1] + gap):
            break
    return ticks


def axis_label(axis: Axis, ticks: Ticks) -> str:
    """Quantity and unit, with the origin and the power of ten that the tick labels leave out."""
    if not ticks.exponent and not ticks.origin:
        return axis.label
    unit = "" if axis.unit == "1" else axis.unit
    quantity = axis.quantity
    if ticks.origin:
        sign = "−" if ticks.origin > 0.0 else "+"
        quantity += f" {sign} {significant(abs(ticks.origin), 15)}{' ' + unit if unit else ''}"
    if ticks.exponent:
        unit = f"{power(ticks.exponent)}{' × ' if unit[:1].isdigit() else ' ' if unit else ''}{unit}"
    return replace(axis, quantity=quantity, unit=unit).label


def _linear_ticks(
    low: float, high: float, most: int, *, least: float = 0.0, factors: tuple[int, ...] = ()
) -> Ticks:
    step, at = _round_values(low, high, most, least, factors)
    origin = 0.0
    if at.size and step < OFFSET_STEP * float(np.abs(at).max()):
        unit = 10.0 ** math.ceil(math.log10(step) + 1.0)
        origin = unit * round(0.5 * (low + high) / unit)
        step, at = _round_values(low - origin, high - origin, most, least, factors)
    exponent = _common_exponent(at)
    decimals = max(0, exponent - math.floor(math.log10(step) + 1e-9))
    words = tuple(_plain(value / 10.0**exponent, decimals) for value in at.tolist())
    return Ticks(at + origin, words, np.zeros(0), exponent, origin)


def _round_values(
    low: float, high: float, most: int, least: float, factors: tuple[int, ...]
) -> tuple[float, Array]:
    """The smallest round step with at most ``most`` multiples between ``low`` and ``high``, and these.

    Where there is room for four, and only one multiple is left, the next smaller step is taken.
    """
    unit = 10.0 ** math.floor(math.log10(max((high - low) / most, 1e-300)))
    steps = [float(f) for f in factors] or [unit * f for f in _STEPS]
    steps = [step for step in steps if step >= least] or [least]
    sizes = [_multiples(low, high, step).size for step in steps]
    chosen = next((index for index, size in enumerate(sizes) if size <= most), len(steps) - 1)
    if sizes[chosen] < 2 and most >= 4 and chosen > 0:
        chosen -= 1
    return steps[chosen], _multiples(low, high, steps[chosen]) * steps[chosen]


def _multiples(low: float, high: float, step: float) -> Array:
    return np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1.0)


def _common_exponent(at: Array) -> int:
    largest = float(np.abs(at).max()) if at.size else 0.0
    if largest == 0.0:
        return 0
    leading = math.floor(math.log10(largest) + 1e-9)
    return 0 if SMALLEST_PLAIN <= leading < LARGEST_PLAIN else 3 * math.floor(leading / 3)


def _plain(value: float, decimals: int) -> str:
    """A label: true minus, thin unbreakable spaces between thousands from five digits on."""
    text = fixed(value, decimals)
    if abs(value) >= 1e4:
        whole, point, rest = text.partition(".")
        text = f"{int(whole):,}".replace(",", "\u202f") + point + rest
    return text.replace("-", "−")


def _log_ticks(low: float, high: float, most: int) -> Ticks:
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    decades = last - first + 1
    inside = np.array([f * 10.0**n for n in range(first - 1, last + 1) for f in range(1, 10)])
    inside = inside[(inside >= low * (1.0 - 1e-9)) & (inside <= high * (1.0 + 1e-9))]
    if decades >= 3 or (decades == 2 and most < 4):
        stride = math.ceil(decades / most)
        marked = [n for n in range(first, last + 1) if n % stride == 0]
        minor = inside if stride == 1 else 10.0 ** np.arange(first, last + 1.0)
        return Ticks(10.0 ** np.array(marked, dtype=float), _decade_words(marked), minor)
    for factors in ((1, 2, 5), (1, 3), (1,)):
        pairs = [(f, n) for n in range(first - 1, last + 1) for f in factors]
        at = np.array([f * 10.0**n for f, n in pairs])
        kept = (at >= low * (1.0 - 1e-9)) & (at <= high * (1.0 + 1e-9))
        if 2 <= kept.sum() <= most:
            some = [pair for pair, one in zip(pairs, kept, strict=True) if one]
            return Ticks(at[kept], _sub_words(some), inside)
    return _linear_ticks(low, high, most)


def _decade_words(marked: list[int]) -> tuple[str, ...]:
    if all(n in _SHOWN_DECADES for n in marked):
        return tuple(_plain(10.0**n, max(0, -n)) for n in marked)
    return tuple(power(n) for n in marked)


def _sub_words(some: list[tuple[int, int]]) -> tuple[str, ...]:
    if all(n in _SHOWN_DECADES for _, n in some):
        return tuple(_plain(f * 10.0**n, max(0, -n)) for f, n in some)
    return tuple(power(n) if f == 1 else printed(f"{f}e{n}") for f, n in some)


def _date_ticks(low: float, high: float, most: int) -> Ticks:
    """Calendar dates at the finest round step; each label is a whole date or, for seconds, a time of day."""
    for unit, steps in _CALENDAR:
        for step in steps:
            if (high - low) * DAY > (most + 1) * step * _SECONDS[unit] * 1.12:
                continue
            at, words = _dates(low, high, unit, step)
            if at.size <= most:
                return Ticks(at, words, np.zeros(0))
    return Ticks(np.zeros(0), (), np.zeros(0))


def _dates(low: float, high: float, unit: str, step: int) -> tuple[Array, tuple[str, ...]]:
    first, last = (np.datetime64(math.floor(day * DAY), "s").astype(f"M8[{unit}]") for day in (low, high))
    shift = 1970 if unit == "Y" else 0
    number = np.arange(first.astype(int), last.astype(int) + 2) + shift
    dates = (number[number % step == 0] - shift).astype(f"M8[{unit}]")
    at = dates.astype("M8[s]").astype(np.int64) / DAY
    dates, at = dates[(at >= low) & (at <= high)], at[(at >= low) & (at <= high)]
    form = "m" if unit in ("h", "m") else unit
    words = [str(date).replace("T", " ") for date in dates.astype(f"M8[{form}]")]
    return at, tuple(word[-8:] if unit == "s" else word for word in words)
