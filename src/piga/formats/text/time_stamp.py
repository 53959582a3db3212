"""Time stamps: dates and times of day in the forms that loggers write, as seconds.

A form is written with ``YYYY`` or ``YY``, ``MM``, ``DD``, ``hh``, ``mm``, ``ss``, ``f`` (decimals of the second, may be
absent), ``ap`` (AM or PM) and ``zz`` (``Z`` or ``+02:00``). All other characters stand for themselves. ``iso`` is
``YYYY-MM-DDThh:mm:ss.fzz``, with a space in place of ``T`` and without zone as well.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from datetime import date
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
_AROUND = ' "\t'
_EPOCH = date(1970, 1, 1).toordinal()
_SPLIT = re.compile("|".join(sorted(map(re.escape, _TOKENS), key=len, reverse=True)))
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
    """A form of time stamps, and its ``pattern``."""

    form: str
    pattern: re.Pattern[str]

    @property
    def dated(self) -> bool:
        """True if the form has a date, not only the time of day."""
        return "D" in self.pattern.groupindex

    def parts(self, cell: str) -> tuple[int, float] | None:
        """Days since 1970 (0 without a date) and seconds of the day of one stamp. None if it is not of this form."""
        match = self.pattern.fullmatch(cell.strip(_AROUND))
        if match is None:
            return None
        text = match.groupdict()
        hour, minute, second = int(text["h"]), int(text["m"]), int(text.get("s") or 0)
        if "p" in text:
            if not 1 <= hour <= 12:
                return None
            hour = hour % 12 + 12 * (text["p"].upper() == "PM")
        day = _day(text["Y"] if "Y" in text else f"20{text['y']}", text["M"], text["D"]) if "D" in text else 0
        if day is None or hour > 24 or minute > 59 or second > 60:
            return None
        seconds = 3600 * hour + 60 * minute + second + float(f"0.{text.get('f') or 0}")
        return day, seconds - _zone(text.get("z") or "Z")

    def seconds(self, cell: str) -> float | None:
        """Seconds of one stamp since 1970, or since midnight without a date. None if it is not of this form."""
        parts = self.parts(cell)
        return None if parts is None else DAY * parts[0] + parts[1]


@lru_cache(maxsize=64)
def time_stamp(form: str) -> TimeStamp:
    """The form written in a run file. One that lacks hours or minutes, has part of a date or repeats a part is refused."""
    if form == "iso":
        return TimeStamp(form, re.compile(ISO, re.ASCII))
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
    return TimeStamp(form, re.compile(pattern, re.ASCII))


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

        parts = [self.stamp.parts(cell or "") for cell in column.to_pylist()]
        days, seconds = np.array([part or (np.nan, np.nan) for part in parts]).reshape(-1, 2).T
        bad = np.isnan(seconds)
        if any((column[k].as_py() or "").strip(_AROUND) not in missing for k in np.flatnonzero(bad).tolist()):
            return None
        return pa.array(self._continued(days, seconds), mask=bad)

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


@lru_cache(maxsize=64)
def _day(year: str, month: str, day: str) -> int | None:
    """Days since 1970-01-01 of a date. A day beyond the end of its month counts on; None above 31."""
    if not (int(year) and 1 <= int(month) <= 12 and 1 <= int(day) <= 31):
        return None
    return date(int(year), int(month), 1).toordinal() - _EPOCH + int(day) - 1


@lru_cache(maxsize=64)
def _zone(text: str) -> float:
    if text == "Z":
        return 0.0
    digits = text[1:].replace(":", "")
    size = 3600.0 * int(digits[:2]) + 60.0 * int(digits[2:])
    return -size if text[0] == "-" else size
