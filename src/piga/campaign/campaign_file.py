"""Campaign files (TOML): scenarios, grids, drawn values and repeats; and the list of records.

The list of records is a function of the campaign file and of the scenario files. It does not depend on the machine.
Every record has a case and a repeat, and its random numbers start at ``SeedSequence(seed, spawn_key=(case, repeat))``.
"""

from __future__ import annotations

import bisect
import itertools
import math
import re
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from piga.errors import RunFileError
from piga.records.run_file import Quantity, TomlTable
from piga.records.text_files import read_toml, toml_bytes, toml_document

Count = Annotated[int, Meta(ge=1, le=1_000_000_000)]
Subject = Literal["stand", "platform"]
_MOST_CASES = 1_000_000
"""Most cases of a campaign."""


class CampaignTable(TomlTable, frozen=True):
    """``[campaign]``: settings of the whole campaign.

    ``designs`` is the number of cases that are drawn for each point of the grid (with ``[draw]``). ``bounds`` is the
    number of records per case for which the Cramer-Rao bound is computed. ``records_per_shard``: how many records are
    computed together. If it is not given, the planning measures it.
    """

    title: str = ""
    seed: Annotated[int, Meta(ge=0)] = 1
    repeats: Count = 1
    designs: Count = 1
    bounds: Annotated[int, Meta(ge=0)] = 50
    records_per_shard: Count | None = None


class CaseTable(TomlTable, frozen=True):
    """``[[case]]``: one scenario with a name and with its own values.

    ``scenario`` names a scenario file. ``set`` replaces values of it.
    """

    name: str
    scenario: str | None = None
    set: dict[str, Any] = msgspec.field(default_factory=dict)
    repeats: Count | None = None
    bounds: Annotated[int, Meta(ge=0)] | None = None


class DrawTable(TomlTable, frozen=True):
    """An entry of ``[draw]``: how a value is drawn for each design."""

    distribution: Literal["uniform", "log-uniform", "normal", "choice"]
    low: Quantity | None = None
    high: Quantity | None = None
    mean: Quantity | None = None
    std: Quantity | None = None
    values: tuple[Any, ...] = ()


class CampaignFile(TomlTable, frozen=True):
    """The whole file."""

    campaign: CampaignTable = CampaignTable()
    scenario: str | None = None
    case: tuple[CaseTable, ...] = ()
    grid: dict[str, tuple[Any, ...]] = msgspec.field(default_factory=dict)
    draw: dict[str, DrawTable] = msgspec.field(default_factory=dict)


@dataclass(frozen=True)
class CampaignGroup:
    """Cases whose records are judged together: one scenario at one point of the grid.

    ``first`` is the number of its first case, ``start`` the number of its first record.
    """

    name: str
    subject: Subject
    scenario: str
    set: dict[str, Any]
    designs: int
    repeats: int
    bounds: int
    first: int
    start: int

    @property
    def records(self) -> int:
        """Number of records."""
        return self.designs * self.repeats

    @property
    def label(self) -> str:
        """Name and point of the grid in words."""
        return label(self.name, self.set)


def label(name: str, point: Mapping[str, Any]) -> str:
    """Name of a case and point of the grid in words."""
    words = ", ".join(f"{key} = {_shown(value)}" for key, value in point.items())
    return f"{name}: {words}" if name and words else name or words or "all records"


