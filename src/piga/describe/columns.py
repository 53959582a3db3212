"""What each column of a log holds, from its name, its unit and its values."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga.describe.names import Kind, kind_of_name, known_unit, measures, unit_in_name
from piga.formats.text.time_stamp import forms_of

Array = NDArray[np.float64]

LIKE: dict[str, str] = {
    "time": "s",
    "angle": "rad",
    "rate": "rad/s",
    "force": "m/s^2",
    "base-rate": "rad/s",
    "temperature": "K",
    "stand-angle": "rad",
    "stand-speed": "rad/s",
}
"""A unit of the quantity of each kind that has one."""
WORDS: dict[str, str] = {
    "time": "time",
    "date": "date",
    "counts": "output in counts",
    "angle": "output angle",
    "rate": "output rate",
    "force": "specific force",
    "base-rate": "base rate",
    "temperature": "temperature",
    "segment": "segment",
    "sequence": "sample number",
    "stand-angle": "angle of the stand",
    "stand-speed": "speed of the stand",
    "other": "not used",
}
"""Kinds in words."""
MOST_LEVELS = 2000
"""Most holds of a stepped column."""


@dataclass(frozen=True)
class ColumnGuess:
    """What one column holds: its kind, axis (0 to 2) and unit, and what else it may be.

    ``stamp``: form of its time stamps. ``example``: its first cell.
    """

    name: str
    kind: Kind
    reason: str
    axis: int | None = None
    unit: str = ""
    stamp: str = ""
    alternatives: tuple[str, ...] = ()
    example: str = ""


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
        return cls(
            bool((x == np.round(x)).all()),
            bool((d > 0.0).all()),
            even,
            1 + int(np.count_nonzero(d)),
            int(x.size),
            step,
        )

    @property
    def stepped(self) -> bool:
        """True if the value is held over many rows, at several levels."""
        return 2 <= self.holds <= min(MOST_LEVELS, max(self.count // 4, 2))


def guess_columns(
    names: tuple[str, ...], units: dict[str, str], sample: dict[str, list[str]], numbers: dict[str, Array]
) -> list[ColumnGuess]:
    """Guess what every named column holds.

    Parameters
    ----------
    names, units:
        Names of the columns, and their units where the log has them.
    sample:
        First cells of each column as text; empty for files that hold no text.
    numbers:
        Values of the number columns (n,).
    """
    guesses = [
        _by_name(name, units.get(name, ""), sample.get(name, []), numbers.get(name)) for name in names if name
    ]
    guesses = _one_output(guesses, numbers)
    guesses = _by_values(guesses, numbers)
    return [_with_unit(guess, numbers) for guess in guesses]


def _by_name(name: str, logged: str, cells: list[str], x: Array | None) -> ColumnGuess:
    kind, axis = kind_of_name(name)
    unit = known_unit(logged) or known_unit(unit_in_name(name)[1])
    guess = ColumnGuess(name, kind, "its name", axis, unit, example=cells[0] if cells else "")
    forms = forms_of(cells[:50]) if cells and x is None else []
    if forms:
        return replace(
            guess,
            kind="time",
            stamp=forms[0],
            unit="",
            reason="its cells are time stamps",
            alternatives=tuple(forms[1:]),
        )
    if kind == "segment" and measures(unit, "rad"):
        return replace(guess, kind="stand-angle", reason=f"its name, and its unit {unit}")
    if kind in LIKE and unit and not measures(unit, LIKE[kind]):
        return _by_unit(guess)
    if x is None and kind not in ("segment", "date"):
        return replace(guess, kind="other", reason="its cells are not numbers", unit="")
    return guess


def _by_unit(guess: ColumnGuess) -> ColumnGuess:
    """A column whose name and unit disagree: the unit decides."""
    others: tuple[Kind, ...] = ("angle", "rate", "temperature") if guess.kind != "temperature" else ("time",)
    for kind in others:
        if measures(guess.unit, LIKE[kind]):
            return replace(
                guess, kind=kind, axis=None, reason=f"its unit {guess.unit}", alternatives=(WORDS[guess.kind],)
            )
    return replace(
        guess,
        kind="other",
        axis=None,
        reason=f"its name says {WORDS[guess.kind]}, its unit {guess.unit} does not",
    )


def _one_output(guesses: list[ColumnGuess], numbers: dict[str, Array]) -> list[ColumnGuess]:
    """Tell the output angle and rate from those of the stand: the stand holds its value, the output turns."""
    counted = any(guess.kind == "counts" and guess.name in numbers for guess in guesses)
    return [_turning(guess, numbers, counted) for guess in guesses]


def _turning(guess: ColumnGuess, numbers: dict[str, Array], counted: bool) -> ColumnGuess:
    if guess.kind not in ("angle", "rate") or guess.name not in numbers:
        return guess
    held = Values.of(numbers[guess.name]).stepped
    if not (held or counted):
        return guess
    kind: Kind = "stand-angle" if guess.kind == "angle" else "stand-speed"
    why = "it holds its value over many rows" if held else "the output is the column of counts"
    return replace(guess, kind=kind, reason=f"its name, and {why}", alternatives=(WORDS[guess.kind],))


def _by_values(guesses: list[ColumnGuess], numbers: dict[str, Array]) -> list[ColumnGuess]:
    """Fill in time, output and sample number from the values, where no name says them."""
    kinds: set[str] = {guess.kind for guess in guesses}
    result = []
    for guess in guesses:
        x = numbers.get(guess.name)
        result.append(guess if x is None or x.size < 3 else _by_value(guess, Values.of(x), kinds))
        kinds.add(result[-1].kind)
    return result


def _by_value(guess: ColumnGuess, values: Values, kinds: set[str]) -> ColumnGuess:
    """One column by its values. ``kinds``: the kinds that are taken."""
    busy = values.holds > values.count // 2
    if guess.kind == "segment" and values.rising and values.even and busy:
        why = "its name, and it rises in every row"
        return replace(guess, kind="sequence", reason=why, alternatives=("segment",))
    if guess.kind == "sequence" and values.stepped:
        why = "its name, and it holds its value over many rows"
        return replace(guess, kind="segment", reason=why, alternatives=("sample number",))
    if guess.kind == "other" and not guess.unit:
        if "time" not in kinds and values.rising and values.even:
            why = "its name says nothing, but it rises by even steps"
            return replace(guess, kind="time", reason=why, alternatives=("not used",))
        if not kinds & {"counts", "angle", "rate"} and values.whole and not values.stepped and busy:
            why = "its name says nothing, but it holds whole numbers that change in most rows"
            return replace(guess, kind="counts", reason=why, alternatives=("not used",))
    return guess


def _with_unit(guess: ColumnGuess, numbers: dict[str, Array]) -> ColumnGuess:
    """Guess a unit that neither header nor name gives."""
    x = numbers.get(guess.name)
    if guess.unit or guess.stamp or x is None or guess.kind not in LIKE:
        return guess
    size = float(np.nanmax(np.abs(x))) if np.isfinite(x).any() else 0.0
    units, why = _units(guess.kind, size, Values.of(x))
    return replace(
        guess,
        unit=units[0],
        reason=f"{guess.reason}; unit {units[0]} guessed: {why}",
        alternatives=(*guess.alternatives, *(f"unit {other}" for other in units[1:])),
    )


def _units(kind: Kind, size: float, values: Values) -> tuple[tuple[str, ...], str]:
    """Units of a column of this kind whose largest value is ``size``, the likelier ones first, and why."""
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
