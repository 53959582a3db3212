"""Collect a campaign: read all parts in the order of the records, and judge them.

The result does not depend on the shards, the workers and the interruptions, to the bit.
"""

from __future__ import annotations

import csv
import math
import shlex
from collections import Counter
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga.campaign.shards import Campaign, read_part
from piga.errors import PigaError
from piga.results import Array

if TYPE_CHECKING:
    import pyarrow as pa

Row = dict[str, Any]


PROBABILITY = 0.95
"""Probability of the intervals, the target of the coverage."""
CHANCE = 1.96
"""Standard errors from the target beyond which a quantity is named: one of twenty sound ones lies beyond."""
SURE = 3.29
"""Standard errors from the target that chance does not explain: one of a thousand sound ones lies beyond."""
WORST = 12
"""Number of worst cases that are kept."""


class CampaignCoefficient(msgspec.Struct, frozen=True):
    """The figures of one coefficient or quantity in one group; what is not known is None.

    ``coverage_std_error`` is that of a binomial share of 0.95. ``bias`` is the mean error, ``spread`` the standard deviation of
    the errors, both in ``unit``. ``nees`` is the mean square of the errors over standard uncertainties, ``nees_expected`` its
    expected value for Student's t.
    For quantities without truth, ``mean``, ``standard_deviation``, ``lowest`` and ``highest`` describe the results.
    """

    name: str
    unit: str
    tests: int
    mean: float
    standard_deviation: float | None
    lowest: float
    highest: float
    coverage: float | None = None
    coverage_std_error: float | None = None
    bias: float | None = None
    bias_std_error: float | None = None
    bias_over_sigma: float | None = None
    spread: float | None = None
    rms_u: float | None = None
    nees: float | None = None
    nees_expected: float | None = None
    largest_z: float | None = None

    @property
    def coverage_off(self) -> float:
        """Coverage less its target, in standard errors; 0 if it is not known."""
        return (
            0.0 if self.coverage is None else (self.coverage - PROBABILITY) / (self.coverage_std_error or 1.0)
        )


class Miss(msgspec.Struct, frozen=True):
    """A quantity away from its target: ``what`` is 'coverage' (target 0.95) or 'bias' (target 0, here over the spread)."""

    group: str
    coefficient: str
    what: str
    value: float
    std_error: float
    standard_errors: float

    @property
    def label(self) -> str:
        """The quantity in words."""
        if self.what == "coverage":
            return f"{self.coefficient} of {self.group} ({100 * self.value:.1f} ± {100 * self.std_error:.1f} %)"
        return f"bias of {self.coefficient} of {self.group} ({self.value:+.3f} ± {self.std_error:.3f} sigma)"


class GroupResult(msgspec.Struct, frozen=True):
    """The results of one group: figures by coefficient, records that failed by class, NEES of all coefficients together.

    ``seen`` is the share of the records whose calibration reports a kind of noise, suggests a term, or doubts the noise.
    """

    name: str
    label: str
    set: dict[str, Any]
    subject: str
    planned: int
    records: int
    failed: dict[str, int]
    nees: float | None
    nees_expected: float | None
    seen: dict[str, float]
    coefficients: tuple[CampaignCoefficient, ...]


class _WorstCase(msgspec.Struct, frozen=True):
    """A coefficient of one record far from its truth: error over standard uncertainty, and the command that repeats it."""

    record: int
    group: str
    coefficient: str
    z: float
    command: str


class _Failure(msgspec.Struct, frozen=True):
    """A class of failures: how many records, and the first of them."""

    error_class: str
    records: int
    first: int
    message: str
    command: str


class Collected(msgspec.Struct, frozen=True):
    """A whole campaign, judged."""

    schema: str
    campaign: str
    title: str
    version: str
    seed: int
    records: int
    computed: int
    failed: int
    complete: bool
    shards: int
    missing: tuple[int, ...]
    groups: tuple[GroupResult, ...]
    misses: tuple[Miss, ...]
    worst: tuple[_WorstCase, ...]
    failures: tuple[_Failure, ...]


