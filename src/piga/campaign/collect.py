"""Collect a campaign: read all parts as one Arrow dataset, in the order of the records, and judge them.

Sums are added record by record, in order. So the result does not depend on the shards, the workers and the
interruptions, to the bit. The memory does not grow with the number of records.
"""

from __future__ import annotations

import heapq
import math
import shlex
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.campaign.campaign_file import CampaignGroup, RecordName, Subject
from piga.campaign.manifest import Campaign
from piga.campaign.shard import KEY
from piga.errors import DataError, PigaError
from piga.results import finite

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CollectSettings:
    """Settings of the collection of a campaign (own choices)."""

    rows: int = 4096
    """Records that are read together."""
    worst: int = 12
    """Number of worst cases that are kept."""
    messages: int = 20
    """Most different failures that are kept with an example."""


COLLECT = CollectSettings()

EDGES = np.linspace(-5.0, 5.0, 41)
"""Edges of the histogram of errors over standard uncertainties; values beyond are counted in the outer bins."""


@dataclass
class Sums:
    """Running sums of one coefficient in one group. Everything is added in the order of the records.

    ``origin`` is the first value. Sums of values are taken about it, so that squares lose no digits.
    """

    unit: str
    origin: float = math.nan
    tests: int = 0
    known: int = 0
    held: int = 0
    bounded: int = 0
    judged: int = 0
    value: float = 0.0
    value2: float = 0.0
    lowest: float = math.inf
    highest: float = -math.inf
    u2: float = 0.0
    deviation: float = 0.0
    deviation2: float = 0.0
    z2: float = 0.0
    largest_z: float = 0.0
    expected: float = 0.0
    bound2: float = 0.0
    half: float = 0.0
    histogram: NDArray[np.int64] = field(default_factory=lambda: np.zeros(EDGES.size - 1, np.int64))

    def add(self, rows: dict[str, Array]) -> None:
        """Add rows of one coefficient, in order."""
        value = rows["value"]
        if not value.size:
            return
        if math.isnan(self.origin):
            self.origin = float(value[0])
        self.tests += value.size
        self.value = _sum(self.value, value - self.origin)
        self.value2 = _sum(self.value2, (value - self.origin) ** 2)
        self.lowest, self.highest = min(self.lowest, float(value.min())), max(self.highest, float(value.max()))
        self.u2 = _sum(self.u2, rows["u"] ** 2)
        self._judge({name: column[np.isfinite(rows["deviation"])] for name, column in rows.items()})
        bound = rows["bound"][np.isfinite(rows["bound"])]
        self.bounded += bound.size
        self.bound2 = _sum(self.bound2, bound**2)

    def _judge(self, rows: dict[str, Array]) -> None:
        """Rows with a known truth."""
        off, z = rows["deviation"], rows["z"]
        self.known += off.size
        self.held += int(np.count_nonzero(_held(rows)))
        self.deviation, self.deviation2 = _sum(self.deviation, off), _sum(self.deviation2, off**2)
        self.half = _sum(self.half, 0.5 * (rows["high"] - rows["low"]))
        finite = np.isfinite(z)
        z, degrees = z[finite], rows["degrees_of_freedom"][finite]
        self.judged += z.size
        self.z2 = _sum(self.z2, z**2)
        self.expected = _sum(self.expected, 1.0 / (1.0 - 2.0 / np.maximum(degrees, 3.0)))
        self.largest_z = max(self.largest_z, float(np.abs(z).max(initial=0.0)))
        self.histogram += np.histogram(np.clip(z, EDGES[0], EDGES[-1]), EDGES)[0]


def _held(rows: dict[str, Array]) -> NDArray[np.bool_]:
    """True where the interval of a coefficient holds its truth."""
    truth = rows["value"] - rows["deviation"]
    held: NDArray[np.bool_] = (rows["low"] <= truth) & (truth <= rows["high"])
    return held


def _sum(start: float, values: Array) -> float:
    """Add values one after the other: the result does not depend on the pieces."""
    return float(np.add.accumulate(np.concatenate([[start], values]))[-1])


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
    histogram: tuple[int, ...] = ()


@dataclass(frozen=True)
class GroupResult:
    """The results of one group: figures by coefficient, records that failed by class, NEES of all coefficients together.

    ``verdicts`` counts the results of the comparison with the stored calibrations of an archive.
    ``seen`` is the share of the records whose calibration reports a kind of noise, suggests a term, or has a doubt or a remark
    about the noise. ``missed`` counts the records in which an interval misses its truth, ``seen_where_missed`` is ``seen`` of
    these.
    """

    group: CampaignGroup
    records: int
    failed: dict[str, int]
    coefficients: tuple[CampaignCoefficient, ...]
    nees: float | None
    nees_expected: float | None
    verdicts: dict[str, int]
    seen: dict[str, float]
    missed: int
    seen_where_missed: dict[str, float]


