"""A campaign on disk and on its way: the manifest, records, a part (Parquet) for each shard, and the run on Dask.

``manifest.json`` holds the campaign file, the scenario files, the length of a shard and the software. A shard is a range of
records. ``parts/part-NNNNN-DIGEST.parquet`` is its result. The digest is the SHA-256 of campaign, shard number and bytes, so
a part that was altered, copied or renamed is refused. A shard is done if its part exists. Nothing else marks it: any process
may be killed at any time, and the next run computes the shards without a part.

A Dask worker runs whatever code it is sent, and an open port of this machine can be reached by all of its users. So the
local cluster has TLS with temporary credentials, and a cluster on another machine must have TLS.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import queue
import re
import signal
import socket
import tempfile
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import urlsplit

import msgspec
import numpy as np

from piga.campaign.campaign_file import CampaignPlan, Count, RecordName, plan_of, read_campaign
from piga.errors import ArgumentError, DataError, PigaError, PigaWarning, needed
from piga.output import write_whole
from piga.progress import Progress
from piga.progress import report as report_progress
from piga.records.calibration.coefficient import changes
from piga.records.calibration.diagnostics import SCATTER
from piga.results import Array
from piga.stand.scenario import Scenario, run_scenario
from piga.text_files import converted, first_line, toml_text

if TYPE_CHECKING:
    import pyarrow as pa

    from piga.platform.scenario import PlatformScenario
    from piga.records import Calibration

MANIFEST, _PARTS = "manifest.json", "parts"
_PART = re.compile(r"part-(\d{5,})-[0-9a-f]{32}\.parquet")
_SHARDS = 500
"""Most shards, unless the campaign file has ``records_per_shard``: a killed run loses little, and workers have work."""


class Manifest(msgspec.Struct, frozen=True):
    """What ``manifest.json`` holds. ``texts`` are the campaign file (name "") and the scenario files, by name."""

    schema: Literal["piga.campaign/2"]
    campaign: str
    texts: dict[str, str]
    records_per_shard: Count
    software: dict[str, str]


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
        paths = sorted((self.folder / _PARTS).glob("part-*.parquet"), reverse=True)
        parts = {int(match[1]): path for path in paths if (match := _PART.fullmatch(path.name))}
        return {shard: parts[shard] for shard in sorted(parts) if shard < self.shards}

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
        texts = {name: text.encode() for name, text in manifest.texts.items()}
        return Campaign(folder, manifest, plan_of(Path(manifest.campaign), texts))
    except (FileNotFoundError, NotADirectoryError):
        raise PigaError(
            f"{folder}: holds no campaign", remedy="plan one: piga campaign plan CAMPAIGN.toml --out DIR"
        ) from None
    except (msgspec.MsgspecError, UnicodeDecodeError, KeyError) as error:
        raise PigaError(
            f"{path}: is damaged, or from another version of piga ({error})",
            remedy="plan the campaign again in another folder",
        ) from None


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
    if not (folder / MANIFEST).exists():
        (folder / _PARTS).mkdir(parents=True, exist_ok=True)
        size = plan.file.campaign.records_per_shard or math.ceil(plan.records / _SHARDS)
        manifest = msgspec.json.encode(Manifest("piga.campaign/2", str(path), texts, size, software()))
        write_whole(folder / MANIFEST, lambda part: part.write_bytes(msgspec.json.format(manifest, indent=1)))
    campaign = open_campaign(folder)
    if campaign.manifest.texts != texts:
        raise PigaError(
            f"{folder}: holds another campaign, or its files changed since it was planned",
            remedy="choose another --out",
        )
    _check_software(campaign)
    return campaign


def _check_software(campaign: Campaign) -> None:
    """Refuse a campaign that was begun with other software."""
    pairs = [(name, campaign.manifest.software.get(name, ""), text) for name, text in software().items()]
    changed = ", ".join(f"{name} {old[:12]} then, {new[:12]} now" for name, old, new in pairs if old != new)
    if changed:
        raise PigaError(
            f"{campaign.folder}: was begun with other software ({changed}); records of different software must not "
            "be mixed",
            remedy="choose another --out, or continue with the earlier software",
        )


# --- one record --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """Numbers of one record: ``rows`` has one for each coefficient or quantity, in the units of calibration.json.

    ``low`` and ``high`` are the ends of the 95 % interval. ``deviation`` is value minus ``truth``; for a phase it is taken to
    the nearest turn. ``z`` is that over ``u``. Unknown values are nan; a quantity without truth has ``name``, ``unit`` and
    ``value`` alone. ``nees`` is the mean square of all errors in their covariance, ``nees_expected`` its expected value for
    Student's t. ``seen`` names what the calibration reports: kinds of noise, terms it suggests, and a doubt about the noise.
    """

    rows: list[dict[str, Any]]
    nees: float = math.nan
    nees_expected: float = math.nan
    seen: tuple[str, ...] = ()


def compute(plan: CampaignPlan, record: RecordName) -> Outcome:
    """Compute a record."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PigaWarning)
        scenario, seed = plan.scenario(record), plan.seed_of(record)
        return _simulated(scenario, seed) if isinstance(scenario, Scenario) else _platform_run(scenario, seed)


