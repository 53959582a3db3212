"""Suggested run-file lines that resolve an error or ambiguity of a data file. Nothing is applied."""

from __future__ import annotations

import difflib
import re
import unicodedata
from dataclasses import dataclass

from piga.errors import PigaError
from piga.records.run import Run

_LINE = re.compile(r"\[(data|model|instrument)\] (\w+ = (?:'[^']*'|\[[^\]]*\]))(?:,? or (\w+ = '[^']*'))?")
_MISSING = re.compile(r"no column ((?:'[^']*'(?:, )?)+); the columns are: (.*)", re.DOTALL)
_SHEETS = re.compile(r"there are \d+ sheets: (.*)")
_STUCK = re.compile(r"column '([^']*)' stays at its (largest|smallest) value (\S+):")

ALIASES = (
    ("t", "time", "t_s", "timestamp", "时间", "时刻"),
    ("n", "count", "counts", "counter", "pulse", "pulses", "计数", "脉冲", "脉冲数"),
    ("angle", "psi", "alpha", "角度", "转角"),
    ("rate", "omega", "角速度", "角速率"),
    ("fx", "ax", "x轴加速度", "加速度x"),
    ("fy", "ay", "y轴加速度", "加速度y"),
    ("fz", "az", "z轴加速度", "加速度z"),
    ("temperature", "temp", "tempc", "温度"),
    ("segment", "position", "pos", "位置", "序号"),
)
"""Groups of names that logs use for one quantity."""


@dataclass(frozen=True)
class Suggestion:
    """A line for a table of the run file, and the reason."""

    table: str
    line: str
    reason: str


def from_error(error: PigaError) -> list[Suggestion]:
    """Lines that resolve an error: those that the message names, and similar column names."""
    lines = []
    for match in _LINE.finditer(error.remedy or ""):
        first = error.message.split(": ", 1)[-1][:160]
        lines += [
            Suggestion(match.group(1), line, first) for line in match.groups()[1:] if line and "..." not in line
        ]
    missing = _MISSING.search(error.message)
    if missing:
        columns = missing.group(2).split(", ")
        for name in re.findall(r"'([^']*)'", missing.group(1)):
            near = similar_name(name, columns)
            if near:
                lines.append(
                    Suggestion("data", f"column = '{near}'", f"instead of '{name}', which is not in the file")
                )
    sheets = _SHEETS.search(error.message)
    if sheets:
        titles = re.findall(r"'([^']*)'", sheets.group(1))
        lines += [Suggestion("data", f"sheet = '{title}'", "one of the sheets") for title in titles]
    if "the output jumps" in error.message or "it was reset there" in error.message:
        lines += [
            Suggestion("instrument", f"counter_bits = {bits}", "if the counter wraps at that width")
            for bits in (16, 24, 32)
        ]
    return lines


def from_run(run: Run) -> list[Suggestion]:
    """Lines that follow from the events of a readable record."""
    lines = []
    for event in run.quality.events:
        stuck = _STUCK.search(event.detail)
        if stuck:
            name, side, value = stuck.groups()
            limits = f"[-1e30, {value}]" if side == "largest" else f"[{value}, 1e30]"
            lines.append(Suggestion("data", f"range = {{ '{name}' = {limits} }}", event.detail))
        if event.kind == "phase-lost":
            lines.append(Suggestion("model", "phase = 'per-segment'", "the zero of the output angle was lost"))
        if event.kind == "encoding":
            lines.append(
                Suggestion("data", f"encoding = '{event.detail.split()[-1]}'", "to fix what was detected")
            )
        if event.kind == "implausible-unit":
            lines.append(Suggestion("data", "unit = '...'", event.detail))
    return lines


def similar_name(name: str, columns: list[str]) -> str | None:
    """The most probable column: equal apart from character width and case, an alias, or nearly equal."""
    plain = {_plain(column): column for column in columns}
    if _plain(name) in plain:
        return plain[_plain(name)]
    for group in ALIASES:
        if _plain(name) in group:
            return next((plain[alias] for alias in group if alias in plain), None)
    near = difflib.get_close_matches(_plain(name), list(plain), n=1)
    return plain[near[0]] if near else None


def _plain(name: str) -> str:
    return re.sub(r"[\[(（].*$", "", unicodedata.normalize("NFKC", name)).strip().lower()