@dataclass(frozen=True)
class WorstCase:
    """A coefficient of one record far from its truth: error over standard uncertainty, and the command that repeats it."""

    record: int
    case: int
    repeat: int
    group: str
    coefficient: str
    z: float
    command: str


@dataclass(frozen=True)
class Failure:
    """A class of failures: how many records, and the first of them."""

    error_class: str
    records: int
    first: int
    message: str
    command: str


@dataclass(frozen=True)
class Collected:
    """A whole campaign, judged."""

    title: str
    file: str
    version: str
    seed: int
    records: int
    computed: int
    shards: int
    missing: tuple[int, ...]
    set_aside: dict[int, str]
    groups: tuple[GroupResult, ...]
    worst: tuple[WorstCase, ...]
    failures: tuple[Failure, ...]

    @property
    def failed(self) -> int:
        """Records that failed."""
        return sum(failure.records for failure in self.failures)

    @property
    def complete(self) -> bool:
        """True if every shard has its part."""
        return not self.missing


class _Group:
    """Running sums of one group."""

    def __init__(self) -> None:
        self.records = 0
        self.failed: Counter[str] = Counter()
        self.verdicts: Counter[str] = Counter()
        self.seen: Counter[str] = Counter()
        self.missed = 0
        self.seen_where_missed: Counter[str] = Counter()
        self.sums: dict[str, Sums] = {}
        self.nees = self.expected = 0.0
        self.judged = 0


def collect(campaign: Campaign) -> Collected:
    """Read all parts and judge them.

    Raises
    ------
    PigaError
        If a part is damaged or belongs to another campaign, or if there are no parts.
    """
    from piga._version import __version__

    done = campaign.done()
    if not done and campaign.manifest.records:
        raise PigaError(f"{campaign.folder}: has no results yet", remedy="compute them with: piga campaign run")
    groups: dict[int, _Group] = {}
    worst: list[tuple[float, int, str, int]] = []
    failures: dict[str, tuple[int, str]] = {}
    failed: Counter[str] = Counter()
    for batch in _batches(campaign, done):
        _add_failures(batch, failed, failures)
        for index, rows in _by_group(campaign, batch):
            _add(groups.setdefault(index, _Group()), rows)
        _keep_worst(batch, worst)
    plan, manifest = campaign.plan, campaign.manifest
    named = campaign.set_aside()
    return Collected(
        title=plan.file.campaign.title or plan.path.stem,
        file=plan.path.name,
        version=manifest.software.get("piga", __version__),
        seed=plan.seed,
        records=manifest.records,
        computed=sum(group.records for group in groups.values()),
        shards=campaign.shards,
        missing=tuple(campaign.missing()),
        set_aside=named,
        groups=tuple(_result(plan.groups[index], sums) for index, sums in sorted(groups.items())),
        worst=tuple(
            WorstCase(one.number, one.case, one.repeat, one.group.label, name, z, repeat_command(campaign, one))
            for z, one, name in ((z, plan.record(number), name) for z, number, name in _ordered(worst))
        ),
        failures=tuple(
            Failure(name, count, *failures[name], repeat_command(campaign, plan.record(failures[name][0])))
            for name, count in sorted(failed.items(), key=lambda item: (-item[1], item[0]))
        ),
    )


def repeat_command(campaign: Campaign, record: RecordName) -> str:
    """The command that repeats one record."""
    if record.group.subject == "archive" and campaign.archive is not None:
        return f"piga calibrate {shlex.quote(campaign.archive.files[record.number].run)}"
    name = shlex.quote(campaign.plan.path.name)
    return f"piga campaign repeat {name} --case {record.case} --repeat {record.repeat} --out DIR"


# --- reading -----------------------------------------------------------------------------------------


def _batches(campaign: Campaign, done: list[int]) -> Iterator[pa.RecordBatch]:
    """The rows of all parts, in the order of the records."""
    import pyarrow as pa
    from pyarrow import dataset

    for shard in done:
        check_part(campaign, shard)
    paths = [str(campaign.part(shard)) for shard in done]
    parts = dataset.dataset(paths, format="parquet")
    scanner = parts.scanner(batch_size=COLLECT.rows, batch_readahead=2, fragment_readahead=1, use_threads=False)
    try:
        for batch in scanner.to_batches():
            if batch.num_rows:
                yield batch
    except (pa.ArrowException, OSError) as error:
        raise DataError(
            f"{campaign.folder / 'parts'}: a part cannot be read ({first_line(error)})",
            remedy="delete it, then run the campaign again: it is computed anew",
        ) from None


