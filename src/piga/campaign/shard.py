"""One shard: compute its records, and write its part. This is the task of a worker."""

from __future__ import annotations

import os
import socket
import threading
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from piga.campaign.manifest import MANIFEST, Campaign, open_campaign, software
from piga.campaign.subjects import Outcome, compute, reason
from piga.errors import PigaError
from piga.output import write_whole

if TYPE_CHECKING:
    import pyarrow as pa

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMBA_NUM_THREADS",
)
"""Variables that give a worker one thread, in kernels and in linear algebra."""
KEY = b"piga.campaign"
"""Name of the metadata of a part that holds the key of its campaign."""


@dataclass(frozen=True)
class ShardReport:
    """Report of a worker on a finished shard: records, failed records, processor time [s], and its own name."""

    shard: int
    records: int
    failed: int
    seconds: float
    worker: str


def start_worker() -> None:
    """Prepare a process of the local pool: it ignores Ctrl-C, has one thread, and ends when the parent ends."""
    import signal
    from multiprocessing import parent_process

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """End this process when the parent has ended. Otherwise it would wait for ever."""
    from multiprocessing.connection import wait

    wait([sentinel])
    os._exit(1)


def run_shard(folder: str, shard: int) -> ShardReport:
    """Compute a shard and write its part. If the part is there already, nothing is computed.

    Raises
    ------
    PigaError
        If the worker has other software or does not see the folder, or if the part cannot be written.
    """
    import numba

    campaign = _opened(folder, _stamp(folder))
    worker = f"{socket.gethostname()}:{os.getpid()}"
    if campaign.part(shard).exists():
        return ShardReport(shard, 0, 0, 0.0, worker)
    numba.set_num_threads(1)
    began = time.process_time()
    rows = [_row(campaign, number) for number in campaign.records_of(shard)]
    _write(rows, campaign.key, campaign.part(shard))
    failed = sum(row["error_class"] is not None for row in rows)
    return ShardReport(shard, len(rows), failed, time.process_time() - began, worker)


def _stamp(folder: str) -> int:
    """Time of the manifest [ns]. A cluster worker may outlive a campaign, and a folder may be planned again."""
    try:
        return (Path(folder) / MANIFEST).stat().st_mtime_ns
    except OSError:
        return 0


@lru_cache(maxsize=1)
def _opened(folder: str, _time: int) -> Campaign:
    """The campaign, opened once in a worker; refused if this worker has other software than the campaign."""
    try:
        campaign = open_campaign(folder)
    except PigaError as error:
        raise PigaError(
            f"worker {socket.gethostname()}: {error.message}",
            remedy="every worker needs the folder of the campaign at the same path: use a shared disk",
        ) from None
    own = software()
    if own != campaign.manifest.software:
        changed = [name for name, text in own.items() if campaign.manifest.software.get(name) != text]
        raise PigaError(
            f"worker {socket.gethostname()}: has other software than the campaign ({', '.join(changed)} differ)",
            remedy="install the same version of piga and its packages on every machine",
        )
    return campaign


def _row(campaign: Campaign, number: int) -> dict[str, Any]:
    """A row of the part. A record that fails is a row with its reason."""
    record = campaign.plan.record(number)
    archive = campaign.archive
    row: dict[str, Any] = {
        "record": number,
        "case": record.case,
        "repeat": record.repeat,
        "source": None if archive is None else archive.files[number].run,
        "error_class": None,
        "error": None,
    }
    began = time.process_time()
    try:
        outcome = compute(campaign.plan, record, archive)
        row |= _columns(outcome)
    except Exception as error:
        row["error_class"], row["error"] = reason(error)
    row["seconds"] = time.process_time() - began
    return row


def _columns(outcome: Outcome) -> dict[str, Any]:
    lists = ("value", "u", "low", "high", "degrees_of_freedom", "truth", "error", "bound")
    columns: dict[str, Any] = {
        ("deviation" if name == "error" else name): getattr(outcome, name) for name in lists
    }
    with np.errstate(all="ignore"):
        columns["z"] = outcome.error / outcome.u
    return columns | {
        "name": list(outcome.names),
        "unit": list(outcome.units),
        "nees": outcome.nees,
        "nees_expected": outcome.nees_expected,
        "notes": list(outcome.notes),
        "seen": list(outcome.seen),
        "stored": outcome.stored,
        "verdict": outcome.verdict,
    }


def part_schema() -> pa.Schema:
    """Columns of a part: one row per record; lists have one entry per coefficient."""
    import pyarrow as pa

    numbers, texts = pa.list_(pa.float64()), pa.list_(pa.string())
    return pa.schema(
        [
            ("record", pa.int64()),
            ("case", pa.int64()),
            ("repeat", pa.int64()),
            ("source", pa.string()),
            ("error_class", pa.string()),
            ("error", pa.string()),
            ("name", texts),
            ("unit", texts),
            ("value", numbers),
            ("u", numbers),
            ("low", numbers),
            ("high", numbers),
            ("degrees_of_freedom", numbers),
            ("truth", numbers),
            ("deviation", numbers),
            ("z", numbers),
            ("bound", numbers),
            ("nees", pa.float64()),
            ("nees_expected", pa.float64()),
            ("notes", texts),
            ("seen", texts),
            ("stored", pa.string()),
            ("verdict", pa.string()),
            ("seconds", pa.float64()),
        ]
    )


def _write(rows: list[dict[str, Any]], key: str, path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    schema = part_schema()
    arrays = [pa.array([row.get(field.name) for row in rows], field.type) for field in schema]
    table = pa.Table.from_arrays(arrays, schema=schema.with_metadata({KEY: key.encode()}))
    write_whole(
        path,
        lambda part: parquet.write_table(table, part, compression="zstd", write_page_checksum=True),
        remedy="make room on the disk, then run the campaign again: it goes on where it stopped",
    )
