"""Shards on a Dask cluster. Off the local machine TLS is required, because a cluster runs whatever code it is sent."""

from __future__ import annotations

import ipaddress
import re
import socket
import time
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

from piga.campaign.shard import ShardReport, run_shard
from piga.errors import ArgumentError, PigaError, missing_package

CONNECT = 20.0
"""Longest time to wait for the scheduler [s]."""
PATIENCE = 60.0
"""A cluster without workers for longer than this ends the run [s]."""
_ADDRESS = re.compile(r"dask://(?P<host>\[[0-9a-fA-F:.]+\]|[^:/\[\]\s]+):(?P<port>\d{1,5})/?")


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
                f"--executor {address}: no scheduler answers ({_first_line(error)})",
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
                f"the scheduler {self.address} does not answer ({_first_line(error)})",
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


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:200]