def check_part(campaign: Campaign, shard: int) -> None:
    """Refuse a part that is cut short, belongs to another campaign or holds other records.

    Raises
    ------
    DataError
        Naming the file.
    """
    import pyarrow as pa
    from pyarrow import parquet

    path = campaign.part(shard)
    remedy = "delete it, then run the campaign again: it is computed anew"
    try:
        metadata = parquet.read_metadata(path)
    except (pa.ArrowException, OSError) as error:
        raise DataError(f"{path}: is damaged ({first_line(error)})", remedy=remedy) from None
    if (metadata.metadata or {}).get(KEY) != campaign.key.encode():
        raise DataError(f"{path}: belongs to another campaign", remedy=remedy)
    if metadata.num_rows != len(campaign.records_of(shard)):
        raise DataError(
            f"{path}: holds {metadata.num_rows} records, not {len(campaign.records_of(shard))}", remedy=remedy
        )


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its class."""
    return str(error).splitlines()[0][:200] if str(error) else type(error).__name__


# --- adding ------------------------------------------------------------------------------------------


def _add_failures(batch: pa.RecordBatch, failed: Counter[str], failures: dict[str, tuple[int, str]]) -> None:
    """Count failures by class, and keep the first of each."""
    for name, text, number in zip(
        *(batch.column(c).to_pylist() for c in ("error_class", "error", "record")), strict=True
    ):
        if name is not None:
            failed[name] += 1
            failures.setdefault(name, (number, text or ""))


def _by_group(campaign: Campaign, batch: pa.RecordBatch) -> Iterator[tuple[int, pa.RecordBatch]]:
    """Slices of a batch that belong to one group; a group's records follow each other."""
    numbers = batch.column("record").to_numpy()
    starts = np.array([group.start for group in campaign.plan.groups])
    index = np.searchsorted(starts, numbers, side="right") - 1
    edges = np.flatnonzero(np.diff(index)) + 1
    for first, last in zip([0, *edges], [*edges, numbers.size], strict=True):
        yield int(index[first]), batch.slice(int(first), int(last - first))


_LISTS = ("value", "u", "low", "high", "degrees_of_freedom", "deviation", "z", "bound")


def _flat(
    batch: pa.RecordBatch,
) -> tuple[dict[str, Array], NDArray[np.str_], NDArray[np.str_], NDArray[np.int64]]:
    """Numbers, names, units and row of every coefficient of a batch, in order."""
    import pyarrow.compute as pc

    columns = {name: pc.list_flatten(batch.column(name)).to_numpy(zero_copy_only=False) for name in _LISTS}
    names = pc.list_flatten(batch.column("name")).to_numpy(zero_copy_only=False).astype(str)
    units = pc.list_flatten(batch.column("unit")).to_numpy(zero_copy_only=False).astype(str)
    rows = pc.list_parent_indices(batch.column("value")).to_numpy()
    return columns, names, units, rows


def _add(group: _Group, batch: pa.RecordBatch) -> None:
    group.records += batch.num_rows
    group.failed.update(name for name in batch.column("error_class").to_pylist() if name is not None)
    seen = [reported or () for reported in batch.column("seen").to_pylist()]
    for reported in seen:
        group.seen.update(reported)
    group.verdicts.update(name for name in batch.column("verdict").to_pylist() if name is not None)
    nees, expected = (
        batch.column(c).to_numpy(zero_copy_only=False).astype(float) for c in ("nees", "nees_expected")
    )
    judged = np.isfinite(nees)
    group.judged += int(np.count_nonzero(judged))
    group.nees, group.expected = _sum(group.nees, nees[judged]), _sum(group.expected, expected[judged])
    columns, names, units, rows = _flat(batch)
    for row in np.unique(rows[np.isfinite(columns["deviation"]) & ~_held(columns)]).tolist():
        group.missed += 1
        group.seen_where_missed.update(seen[row])
    for name in dict.fromkeys(names.tolist()):
        mine = names == name
        sums = group.sums.get(name)
        if sums is None:
            sums = group.sums[name] = Sums(str(units[mine][0]))
        sums.add({key: column[mine] for key, column in columns.items()})


def _keep_worst(batch: pa.RecordBatch, worst: list[tuple[float, int, str, int]]) -> None:
    """Keep the coefficients that are farthest from their truth. Of equal ones the first record is kept."""
    columns, names, _, rows = _flat(batch)
    size = np.nan_to_num(np.abs(columns["z"]), nan=0.0, posinf=0.0)
    numbers = batch.column("record").to_numpy()
    for at in np.argsort(-size, kind="stable")[: COLLECT.worst]:
        if size[at] == 0.0:
            break
        entry = (float(size[at]), -int(numbers[rows[at]]), str(names[at]), 1 if columns["z"][at] > 0 else -1)
        if len(worst) < COLLECT.worst:
            heapq.heappush(worst, entry)
        else:
            heapq.heappushpop(worst, entry)


