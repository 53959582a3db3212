"""The process that reads a container: it limits itself, reads, writes plain arrays, and ends.

Run as ``python -m piga.formats.containers.container_child`` with a JSON request on stdin. A damaged or hostile file can
make it fail, run out of memory or time, or crash; the process that asked only sees that it did.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from piga.errors import DataError
from piga.formats.columns import RawTable
from piga.formats.containers.hdf5_reader import read_hdf5
from piga.formats.containers.mat_reader import read_mat
from piga.formats.containers.parquet_reader import read_labels
from piga.formats.containers.tdms_reader import read_tdms
from piga.formats.containers.xlsx_reader import read_xlsx
from piga.records.limits import FULL, MEMORY_LIMIT

READERS: dict[str, Callable[..., RawTable]] = {
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".hdf": read_hdf5,
    ".mat": read_mat,
    ".tdms": read_tdms,
    ".xlsx": read_xlsx,
    ".parquet": read_labels,
}
"""Reader of each kind of container; of Parquet the labels alone are read here."""


def limit_resources(cpu: float) -> None:
    """Limit memory, CPU time and file size of this process, where the platform can."""
    try:
        import resource
    except ImportError:
        return
    seconds = int(np.ceil(cpu))
    for what, limit in (
        (resource.RLIMIT_AS, MEMORY_LIMIT),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_FSIZE, MEMORY_LIMIT),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(what)[1]
        soft = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(what, (soft, hard))


def read(request: dict[str, Any]) -> RawTable:
    """The table that a request asks for."""
    path = Path(request["path"])
    reader = READERS[request["kind"]]
    options = {"sheet": request["sheet"]} if reader is read_xlsx else {}
    return reader(path, tuple(request["numeric"]), request["label"], **options)


def write(table: RawTable, folder: Path) -> dict[str, Any]:
    """Write the arrays as plain ``.npy`` and give what describes them."""
    for index, column in enumerate(table.numbers.values()):
        np.save(folder / f"{index}.npy", column, allow_pickle=False)
    for codes, _ in table.labels.values():
        np.save(folder / "label.npy", codes, allow_pickle=False)
    if table.row_numbers is not None:
        np.save(folder / "rows.npy", table.row_numbers, allow_pickle=False)
    return {
        "numbers": list(table.numbers),
        "labels": {name: list(names) for name, (_, names) in table.labels.items()},
        "rows": table.rows,
        "first_row": table.first_row,
        "units": table.units,
        "events": [[event.kind, event.count, event.first_row, event.detail] for event in table.events],
        "row_numbers": table.row_numbers is not None,
    }


def main() -> None:
    """Read one container as asked on stdin; the outcome is ``answer.json`` in the folder named there."""
    request = json.load(sys.stdin)
    folder = Path(request["folder"])
    limit_resources(request["cpu"])
    table: RawTable | None = None
    answer: dict[str, Any] = {}
    try:
        table = read(request)
    except DataError as error:
        answer = {"error": error.message, "remedy": error.remedy}
    except MemoryError:
        answer = {"memory": True}
    try:
        if table is not None:
            answer = write(table, folder)
        (folder / "answer.json").write_text(json.dumps(answer), encoding="utf-8")
    except MemoryError:
        (folder / "answer.json").write_text(json.dumps({"memory": True}), encoding="utf-8")
    except OSError:
        os._exit(FULL)
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
