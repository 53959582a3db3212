"""Collect a campaign: read all parts as one Arrow table, in the order of the records, and judge them with PyArrow.

The table does not depend on the shards, the workers and the interruptions, and neither does the result, to the bit.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga.campaign.campaign_file import CampaignGroup, RecordName
from piga.campaign.shards import Campaign, read_part
from piga.errors import PigaError
from piga.results import Array, finite

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

EDGES = np.linspace(-5.0, 5.0, 41)
"""Edges of the histogram of errors over standard uncertainties; values beyond are counted in the outer bins."""


@dataclass(frozen=True)
class CampaignCoefficient:
    """The figures of one coefficient or quantity in one group; what is not known is None.

    ``coverage_std_error`` is that of a binomial share. ``bias`` is the mean error, ``spread`` the standard deviation of the errors,
    both in ``unit``. ``variance_over_bound`` is the variance of the errors over that of Cramer and Rao. ``nees`` is
    the mean square of the errors over standard uncertainties, ``nees_expected`` its expected value for Student's t.
    For quantities without truth, ``mean``, ``std``, ``lowest`` and ``highest`` describe the results.
    """

    name: str
    unit: str
    tests: int
    mean: float
    std: float | None
    lowest: float
    highest: float
    coverage: float | None = None
    coverage_std_error: float | None = None
    bias: float | None = None
    bias_std_error: float | None = None
    bias_over_sigma: float | None = None
    spread: float | None = None
    rms_u: float | None = None
    half_width_over_sigma: float | None = None
    variance_over_bound: float | None = None
    nees: float | None = None
    nees_expected: float | None = None
    largest_z: float | None = None

    @property
    def coverage_off(self) -> float:
        """Coverage less its target, over the standard error of a sound share; 0 if it is not known."""
        if self.coverage is None:
            return 0.0
        p = PROBABILITY
        return (self.coverage - p) / math.sqrt(p * (1.0 - p) / self.tests)

    @property
    def bias_off(self) -> float:
        """Mean error over its standard error; 0 if it is not known."""
        return self.bias / self.bias_std_error if self.bias is not None and self.bias_std_error else 0.0


@dataclass(frozen=True)
class Miss:
    """A quantity away from its target: ``what`` is 'coverage' (target 0.95) or 'bias' (target 0, here over the spread)."""

    group: str
    coefficient: str
    what: str
    value: float
    std_error: float
    standard_errors: float

    @property
    def sure(self) -> bool:
        """True if chance does not explain it."""
        return abs(self.standard_errors) > SURE

    @property
    def label(self) -> str:
        """The quantity in words."""
        if self.what == "coverage":
            return f"{self.coefficient} of {self.group} ({100 * self.value:.1f} ± {100 * self.std_error:.1f} %)"
        return f"bias of {self.coefficient} of {self.group} ({self.value:+.3f} ± {self.std_error:.3f} sigma)"


@dataclass(frozen=True)
class GroupResult:
    """The results of one group: figures by coefficient, records that failed by class, NEES of all coefficients together.

    ``seen`` is the share of the records whose calibration reports a kind of noise, suggests a term, or doubts the noise.
    """

    group: CampaignGroup
    records: int
    failed: dict[str, int]
    coefficients: tuple[CampaignCoefficient, ...]
    nees: float | None
    nees_expected: float | None
    seen: dict[str, float]


@dataclass(frozen=True)
class _WorstCase:
    """A coefficient of one record far from its truth: error over standard uncertainty, and the command that repeats it."""

    record: int
    case: int
    repeat: int
    group: str
    coefficient: str
    z: float
    command: str


@dataclass(frozen=True)
class _Failure:
    """A class of failures: how many records, and the first of them."""

    error_class: str
    records: int
    first: int
    message: str
    command: str


@dataclass(frozen=True)
class Collected:
    """A whole campaign, judged. ``errors`` is the histogram of all errors over standard uncertainties, at ``EDGES``."""

    title: str
    file: str
    version: str
    seed: int
    records: int
    computed: int
    shards: int
    missing: tuple[int, ...]
    groups: tuple[GroupResult, ...]
    misses: tuple[Miss, ...]
    errors: tuple[int, ...]
    worst: tuple[_WorstCase, ...]
    failures: tuple[_Failure, ...]

    @property
    def failed(self) -> int:
        """Records that failed."""
        return sum(failure.records for failure in self.failures)

    @property
    def complete(self) -> bool:
        """True if every shard has its part."""
        return not self.missing


def collect(campaign: Campaign) -> Collected:
    """Read all parts and judge them.

    Raises
    ------
    PigaError
        If a part is damaged or belongs to another campaign or shard, or if there are no parts.
    """
    from piga._version import __version__

    parts = campaign.parts()
    if not parts:
        raise PigaError(f"{campaign.folder}: has no results yet", remedy="compute them with: piga campaign run")
    heads, rows = read_rows(campaign, parts)
    plan, manifest = campaign.plan, campaign.manifest
    groups = tuple(_group_results(campaign, heads, rows))
    return Collected(
        title=plan.file.campaign.title or plan.path.stem,
        file=plan.path.name,
        version=manifest.software.get("piga", __version__),
        seed=plan.seed,
        records=manifest.records,
        computed=heads.num_rows,
        shards=campaign.shards,
        missing=tuple(campaign.missing()),
        groups=groups,
        misses=_misses(groups),
        errors=_histogram(rows),
        worst=tuple(_worst(campaign, rows)),
        failures=tuple(_failures(campaign, heads)),
    )


def _repeat_command(campaign: Campaign, record: RecordName) -> str:
    name = shlex.quote(campaign.plan.path.name)
    return f"piga campaign repeat {name} --case {record.case} --repeat {record.repeat} --out DIR"


# --- reading -----------------------------------------------------------------------------------------


def read_rows(campaign: Campaign, parts: dict[int, Path]) -> tuple[pa.Table, pa.Table]:
    """The rows of all records and those of all coefficients, each with the number of its group."""
    import pyarrow as pa
    import pyarrow.compute as pc

    table = pa.concat_tables([read_part(campaign, shard, path) for shard, path in parts.items()])
    starts = [group.start for group in campaign.plan.groups]
    index = np.searchsorted(starts, table.column("record").to_numpy(), side="right") - 1
    table = table.append_column("group", pa.array(index, pa.int64()))
    is_record = pc.is_null(table.column("name"))
    return table.filter(is_record).combine_chunks(), table.filter(pc.invert(is_record)).combine_chunks()


def _numbers(table: pa.Table, name: str) -> Array:
    return table.column(name).to_numpy().astype(float)


def _judged(rows: pa.Table) -> pa.Table:
    """The rows with the columns that are averaged; empty where something is not known."""
    import pyarrow as pa

    z, off, low, high = (_numbers(rows, name) for name in ("z", "deviation", "low", "high"))
    degrees, bound, u = (_numbers(rows, name) for name in ("degrees_of_freedom", "bound", "u"))
    truth, known = _numbers(rows, "value") - off, np.isfinite(off)
    table = rows.select(["record", "group", "name", "unit", "value"])
    with np.errstate(all="ignore"):
        columns = {
            "deviation": off,
            "held": np.where(known, (low <= truth) & (truth <= high), np.nan),
            "half": np.where(known, 0.5 * (high - low), np.nan),
            "z2": z**2,
            "abs_z": np.abs(z),
            "expected": np.where(np.isfinite(z), 1.0 / (1.0 - 2.0 / np.maximum(degrees, 3.0)), np.nan),
            "u2": u**2,
            "bound2": bound**2,
        }
    for name, column in columns.items():
        table = table.append_column(name, pa.array(column, mask=~np.isfinite(column)))
    return table


def _grouped(table: pa.Table, keys: list[str], wanted: list[tuple[Any, ...]]) -> list[Row]:
    """Aggregates by key, in the order in which the keys come first; one thread, so that sums have one order."""
    return table.group_by(keys, use_threads=False).aggregate(wanted).to_pylist()


# --- judging -----------------------------------------------------------------------------------------


def _group_results(campaign: Campaign, heads: pa.Table, rows: pa.Table) -> list[GroupResult]:
    import pyarrow.compute as pc

    table = _judged(rows)
    sample = pc.VarianceOptions(ddof=1)
    figures = _grouped(
        table,
        ["group", "name", "unit"],
        [("value", "count"), ("value", "mean"), ("value", "stddev", sample), ("value", "min"), ("value", "max")]
        + [("deviation", "count"), ("deviation", "mean"), ("deviation", "stddev", sample), ("held", "sum")]
        + [(name, "mean") for name in ("half", "z2", "expected", "u2", "bound2")]
        + [("abs_z", "max")],
    )
    seen: dict[int, Counter[str]] = {}
    failed: dict[int, Counter[str]] = {}
    columns = (heads.column(name).to_pylist() for name in ("group", "error_class", "seen"))
    for group, error, names in zip(*columns, strict=True):
        failed.setdefault(group, Counter()).update([error] if error else [])
        seen.setdefault(group, Counter()).update(names or ())
    wanted = [("record", "count"), ("nees", "mean"), ("nees_expected", "mean")]
    return [
        GroupResult(
            group=campaign.plan.groups[index],
            records=head["record_count"],
            failed=dict(sorted(failed[index].items())),
            coefficients=tuple(_coefficient(row) for row in figures if row["group"] == index),
            nees=finite(head["nees_mean"]),
            nees_expected=finite(head["nees_expected_mean"]),
            seen={name: count / head["record_count"] for name, count in sorted(seen[index].items())},
        )
        for head in sorted(_grouped(heads, ["group"], wanted), key=lambda head: head["group"])
        for index in [head["group"]]
    ]


def _coefficient(row: Row) -> CampaignCoefficient:
    tests, with_truth = row["value_count"], row["deviation_count"]
    plain = {"mean": row["value_mean"], "lowest": row["value_min"], "highest": row["value_max"]}
    std = row["value_stddev"] if tests > 1 else None
    if not with_truth:
        return CampaignCoefficient(row["name"], row["unit"], tests, std=std, **plain)
    bias, spread = row["deviation_mean"], row["deviation_stddev"] if with_truth > 1 else None
    hits, bound2 = int(row["held_sum"]), row["bound2_mean"]
    return CampaignCoefficient(
        row["name"],
        row["unit"],
        tests,
        std=std,
        **plain,
        coverage=hits / with_truth,
        coverage_std_error=_share_error(hits, with_truth),
        bias=bias,
        bias_std_error=None if spread is None else spread / math.sqrt(with_truth),
        bias_over_sigma=bias / spread if spread else None,
        spread=spread,
        rms_u=math.sqrt(row["u2_mean"]) if row["u2_mean"] is not None else None,
        half_width_over_sigma=row["half_mean"] / spread if spread else None,
        variance_over_bound=spread**2 / bound2 if spread is not None and bound2 else None,
        nees=row["z2_mean"],
        nees_expected=row["expected_mean"],
        largest_z=row["abs_z_max"],
    )


def _share_error(hits: int, tests: int) -> float:
    """Standard error of a share. At 0 and 1 it is that of half a test, because that of the binomial would be 0."""
    share = min(max(hits, 0.5), tests - 0.5) / tests
    return math.sqrt(share * (1.0 - share) / tests)


def _misses(groups: tuple[GroupResult, ...]) -> tuple[Miss, ...]:
    """Every quantity away from its target by more than ``CHANCE`` standard errors, the farthest first."""
    misses = []
    for result in groups:
        for c in result.coefficients:
            if abs(c.coverage_off) > CHANCE:
                values = (c.coverage or 0.0, c.coverage_std_error or 0.0, c.coverage_off)
                misses.append(Miss(result.group.label, c.name, "coverage", *values))
            if abs(c.bias_off) > CHANCE:
                values = (c.bias_over_sigma or 0.0, 1.0 / math.sqrt(c.tests), c.bias_off)
                misses.append(Miss(result.group.label, c.name, "bias", *values))
    return tuple(sorted(misses, key=lambda miss: -abs(miss.standard_errors)))


def _histogram(rows: pa.Table) -> tuple[int, ...]:
    z = _numbers(rows, "z")
    counts = np.histogram(np.clip(z[np.isfinite(z)], EDGES[0], EDGES[-1]), EDGES)[0]
    return tuple(int(count) for count in counts)


def _worst(campaign: Campaign, rows: pa.Table) -> list[_WorstCase]:
    z = _numbers(rows, "z")
    size = np.where(np.isfinite(z), np.abs(z), 0.0)
    cases = []
    for at in np.argsort(-size, kind="stable")[:WORST]:
        if size[at] > 0.0:
            record = campaign.plan.record(rows.column("record")[int(at)].as_py())
            place = (record.number, record.case, record.repeat, record.group.label)
            name = rows.column("name")[int(at)].as_py()
            cases.append(_WorstCase(*place, name, float(z[at]), _repeat_command(campaign, record)))
    return cases


def _failures(campaign: Campaign, heads: pa.Table) -> list[_Failure]:
    import pyarrow.compute as pc

    failed = heads.filter(pc.is_valid(heads.column("error_class"))).select(["error_class", "record", "error"])
    rows = failed.to_pylist()
    failures = []
    for name, count in Counter(row["error_class"] for row in rows).items():
        first = next(row for row in rows if row["error_class"] == name)
        command = _repeat_command(campaign, campaign.plan.record(first["record"]))
        failures.append(_Failure(name, count, first["record"], first["error"] or "", command))
    return sorted(failures, key=lambda failure: (-failure.records, failure.error_class))


# --- documents ---------------------------------------------------------------------------------------

COLLECTED = "piga.campaign.collected/2"


def document(collected: Collected) -> dict[str, Any]:
    """The JSON document of ``piga campaign collect``."""
    names = ("title", "version", "seed", "records", "computed", "failed", "complete", "missing")
    entry = {"schema": COLLECTED, "campaign": collected.file} | {
        name: getattr(collected, name) for name in names
    }
    return entry | {
        "missing": list(collected.missing),
        "groups": [_group_document(result) for result in collected.groups],
        "misses": msgspec.to_builtins(collected.misses),
        "worst": msgspec.to_builtins(collected.worst),
        "failures": msgspec.to_builtins(collected.failures),
    }


def _group_document(result: GroupResult) -> dict[str, Any]:
    group = result.group
    names = ("records", "failed", "nees", "nees_expected", "seen")
    entry = {"name": group.name, "set": group.set, "subject": group.subject, "planned": group.records}
    entry |= {name: getattr(result, name) for name in names}
    return entry | {"coefficients": msgspec.to_builtins(result.coefficients)}


def write_table(collected: Collected, path: Path) -> None:
    """Write one row per group and coefficient as CSV."""
    import csv

    rows = [
        {"group": result.group.label} | msgspec.to_builtins(c)
        for result in collected.groups
        for c in result.coefficients
    ]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]) if rows else ["group"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
