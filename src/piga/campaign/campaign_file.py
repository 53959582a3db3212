"""Campaign files (TOML): scenarios, grids, drawn values and repeats; and the list of records.

The list of records is a function of the campaign file and of the scenario files. It does not depend on the machine.
Every record has a case and a repeat, and its random numbers start at ``SeedSequence(seed, spawn_key=(case, repeat))``.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from piga.errors import ArgumentError, PigaError, RunFileError, UnitError
from piga.records.run_file import EstimationTable, ModelTable, Quantity, TomlTable, UncertaintyTable
from piga.stand.scenario import Scenario, ScenarioTable, scenario_of
from piga.text_files import convert_table, convert_toml, read_toml, toml_bytes, toml_document
from piga.units import written_quantity

if TYPE_CHECKING:
    from piga.platform.scenario import PlatformScenario

Count = Annotated[int, Meta(ge=1, le=1_000_000_000)]
Subject = Literal["stand", "platform"]
_MOST_CASES = 1_000_000
"""Most cases of a campaign."""


class CampaignTable(TomlTable, frozen=True):
    """``[campaign]``: settings of the whole campaign.

    ``designs`` is the number of cases that are drawn for each point of the grid (with ``[draw]``). ``records_per_shard``:
    how many records are computed together [default: a five-hundredth of all].
    """

    title: str = ""
    seed: Annotated[int, Meta(ge=0)] = 1
    repeats: Count = 1
    designs: Count = 1
    records_per_shard: Count | None = None


class CaseTable(TomlTable, frozen=True):
    """``[[case]]``: one scenario with a name and with its own values.

    ``scenario`` names a scenario file. ``set`` replaces values of it.
    """

    name: str
    scenario: str | None = None
    set: dict[str, Any] = msgspec.field(default_factory=dict)
    repeats: Count | None = None


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

    ``set`` is the point of the grid, ``values`` those of the case and of the point. ``first`` is the number of the first case,
    ``start`` the number of the first record.
    """

    name: str
    subject: Subject
    scenario: str
    set: dict[str, Any]
    values: dict[str, Any]
    designs: int
    repeats: int
    first: int
    start: int

    @property
    def records(self) -> int:
        """Number of records."""
        return self.designs * self.repeats

    @property
    def label(self) -> str:
        """Name and point of the grid in words."""
        point = ", ".join(f"{key} = {_shown(value)}" for key, value in self.set.items())
        return ": ".join(words for words in (self.name, point) if words) or "all records"


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
    def records(self) -> int:
        """Number of records."""
        return self.groups[-1].start + self.groups[-1].records

    def record(self, number: int) -> RecordName:
        """A record by its number."""
        if not 0 <= number < self.records:
            remedy = f"they count from 0 to {self.records - 1}"
            raise RunFileError(f"{self.path}: there is no record {number}", remedy=remedy)
        group = self.groups[bisect.bisect_right(self.groups, number, key=lambda group: group.start) - 1]
        design, repeat = divmod(number - group.start, group.repeats)
        return RecordName(number, group, group.first + design, repeat)

    def document(self, record: RecordName) -> dict[str, Any]:
        """The scenario of a record: the file with the values of the case, of the grid and of the draw."""
        document = deepcopy(self.documents[record.group.scenario])
        for key, value in record.group.values.items():
            _replace_value(document, key, value)
        rng = np.random.default_rng(np.random.SeedSequence(self.file.campaign.seed, spawn_key=(record.case,)))
        for key, table in self.file.draw.items():
            try:
                _replace_value(document, key, _drawn(table, rng))
            except (ValueError, UnitError) as error:
                raise RunFileError(f"[draw] {key}: {error}", remedy="correct the entry") from None
        return document

    def scenario(self, record: RecordName) -> Scenario | PlatformScenario:
        """The scenario of a record, ready to run."""
        path, document = self.path.parent / record.group.scenario, self.document(record)
        if record.group.subject == "platform":
            from piga.platform.scenario import scenario_of_document

            return scenario_of_document(path, document)
        table = convert_toml(path, document, ScenarioTable)
        kinds = {"model": ModelTable, "estimation": EstimationTable, "uncertainty": UncertaintyTable}
        for part, kind in kinds.items():
            convert_table(part, getattr(table, part), kind)
        if table.truth.get("k1"):
            raise ArgumentError(
                "[truth] k1: a calibration cannot separate it from the scale factor",
                remedy="leave it out, or change scale_factor",
            )
        return scenario_of(path, table)

    def seed_of(self, record: RecordName) -> int:
        """Seed of a record, as ``piga simulate --seed`` takes it: the same on every machine, in every order."""
        sequence = np.random.SeedSequence(self.file.campaign.seed, spawn_key=(record.case, record.repeat))
        return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))


