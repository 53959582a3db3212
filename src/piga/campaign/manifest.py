"""The folder of a campaign: manifest, parts, and shards that were set aside.

``manifest.json`` holds the campaign file, the scenario files, the length of a shard and the software. A shard is a
range of records, and ``parts/part-NNNNN.parquet`` is its result. A shard is done if its part exists. Nothing else
marks it. For an archive, ``archive.parquet`` lists the run files with size, time, SHA-256 and stored record.
"""

from __future__ import annotations

import glob
import hashlib
import json
import math
import os
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import msgspec

from piga.campaign.campaign_file import CampaignFile, CampaignPlan, plan_of, read_campaign
from piga.campaign.subjects import Archive, ArchiveFile, compute
from piga.errors import ArgumentError, PigaError, RunFileError
from piga.output import write_whole

SCHEMA = "piga.campaign/1"
MANIFEST, ARCHIVE, PARTS, ASIDE, LOCK = "manifest.json", "archive.parquet", "parts", "set-aside", "running.lock"


@dataclass(frozen=True)
class CutSettings:
    """How a campaign is cut into shards.

    A shard should last ``seconds``. ``fewest`` is the number of shards that a short campaign is cut into, so that several
    workers have work. ``probes`` is the number of records that are timed, for at most ``patience`` seconds.
    """

    seconds: float = 120.0
    fewest: int = 16
    probes: int = 12
    patience: float = 60.0


CUT = CutSettings()


class Manifest(msgspec.Struct, frozen=True):
    """What ``manifest.json`` holds. ``texts`` are the campaign file (name "") and the scenario files, by name."""

    schema: str
    campaign: str
    texts: dict[str, str]
    records: int
    records_per_shard: int
    software: dict[str, str]
    archive_sha256: str | None = None
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
        return math.ceil(self.manifest.records / self.manifest.records_per_shard)

    def records_of(self, shard: int) -> range:
        """Numbers of the records of a shard."""
        size = self.manifest.records_per_shard
        return range(shard * size, min((shard + 1) * size, self.manifest.records))

    def part(self, shard: int) -> Path:
        """The file of a shard's results."""
        return self.folder / PARTS / f"part-{shard:05d}.parquet"

    def aside(self, shard: int) -> Path:
        """The file that says why a shard was set aside."""
        return self.folder / ASIDE / f"shard-{shard:05d}.txt"

    def done(self) -> list[int]:
        """Shards with a part, in order."""
        there = {entry.name for entry in os.scandir(self.folder / PARTS)} if self._has(PARTS) else set()
        return [shard for shard in range(self.shards) if self.part(shard).name in there]

    def missing(self) -> list[int]:
        """Shards without a part, in order."""
        done = set(self.done())
        return [shard for shard in range(self.shards) if shard not in done]

    def set_aside(self) -> dict[int, str]:
        """Reason by shard that was set aside and still has no part."""
        names = sorted((self.folder / ASIDE).glob("shard-*.txt")) if self._has(ASIDE) else []
        reasons = {int(path.stem.partition("-")[2]): path.read_text(encoding="utf-8").strip() for path in names}
        missing = set(self.missing())
        return {shard: text for shard, text in reasons.items() if shard in missing}

    def _has(self, name: str) -> bool:
        return (self.folder / name).is_dir()

    @cached_property
    def key(self) -> str:
        """SHA-256 of everything that determines the numbers. Every part holds it."""
        return _key(self.manifest)

    @cached_property
    def archive(self) -> Archive | None:
        """The list of an archive's run files."""
        if self.plan.file.archive is None:
            return None
        from pyarrow import parquet

        table = parquet.read_table(self.folder / ARCHIVE)
        store = self.plan.file.archive.store
        return Archive(
            self.plan.path.parent,
            tuple(ArchiveFile(**row) for row in table.select(list(ArchiveFile._fields)).to_pylist()),
            None if store is None else where_is(self.plan.path.parent, store),
        )


def where_is(folder: Path, store: str) -> str:
    """A store as given: a URL, or a file relative to the campaign file."""
    return store if "://" in store else str(folder / store)


def _key(manifest: Manifest) -> str:
    """Digest of the manifest without the cut, the times and the place."""
    chosen = [sorted(manifest.texts.items()), manifest.records, manifest.archive_sha256, manifest.software]
    return hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()


