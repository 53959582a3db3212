"""Guess the content of each column of a log from its name, its unit and its values.

Names and units are those that logs write, in English, German, French and Chinese.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, Literal

import numpy as np

from piga.errors import ArgumentError, UnitError
from piga.formats.text.time_stamp import forms_of
from piga.reading.columns import positions
from piga.results import Array
from piga.units import G0, parse_unit

Kind = Literal[
    "time", "date", "counts", "pulses", "angle", "rate", "direct", "force", "base-rate", "temperature", "segment", "sequence",
    "stand-angle", "stand-speed", "other",
]  # fmt: skip
"""What a column holds. ``angle`` and ``rate`` are those of the outer gimbal, ``stand-...`` those of the machine.

``direct`` is the output of an instrument without a gimbal, in V, mA, Hz, LSB, m/s^2."""

_AXES = {"x": 0, "y": 1, "z": 2}
_AXIAL = ("force", "base-rate")
"""Kinds of a component along an axis."""
_NAMES = tomllib.loads(files("piga.data").joinpath("names.toml").read_text("utf-8"))
"""Names in English, German, French and Chinese."""
_WORDS: dict[Kind, list[str]] = _NAMES["columns"]
FACTS: dict[str, list[str]] = _NAMES["facts"]
"""Keys of the run file, with the names of their values in preambles."""
_SUFFIX_UNITS: dict[str, str] = _NAMES["units"]
_SPEEDS: list[str] = _NAMES["speeds"]["rpm"]
_BRACKET = re.compile(r"\s*[\[(（【][^\])）】]*[\])）】]?\s*$")


def plain(name: str) -> str:
    """A name in small letters, without unit in brackets, with one space between its words."""
    bare = re.sub(r"#\d+$", "", unicodedata.normalize("NFKC", name).strip().lstrip("#"))
    text = _BRACKET.sub("", bare.strip())
    text = re.sub(r"(?<=[a-zäöüéè])(?=[A-Z][a-z])", " ", text)
    return " ".join(re.sub(r"[_\-./:,;]+", " ", text).casefold().split())


def unit_in_name(name: str) -> tuple[str, str]:
    """A plain name without the unit at its end, and this unit: ``fx_g`` is fx in g. Empty without one."""
    text = plain(name)
    words = text.split()
    for count in (3, 2, 1):
        unit = _SUFFIX_UNITS.get(" ".join(words[-count:])) if len(words) > count else None
        if unit is not None:
            return " ".join(words[:-count]), unit
    return text, ""


def kind_of_name(name: str) -> tuple[Kind, int | None]:
    """What a column of this name holds, and its axis (0, 1, 2 for X0, Y0, Z0) if it has one."""
    short, unit = unit_in_name(name)
    for text in dict.fromkeys((plain(name), short)):
        for along, words in _NAMES["axes"].items():
            for pattern in (
                rf"(?:{words}) ?([xyz])0?(?: ?(?:achse|axis|axe|轴))?",
                rf"([xyz])0? ?(?:achse|axis|axe|轴)?(?:向|方向)? ?(?:{words})",
            ):
                match = re.fullmatch(pattern, text)
                if match:
                    return along, _AXES[match.group(1)]
        for kind, words in _WORDS.items():
            if re.fullmatch("|".join(words), text):
                return (kind, None) if not (kind == "segment" and unit) else ("other", None)
    return "other", None


def known_names(names: Iterable[str]) -> int:
    """How many of the names say what their column holds."""
    return sum(kind_of_name(name)[0] != "other" for name in names)


def known_unit(text: str) -> str:
    """A unit as piga reads it; empty if the text is not one."""
    bare = text.strip().strip("[]()（）【】").strip()
    if bare in _SPEEDS:
        return "rpm"
    try:
        parse_unit(bare)
    except UnitError:
        return ""
    return bare


def measures(unit: str, like: str) -> bool:
    """True if the unit measures the same quantity as ``like``."""
    return bool(unit) and parse_unit(unit).dimension == parse_unit(like).dimension


_KINDS: dict[str, Any] = _NAMES["kinds"]
WORDS: dict[str, str] = {kind: entry["words"] for kind, entry in _KINDS.items()}
"""Kinds in words."""
UNITS: dict[str, list[str]] = {kind: entry["units"] for kind, entry in _KINDS.items() if "units" in entry}
"""Units that logs write, by kind."""
_PLAIN = re.compile(r"[-+]?\d*[.,]?\d*(?:[eE][-+]?\d+)?")
_UNNAMED = re.compile(r"[A-Z]{1,2}|.*\(:,\d+\)|(?:c|ch|col|column|channel|var|field)[ _-]?\d+", re.IGNORECASE)
"""Names that say nothing."""
_MOST_LEVELS = 2000
"""Most holds of a stepped column."""


@dataclass(frozen=True)
class ColumnGuess:
    """Guess for one column: its kind, axis (0 to 2) and unit, and the alternatives.

    ``stamp``: form of its time stamps. ``unwritten``: the log names no unit, it is a guess.
    """

    name: str
    kind: Kind
    reason: str
    axis: int | None = None
    unit: str = ""
    stamp: str = ""
    alternatives: tuple[str, ...] = ()
    unwritten: bool = False

    @property
    def words(self) -> str:
        """The guess in words."""
        axis = "" if self.axis is None else f" {'XYZ'[self.axis]}0"
        unit = f" [{self.unit}]" if self.unit else f" ({self.stamp})" if self.stamp else ""
        others = f"; or {', '.join(self.alternatives)}" if self.alternatives else ""
        return f"{WORDS[self.kind]}{axis}{unit}: {self.reason}{others}"

    def but(self, kind: Kind, reason: str, *alternatives: str, **more: Any) -> ColumnGuess:
        """The guess with another kind, for this reason."""
        return replace(self, kind=kind, reason=reason, alternatives=alternatives, **more)


@dataclass(frozen=True)
class Values:
    """Traits of the numbers of a column."""

    whole: bool
    rising: bool
    even: bool
    holds: int
    count: int
    step: float

    @classmethod
    def of(cls, x: Array) -> Values:
        """The traits of a column (n,)."""
        x = x[np.isfinite(x)]
        d = np.diff(x)
        if d.size == 0:
            return cls(False, False, False, 0, int(x.size), 0.0)
        step = float(np.median(d))
        even = step > 0.0 and bool(np.quantile(np.abs(d - step), 0.9) <= 0.2 * step)
        whole, rising = bool((x == np.round(x)).all()), bool((d > 0.0).all())
        return cls(whole, rising, even, 1 + int(np.count_nonzero(d)), int(x.size), step)

    @property
    def stepped(self) -> bool:
        """True if the value is held over many rows, at several levels."""
        return 2 <= self.holds <= min(_MOST_LEVELS, max(self.count // 4, 2))


_OUTPUTS: set[str] = {"counts", "pulses", "angle", "rate"}
"""Kinds of an output that turns."""
TOLD = "as you said"
"""Reason of a column that the user named."""
_TOLD = re.compile(r"(.+?)(?:[ -]([xyz])0?)?(?:\s*\[(.*)\])?")


def _as_told(
    guesses: list[ColumnGuess], told: Mapping[str, str], numbers: dict[str, Array]
) -> list[ColumnGuess]:
    """The guesses with what the user said of some columns."""
    for name, text in told.items():
        place = next((k for k, guess in enumerate(guesses) if name in (guess.name, plain(guess.name))), None)
        if place is None:
            raise ArgumentError(
                f"--column {name}: there is no such column",
                remedy=f"the columns are: {', '.join(guess.name for guess in guesses)}",
            )
        before, guess = guesses[place], _told(guesses[place], text)
        unread = before.name not in numbers and not before.stamp
        if unread and guess.kind in (*UNITS, "counts", "pulses"):
            remedy = "name a column of numbers, or repair its cells"
            raise ArgumentError(f"--column {name}={text}: {before.reason}", remedy=remedy)
        if text.split("[")[0].strip() in ("angle", "rate"):
            kinds = {one.kind for one in guesses if one is not before and one.name in numbers}
            guess = replace(_turning(guess, numbers, bool(kinds & _OUTPUTS)), reason=TOLD)
        guesses[place] = guess
        guesses[place] = replace(_with_unit(guess, guesses, numbers), alternatives=())
    return guesses


def _told(guess: ColumnGuess, text: str) -> ColumnGuess:
    names = {words: kind for kind, words in WORDS.items()} | {kind: kind for kind in WORDS}
    parts = _TOLD.fullmatch(text.strip())
    name, axis, unit = parts.groups() if parts else (text, None, None)
    kind: Any = names.get(name.strip().lower())
    said = known_unit(unit or "")

    def fits(one: str) -> bool:
        return kind == "direct" or (kind in UNITS and measures(one, UNITS[kind][0]))

    if (
        kind is None
        or (kind in _AXIAL) != (axis is not None)
        or (unit is not None and not (said and fits(said)))
    ):
        kinds = ", ".join(f"{one} x" if one in _AXIAL else one for one in WORDS)
        raise ArgumentError(
            f"--column {guess.name}={text}: this is not what a column can hold",
            remedy=f"one of: {kinds}; with a unit of this quantity: angle [deg]",
        )
    place = None if axis is None else _AXES[axis]
    return replace(
        guess, kind=kind, axis=place, unit=said or (guess.unit if fits(guess.unit) else ""), reason=TOLD
    )


def guess_columns(
    names: Mapping[str, str],
    units: dict[str, str],
    sample: dict[str, list[str]],
    numbers: dict[str, Array],
    told: Mapping[str, str],
) -> list[ColumnGuess]:
    """Guess what every named column holds.

    Parameters
    ----------
    names, units:
        The columns, each with the part of its name that says what it holds, and their units where the log has them.
    sample:
        First cells of each column as text; empty for files that hold no text.
    numbers:
        Values of the number columns (n,).
    told:
        What the user said, by column: kind, axis and unit, such as ``"angle"``, ``"force x [g]"``. ``angle`` and ``rate`` are
        those of the output, if no other column is the output and they do not stand still.
    """
    guesses = [
        _by_name(name, short, units.get(name, ""), sample.get(name, []), numbers.get(name))
        for name, short in names.items()
        if name
    ]
    counted = any(guess.kind == "counts" and guess.name in numbers for guess in guesses)
    guesses = [_turning(guess, numbers, counted) for guess in guesses]
    guesses = _by_values(guesses, numbers)
    guesses = _direct_output(_triad_by_values(guesses, numbers), numbers)
    return _as_told([_with_unit(guess, guesses, numbers) for guess in guesses], told, numbers)


_FILLS = (-9999.0, -999.0, -99999.0, -9999.9, -999.9, -32768.0, 9999.0, 99999.0, 32767.0, -1e30, 1e30, 9.9e37)
"""Numbers that loggers write for a missing value."""
_MOST_FILLED = 0.2
"""Largest share of the rows that such a number may take."""
_FAR = 20.0
"""A fill value is at least this many usual steps from the values before and after it."""


def without_fills(numbers: dict[str, Array], names: tuple[str, ...]) -> dict[str, float]:
    """Find numbers that mark missing values, and put nan in their place. Returns the number by column."""
    fills = {}
    for name in names:
        value = next((one for one in _FILLS if _marks_missing(numbers[name], one)), None)
        if value is not None:
            fills[name] = value
            numbers[name] = np.where(numbers[name] == value, np.nan, numbers[name])
    return fills


def _marks_missing(x: Array, value: float) -> bool:
    """True for a number in a few rows of a column, each time far from the values before and after it."""
    filled = x == value
    rest = x[~filled & np.isfinite(x)]
    if not 0 < np.count_nonzero(filled) <= _MOST_FILLED * x.size or rest.size < 3:
        return False
    edges = np.flatnonzero(np.diff(filled, prepend=False, append=False))
    before, after = edges[::2] - 1, edges[1::2]
    beside = x[np.concatenate((before[before >= 0], after[after < x.size]))]
    usual = float(np.quantile(np.abs(np.diff(rest)), 0.9))
    far = _FAR * usual if usual else float(np.ptp(rest))
    return bool(np.nanmin(np.abs(beside - value), initial=np.inf) > far)


def _triad_by_values(guesses: list[ColumnGuess], numbers: dict[str, Array]) -> list[ColumnGuess]:
    """Three columns without names whose squares add up to g in nearly every row: the specific force."""
    if any(guess.kind == "force" for guess in guesses):
        return guesses
    for k in range(len(guesses) - 2):
        three = guesses[k : k + 3]
        if any(one.kind != "other" or one.unit or one.name not in numbers for one in three):
            continue
        size = np.sqrt(sum(numbers[one.name] ** 2 for one in three))
        typical = float(np.nanmedian(size)) if np.isfinite(size).any() else 0.0
        for unit, g in (("g", 1.0), ("m/s^2", G0), ("mg", 1e3), ("ug", 1e6)):
            if abs(typical / g - 1.0) < 0.01 and np.nanmean(np.abs(size - typical) < 0.02 * typical) > 0.9:
                names = ", ".join(one.name for one in three)
                why = f"their names say nothing, but the squares of {names} add up to the square of {typical:.4g} {unit}"
                triad = [one.but("force", why, "not used", axis=i, unit=unit) for i, one in enumerate(three)]
                return [*guesses[:k], *triad, *guesses[k + 3 :]]
    return guesses


def _by_name(name: str, short: str, logged: str, cells: list[str], x: Array | None) -> ColumnGuess:
    kind, axis = kind_of_name(short)
    unit = known_unit(logged) or known_unit(unit_in_name(short)[1])
    guess = ColumnGuess(name, kind, "its name", axis, unit)
    forms = forms_of(cells[:50]) if cells and x is None else []
    if forms:
        return guess.but("time", "its cells are time stamps", *forms[1:], stamp=forms[0], unit="")
    if kind == "segment" and measures(unit, "rad"):
        return guess.but("stand-angle", f"its name, and its unit {unit}")
    if kind in UNITS and unit and not measures(unit, UNITS[kind][0]):  # the unit decides
        others: tuple[Kind, ...] = ("time",) if kind == "temperature" else ("angle", "rate", "temperature")
        for other in others:
            if measures(unit, UNITS[other][0]):
                return guess.but(other, f"its unit {unit}", WORDS[kind], axis=None)
        return guess.but("other", f"its name says {WORDS[kind]}, its unit {unit} does not", axis=None)
    if x is None and kind not in ("segment", "date"):
        example = next((f", such as '{cell[:30]}'" for cell in cells if not _PLAIN.fullmatch(cell)), "")
        return guess.but("other", f"its cells are not numbers{example}", unit="")
    if kind == "other" and measures(unit, "Hz"):
        why = "its unit is a frequency: piga reads a running count, an angle or a rate such as rev/s, not pulses per second"
        return replace(guess, reason=why)
    return guess


def _turning(guess: ColumnGuess, numbers: dict[str, Array], counted: bool) -> ColumnGuess:
    """Tell the output angle and rate from those of the stand: the stand holds its value, the output turns."""
    if guess.kind not in ("angle", "rate") or guess.name not in numbers:
        return guess
    held = Values.of(numbers[guess.name]).stepped
    if not (held or counted):
        return guess
    kind: Kind = "stand-angle" if guess.kind == "angle" else "stand-speed"
    why = "it holds its value over many rows" if held else "the output is the column of counts"
    return guess.but(kind, f"its name, and {why}", WORDS[guess.kind])


def _by_values(guesses: list[ColumnGuess], numbers: dict[str, Array]) -> list[ColumnGuess]:
    """Fill in time, output and sample number from the values, where no name says them."""
    kinds: set[str] = {guess.kind for guess in guesses}
    result = []
    for guess in guesses:
        x = numbers.get(guess.name)
        result.append(guess if x is None or x.size < 3 else _by_value(guess, x, kinds))
        kinds.add(result[-1].kind)
    return result


def _by_value(guess: ColumnGuess, x: Array, kinds: set[str]) -> ColumnGuess:
    """One column by its values ``x`` (n,) and its unit. ``kinds``: the kinds that are taken."""
    values = Values.of(x)
    busy = values.holds > values.count // 2
    if guess.kind == "segment" and values.rising and values.even and busy:
        return guess.but("sequence", "its name, and it rises in every row", "segment")
    if guess.kind == "sequence" and values.stepped:
        return guess.but("segment", "its name, and it holds its value over many rows", "sample number")
    if guess.kind == "other" and guess.reason == "its name" and guess.unit:
        stands: dict[str, Kind] = {"rad/s": "stand-speed", "rad": "stand-angle"}
        kind = next((kind for like, kind in stands.items() if measures(guess.unit, like)), guess.kind)
        if kind not in (*kinds, "other") and positions(x):
            return guess.but(kind, f"its unit {guess.unit}, and it stands still at times")
        if kind == "stand-angle" and busy and not kinds & _OUTPUTS:
            return guess.but("angle", f"its unit {guess.unit}, and it turns in most rows")
    if guess.kind == "other" and not guess.unit:
        nothing = "its name says nothing, but"
        if "time" not in kinds and values.rising and values.even:
            return guess.but("time", f"{nothing} it rises by even steps", "not used")
        if not kinds & _OUTPUTS and values.whole and not values.stepped and busy:
            return guess.but("counts", f"{nothing} it holds whole numbers that change in most rows", "not used")
        if "segment" not in kinds and values.whole and values.stepped and _UNNAMED.fullmatch(guess.name):
            return guess.but("segment", f"{nothing} it holds whole numbers, each over many rows", "not used")
    return guess


def _direct_output(guesses: list[ColumnGuess], numbers: dict[str, Array]) -> list[ColumnGuess]:
    """The output of an instrument without a gimbal: the one column with another unit beside the angle or speed of a stand."""
    kinds = {guess.kind for guess in guesses}
    if kinds & _OUTPUTS or not kinds & {"stand-angle", "stand-speed"}:
        return guesses
    others = [one for one in guesses if one.kind in ("other", "force") and one.unit and one.name in numbers]
    others = [one for one in others if not parse_unit(one.unit).dimension[2]]
    if len(others) != 1:
        return guesses
    why = f"the only column in another unit ({others[0].unit}) beside the stand"
    output = others[0].but("direct", why, *others[0].alternatives, axis=None)
    return [output if one is others[0] else one for one in guesses]


def _with_unit(guess: ColumnGuess, guesses: list[ColumnGuess], numbers: dict[str, Array]) -> ColumnGuess:
    """Guess a unit that neither header nor name gives. Columns of three axes have one unit."""
    x = numbers.get(guess.name)
    if guess.unit or guess.stamp or x is None or guess.kind not in UNITS:
        return guess
    axes = {one.axis: one for one in reversed(guesses) if one.kind == guess.kind and one.axis is not None}
    beside = list(axes.values()) if guess in axes.values() else []
    stated = {one.unit for one in beside if one.unit}
    if len(stated) == 1:
        unit = stated.pop()
        return replace(guess, unit=unit, reason=f"{guess.reason}; unit {unit} as in the columns beside it")
    size = max((_size(numbers[one.name]) for one in beside if one.name in numbers), default=_size(x))
    units, why = _units(guess.kind, size, Values.of(x))
    return replace(
        guess,
        unit=units[0],
        reason=f"{guess.reason}; unit {units[0]} guessed: {why}",
        alternatives=(*guess.alternatives, *(f"unit {other}" for other in units[1:])),
        unwritten=True,
    )


def _size(x: Array) -> float:
    return float(np.nanmax(np.abs(x))) if np.isfinite(x).any() else 0.0


def _units(kind: Kind, size: float, values: Values) -> tuple[tuple[str, ...], str]:
    """Possible units of a column of this kind whose largest value is ``size``, the likeliest first, and the reason."""
    largest = f"its largest size is {size:.4g}"
    if kind == "time":
        return (("ms", "s", "us") if values.step >= 5.0 else ("s", "ms", "min")), f"steps of {values.step:g}"
    if kind == "force":
        near_g = 9.0 < size < 11.0
        return ("mg", "ug", "g") if size > 200.0 else ("m/s^2", "g") if near_g else ("g", "m/s^2"), largest
    if kind in ("angle", "stand-angle"):
        return (("deg", "rad") if size > 7.0 or values.whole else ("rad", "deg")), largest
    if kind == "temperature":
        return (("K", "degC") if size > 200.0 else ("degC", "K")), largest
    if kind == "stand-speed":
        return ("rpm", "deg/s", "rad/s"), "none is written"
    return ("rad/s", "deg/s", "deg/h"), "none is written"