def _ordered(worst: list[tuple[float, int, str, int]]) -> list[tuple[float, int, str]]:
    ordered = sorted(worst, key=lambda entry: (-entry[0], -entry[1], entry[2]))
    return [(size * sign, -number, name) for size, number, name, sign in ordered]


# --- results -----------------------------------------------------------------------------------------


def _result(group: CampaignGroup, sums: _Group) -> GroupResult:
    return GroupResult(
        group=group,
        records=sums.records,
        failed=dict(sorted(sums.failed.items())),
        coefficients=tuple(_coefficient(name, one, group.subject) for name, one in sums.sums.items()),
        nees=sums.nees / sums.judged if sums.judged else None,
        nees_expected=sums.expected / sums.judged if sums.judged else None,
        verdicts=dict(sorted(sums.verdicts.items())),
        seen={name: count / sums.records for name, count in sorted(sums.seen.items())},
        missed=sums.missed,
        seen_where_missed={n: count / sums.missed for n, count in sorted(sums.seen_where_missed.items())},
    )


def _coefficient(name: str, sums: Sums, subject: Subject) -> CampaignCoefficient:
    n, k = sums.tests, sums.known
    mean = sums.value / n
    std = math.sqrt(max(sums.value2 - n * mean**2, 0.0) / (n - 1)) if n > 1 else None
    plain = CampaignCoefficient(name, sums.unit, n, sums.origin + mean, std, sums.lowest, sums.highest)
    if not k:
        return plain
    bias = sums.deviation / k
    spread = math.sqrt(max(sums.deviation2 - k * bias**2, 0.0) / (k - 1)) if k > 1 else None
    bound2 = sums.bound2 / sums.bounded if sums.bounded else None
    share = sums.held / k
    truth = subject != "archive"
    return replace(
        plain,
        coverage=share if truth else None,
        coverage_std_error=_share_error(sums.held, k) if truth else None,
        bias=bias,
        bias_std_error=spread / math.sqrt(k) if spread is not None else None,
        bias_over_sigma=bias / spread if spread and truth else None,
        spread=spread,
        rms_u=math.sqrt(sums.u2 / n),
        half_width_over_sigma=sums.half / k / spread if spread and truth else None,
        variance_over_bound=spread**2 / bound2 if spread is not None and bound2 else None,
        nees=sums.z2 / sums.judged if sums.judged and truth else None,
        nees_expected=sums.expected / sums.judged if sums.judged and truth else None,
        largest_z=sums.largest_z,
        histogram=tuple(int(count) for count in sums.histogram),
    )


def _share_error(held: int, tests: int) -> float:
    """Standard error of a share. At 0 and 1 it is that of half a test, because that of the binomial would be 0."""
    share = min(max(held, 0.5), tests - 0.5) / tests
    return math.sqrt(share * (1.0 - share) / tests)


# --- documents ---------------------------------------------------------------------------------------

COLLECTED = "piga.campaign.collected/1"


def document(collected: Collected) -> dict[str, Any]:
    """The JSON document of ``piga campaign collect``."""
    return {
        "schema": COLLECTED,
        "title": collected.title,
        "campaign": collected.file,
        "version": collected.version,
        "seed": collected.seed,
        "records": collected.records,
        "computed": collected.computed,
        "failed": collected.failed,
        "complete": collected.complete,
        "set_aside": [{"shard": shard, "reason": text} for shard, text in sorted(collected.set_aside.items())],
        "groups": [_group_document(result) for result in collected.groups],
        "worst": msgspec.to_builtins(collected.worst),
        "failures": msgspec.to_builtins(collected.failures),
    }


def _group_document(result: GroupResult) -> dict[str, Any]:
    group = result.group
    entry: dict[str, Any] = {
        "name": group.name,
        "set": group.set,
        "subject": group.subject,
        "planned": group.records,
        "records": result.records,
        "failed": result.failed,
        "nees": finite(result.nees),
        "nees_expected": finite(result.nees_expected),
        "coefficients": [coefficient_document(c) for c in result.coefficients],
        "seen": result.seen,
        "missed": result.missed,
        "seen_where_missed": result.seen_where_missed,
    }
    if result.verdicts or group.subject == "archive":
        entry["compared_with_store"] = result.verdicts
    return entry


def coefficient_document(c: CampaignCoefficient) -> dict[str, Any]:
    """Figures of a coefficient as plain data; what is not known is None."""
    names = [name for name in CampaignCoefficient.__dataclass_fields__ if name != "histogram"]
    return {name: finite(getattr(c, name)) for name in names}


def write_table(collected: Collected, path: Path) -> None:
    """Write one row per group and coefficient as CSV."""
    import csv

    rows = [
        {"group": result.group.label} | coefficient_document(c)
        for result in collected.groups
        for c in result.coefficients
    ]
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]) if rows else ["group"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
