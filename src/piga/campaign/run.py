"""Run the shards of a campaign on Dask: workers of this machine, or a cluster whose scheduler is named.

A Dask worker runs whatever code it is sent, and an open port of this machine can be reached by all of its users. So the
local cluster has TLS with temporary credentials, and a cluster on another machine must have TLS.

Everything that must survive is in the folder. Any process may be killed at any time. The next run computes the shards
without a part.
"""

from __future__ import annotations

import logging
import os
import queue
import re
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from piga.campaign.shards import LOCK, Campaign, compile_kernels, read_part, run_shard
from piga.errors import ArgumentError, PigaError, needed
from piga.progress import Progress
from piga.progress import report as report_progress
from piga.records.text_files import first_line

_POLL = 0.5
"""Time between two reports of the progress [s]."""
_CONNECT = 20.0
"""Longest time to wait for the scheduler and its first worker [s]."""
PATIENCE = 60.0
"""A cluster without workers for longer than this ends the run [s]."""
_THREADS = ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "VECLIB_MAXIMUM", "NUMBA_NUM")
_ONE_THREAD = {f"{name}_THREADS": "1" for name in _THREADS}
"""Variables that give a worker of this machine one thread, in kernels and in linear algebra."""
_ADDRESS = re.compile(r"(?:dask|tls|tcp)://(?P<host>\[[0-9a-fA-F:.]+\]|[^:/\[\]\s]+):(?P<port>\d{1,5})/?")
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_STAY = "parts that are written stay"
_AGAIN = f"then give the same command: {_STAY}"


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
        ``dask://HOST:PORT`` of a Dask scheduler, instead of processes of this machine.
    progress:
        Function of the records done, all records, and what comes now (:mod:`piga.progress`).

    Raises
    ------
    PigaError
        If another run works in the folder, a part is damaged, the cluster cannot be used, or parts cannot be written.
    """
    with _lock(campaign.folder):
        done = campaign.parts()
        for shard, path in done.items():
            read_part(campaign, shard, path)
        report = RunReport(campaign.shards, len(done))
        missing = [shard for shard in range(campaign.shards) if shard not in done]
        if missing:
            with _client(campaign, executor, workers, progress) as client:
                _compute(client, campaign, missing, report, progress)
        return report


def _lock(folder: Path) -> IO[str]:
    """The locked file of a run; closing it unlocks the folder."""
    stream = (folder / LOCK).open("a")
    try:
        if os.name != "nt":
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        stream.close()
        if isinstance(error, BlockingIOError):
            why, remedy = "another 'piga campaign run' works in this folder", "wait for it, or stop it"
        else:
            why, remedy = f"cannot be locked ({error.strerror})", "use a file system with locks"
        raise PigaError(f"{folder}: {why}", remedy=remedy) from None
    return stream


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
    if executor is not None:
        if workers is not None:
            raise ArgumentError(
                "--workers is for this machine only; with --executor the cluster has its own number of workers",
                remedy="leave --workers out",
            )
        client = _connected(distributed, executor)
        try:
            yield client
        finally:
            client.close(timeout=5)
        return
    count = (os.cpu_count() or 1) if workers is None else workers
    if count < 1:
        raise ArgumentError(f"--workers {count}: at least one is needed", remedy="write e.g. --workers 2")
    report_progress(progress, 0, campaign.plan.records, "first record, and kernels where they are not compiled")
    compile_kernels(campaign.plan)
    options = {"threads_per_worker": 1, "security": True, "protocol": "tls://", "dashboard_address": None}
    options["silence_logs"] = logging.CRITICAL  # of the workers: their traceback at Ctrl-C
    options["scheduler_kwargs"] = {"dashboard_address": "127.0.0.1:0"}  # any free port; nothing is shown there
    pages: dict[str, list[str]] = {f"distributed.{part}.http.routes": [] for part in ("scheduler", "worker")}
    with dask.config.set({"distributed.scheduler.worker-saturation": 1.0, **pages}):
        with _without_ctrl_c():
            cluster = distributed.LocalCluster(n_workers=count, host="127.0.0.1", env=_ONE_THREAD, **options)
        with cluster, distributed.Client(cluster, set_as_default=False) as client:
            yield client


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Processes started here never see Ctrl-C: a terminal sends it to all of them, and only this one is to answer."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _connected(distributed: Any, executor: str) -> Any:
    """A client of a running scheduler, with at least one worker."""
    match = _ADDRESS.fullmatch(executor)
    if match is None:
        raise ArgumentError(
            f"--executor {executor}: is not dask://HOST:PORT",
            remedy="write e.g. --executor dask://10.0.0.1:8786",
        )
    security = distributed.Security()
    secure = bool(security.tls_ca_file and security.tls_client_cert)
    if not secure and match["host"] not in _LOOPBACK:
        raise PigaError(
            f"--executor {executor}: is not on this machine, and there are no TLS certificates",
            remedy="a cluster runs whatever code it is sent: set distributed.comm.tls in Dask's configuration "
            "(ca-file, client.cert, client.key), as the page 'Run thousands of tests' shows",
        )
    security.require_encryption = secure
    address = f"{'tls' if secure else 'tcp'}://{match['host']}:{match['port']}"
    try:
        client = distributed.Client(address, security=security, timeout=_CONNECT, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        raise PigaError(
            f"--executor {executor}: no scheduler answers ({first_line(error)[:200]})",
            remedy="start it, and check that its address and certificates are the ones given here",
        ) from None
    try:
        client.wait_for_workers(1, timeout=_CONNECT)
    except (OSError, TimeoutError):
        client.close(timeout=5)
        raise PigaError(
            f"--executor {executor}: the cluster has no workers", remedy="start: dask worker ... --nthreads 1"
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
    folder = str(campaign.folder.resolve())
    waiting = {}
    for shard in missing:
        future = client.submit(run_shard, folder, shard, key=f"piga-{campaign.key[:16]}-{shard}", pure=False)
        waiting[future] = shard
        future.add_done_callback(finished.put)
    seen = time.monotonic()
    while waiting:
        failed = f", {report.failed} records failed" if report.failed else ""
        what = f"{report.done} of {report.shards} shards{failed}"
        report_progress(progress, records, total, what, f"go on with the same command: {_STAY}")
        try:
            future = finished.get(timeout=_POLL)
        except queue.Empty:
            seen = _look_after(client, seen)
            continue
        if future.status == "cancelled":
            raise _gone(client)
        shard = waiting.pop(future)
        numbers = campaign.records_of(shard)
        try:
            computed, failures, seconds = future.result()
            report.done += 1
            report.records += computed
            report.failed += failures
            report.seconds += seconds
        except (OSError, TimeoutError, CancelledError):
            raise _gone(client) from None
        except KilledWorker as error:
            died = f"its worker died {error.allowed_failures + 1} times"
            report.set_aside[shard] = f"records {numbers[0]} to {numbers[-1]}: {died}"
        records += len(numbers)
        seen = time.monotonic()


def _look_after(client: Any, seen: float) -> float:
    """Time when the cluster last had a worker [s]. Ends the run if the scheduler or all workers are gone."""
    if client.status != "running":
        raise _gone(client)
    try:
        if client.nthreads():
            return time.monotonic()
    except (OSError, TimeoutError):
        raise _gone(client) from None
    if time.monotonic() - seen > PATIENCE:
        raise PigaError("the cluster has had no worker for a minute", remedy=f"start workers, {_AGAIN}")
    return seen


def _gone(client: Any) -> PigaError:
    address = getattr(client.scheduler, "address", "")
    return PigaError(f"the scheduler {address} is gone", remedy=f"start it again, {_AGAIN}")
