"""The folder of a campaign: the manifest, and one part (Parquet) for each shard.

``manifest.json`` holds the campaign file, the scenario files, the length of a shard and the software. A shard is a range of
records. ``parts/part-NNNNN-DIGEST.parquet`` is its result. The digest is the SHA-256 of campaign, shard number and bytes, so
a part that was altered, copied or renamed is refused. A shard is done if its part exists. Nothing else marks it.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from piga.campaign.campaign_file import CampaignPlan, Count, plan_of, read_campaign
from piga.campaign.subjects import compute
from piga.errors import DataError, PigaError
from piga.output import write_whole
from piga.records.text_files import converted

if TYPE_CHECKING:
    import pyarrow as pa

SCHEMA = "piga.campaign/2"
MANIFEST, _PARTS, LOCK = "manifest.json", "parts", "running.lock"
_PART = re.compile(r"part-(\d{5,})-[0-9a-f]{32}\.parquet")


_SECONDS, _FEWEST = 120.0, 16
"""How long a shard should last [s], and the shards of a short campaign, so that several workers have work."""


class Manifest(msgspec.Struct, frozen=True):
    """What ``manifest.json`` holds. ``texts`` are the campaign file (name "") and the scenario files, by name."""

    schema: str
    campaign: str
    texts: dict[str, str]
    records_per_shard: Count
    software: dict[str, str]
    seconds_per_record: float | None = None


@dataclass(frozen=True)
class Campaign:
    """A planned campaign in its folder."""

    folder: Path
    manifest: Manifest
    plan: CampaignPlan

    @property
    def shards(self) -> int:
        """Number of shards."""
        return math.ceil(self.plan.records / self.manifest.records_per_shard)

    def records_of(self, shard: int) -> range:
        """Numbers of the records of a shard."""
        size = self.manifest.records_per_shard
        return range(shard * size, min((shard + 1) * size, self.plan.records))

    def parts(self) -> dict[int, Path]:
        """The part of each shard that is done, in the order of the shards."""
        paths = sorted((self.folder / _PARTS).glob("part-*.parquet"))
        named = [(match, path) for path in paths if (match := _PART.fullmatch(path.name))]
        parts = {int(match[1]): path for match, path in reversed(named) if int(match[1]) < self.shards}
        return dict(sorted(parts.items()))

    def missing(self) -> list[int]:
        """Shards without a part, in order."""
        done = self.parts()
        return [shard for shard in range(self.shards) if shard not in done]

    @cached_property
    def key(self) -> str:
        """SHA-256 of everything that determines the numbers and the shards."""
        m = self.manifest
        chosen = [sorted(m.texts.items()), self.plan.records, m.records_per_shard, m.software]
        return hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()

    def part_name(self, shard: int, content: bytes) -> str:
        """Name of the part with this content."""
        digest = hashlib.sha256(f"{self.key} {shard} ".encode() + content).hexdigest()[:32]
        return f"part-{shard:05d}-{digest}.parquet"


# --- planning ----------------------------------------------------------------------------------------


def software() -> dict[str, str]:
    """Software that determines the numbers: version of piga, digest of its numeric source, versions of libraries."""
    from piga.ledger.evidence import NUMERIC_ROOMS, software_identity, source_digest

    names = ("piga", "numpy", "scipy", "numba", "compiled")
    versions = {name: text for name, text in software_identity().items() if name in names}
    return versions | {"source_sha256": source_digest((*NUMERIC_ROOMS, "platform", "campaign"))}


def open_campaign(folder: str | Path) -> Campaign:
    """Open the folder of a planned campaign.

    Raises
    ------
    PigaError
        If it holds no campaign, or its manifest cannot be read.
    """
    folder = Path(folder)
    path = folder / MANIFEST
    try:
        manifest = converted(msgspec.json.decode(path.read_bytes()), Manifest)
    except (FileNotFoundError, NotADirectoryError):
        raise PigaError(
            f"{folder}: holds no campaign", remedy="plan one: piga campaign plan CAMPAIGN.toml --out DIR"
        ) from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise _damaged(path, str(error)) from None
    if manifest.schema != SCHEMA:
        raise PigaError(
            f"{path}: schema '{manifest.schema}' is not known",
            remedy=f"this piga reads {SCHEMA}: plan the campaign again in another folder",
        )
    try:
        plan = plan_of(Path(manifest.campaign), {name: text.encode() for name, text in manifest.texts.items()})
    except KeyError as error:
        raise _damaged(path, f"it lacks the file {error}") from None
    return Campaign(folder, manifest, plan)


def _damaged(path: Path, why: str) -> PigaError:
    remedy = "delete it, then plan the campaign again; its parts stay"
    return PigaError(f"{path}: is damaged ({why})", remedy=remedy)


def plan_campaign(path: str | Path, folder: str | Path) -> Campaign:
    """Plan a campaign in a folder, or open it if it is planned there already.

    Raises
    ------
    PigaError
        If the campaign file is not valid, or the folder holds another campaign or results of another version.
    """
    path, folder = Path(os.path.abspath(path)), Path(folder)  # noqa: PTH100 - symbolic links stay as they are named
    plan = read_campaign(path)
    texts = {name: raw.decode("utf-8") for name, raw in plan.texts.items()}
    wanted = Manifest(SCHEMA, str(path), texts, 1, software())
    if (folder / MANIFEST).exists():
        return _same(open_campaign(folder), wanted)
    (folder / _PARTS).mkdir(parents=True, exist_ok=True)
    size, seconds = plan.file.campaign.records_per_shard, None
    if size is None:
        seconds = seconds_per_record(plan)
        size = shard_size(plan.records, seconds)
    manifest = msgspec.structs.replace(wanted, records_per_shard=size, seconds_per_record=seconds)
    document = msgspec.json.format(msgspec.json.encode(manifest), indent=1)
    write_whole(folder / MANIFEST, lambda part: part.write_bytes(document))
    return open_campaign(folder)


def _same(campaign: Campaign, wanted: Manifest) -> Campaign:
    has, folder = campaign.manifest, campaign.folder
    if has.texts != wanted.texts:
        raise PigaError(
            f"{folder}: holds another campaign, or its files changed since it was planned",
            remedy="choose another --out",
        )
    changed = _changed(has)
    if changed:
        raise PigaError(
            f"{folder}: was begun with other software ({changed}); records of different software must not "
            "be mixed",
            remedy="choose another --out, or continue with the earlier software",
        )
    return campaign


def _changed(manifest: Manifest) -> str:
    """The software that is another now, in words."""
    pairs = [(name, manifest.software.get(name, ""), text) for name, text in software().items()]
    return ", ".join(f"{name} {old[:12]} then, {new[:12]} now" for name, old, new in pairs if old != new)


def compile_kernels(plan: CampaignPlan, number: int = 0) -> None:
    """Compute one record, so that the kernels are compiled before the workers start. The workers then load them."""
    with suppress(Exception):  # the record will be a row with the reason
        compute(plan, plan.record(number))


def seconds_per_record(plan: CampaignPlan) -> float:
    """Processor time of a record [s]: the mean of the last ones of the first and the last group; kernels are compiled before.

    The last repeats have no bound of Cramer and Rao. That bound takes far longer than the record itself.
    """
    spent = []
    for group in (plan.groups[0], plan.groups[-1]):
        last = group.start + group.records - 1
        compile_kernels(plan, last)
        start = time.process_time()
        compile_kernels(plan, last)
        spent.append(time.process_time() - start)
    return max(sum(spent) / len(spent), 1e-6)


def shard_size(records: int, seconds: float) -> int:
    """Records of a shard: 1, 2 or 5 times a power of ten, for shards of ``_SECONDS``, and at least ``_FEWEST`` shards."""
    wanted = min(_SECONDS / seconds, max(1.0, records / _FEWEST))
    if wanted <= 1.0:
        return 1
    power = 10 ** math.floor(math.log10(wanted))
    return next(step * power for step in (5, 2, 1) if step * power <= wanted)


# --- computing a shard: the task of a worker ---------------------------------------------------------


def run_shard(folder: str, shard: int) -> tuple[int, int, float]:
    """Compute a shard and write its part: records, failed records, processor time [s]. A part that is there stays."""
    campaign = _opened(folder)
    if shard in campaign.parts():
        return 0, 0, 0.0
    began = time.process_time()
    numbers = campaign.records_of(shard)
    rows = [row for number in numbers for row in _rows(campaign, number)]
    _write_part(campaign, shard, rows)
    return len(numbers), sum(bool(row.get("error_class")) for row in rows), time.process_time() - began


def _opened(folder: str) -> Campaign:
    """The campaign; refused if this worker has other software."""
    host = socket.gethostname()
    try:
        campaign = open_campaign(folder)
    except PigaError as error:
        raise PigaError(
            f"worker {host}: {error.message}",
            remedy="every worker needs the folder of the campaign at the same path: use a shared disk",
        ) from None
    changed = _changed(campaign.manifest)
    if changed:
        raise PigaError(
            f"worker {host}: has other software than the campaign ({changed})",
            remedy="install the same version of piga and its packages on every machine",
        )
    return campaign


def _rows(campaign: Campaign, number: int) -> list[dict[str, Any]]:
    """The rows of a record: one of the record itself (no name), then one for each coefficient.

    A record that fails is one row with its reason.
    """
    record = campaign.plan.record(number)
    place = {"record": number, "case": record.case, "repeat": record.repeat, "name": None}
    head: dict[str, Any] = place | {"error_class": None, "error": None}
    rows: list[dict[str, Any]] = []
    began = time.process_time()
    try:
        outcome = compute(campaign.plan, record)
    except Exception as error:
        head["error_class"], head["error"] = type(error).__name__, (str(error) or repr(error))[:2000]
    else:
        head |= {name: getattr(outcome, name) for name in ("nees", "nees_expected", "notes", "seen")}
        rows = [place | row for row in outcome.rows()]
    head["seconds"] = time.process_time() - began
    return [head, *rows]


def _part_schema() -> pa.Schema:
    """Columns of a part. Rows without a name are records, the others their coefficients."""
    import pyarrow as pa

    whole, number, text, texts = pa.int64(), pa.float64(), pa.string(), pa.list_(pa.string())
    types = {
        "record": whole, "case": whole, "repeat": whole, "name": text, "unit": text, "value": number, "u": number,
        "low": number, "high": number, "degrees_of_freedom": number, "truth": number, "deviation": number, "z": number,
        "bound": number, "error_class": text, "error": text, "nees": number, "nees_expected": number, "notes": texts,
        "seen": texts, "seconds": number,
    }  # fmt: skip
    return pa.schema(list(types.items()))


def _write_part(campaign: Campaign, shard: int, rows: list[dict[str, Any]]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    schema = _part_schema()
    columns = [pa.array([row.get(f.name) for row in rows], f.type, from_pandas=True) for f in schema]
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.Table.from_arrays(columns, schema=schema), sink, compression="zstd")
    content = sink.getvalue().to_pybytes()
    write_whole(
        campaign.folder / _PARTS / campaign.part_name(shard, content),
        lambda part: part.write_bytes(content),
        remedy="make room on the disk, then run the campaign again: it goes on where it stopped",
    )


def read_part(campaign: Campaign, shard: int, path: Path) -> pa.Table:
    """The rows of a part, as they were written."""
    import pyarrow as pa
    from pyarrow import parquet

    content = path.read_bytes()
    if path.name != campaign.part_name(shard, content):
        raise DataError(
            f"{path}: is damaged, or belongs to another campaign or shard",
            remedy="delete it, then run the campaign again: it is computed anew",
        )
    # read_table scans in threads that outlive the call; one that lets go of `content` while Python ends aborts the process
    with parquet.ParquetFile(pa.BufferReader(content), pre_buffer=False) as source:
        return source.read(use_threads=False)
