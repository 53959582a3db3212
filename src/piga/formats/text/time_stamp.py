"""Time stamps: dates and times of day in the forms that loggers write, as seconds.

A form is written with ``YYYY`` or ``YY``, ``MM``, ``DD``, ``hh``, ``mm``, ``ss``, ``f`` (decimals of the second, may be
absent), ``ap`` (AM or PM) and ``zz`` (``Z`` or ``+02:00``). All other characters stand for themselves. ``iso`` is
``YYYY-MM-DDThh:mm:ss.fzz``, with a space in place of ``T`` and without zone as well.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import RunFileError
from piga.units import DAY

_HALF_DAY = 43200.0
"""A time of day that falls by more passed midnight [s]."""
ISO = (
    r"(?P<Y>\d{4})-(?P<M>\d{2})-(?P<D>\d{2})[T ](?P<h>\d{2}):(?P<m>\d{2})(?::(?P<s>\d{2})(?:[.,](?P<f>\d{1,12}))?)?"
    r"\s?(?P<z>Z|[+-]\d{2}:?\d{2})?"
)
_TOKENS = {
    "YYYY": r"(?P<Y>\d{4})",
    "YY": r"(?P<y>\d{2})",
    "MM": r"(?P<M>\d{1,2})",
    "DD": r"(?P<D>\d{1,2})",
    "hh": r"(?P<h>\d{1,2})",
    "mm": r"(?P<m>\d{1,2})",
    "ss.f": r"(?P<s>\d{1,2})(?:[.,](?P<f>\d{1,12}))?",
    "ss,f": r"(?P<s>\d{1,2})(?:[.,](?P<f>\d{1,12}))?",
    "ss:f": r"(?P<s>\d{1,2})(?::(?P<f>\d{1,12}))?",
    "ss": r"(?P<s>\d{1,2})",
    "ap": r"(?P<p>[AaPp][Mm])",
    "zz": r"(?P<z>Z|[+-]\d{2}:?\d{2})",
}
_SPLIT = re.compile("|".join(sorted(map(re.escape, _TOKENS), key=len, reverse=True)))
_LIMITS = {"M": (1, 12), "D": (1, 31), "h": (0, 24), "m": (0, 59), "s": (0, 60)}
FORMS = (
    "iso",
    "YYYY/MM/DD hh:mm:ss.f",
    "YYYY.MM.DD hh:mm:ss.f",
    "DD.MM.YYYY hh:mm:ss.f",
    "DD.MM.YY hh:mm:ss.f",
    "DD/MM/YYYY hh:mm:ss.f",
    "MM/DD/YYYY hh:mm:ss.f",
    "DD-MM-YYYY hh:mm:ss.f",
    "MM/DD/YYYY hh:mm:ss.f ap",
    "DD/MM/YYYY hh:mm:ss.f ap",
    "DD.MM.YYYY hh:mm",
    "YYYY年MM月DD日 hh:mm:ss.f",
    "YYYY年MM月DD日 hh时mm分ss.f秒",
    "hh:mm:ss.f",
    "hh:mm:ss:f",
    "hh:mm:ss.f ap",
)
"""Forms that are recognised in a log, the likelier ones first."""


@dataclass(frozen=True)
class TimeStamp:
    """A form of time stamps. ``dated``: the stamps hold a date, not only the time of day."""

    form: str
    pattern: str

    @property
    def dated(self) -> bool:
        """True if the form has a date."""
        return "(?P<D>" in self.pattern

    def seconds(self, cell: str) -> float | None:
        """Seconds of one stamp since 1970, or since midnight without a date. None if it is not of this form."""
        match = re.fullmatch(self.pattern, cell.strip().strip('"').strip(), re.ASCII)
        if match is None:
            return None
        parts = {name: np.array([text or ""]) for name, text in match.groupdict().items()}
        days, seconds = _day_and_seconds(parts)
        value = DAY * float(days[0]) + float(seconds[0])
        return None if np.isnan(value) else value


@lru_cache(maxsize=64)
def time_stamp(form: str) -> TimeStamp:
    """The form written in a run file.

    Raises
    ------
    RunFileError
        If it lacks hours or minutes, has part of a date, or repeats a part.
    """
    if form == "iso":
        return TimeStamp(form, ISO)
    pattern, at, parts = "", 0, []
    for match in _SPLIT.finditer(form):
        pattern += re.escape(form[at : match.start()]) + _TOKENS[match.group()]
        parts.append(match.group())
        at = match.end()
    pattern += re.escape(form[at:])
    names = re.findall(r"\(\?P<(\w)>", pattern)
    date = {"Y" if name == "y" else name for name in names} & {"Y", "M", "D"}
    if len(form) > 80 or len(set(names)) < len(names) or not {"h", "m"} <= set(names) or len(date) in (1, 2):
        raise RunFileError(
            f"[data] time: stamp '{form[:80]}' is not a form of time stamps",
            remedy="write 'iso', 'DD.MM.YYYY hh:mm:ss.f', 'hh:mm:ss.f' or the like",
        )
    return TimeStamp(form, pattern)


def forms_of(cells: list[str]) -> list[str]:
    """The known forms that every one of these cells has, the likelier ones first."""
    return [
        form for form in FORMS if cells and all(time_stamp(form).seconds(cell) is not None for cell in cells)
    ]


@dataclass
class StampClock:
    """Turns the stamps of a file into seconds since the first midnight, piece by piece.

    Times of day without a date go on after midnight.
    """

    stamp: TimeStamp
    _first_day: float | None = field(default=None, init=False)
    _last: float = field(default=float("nan"), init=False)
    _added: float = field(default=0.0, init=False)

    def convert(self, column: Any, missing: set[str | None]) -> Any | None:
        """The stamps of an Arrow column as an Arrow array of seconds. None if a cell is neither a stamp nor ``missing``."""
        import pyarrow as pa
        import pyarrow.compute as pc

        column = column.combine_chunks() if hasattr(column, "combine_chunks") else column
        bare = pc.utf8_trim(column, characters=' "\t')
        parts = pc.extract_regex(bare, pattern=f"^(?:{self.stamp.pattern})$")
        texts = {
            parts.type.field(k).name: np.asarray(pc.struct_field(parts, k).fill_null("").to_pylist(), dtype=str)
            for k in range(parts.type.num_fields)
        }
        days, values = _day_and_seconds(texts)
        bad = np.isnan(values)
        if bad.any() and not missing.issuperset(bare.filter(pa.array(bad)).to_pylist()):
            return None
        return pa.array(self._continued(days, values), mask=bad)

    def _continued(self, days: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        valid = np.flatnonzero(~np.isnan(values))
        if valid.size == 0:
            return values
        if self.stamp.dated:
            if self._first_day is None:
                self._first_day = float(days[valid[0]])
            return DAY * (days - self._first_day) + values
        steps = np.diff(values[valid], prepend=self._last)
        steps[np.isnan(steps)] = 0.0
        turns = np.cumsum((steps < -_HALF_DAY).astype(float) - (steps > _HALF_DAY).astype(float))
        result = values.copy()
        result[valid] += self._added + DAY * turns
        self._last, self._added = float(values[valid[-1]]), self._added + DAY * float(turns[-1])
        return result


def _day_and_seconds(parts: dict[str, NDArray[Any]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Days since 1970 (0 without a date) and seconds of the day, of stamps split into their parts.

    Both are nan where a part is absent or out of its range.
    """
    count = parts["h"].size
    good = parts["h"] != ""
    value: dict[str, NDArray[np.float64]] = {}
    for name in ("Y", "y", "M", "D", "h", "m", "s"):
        if name in parts:
            texts = parts[name]
            value[name] = np.where(texts == "", "0", texts).astype(float)
            low, high = _LIMITS.get(name, (0, 9999))
            good &= (value[name] >= low) & (value[name] <= high)
    hours = value["h"]
    if "p" in parts:
        late = np.char.upper(parts["p"]) == "PM"
        good &= (hours >= 1) & (hours <= 12)
        hours = np.where(hours == 12, 0.0, hours) + 12.0 * late
    seconds = 3600.0 * hours + 60.0 * value["m"] + value.get("s", np.zeros(count))
    if "f" in parts:
        seconds = seconds + np.char.add(np.char.add("0.", parts["f"]), "0").astype(float)
    if "z" in parts:
        seconds = seconds - np.array([_zone(text) for text in parts["z"]])
    days = np.zeros(count)
    if "D" in value:
        year = value["Y"] if "Y" in value else 2000.0 + value["y"]
        days = _days(year, value["M"], value["D"])
    return np.where(good, days, np.nan), np.where(good, seconds, np.nan)


def _days(
    year: NDArray[np.float64], month: NDArray[np.float64], day: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Days since 1970-01-01 of dates in the Gregorian calendar. A day beyond the end of its month counts on."""
    first = (12 * (year - 1970) + month - 1).astype(np.int64).astype("datetime64[M]").astype("datetime64[D]")
    return first.astype(np.int64) + day - 1.0


def _zone(text: str) -> float:
    """Offset of a zone from UTC [s]."""
    if text in ("", "Z"):
        return 0.0
    digits = text[1:].replace(":", "")
    size = 3600.0 * int(digits[:2]) + 60.0 * int(digits[2:])
    return -size if text[0] == "-" else size