def _shown(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class RecordName:
    """The place of a record: its number, group, case and repeat."""

    number: int
    group: CampaignGroup
    case: int
    repeat: int


@dataclass(frozen=True)
class CampaignPlan:
    """All records of a campaign, in order. ``texts`` holds the bytes of the campaign file and of the scenario files by name."""

    path: Path
    file: CampaignFile
    texts: Mapping[str, bytes]
    groups: tuple[CampaignGroup, ...]
    documents: Mapping[str, dict[str, Any]] = field(repr=False)

    @property
    def seed(self) -> int:
        """Seed of the campaign."""
        return self.file.campaign.seed

    @cached_property
    def records(self) -> int:
        """Number of records."""
        return sum(group.records for group in self.groups)

    @cached_property
    def _starts(self) -> list[int]:
        return [group.start for group in self.groups]

    def record(self, number: int) -> RecordName:
        """A record by its number."""
        group = self.groups[bisect.bisect_right(self._starts, number) - 1]
        design, repeat = divmod(number - group.start, group.repeats)
        return RecordName(number, group, group.first + design, repeat)

    def find(self, case: int, repeat: int) -> RecordName:
        """A record by case and repeat."""
        for group in self.groups:
            if group.first <= case < group.first + group.designs and 0 <= repeat < group.repeats:
                return self.record(group.start + (case - group.first) * group.repeats + repeat)
        raise RunFileError(
            f"{self.path}: there is no record of case {case}, repeat {repeat}",
            remedy=f"cases count from 0 to {sum(g.designs for g in self.groups) - 1}, repeats from 0",
        )

    def document(self, record: RecordName) -> dict[str, Any]:
        """The scenario of a record: the file with the values of the case, of the grid and of the draw."""
        document = deepcopy(self.documents[record.group.scenario])
        case = next((c for c in self.file.case if c.name == record.group.name), None)
        for key, value in (case.set if case else {}).items():
            _replace_value(document, key, value)
        for key, value in record.group.set.items():
            _replace_value(document, key, value)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(record.case,)))
        for key, table in self.file.draw.items():
            _replace_value(document, key, _drawn(table, rng))
        return document

    def sequence(self, record: RecordName) -> np.random.SeedSequence:
        """Random numbers of a record: the same on every machine, in every order."""
        return np.random.SeedSequence(self.seed, spawn_key=(record.case, record.repeat))


def _replace_value(document: dict[str, Any], key: str, value: Any) -> None:
    """Set a value of a TOML document by its dotted key. Missing tables are made. A number selects an entry of a list."""
    *tables, last = key.split(".")
    at: Any = document
    for name in tables:
        at = at[int(name)] if isinstance(at, list) else at.setdefault(name, {})
        if not isinstance(at, (dict, list)):
            raise KeyError(name)
    if isinstance(at, list):
        at[int(last)] = value
    else:
        at[last] = value


# --- drawing -----------------------------------------------------------------------------------------


_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)", re.DOTALL)


def _number(value: Quantity) -> tuple[float, str]:
    if not isinstance(value, str):
        return float(value), ""
    match = _NUMBER.fullmatch(value)
    if match is None:
        raise ValueError(f"'{value}' does not begin with a number")
    return float(match[1]), match[2].strip()


def _drawn(table: DrawTable, rng: np.random.Generator) -> Any:
    """One value. An error of the distribution is a ValueError that says what is wrong."""
    kind = table.distribution
    needed = {"normal": ("mean", "std"), "choice": ("values",)}.get(kind, ("low", "high"))
    given = [getattr(table, name) for name in needed]
    if None in given or () in given:
        raise ValueError(f"a distribution '{kind}' needs {' and '.join(needed)}")
    if kind == "choice":
        return table.values[int(rng.integers(len(table.values)))]
    (a, unit), (b, other) = map(_number, given)
    if unit != other:
        raise ValueError(f"units differ: '{unit}' and '{other}'")
    if kind == "normal":
        if b < 0.0:
            raise ValueError("std is negative")
        value = a + b * float(rng.standard_normal())
    elif not a < b:
        raise ValueError("low is not below high")
    elif kind == "uniform":
        value = float(rng.uniform(a, b))
    elif a <= 0.0:
        raise ValueError("low must be positive for 'log-uniform'")
    else:
        value = math.exp(float(rng.uniform(math.log(a), math.log(b))))
    return f"{value!r} {unit}" if unit else value


# --- reading -----------------------------------------------------------------------------------------


def read_campaign(path: str | Path) -> CampaignPlan:
    """Read a campaign file and the scenario files that it names.

    Raises
    ------
    RunFileError
        If a file cannot be read, a key is unknown, or a key of ``[grid]``, ``[draw]`` or ``set`` does not exist in the
        scenario. The message names file and key.
    """
    path = Path(path)
    texts = {"": toml_bytes(path)}
    file = read_toml(path, CampaignFile, texts[""])
    for name in dict.fromkeys(n for n in (file.scenario, *(case.scenario for case in file.case)) if n):
        texts[name] = toml_bytes(path.parent / name)
    return plan_of(path, texts)


