"""Run the shards of a campaign on an executor: the processes of this machine, or a cluster of Dask.

Off the local machine a cluster needs TLS, because it runs whatever code it is sent.

Everything that must survive is in the folder. Any process may be killed at any time. The next run computes the shards
without a part. The code is written against :class:`concurrent.futures.Executor`.
"""

from __future__ import annotations

import ipaddress
import multiprocessing
import os
import re
import socket
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from piga.campaign.collect import check_part, first_line
from piga.campaign.manifest import LOCK, Campaign, compile_kernels
from piga.campaign.shard import THREAD_VARIABLES, ShardReport, run_shard, start_worker
from piga.errors import ArgumentError, PigaError, missing_package
from piga.output import hold

TASKS_PER_CHILD = 32
"""Shards after which a process of the local pool is replaced. Memory leaks of a library then do not add up."""
POLL = 0.5
"""Time between two checks of the workers [s]."""

CONNECT = 20.0
"""Longest time to wait for the scheduler [s]."""
PATIENCE = 60.0
"""A cluster without workers for longer than this ends the run [s]."""
_ADDRESS = re.compile(r"dask://(?P<host>\[[0-9a-fA-F:.]+\]|[^:/\[\]\s]+):(?P<port>\d{1,5})/?")


class Engine(Protocol):
    """Where shards are computed."""

    workers: int

    def submit(self, folder: str, shard: int) -> Future[ShardReport]:
        """Begin a shard."""

    def renew(self) -> None:
        """Begin anew after a worker died."""

    def check(self) -> None:
        """Raise PigaError if no worker is left."""

    def close(self, *, drop: bool) -> None:
        """End the workers. ``drop``: do not wait for their shards."""