def software() -> dict[str, str]:
    """Software that determines the numbers: version of piga, digest of its numeric source, versions of libraries."""
    from piga.ledger.reproduce import NUMERIC_ROOMS, software_identity, source_digest

    names = ("piga", "numpy", "scipy", "numba", "compiled")
    known = {name: text for name, text in software_identity().items() if name in names}
    return known | {"source_sha256": source_digest((*NUMERIC_ROOMS, "platform", "campaign"))}


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
        manifest = msgspec.json.decode(path.read_bytes(), type=Manifest)
    except FileNotFoundError:
        raise PigaError(
            f"{folder}: holds no campaign", remedy="plan one: piga campaign plan CAMPAIGN.toml --out DIR"
        ) from None
    except OSError as error:
        raise PigaError(
            f"{path}: cannot be read ({error.strerror or error})", remedy="check that you may read this folder"
        ) from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise PigaError(
            f"{path}: is damaged ({error})", remedy="delete it, then plan the campaign again; its parts stay"
        ) from None
    if manifest.schema != SCHEMA:
        raise PigaError(f"{path}: schema '{manifest.schema}' is not known", remedy=f"this piga reads {SCHEMA}")
    texts = {name: text.encode() for name, text in manifest.texts.items()}
    return Campaign(folder, manifest, plan_of(Path(manifest.campaign), texts, manifest.records))