def scenario_text(plan: CampaignPlan, record: RecordName) -> str:
    """The scenario file of a record: that of the campaign with the values and the seed of the record."""
    document = plan.document(record)
    return toml_text(document | {"run": document.get("run", {}) | {"seed": plan.seed_of(record)}})


def of_calibration(calibration: Calibration, truth: Array) -> Outcome:
    """The outcome of a calibration with its truth (nan where it is not known)."""
    coefficients = calibration.coefficients
    u = np.array([c.std for c in coefficients])
    error = changes(coefficients, truth, np.array([c.value for c in coefficients]))
    nees = expected = math.nan
    if np.isfinite(error).all() and error.size:
        nees = float(error @ np.linalg.solve(calibration.covariance, error)) / error.size
        degrees = np.array([c.degrees_of_freedom or math.inf for c in coefficients])
        expected = float(np.mean(1.0 / (1.0 - 2.0 / np.maximum(degrees, 3.0))))
    names = ("name", "unit", "value", "u", "low", "high", "degrees_of_freedom", "truth", "deviation", "z")
    with np.errstate(all="ignore"):
        numbers = zip(truth.tolist(), error.tolist(), (error / u).tolist(), strict=True)
    rows = []
    for c, judged in zip(coefficients, numbers, strict=True):
        values = (c.key, c.unit, c.value, c.std, *c.limits, c.degrees_of_freedom or math.inf, *judged)
        rows.append(dict(zip(names, values, strict=True)))
    return Outcome(rows, nees, expected, _seen(calibration))


def _seen(calibration: Calibration) -> tuple[str, ...]:
    """What a calibration reports of noise and of missing terms."""
    scatters = calibration.diagnostics.worst_scatter > SCATTER
    noise = {
        "random walk": calibration.angle_random_walk > 0.0,
        "scatter of the segments": calibration.segment_scatter > 0.0,
        "doubt about the noise": scatters or any(doubt.noise for doubt in calibration.verdict.doubts),
    }
    missing = calibration.diagnostics.missing_terms
    suggested = dict.fromkeys(f"suggested: {' '.join(entry.terms)}" for entry in missing)
    return (*(name for name, there in noise.items() if there), *suggested)


def _simulated(scenario: Scenario, seed: int) -> Outcome:
    """Simulate, write the files of a lab, read them and calibrate, as a user does."""
    from piga.calibration.calibrate import calibrate
    from piga.stand import read_run
    from piga.stand.write_run import coefficients, run_file_text, write_data

    test = run_scenario(scenario, seed=seed)
    with tempfile.TemporaryDirectory(prefix="piga-campaign-") as folder:
        run, data = Path(folder, "run.toml"), f"run.{scenario.table.run.format}"
        write_data(test, Path(folder, data))
        run.write_text(run_file_text(scenario, test, data), encoding="utf-8", newline="\n")
        calibration = calibrate(read_run(run))
    known = {(value.name, value.segment): value.value for value in coefficients(test)}
    truth = []
    for c in calibration.coefficients:  # a term that the simulation lacks has the truth 0
        shared = known.get((c.name, None), math.nan if c.name == "phi" else 0.0)
        truth.append(known.get((c.name, c.segment), shared))
    return of_calibration(calibration, np.array(truth))


def _platform_run(scenario: PlatformScenario, seed: int) -> Outcome:
    from piga.platform.chain import compare, last_east_lines

    labels = ("east_velocity_line", "east_velocity_equatorial_line")
    rows: list[tuple[str, str, float]] = []
    for model, run in compare(replace(scenario, seed=seed)).models.items():
        rows.append((f"position_error[{model}]", "m", float(run.lines.position.max())))
        values = zip(labels, last_east_lines(run.lines), strict=False)
        rows += [(f"{label}[{model}]", "m/s", value) for label, value in values]
    return Outcome([dict(zip(("name", "unit", "value"), row, strict=True)) for row in rows])