def write_table(collected: Collected, path: Path) -> None:
    """Write one row per group and coefficient as CSV."""
    rows = [{"group": g.label} | msgspec.to_builtins(c) for g in collected.groups for c in g.coefficients]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]) if rows else ["group"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def collect(campaign: Campaign) -> Collected:
    """Read all parts and judge them.

    Raises
    ------
    PigaError
        If a part is damaged or belongs to another campaign or shard, or if there are no parts.
    """
    parts = campaign.parts()
    if not parts:
        raise PigaError(f"{campaign.folder}: has no results yet", remedy="compute them with: piga campaign run")
    heads, rows = read_rows(campaign, parts)
    plan, manifest, missing = campaign.plan, campaign.manifest, campaign.missing()
    groups, z = _group_results(campaign, heads, rows), _numbers(rows, "z")
    failures = _failures(campaign, heads)
    return Collected(
        schema="piga.campaign.collected/3",
        campaign=plan.path.name,
        title=plan.file.campaign.title or plan.path.stem,
        version=manifest.software.get("piga", ""),
        seed=plan.seed,
        records=plan.records,
        computed=len(heads),
        failed=sum(failure.records for failure in failures),
        complete=not missing,
        shards=campaign.shards,
        missing=tuple(missing),
        groups=groups,
        misses=_misses(groups),
        worst=tuple(_worst(campaign, rows, np.where(np.isfinite(z), z, 0.0))),
        failures=tuple(failures),
    )


def read_rows(campaign: Campaign, parts: dict[int, Path]) -> tuple[list[Row], pa.Table]:
    """The rows of all records, and the table of all coefficients, each with the number of its group."""
    import pyarrow as pa
    import pyarrow.compute as pc

    table = pa.concat_tables([read_part(campaign, shard, path) for shard, path in parts.items()])
    starts = [group.start for group in campaign.plan.groups]
    index = np.searchsorted(starts, table.column("record").to_numpy(), side="right") - 1
    table = table.append_column("group", pa.array(index, pa.int64()))
    is_record = pc.is_null(table.column("name"))
    names = ["record", "group", "error_class", "error", "nees", "nees_expected", "seen", "seconds"]
    return table.filter(is_record).select(names).to_pylist(), table.filter(pc.invert(is_record))


def _numbers(table: pa.Table, name: str) -> Array:
    return table.column(name).to_numpy().astype(float)


# --- judging -----------------------------------------------------------------------------------------


def _group_results(campaign: Campaign, heads: list[Row], rows: pa.Table) -> tuple[GroupResult, ...]:
    places: dict[tuple[int, str, str], list[int]] = {}
    for at, key in enumerate(
        zip(*(rows.column(n).to_pylist() for n in ("group", "name", "unit")), strict=True)
    ):
        places.setdefault(key, []).append(at)
    names = ("value", "u", "low", "high", "degrees_of_freedom", "deviation", "z")
    numbers = {name: _numbers(rows, name) for name in names}
    figures: dict[int, list[CampaignCoefficient]] = {}
    for (index, name, unit), where in places.items():
        figure = _coefficient(name, unit, {n: column[where] for n, column in numbers.items()})
        figures.setdefault(index, []).append(figure)
    results = []
    for index, members in groupby(heads, key=itemgetter("group")):
        group, mine = campaign.plan.groups[index], list(members)
        failed = Counter(head["error_class"] for head in mine if head["error_class"])
        seen = Counter(name for head in mine for name in head["seen"] or ())
        nees, expected = (_mean([head[n] for head in mine]) for n in ("nees", "nees_expected"))
        results.append(
            GroupResult(
                name=group.name,
                label=group.label,
                set=group.set,
                subject=group.subject,
                planned=group.records,
                records=len(mine),
                failed=dict(sorted(failed.items())),
                nees=nees,
                nees_expected=expected,
                seen={name: number / len(mine) for name, number in sorted(seen.items())},
                coefficients=tuple(figures.get(index, ())),
            )
        )
    return tuple(results)


def _mean(values: Array | list[float | None]) -> float | None:
    """Mean of what is known."""
    given = np.array(values, dtype=float)
    known = given[np.isfinite(given)]
    return float(known.mean()) if known.size else None


def _std(values: Array) -> float | None:
    return float(values.std(ddof=1)) if values.size > 1 else None


def _coefficient(name: str, unit: str, rows: dict[str, Array]) -> CampaignCoefficient:
    """The figures of one coefficient from the columns of its rows."""
    value = rows["value"]
    ends = {"lowest": float(value.min()), "highest": float(value.max())}
    plain: dict[str, Any] = {"mean": float(value.mean()), "standard_deviation": _std(value)} | ends
    known = np.isfinite(rows["deviation"])
    if not known.any():
        return CampaignCoefficient(name, unit, value.size, **plain)
    off, low, high = (rows[column][known] for column in ("deviation", "low", "high"))
    truth, tests, bias, spread = value[known] - off, off.size, float(off.mean()), _std(off)
    hits = int(((low <= truth) & (truth <= high)).sum())
    mean_u2 = _mean(rows["u"] ** 2)
    scaled = np.isfinite(rows["z"])
    z, degrees = rows["z"][scaled], rows["degrees_of_freedom"][scaled]
    return CampaignCoefficient(
        name,
        unit,
        value.size,
        **plain,
        coverage=hits / tests,
        coverage_std_error=math.sqrt(PROBABILITY * (1.0 - PROBABILITY) / tests),
        bias=bias,
        bias_std_error=None if spread is None else spread / math.sqrt(tests),
        bias_over_sigma=bias / spread if spread else None,
        spread=spread,
        rms_u=None if mean_u2 is None else math.sqrt(mean_u2),
        nees=_mean(z**2),
        nees_expected=_mean(1.0 / (1.0 - 2.0 / np.maximum(degrees, 3.0))),
        largest_z=float(np.abs(z).max()) if z.size else None,
    )


def _misses(groups: tuple[GroupResult, ...]) -> tuple[Miss, ...]:
    """Every quantity away from its target by more than ``CHANCE`` standard errors, the farthest first."""
    misses = []
    for group in groups:
        for c in group.coefficients:
            coverage = ("coverage", c.coverage or 0.0, c.coverage_std_error or 0.0, c.coverage_off)
            errors = (c.bias or 0.0) / (c.bias_std_error or math.inf)
            bias = ("bias", c.bias_over_sigma or 0.0, 1.0 / math.sqrt(c.tests), errors)
            misses += [Miss(group.label, c.name, *one) for one in (coverage, bias) if abs(one[-1]) > CHANCE]
    return tuple(sorted(misses, key=lambda miss: -abs(miss.standard_errors)))


def _repeat_command(campaign: Campaign, record: int) -> str:
    return f"piga campaign repeat {shlex.quote(campaign.plan.path.name)} --record {record} --out DIR"


def _worst(campaign: Campaign, rows: pa.Table, z: Array) -> list[_WorstCase]:
    cases = []
    for at in np.argsort(-np.abs(z), kind="stable")[:WORST].tolist():
        if z[at] != 0.0:
            number, name = (rows.column(column)[at].as_py() for column in ("record", "name"))
            label, command = campaign.plan.record(number).group.label, _repeat_command(campaign, number)
            cases.append(_WorstCase(number, label, name, float(z[at]), command))
    return cases


def _failures(campaign: Campaign, heads: list[Row]) -> list[_Failure]:
    """The classes of failures, the most frequent first."""
    failed = [head for head in heads if head["error_class"]]
    first = {head["error_class"]: head for head in reversed(failed)}
    counts = sorted(
        Counter(head["error_class"] for head in failed).items(), key=lambda pair: (-pair[1], pair[0])
    )
    places = [(name, count, first[name]["record"], first[name]["error"]) for name, count in counts]
    return [_Failure(*place, _repeat_command(campaign, place[2])) for place in places]