def plan_campaign(path: str | Path, folder: str | Path) -> Campaign:
    """Plan a campaign in a folder, or open it if it is planned there already.

    Raises
    ------
    PigaError
        If the campaign file is not valid, or the folder holds another campaign or results of another version.
    """
    path, folder = Path(os.path.abspath(path)), Path(folder)  # noqa: PTH100 - symbolic links stay as they are named
    plan = read_campaign(path)
    files: list[ArchiveFile] = []
    digest = None
    if plan.file.archive is not None:
        files = _listed(path, plan.file)
        told = [(one.run, one.size, one.sha256, one.stored) for one in files]
        digest = hashlib.sha256(json.dumps(told).encode()).hexdigest()
        plan = plan_of(path, plan.texts, len(files))
    texts = {name: raw.decode("utf-8") for name, raw in plan.texts.items()}
    wanted = Manifest(SCHEMA, str(path), texts, plan.records, 1, software(), digest)
    if (folder / MANIFEST).exists():
        return _known(open_campaign(folder), wanted)
    if folder.exists() and not folder.is_dir():
        raise ArgumentError(f"--out {folder}: is a file", remedy="name a folder")
    try:
        (folder / PARTS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PigaError(
            f"--out {folder}: cannot be written ({error.strerror or error})",
            remedy="name a folder you may write to, with room",
        ) from None
    if files:
        _write_archive(files, folder / ARCHIVE)
    campaign = Campaign(folder, wanted, plan)
    size = plan.file.campaign.records_per_shard
    seconds = None
    if size is None:
        seconds = seconds_per_record(campaign)
        size = shard_size(plan.records, seconds)
    manifest = msgspec.structs.replace(wanted, records_per_shard=size, seconds_per_record=seconds)
    document = msgspec.json.format(msgspec.json.encode(manifest), indent=1)
    write_whole(folder / MANIFEST, lambda part: part.write_bytes(document))
    return open_campaign(folder)


def _known(campaign: Campaign, wanted: Manifest) -> Campaign:
    """The campaign that a folder holds, if it is the one that is wanted."""
    has, folder = campaign.manifest, campaign.folder
    if (has.texts, has.records, has.archive_sha256) != (wanted.texts, wanted.records, wanted.archive_sha256):
        raise PigaError(
            f"{folder}: holds another campaign, or its files changed since it was planned",
            remedy="choose another --out",
        )
    if has.software != wanted.software:
        changed = ", ".join(
            f"{name} {has.software.get(name, '')[:12]} then, {text[:12]} now"
            for name, text in wanted.software.items()
            if has.software.get(name) != text
        )
        raise PigaError(
            f"{folder}: was begun with other software ({changed}); records of different software must not "
            "be mixed",
            remedy="choose another --out, or continue with the earlier software",
        )
    return campaign


# --- cutting -----------------------------------------------------------------------------------------


def probes(plan: CampaignPlan) -> list[int]:
    """Numbers of the records that represent all others: the last of each group, or an even selection of these.

    The last repeats have no bound of Cramer and Rao. That bound takes far longer than the record itself.
    """
    ends = [group.start + group.records - 1 for group in plan.groups if group.records]
    if len(plan.groups) == 1:
        first = min(plan.groups[0].bounds, plan.records - 1)
        step = (plan.records - 1 - first) / (CUT.probes - 1)
        ends = [first + round(k * step) for k in range(CUT.probes)]
    elif len(ends) > CUT.probes:
        ends = [ends[round(k * (len(ends) - 1) / (CUT.probes - 1))] for k in range(CUT.probes)]
    return sorted(set(ends))


def compile_kernels(campaign: Campaign) -> None:
    """Compute one record, so that the kernels are compiled before the workers start. The workers then load them."""
    if campaign.plan.records:
        _try(campaign, 0)


def _try(campaign: Campaign, number: int) -> None:
    with suppress(Exception):  # the record will be a row with the reason
        compute(campaign.plan, campaign.plan.record(number), campaign.archive)


def seconds_per_record(campaign: Campaign) -> float:
    """Processor time of a record [s], the mean of several; kernels are compiled before."""
    numbers = probes(campaign.plan)
    if not numbers:
        return 1.0
    began = time.monotonic()
    spent: list[float] = []
    for number in numbers:
        _try(campaign, number)
        start = time.process_time()
        _try(campaign, number)
        spent.append(time.process_time() - start)
        if time.monotonic() - began > CUT.patience:
            break
    return max(sum(spent) / len(spent), 1e-6)


def shard_size(records: int, seconds: float) -> int:
    """Records of a shard: 1, 2 or 5 times a power of ten, for shards of ``CUT.seconds``, and at least ``CUT.fewest`` shards."""
    wanted = min(CUT.seconds / seconds, max(1.0, records / CUT.fewest))
    if wanted <= 1.0:
        return 1
    power = 10 ** math.floor(math.log10(wanted))
    return next(step * power for step in (5, 2, 1) if step * power <= wanted)


# --- archive -----------------------------------------------------------------------------------------


def _listed(path: Path, file: CampaignFile) -> list[ArchiveFile]:
    """Run files of an archive in the order of their names, with the stored record of each."""
    table = file.archive
    if table is None:
        return []
    patterns = (table.runs,) if isinstance(table.runs, str) else table.runs
    names = sorted({name for pattern in patterns for name in _matching(path.parent, pattern)})
    if not names:
        raise RunFileError(
            f"{path}: [archive] runs: no file matches {', '.join(patterns)}",
            remedy="patterns are relative to the campaign file, e.g. '2024/**/*.toml'",
        )
    stored = {} if table.store is None else _stored(where_is(path.parent, table.store))
    return [_facts(path.parent / name, name, stored) for name in names]


def _matching(folder: Path, pattern: str) -> Iterator[str]:
    for name in glob.iglob(pattern, root_dir=folder, recursive=True):  # noqa: PTH207 - many names, no objects
        if (folder / name).is_file():
            yield name.replace(os.sep, "/")


def _facts(path: Path, name: str, stored: dict[str, str]) -> ArchiveFile:
    """A run file. Its SHA-256 is empty if it cannot be read; its record then holds the reason."""
    status, digest = path.stat(), ""
    with suppress(OSError):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return ArchiveFile(name, status.st_size, status.st_mtime_ns, digest, stored.get(digest))


def _stored(where: str) -> dict[str, str]:
    """Name of the last record of a store by SHA-256 of its run file."""
    from piga.ledger.store import open_store

    with open_store(where) as store:
        records = [(record.file("run"), record.id) for record in store.each()]
    return {file.sha256: name for file, name in records if file is not None}


def _write_archive(files: list[ArchiveFile], path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    types = (pa.string(), pa.int64(), pa.int64(), pa.string(), pa.string())
    schema = pa.schema(zip(ArchiveFile._fields, types, strict=True))
    table = pa.Table.from_pylist([file._asdict() for file in files], schema)
    write_whole(path, lambda part: parquet.write_table(table, part, compression="zstd"))