# --- computing a shard: the task of a worker ---------------------------------------------------------


def run_shard(folder: str, shard: int) -> tuple[int, int, float]:
    """Compute a shard and write its part: records, failed records, processor time [s]. A part that is there stays."""
    try:
        campaign = open_campaign(folder)
        _check_software(campaign)
    except PigaError as error:
        raise PigaError(
            f"worker {socket.gethostname()}: {error.message}",
            remedy="every worker needs the folder at the same path (a shared disk), and the same version of piga and its "
            "packages",
        ) from None
    if shard in campaign.parts():
        return 0, 0, 0.0
    began = time.process_time()
    numbers = campaign.records_of(shard)
    rows = [row for number in numbers for row in _rows(campaign, number)]
    _write_part(campaign, shard, rows)
    return len(numbers), sum(bool(row.get("error_class")) for row in rows), time.process_time() - began


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
        head |= {name: getattr(outcome, name) for name in ("nees", "nees_expected", "seen")}
        rows = [place | row for row in outcome.rows]
    head["seconds"] = time.process_time() - began
    return [head, *rows]


def _write_part(campaign: Campaign, shard: int, rows: list[dict[str, Any]]) -> None:
    """Write a part. Rows without a name are records, the others their coefficients."""
    import pyarrow as pa
    from pyarrow import parquet

    whole, number, text = pa.int64(), pa.float64(), pa.string()
    types = {
        "record": whole, "case": whole, "repeat": whole, "name": text, "unit": text, "value": number, "u": number,
        "low": number, "high": number, "degrees_of_freedom": number, "truth": number, "deviation": number, "z": number,
        "error_class": text, "error": text, "nees": number, "nees_expected": number, "seen": pa.list_(text),
        "seconds": number,
    }  # fmt: skip
    sink = pa.BufferOutputStream()
    table = pa.Table.from_pylist(rows, schema=pa.schema(list(types.items())))
    parquet.write_table(table, sink, compression="zstd")
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


# --- running -----------------------------------------------------------------------------------------

_POLL = 0.5
"""Time between two reports of the progress [s]."""
_CONNECT = 20.0
"""Longest time to wait for the scheduler and its first worker [s]."""
_THREADS = ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "VECLIB_MAXIMUM", "NUMBA_NUM")
_ONE_THREAD = {f"{name}_THREADS": "1" for name in _THREADS}
"""Variables that give a worker of this machine one thread, in kernels and in linear algebra."""
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_AGAIN = "give the same command: parts that are written stay"


@dataclass
class RunReport:
    """Result of a run: shards in all and done, and shards whose worker died again and again.

    ``records``, ``failed`` and ``seconds`` (of processor time) are those of this run.
    """

    shards: int
    done: int = 0
    records: int = 0
    failed: int = 0
    seconds: float = 0.0
    set_aside: dict[int, str] = field(default_factory=dict)