def plan_of(path: Path, texts: Mapping[str, bytes]) -> CampaignPlan:
    """The plan of a campaign whose files were read before."""
    file = read_toml(path, CampaignFile, texts[""])
    documents = {n: toml_document(path.parent / n, raw) for n, raw in texts.items() if n}
    plan = CampaignPlan(path, file, texts, tuple(_groups(path, file, documents)), documents)
    _check(plan)
    return plan


def _groups(path: Path, file: CampaignFile, documents: Mapping[str, dict[str, Any]]) -> Iterator[CampaignGroup]:
    if file.scenario is None and not file.case:
        raise RunFileError(f"{path}: there is nothing to compute", remedy="give scenario or [[case]]")
    names, settings = [case.name for case in file.case], file.campaign
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise RunFileError(f"{path}: two cases have the name '{twice}'", remedy="rename one")
    points = [dict(zip(file.grid, values, strict=True)) for values in itertools.product(*file.grid.values())]
    if settings.designs > 1 and not file.draw:
        raise RunFileError(f"{path}: [campaign] designs needs [draw]", remedy="add [draw], or use repeats")
    if max(1, len(file.case)) * len(points) * settings.designs > _MOST_CASES:
        raise RunFileError(f"{path}: more than {_MOST_CASES} cases", remedy="make the grid coarser")
    first = start = 0
    for case in file.case or (CaseTable(""),):
        scenario = case.scenario or file.scenario
        if scenario is None:
            raise RunFileError(f"{path}: case '{case.name}' has no scenario", remedy="name a scenario file")
        subject = _subject(path, scenario, documents[scenario])
        repeats = case.repeats or settings.repeats
        bounds = settings.bounds if case.bounds is None else case.bounds
        for point in points:
            yield CampaignGroup(
                case.name, subject, scenario, point, settings.designs, repeats, bounds, first, start
            )
            first, start = first + settings.designs, start + settings.designs * repeats


def _subject(path: Path, scenario: str, document: Mapping[str, Any]) -> Subject:
    if "stand" in document and "electronics" in document:
        return "stand"
    if "site" in document and "run" in document:
        return "platform"
    raise RunFileError(
        f"{path.parent / scenario}: is not a scenario of 'piga simulate' or 'piga platform'",
        remedy="name a scenario file; 'piga records reproduce' calibrates stored runs again",
    )


def _check(plan: CampaignPlan) -> None:
    """Build the first case of each scenario and each value of the grid once. Wrong keys are then refused now."""
    from piga.campaign.subjects import built

    for key, table in plan.file.draw.items():
        try:
            _drawn(table, np.random.default_rng(0))
        except ValueError as error:
            raise RunFileError(f"{plan.path}: [draw] {key}: {error}", remedy="correct the entry") from None
    for key, values in plan.file.grid.items():
        if not values:
            raise RunFileError(f"{plan.path}: [grid] {key}: the list is empty", remedy="give its values")
    overlap = sorted(set(plan.file.grid) & set(plan.file.draw))
    if overlap:
        raise RunFileError(f"{plan.path}: '{overlap[0]}' is in [grid] and in [draw]", remedy="leave one out")
    done: set[tuple[str, str, str]] = set()
    for group in plan.groups:
        settings = {(group.name, key, repr(value)) for key, value in (group.set or {"": ""}).items()}
        if settings <= done:
            continue
        done |= settings
        record = plan.record(group.start)
        where = group.label if group.name or group.set else "scenario"
        try:
            document = plan.document(record)
        except (KeyError, IndexError, ValueError) as error:
            raise RunFileError(
                f"{plan.path}: {where}: the key goes through '{error.args[0]}', which is not a table",
                remedy="write the key as in the scenario file, e.g. 'twin.damping'",
            ) from None
        try:
            built(plan, record, document)
        except RunFileError as error:
            text = error.message.removeprefix(f"{plan.path}: ")
            raise RunFileError(f"{plan.path}: {where}: {text}", remedy=error.remedy) from None
