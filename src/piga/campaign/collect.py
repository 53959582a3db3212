"""Collect a campaign: read all parts in the order of the records, judge them, and show them on a page.

The result does not depend on the shards, the workers and the interruptions, to the bit.
"""

from __future__ import annotations

import csv
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga.campaign.shards import Campaign, read_part
from piga.errors import PigaError
from piga.records.terms import shown_unit
from piga.reports.render.figure import Figure, Plot, Role
from piga.reports.render.numbers import pretty_unit, short, signed
from piga.reports.render.page import ALONE, Cell, Content, Notice, Page, Section, Table, TableOf, Text, Tone
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
    """A coefficient of one record far from its truth: error over standard uncertainty."""

    record: int
    group: str
    coefficient: str
    z: float


class _Failure(msgspec.Struct, frozen=True):
    """A class of failures: how many records, and the first of them."""

    error_class: str
    records: int
    first: int
    message: str


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
    plan, missing = campaign.plan, campaign.missing()
    groups, failures = _group_results(campaign, heads, rows), _failures(heads)
    return Collected(
        schema="piga.campaign.collected/3",
        campaign=plan.path.name,
        title=plan.file.campaign.title or plan.path.stem,
        version=campaign.manifest.software.get("piga", ""),
        seed=plan.file.campaign.seed,
        records=plan.records,
        computed=len(heads),
        failed=sum(failure.records for failure in failures),
        complete=not missing,
        shards=campaign.shards,
        missing=tuple(missing),
        groups=groups,
        misses=_misses(groups),
        worst=_worst(campaign, rows),
        failures=failures,
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
    places = defaultdict(list)
    for at, key in enumerate(
        zip(*(rows.column(n).to_pylist() for n in ("group", "name", "unit")), strict=True)
    ):
        places[key].append(at)
    names = ("value", "u", "low", "high", "degrees_of_freedom", "deviation", "z")
    numbers = {name: _numbers(rows, name) for name in names}
    figures = defaultdict(list)
    for (index, name, unit), where in places.items():
        figure = _coefficient(name, unit, {n: column[where] for n, column in numbers.items()})
        figures[index].append(figure)
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
                coefficients=tuple(figures[index]),
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
            if c.coverage is not None and c.coverage_std_error is not None:
                place = group.label, c.name, "coverage"
                misses.append(Miss(*place, c.coverage, c.coverage_std_error, c.coverage_off))
            if c.bias_over_sigma is not None:
                error = 1.0 / math.sqrt(c.tests)
                misses.append(
                    Miss(group.label, c.name, "bias", c.bias_over_sigma, error, c.bias_over_sigma / error)
                )
    far = (miss for miss in misses if abs(miss.standard_errors) > CHANCE)
    return tuple(sorted(far, key=lambda miss: -abs(miss.standard_errors)))


def _worst(campaign: Campaign, rows: pa.Table) -> tuple[_WorstCase, ...]:
    z = np.nan_to_num(_numbers(rows, "z"), posinf=0.0, neginf=0.0)
    cases = []
    for at in np.argsort(-np.abs(z), kind="stable")[:WORST].tolist():
        number, name = (rows.column(column)[at].as_py() for column in ("record", "name"))
        cases.append(_WorstCase(number, campaign.plan.record(number).group.label, name, float(z[at])))
    return tuple(case for case in cases if case.z)


def _failures(heads: list[Row]) -> tuple[_Failure, ...]:
    """The classes of failures, the most frequent first."""
    by_class = itemgetter("error_class")
    failed = sorted((head for head in heads if head["error_class"]), key=by_class)
    classes = [(name, list(members)) for name, members in groupby(failed, key=by_class)]
    failures = [_Failure(name, len(rows), rows[0]["record"], rows[0]["error"]) for name, rows in classes]
    return tuple(sorted(failures, key=lambda failure: -failure.records))


# --- page --------------------------------------------------------------------------------------------

_GROUPS = 60
"""Most groups whose tables are on the page; ``coefficients.csv`` has all."""


def campaign_page(collected: Collected) -> Page:
    """The page of a campaign."""
    judged = [result for result in collected.groups if _has_truth(result)]
    plain = [result for result in collected.groups if result.coefficients and not _has_truth(result)]
    seen = [result for result in collected.groups if result.seen]
    reports = sorted({name for result in seen for name in result.seen})
    reported = (
        TableOf(seen)
        .text("Group", lambda result: result.label)
        .number("Records", lambda result: str(result.records))
        .across(reports, str, lambda result, name: f"{100 * result.seen.get(name, 0.0):.1f}", lambda _: "%")
        .table(notes=("Share of the records with this noise in the result, or this term suggested.",))
    )
    again = f"piga campaign repeat {collected.campaign} --record N --out DIR writes the scenario of record N."
    worst = (
        TableOf(collected.worst)
        .text("Group", lambda w: w.group)
        .text("Coefficient", lambda w: w.coefficient)
        .number("Error", lambda w: signed(w.z, 1), "u")
        .number("Record", lambda w: str(w.record))
        .table("The largest errors over their standard uncertainties", (again,))
    )
    failures = (
        TableOf(collected.failures)
        .text("Class", lambda f: f.error_class)
        .number("Records", lambda f: str(f.records))
        .number("First record", lambda f: str(f.first))
        .text("First message", lambda f: f.message[:300])
        .table("A record that fails is a row; the campaign goes on.", (again,))
    )
    figure: list[Content] = [_LEAD, _coverage_figure(judged)] if judged else []
    sections: list[tuple[str, str, Sequence[Content]]] = [
        ("Judgement", "judgement", judgement(collected)),
        ("Intervals", "intervals", [*figure, *_tables(judged, _interval_table)]),
        ("Results", "results", _tables(plain, _plain_table)),
        ("What the calibrations report", "seen", [reported] if seen else []),
        ("Worst cases", "worst", [worst] if collected.worst else []),
        ("Records that failed", "failures", [failures] if collected.failures else []),
    ]
    return Page(
        title=collected.title,
        subtitle=f"{collected.computed} of {collected.records} records, from {collected.campaign}, seed {collected.seed}.",
        sections=tuple(Section(title, anchor, tuple(blocks)) for title, anchor, blocks in sections if blocks),
        kicker="piga · campaign",
        footer=f"Made by piga {collected.version}. {ALONE}",
    )


def _has_truth(result: GroupResult) -> bool:
    return any(c.coverage is not None for c in result.coefficients)


# --- judgement ---------------------------------------------------------------------------------------


def judgement(collected: Collected) -> list[Content]:
    """What is missing or failed, and every quantity that misses its target."""
    blocks: list[Content] = []
    if collected.missing:
        text = f"{len(collected.missing)} of {collected.shards} shards are not computed. Their records are missing."
        blocks.append(Notice("warning", text))
    if collected.failed:
        text = f"{collected.failed} of {collected.computed} records failed. They are not in the figures below."
        empty = [result.label for result in collected.groups if result.failed and not result.coefficients]
        text += f" Not one record could be computed of: {'; '.join(empty)}." if empty else ""
        blocks.append(Notice("problem" if empty else "warning", text))
    sure = [miss.label for miss in collected.misses if abs(miss.standard_errors) > SURE]
    perhaps = [miss.label for miss in collected.misses if abs(miss.standard_errors) <= SURE]
    targets = 2 * sum(c.coverage is not None for r in collected.groups for c in r.coefficients)
    if sure:
        blocks.append(Notice("warning", f"Off its target by more than chance explains: {'; '.join(sure)}."))
    if perhaps:
        text = f"Off its target by more than {CHANCE:g} standard errors: {'; '.join(perhaps)}. "
        text += f"Of {targets} targets about {max(1, round(targets / 20))} lie so far off by chance."
        blocks.append(Notice("warning" if len(perhaps) > 3 + targets / 10 else "good", text))
    if not blocks:
        blocks.append(Notice("good", "All records are computed, and every quantity meets its target."))
    return blocks


def _tone(c: CampaignCoefficient) -> Tone:
    """Bad if fewer intervals hold than chance explains, doubtful if more hold or the share is at the edge of chance."""
    if c.coverage_off < -SURE:
        return "bad"
    return "doubtful" if abs(c.coverage_off) > CHANCE else ""


# --- tables ------------------------------------------------------------------------------------------

_LEAD = (
    "Coverage is the share of 95 % intervals that hold the true value, with the binomial standard error of a share of 95 %. "
    f"It is marked where it is more than {CHANCE:g} standard errors away from 95 %. Bias is the mean error over the spread of the "
    "errors. NEES is the mean square of the errors over their standard uncertainties. The expected value of Student's t stands "
    "beside it."
)


def _tables(results: list[GroupResult], table: Callable[[GroupResult], Table]) -> list[Content]:
    blocks: list[Content] = [table(result) for result in results[:_GROUPS]]
    if len(results) > _GROUPS:
        blocks.append(Text(f"{len(results) - _GROUPS} more groups are in coefficients.csv."))
    return blocks


def _coefficients(result: GroupResult) -> TableOf[CampaignCoefficient]:
    return (
        TableOf(result.coefficients)
        .text("Quantity", lambda c: c.name)
        .text("Unit", _unit)
        .number("Tests", lambda c: str(c.tests))
    )


def _count(result: GroupResult) -> str:
    return f"{result.records} records, {sum(result.failed.values())} failed."


def _interval_table(result: GroupResult) -> Table:
    note = _count(result)
    if result.nees is not None:
        note += f" NEES of all coefficients together: {result.nees:.3f}; expected {result.nees_expected:.3f}."
    return (
        _coefficients(result)
        .number("Coverage", lambda c: Cell(_with_error(c), _tone(c)), "%")
        .number("Spread of errors", lambda c: _number(c, c.spread))
        .number("Mean error", lambda c: _number(c, c.bias))
        .number("Bias / sigma", lambda c: _or_dash(c.bias_over_sigma, lambda x: signed(x, 3)))
        .number("NEES (expected)", lambda c: _or_dash(c.nees, lambda x: f"{x:.2f} ({c.nees_expected:.2f})"))
        .number("Largest error", lambda c: _or_dash(c.largest_z, "{:.1f}".format), "u")
        .table(result.label, (note,))
    )


def _plain_table(result: GroupResult) -> Table:
    return (
        _coefficients(result)
        .number("Mean", lambda c: _number(c, c.mean))
        .number("Standard deviation", lambda c: _number(c, c.standard_deviation))
        .number("Lowest", lambda c: _number(c, c.lowest))
        .number("Highest", lambda c: _number(c, c.highest))
        .table(result.label, (_count(result),))
    )


def _or_dash(value: float | None, words: Callable[[float], str]) -> str:
    return "–" if value is None else words(value)


def _with_error(c: CampaignCoefficient) -> str:
    if c.coverage is None or c.coverage_std_error is None:
        return "–"
    return f"{100 * c.coverage:.1f} ± {100 * c.coverage_std_error:.1f}"


def _unit(c: CampaignCoefficient) -> str:
    return pretty_unit(shown_unit(c.name, c.unit)[1]) or "1"


def _number(c: CampaignCoefficient, value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    return short(value * shown_unit(c.name, c.unit)[0], 3)


# --- figures -----------------------------------------------------------------------------------------


def _coverage_figure(judged: list[GroupResult]) -> Figure:
    points = [(r, c) for r in judged for c in r.coefficients if c.coverage is not None]
    x = np.arange(1, len(points) + 1, dtype=float)
    share = np.array([100 * (c.coverage or 0.0) for _, c in points])
    error = np.array([100 * CHANCE * (c.coverage_std_error or 0.0) for _, c in points])
    off = np.array([_tone(c) != "" for _, c in points])
    text = np.array([f"{r.label}: {c.name}" for r, c in points])
    plot = Plot(
        "coverage", "Coverage of the 95 % intervals.", "coefficients in the order of the tables", "coverage [%]"
    )
    plot.level([0.5, len(points) + 0.5], 95.0, "95 %")
    kinds: tuple[tuple[str, Role], ...] = (("coefficients", "data"), ("off the target", "warning"))
    for chosen, (name, role) in zip((~off, off), kinds, strict=True):
        if chosen.any():
            names = tuple(text[chosen].tolist())
            plot.points(x[chosen], share[chosen], name, role, error=error[chosen], text=names)
    return plot.caption(
        f"One point for each coefficient of each group, with {CHANCE:g} standard errors. Good: the bars touch the line."
    )