def run_campaign(
    campaign: Campaign,
    *,
    workers: int | None = None,
    executor: str | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Compute all shards that have no part.

    Parameters
    ----------
    campaign:
        From :func:`piga.campaign.plan_campaign`.
    workers:
        Processes on this machine. None: one for each core.
    executor:
        Address of a Dask scheduler (``tls://HOST:PORT``), instead of processes of this machine.
    progress:
        Function of the records done, all records, and what comes now (:mod:`piga.progress`).

    Raises
    ------
    PigaError
        If a part is damaged, the cluster cannot be used, or parts cannot be written.
    """
    done, missing = campaign.parts(), campaign.missing()
    for shard, path in done.items():
        read_part(campaign, shard, path)
    report = RunReport(campaign.shards, len(done))
    if missing:
        with _client(campaign, executor, workers, progress) as client:
            try:
                _compute(client, campaign, missing, report, progress)
            except (OSError, TimeoutError, CancelledError):
                raise PigaError("the scheduler is gone", remedy=f"start it again, then {_AGAIN}") from None
    return report


# --- clusters ----------------------------------------------------------------------------------------


@contextmanager
def _client(
    campaign: Campaign, executor: str | None, workers: int | None, progress: Progress | None
) -> Iterator[Any]:
    """A client of the cluster that the options name; a cluster of this machine ends with the run."""
    distributed = needed("distributed")
    import dask

    for name in ("distributed", "tornado", "asyncio"):  # what the user needs to know is said by the run
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if workers is not None and (workers < 1 or executor is not None):
        raise ArgumentError(
            f"--workers {workers}: is the number of processes of this machine, at least one; a cluster (--executor) has its own",
            remedy="leave --workers out, or write e.g. --workers 2",
        )
    if executor is not None:
        client = _connected(distributed, executor)
        try:
            yield client
        finally:
            client.close(timeout=5)
        return
    report_progress(progress, 0, campaign.plan.records, "first record, and kernels where they are not compiled")
    with suppress(Exception):  # the workers then load the kernels; a record that fails is a row with its reason
        compute(campaign.plan, campaign.plan.record(0))
    options = {"threads_per_worker": 1, "security": True, "protocol": "tls://", "dashboard_address": None}
    options["silence_logs"] = logging.CRITICAL  # of the workers: their traceback at Ctrl-C
    options["scheduler_kwargs"] = {"dashboard_address": "127.0.0.1:0"}  # any free port; nothing is shown there
    pages: dict[str, list[str]] = {f"distributed.{part}.http.routes": [] for part in ("scheduler", "worker")}
    with dask.config.set({"distributed.scheduler.worker-saturation": 1.0, **pages}):
        before = signal.getsignal(signal.SIGINT)
        try:
            with suppress(ValueError):  # in another thread than the main one
                signal.signal(
                    signal.SIGINT, signal.SIG_IGN
                )  # for the workers: only this process answers Ctrl-C
            cluster = distributed.LocalCluster(
                n_workers=workers or os.cpu_count() or 1, host="127.0.0.1", env=_ONE_THREAD, **options
            )
        finally:
            with suppress(ValueError):
                signal.signal(signal.SIGINT, before)
        with cluster, distributed.Client(cluster, set_as_default=False) as client:
            yield client


def _connected(distributed: Any, address: str) -> Any:
    """A client of a running scheduler, with at least one worker."""
    parts, security = urlsplit(address), distributed.Security()
    certified = security.tls_ca_file and security.tls_client_cert
    if not {"tls": certified, "tcp": parts.hostname in _LOOPBACK}.get(parts.scheme):
        raise PigaError(
            f"--executor {address}: a scheduler off this machine needs a tls:// address, and TLS certificates here",
            remedy="a cluster runs whatever code it is sent: write the address that the scheduler prints, e.g. "
            "tls://10.0.0.1:8786, and set distributed.comm.tls in Dask's configuration (ca-file, client.cert, client.key)",
        )
    try:
        client = distributed.Client(address, timeout=_CONNECT, set_as_default=False)
        client.wait_for_workers(1, timeout=_CONNECT)
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        raise PigaError(
            f"--executor {address}: no scheduler with a worker answers ({first_line(error)[:200]})",
            remedy="start both (dask scheduler; dask worker ... --nthreads 1), and check address and certificates",
        ) from None
    return client


# --- the loop ----------------------------------------------------------------------------------------


def _compute(
    client: Any, campaign: Campaign, missing: list[int], report: RunReport, progress: Progress | None
) -> None:
    """Compute the shards. One whose worker died again and again is set aside; other errors end the run."""
    from distributed.scheduler import KilledWorker

    total = campaign.plan.records
    records = total - sum(len(campaign.records_of(shard)) for shard in missing)
    finished: queue.SimpleQueue[Any] = queue.SimpleQueue()
    folder, idle = str(campaign.folder.resolve()), ""
    waiting = {}
    for shard in missing:
        future = client.submit(run_shard, folder, shard, key=f"piga-{campaign.key[:16]}-{shard}", pure=False)
        waiting[future] = shard
        future.add_done_callback(finished.put)
    while waiting:
        failed = f", {report.failed} records failed" if report.failed else ""
        what = f"{report.done} of {report.shards} shards{failed}{idle}"
        report_progress(progress, records, total, what, _AGAIN)
        try:
            future = finished.get(timeout=_POLL)
        except queue.Empty:
            if client.status != "running":
                raise CancelledError from None
            idle = "" if client.nthreads() else ", waiting: the cluster has no workers"
            continue
        if future.status == "cancelled":
            raise CancelledError
        shard = waiting.pop(future)
        numbers = campaign.records_of(shard)
        try:
            computed, failures, seconds = future.result()
            report.done += 1
            report.records += computed
            report.failed += failures
            report.seconds += seconds
        except KilledWorker as error:
            died = f"its worker died {error.allowed_failures + 1} times"
            report.set_aside[shard] = f"records {numbers[0]} to {numbers[-1]}: {died}"
        records += len(numbers)