def _replace_value(document: dict[str, Any], key: str, value: Any) -> None:
    """Set a value of a TOML document by its dotted key. Missing tables are made. A number selects an entry of a list."""
    *tables, last = key.split(".")
    at: Any = document
    try:
        for name in tables:
            at = at[int(name)] if isinstance(at, list) else at.setdefault(name, {})
        at[int(last) if isinstance(at, list) else last] = value
    except (AttributeError, IndexError, TypeError, ValueError):
        raise RunFileError(
            f"the key '{key}' goes through a value that is not a table, or to an entry that a list lacks",
            remedy="write the key as in the scenario file, e.g. 'twin.damping'",
        ) from None


def _drawn(table: DrawTable, rng: np.random.Generator) -> Any:
    """One value. An error of the distribution is a ValueError that says what is wrong."""
    kind = table.distribution
    needed = {"normal": ("mean", "std"), "choice": ("values",)}.get(kind, ("low", "high"))
    given = [getattr(table, name) for name in needed]
    if None in given or () in given:
        raise ValueError(f"a distribution '{kind}' needs {' and '.join(needed)}")
    if kind == "choice":
        return table.values[int(rng.integers(len(table.values)))]
    (first, unit), (second, other) = (written_quantity(str(value)) for value in given)
    a, b = float(first), float(second)
    if unit != other:
        raise ValueError(f"units differ: '{unit}' and '{other}'")
    if b < 0.0 if kind == "normal" else not a < b or (kind == "log-uniform" and a <= 0.0):
        raise ValueError("low is not below high, low of 'log-uniform' is not positive, or std is negative")
    if kind == "normal":
        value = a + b * float(rng.standard_normal())
    elif kind == "uniform":
        value = float(rng.uniform(a, b))
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
    names = (file.scenario, *(case.scenario for case in file.case))
    texts |= {name: toml_bytes(path.parent / name) for name in names if name}
    plan = plan_of(path, texts)
    done: set[tuple[str, str, str]] = set()
    for group in (
        plan.groups
    ):  # the first record of each case with each value of the grid once: wrong keys are refused now
        settings = {(group.name, key, repr(value)) for key, value in (group.set or {"": ""}).items()}
        if settings <= done:
            continue
        done |= settings
        try:
            plan.scenario(plan.record(group.start))
        except PigaError as error:
            raise RunFileError(f"{path}: {group.label}: {error.message}", remedy=error.remedy) from None
    return plan


def plan_of(path: Path, texts: Mapping[str, bytes]) -> CampaignPlan:
    """The plan of a campaign whose files were read and checked before."""
    file = read_toml(path, CampaignFile, texts[""])
    documents = {n: toml_document(path.parent / n, raw) for n, raw in texts.items() if n}
    return CampaignPlan(path, file, texts, tuple(_groups(path, file, documents)), documents)


def _groups(path: Path, file: CampaignFile, documents: Mapping[str, dict[str, Any]]) -> Iterator[CampaignGroup]:
    def refused(what: str, remedy: str) -> RunFileError:
        return RunFileError(f"{path}: {what}", remedy=remedy)

    settings, names = file.campaign, [case.name for case in file.case]
    for name in names:
        if names.count(name) > 1:
            raise refused(f"two cases have the name '{name}'", "rename one")
    for key, values in file.grid.items():
        if not values:
            raise refused(f"[grid] {key}: the list is empty", "give its values")
        if key in file.draw:
            raise refused(f"'{key}' is in [grid] and in [draw]", "leave one out")
    if max(1, len(names)) * math.prod(map(len, file.grid.values())) * settings.designs > _MOST_CASES:
        raise refused(f"more than {_MOST_CASES} cases", "make the grid coarser")
    first = start = 0
    for case in file.case or (CaseTable(""),):
        scenario = case.scenario or file.scenario
        if scenario is None:
            raise refused("there is nothing to compute", "give scenario, at the top or in each [[case]]")
        subject = _subject(path.parent / scenario, documents[scenario])
        repeats = case.repeats or settings.repeats
        for values in itertools.product(*file.grid.values()):
            point = dict(zip(file.grid, values, strict=True))
            every = case.set | point
            yield CampaignGroup(
                case.name, subject, scenario, point, every, settings.designs, repeats, first, start
            )
            first, start = first + settings.designs, start + settings.designs * repeats


def _subject(path: Path, document: Mapping[str, Any]) -> Subject:
    if "stand" in document and "electronics" in document:
        return "stand"
    if "site" in document and "run" in document:
        return "platform"
    raise RunFileError(
        f"{path}: is not a scenario of 'piga simulate' or 'piga platform'",
        remedy="name a scenario file; 'piga records reproduce' calibrates stored runs again",
    )