class LocalEngine:
    """Processes of this machine. They are spawned, have one thread, ignore Ctrl-C, and end with the parent."""

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._variables = {name: os.environ.get(name) for name in THREAD_VARIABLES}
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
        self._pool = self._new()

    def _new(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(
            self.workers, context, initializer=start_worker, max_tasks_per_child=TASKS_PER_CHILD
        )

    def submit(self, folder: str, shard: int) -> Future[ShardReport]:
        """Begin a shard. At most ``workers`` shards run at a time: waiting ones are lost if the pool breaks."""
        return self._pool.submit(run_shard, folder, shard)

    def renew(self) -> None:
        """A new pool; the old one is broken."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._pool = self._new()

    def check(self) -> None:
        """The pool replaces its workers."""

    def close(self, *, drop: bool) -> None:
        """End the processes."""
        if drop:
            for process in multiprocessing.active_children():
                process.kill()
        self._pool.shutdown(wait=True, cancel_futures=True)
        for name, value in self._variables.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


def is_local(host: str) -> bool:
    """True for a name or address of the local machine's loopback interface."""
    try:
        seen = {info[4][0] for info in socket.getaddrinfo(host.strip("[]"), None)}
    except OSError:
        return False
    return bool(seen) and all(ipaddress.ip_address(str(one).partition("%")[0]).is_loopback for one in seen)


class DaskEngine:
    """Workers of a Dask cluster, through its own :class:`concurrent.futures.Executor`."""

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError:
            raise missing_package("distributed") from None
        dask: Any = distributed
        match = _ADDRESS.fullmatch(address)
        if match is None:
            raise ArgumentError(
                f"--executor {address}: is not dask://HOST:PORT",
                remedy="write e.g. --executor dask://10.0.0.1:8786",
            )
        self.address = f"{match['host']}:{match['port']}"
        security = dask.Security()
        secure = bool(security.tls_ca_file and security.tls_client_cert)
        if not secure and not is_local(match["host"]):
            raise PigaError(
                f"--executor {address}: is not on this machine, and there are no TLS certificates",
                remedy="a cluster runs whatever code it is sent: set distributed.comm.tls in Dask's configuration "
                "(ca-file, client.cert, client.key), as the page 'Run thousands of tests' shows",
            )
        if secure:
            security.require_encryption = True
        try:
            self._client: Any = dask.Client(
                f"{'tls' if secure else 'tcp'}://{self.address}",
                security=security if secure else None,
                timeout=CONNECT,
                set_as_default=False,
                name="piga-campaign",
            )
        except (OSError, TimeoutError, ValueError, TypeError) as error:
            raise PigaError(
                f"--executor {address}: no scheduler answers ({first_line(error)})",
                remedy="start it, and check that its address and certificates are the ones given here",
            ) from None
        self._executor = self._client.get_executor(pure=False)
        self.workers = 0
        self._seen = time.monotonic()
        self._count()
        if not self.workers:
            self._client.close(timeout=5)
            raise PigaError(
                f"--executor {address}: the cluster has no workers",
                remedy="start: dask worker ... --nthreads 1",
            )

    def _count(self) -> None:
        """Number of workers now; refuses workers with several threads."""
        threads = list(self._client.nthreads().values())
        if any(count > 1 for count in threads):
            self._client.close(timeout=5)
            raise PigaError(
                f"--executor dask://{self.address}: a worker has {max(threads)} threads",
                remedy="start workers with: dask worker ... --nworkers N --nthreads 1",
            )
        self.workers = len(threads)

    def submit(self, folder: str, shard: int) -> Future[ShardReport]:
        """Begin a shard."""
        future: Future[ShardReport] = self._executor.submit(run_shard, folder, shard)
        return future

    def renew(self) -> None:
        """The scheduler replaces its workers."""

    def check(self) -> None:
        """Look after the cluster every few seconds: new workers get work, a lost scheduler ends the run.

        Raises
        ------
        PigaError
            If the scheduler is gone, or there has been no worker for a minute.
        """
        now = time.monotonic()
        if self._client.status != "running":
            raise PigaError(
                f"the scheduler {self.address} is gone",
                remedy="start it again, then give the same command: parts that are written stay",
            )
        if now - self._seen < 2.0:
            return
        try:
            self._count()
        except (OSError, TimeoutError) as error:
            raise PigaError(
                f"the scheduler {self.address} does not answer ({first_line(error)})",
                remedy="start it again, then give the same command: parts that are written stay",
            ) from None
        if self.workers:
            self._seen = now
        elif now - self._seen > PATIENCE:
            raise PigaError(
                f"the cluster {self.address} has had no worker for a minute",
                remedy="start workers, then give the same command: parts that are written stay",
            )

    def close(self, *, drop: bool) -> None:
        """Leave the cluster; it goes on running."""
        with suppress(Exception):
            self._executor.shutdown(wait=not drop)
        with suppress(Exception):
            self._client.close(timeout=5)


@dataclass(frozen=True)
class Progress:
    """Progress of a run: shards done and in all, records computed and failed in this run, running shards.

    ``running`` has the elapsed time of each running shard [s]. ``left`` is the estimated time to the end [s]; None
    before the first shard is done.
    """

    done: int
    shards: int
    records: int
    failed: int
    running: dict[int, float]
    left: float | None
    finishing: bool = False

    def line(self) -> str:
        """One line for people."""
        text = f"{self.done} of {self.shards} shards, {self.records} records"
        text += f", {self.failed} failed" if self.failed else ""
        text += "" if self.left is None or self.finishing else f"; about {duration(self.left)} to go"
        at = ", ".join(f"{shard} ({duration(seconds)})" for shard, seconds in sorted(self.running.items())[:6])
        more = f" and {len(self.running) - 6} more" if len(self.running) > 6 else ""
        return f"{text}; under way: {at}{more}" if at else text


def duration(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5940.0 else f"{seconds / 3600:.1f} h"


@dataclass
class RunReport:
    """Result of a run: shards done in all, shards set aside with reasons, reports of this run, and if it was stopped."""

    shards: int
    done: int = 0
    set_aside: dict[int, str] = field(default_factory=dict)
    reports: list[ShardReport] = field(default_factory=list)
    stopped: bool = False


def run_campaign(
    campaign: Campaign,
    *,
    workers: int | None = None,
    executor: str | None = None,
    show: Callable[[Progress], None] = lambda _progress: None,
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
    show:
        Called with the progress several times a second.

    Raises
    ------
    PigaError
        If another run works in the folder, a part is damaged, the executor cannot be used, or parts cannot be
        written.
    """
    release = _lock(campaign.folder)
    try:
        missing = campaign.missing()
        for shard in campaign.done():
            check_part(campaign, shard)
        report = RunReport(campaign.shards, campaign.shards - len(missing))
        if not missing:
            return report
        if executor is None:
            compile_kernels(campaign)
        engine = engine_of(executor, workers)
        drop = True
        try:
            _Loop(campaign, engine, deque(missing), report, show).run()
            drop = False
        finally:
            engine.close(drop=drop)
        return report
    finally:
        release()


def _lock(folder: Path) -> Callable[[], None]:
    try:
        return hold(folder / LOCK)
    except BlockingIOError:
        raise PigaError(
            f"{folder}: another 'piga campaign run' works in this folder", remedy="wait for it, or stop it"
        ) from None
    except OSError as error:
        raise PigaError(
            f"{folder}: cannot be written ({error.strerror or error})",
            remedy="use a folder you may write to, on a file system with locks",
        ) from None


def engine_of(executor: str | None, workers: int | None) -> Engine:
    """The engine that the options name.

    Raises
    ------
    PigaError
        If the options do not fit, or the cluster cannot be used.
    """
    if executor is None:
        count = (os.cpu_count() or 1) if workers is None else workers
        if count < 1:
            raise ArgumentError(f"--workers {count}: at least one is needed", remedy="write e.g. --workers 2")
        return LocalEngine(count)
    if workers is not None:
        raise ArgumentError(
            "--workers is for this machine only; with --executor the cluster has its own number of workers",
            remedy="leave --workers out",
        )

    return DaskEngine(executor)


class _Loop:
    """The loop of a run: give every worker one shard, and react to results, deaths and stops."""

    def __init__(
        self,
        campaign: Campaign,
        engine: Engine,
        waiting: deque[int],
        report: RunReport,
        show: Callable[[Progress], None],
    ) -> None:
        self.campaign, self.engine, self.waiting = campaign, engine, waiting
        self.report, self.show = report, show
        self.suspects: deque[int] = deque()
        """Shards whose worker died. Each is tried again alone, so that no other shard is blamed."""
        self.running: dict[Future[ShardReport], tuple[int, float, bool]] = {}
        self.began = time.monotonic()

    def run(self) -> None:
        """Run until all is done. The first Ctrl-C finishes the running shards, the second drops them."""
        folder = str(self.campaign.folder.resolve())
        while True:
            try:
                while self.running or self.suspects or self.waiting:
                    self._submit(folder)
                    done, _ = wait(self.running, timeout=POLL, return_when=FIRST_COMPLETED)
                    self._answer(done)
                    self.show(self._progress())
                    self.engine.check()
                return
            except KeyboardInterrupt:
                if self.report.stopped:
                    raise
                self.report.stopped = True
                self.waiting.clear()
                self.suspects.clear()

    def _submit(self, folder: str) -> None:
        alone = bool(self.suspects) or any(alone for _, _, alone in self.running.values())
        queue = self.suspects if alone else self.waiting
        while queue and len(self.running) < (1 if alone else self.engine.workers):
            shard = queue.popleft()
            try:
                future = self.engine.submit(folder, shard)
            except BrokenExecutor:  # a worker died while it was idle
                queue.appendleft(shard)
                self.engine.renew()
                return
            self.running[future] = (shard, time.monotonic(), alone)

    def _answer(self, done: set[Future[ShardReport]]) -> None:
        died: list[tuple[int, bool, BaseException]] = []
        for future in done:
            shard, _, alone = self.running.pop(future)
            try:
                report = future.result()
            except PigaError:
                raise
            except CancelledError:  # the scheduler is gone, or lost the shard
                self.waiting.appendleft(shard)
            except Exception as error:
                died.append((shard, alone, error))
            else:
                self.report.reports.append(report)
                self.report.done += 1
                with suppress(OSError):
                    self.campaign.aside(shard).unlink(missing_ok=True)
        if died:
            self._after_death(died)

    def _after_death(self, died: list[tuple[int, bool, BaseException]]) -> None:
        """A worker died. All shards that the pool was computing are lost, and are tried again one by one."""
        if any(isinstance(error, BrokenExecutor) for _, _, error in died):
            lost, _ = wait(self.running, timeout=10.0)
            for future in lost:
                shard, _, alone = self.running.pop(future)
                error = future.exception()
                if error is None:
                    self.report.reports.append(future.result())
                    self.report.done += 1
                else:
                    died.append((shard, alone, error))
            self.engine.renew()
        for shard, alone, error in died:
            if self.campaign.part(shard).exists():  # it died after its work
                self.report.done += 1
            elif alone:
                self._set_aside(shard, error)
            elif not self.report.stopped:
                self.suspects.append(shard)

    def _set_aside(self, shard: int, error: BaseException) -> None:
        numbers = self.campaign.records_of(shard)
        text = f"records {numbers[0]} to {numbers[-1]}: the worker died twice ({type(error).__name__}: {error})"
        self.report.set_aside[shard] = text
        path = self.campaign.aside(shard)
        try:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text + "\n", encoding="utf-8")
        except OSError as problem:
            raise PigaError(
                f"{path}: cannot be written ({problem.strerror or problem})",
                remedy="make room there, and check that you may write to it",
            ) from None

    def _progress(self) -> Progress:
        now = time.monotonic()
        reports = self.report.reports
        records = sum(report.records for report in reports)
        left = None
        if records:
            open_ = sum(len(self.campaign.records_of(shard)) for shard in (*self.waiting, *self.suspects))
            under_way = sum(len(self.campaign.records_of(shard)) for shard, _, _ in self.running.values())
            left = (now - self.began) / records * (open_ + 0.5 * under_way)
        return Progress(
            self.report.done,
            self.campaign.shards,
            records,
            sum(report.failed for report in reports),
            {shard: now - since for shard, since, _ in self.running.values()},
            left,
            self.report.stopped,
        )
