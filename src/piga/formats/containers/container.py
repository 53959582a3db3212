"""Read binary containers (HDF5, MATLAB, TDMS, XLSX) in a separate process with limits.

That process runs this module with a JSON request on stdin (:func:`main`). It limits itself, reads the file, writes
plain arrays, and ends. A damaged or hostile file can make it fail, exceed memory or time, or crash. The calling
process then only reports an error.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from piga.errors import DataError
from piga.formats.columns import CHUNK_ROWS, FileChunk, RawTable
from piga.formats.containers.hdf5_reader import read_hdf5
from piga.formats.containers.mat_reader import read_mat
from piga.formats.containers.parquet_reader import read_labels
from piga.formats.containers.tdms_reader import read_tdms
from piga.formats.containers.xlsx_reader import read_xlsx
from piga.records.calibration import Event
from piga.records.limits import CPU_BASE, CPU_PER_MIB, FULL, MEMORY_LIMIT
from piga.records.spool import mapped, trim


class ContainerStream:
    """A container. It is read whole in a separate process and given in chunks (:class:`piga.formats.columns.RecordStream`)."""

    def __init__(
        self, path: Path, kind: str, numeric: tuple[str, ...], label: str | None, sheet: str | None = None
    ) -> None:
        self._table, self._label = read_container(path, kind, numeric, label, sheet), label
        self.units, self.expected_rows = self._table.units, self._table.rows
        self.label_names = list(self._table.labels[label][1]) if label else []

    def chunks(self) -> Iterator[FileChunk]:
        """The rows in order."""
        table = self._table
        codes = table.labels[self._label][0] if self._label else None
        for start in range(0, table.rows, CHUNK_ROWS):
            part = slice(start, min(start + CHUNK_ROWS, table.rows))
            numbers = {name: np.array(column[part], dtype=float) for name, column in table.numbers.items()}
            yield FileChunk(numbers, None if codes is None else np.array(codes[part]), table.file_rows(part))
            trim()

    def events(self) -> list[Event]:
        """Faults and omissions."""
        return list(self._table.events)


def read_container(
    path: Path, kind: str, numeric: tuple[str, ...], label: str | None, sheet: str | None = None
) -> RawTable:
    """Read the named columns of a container.

    Parameters
    ----------
    path:
        The file.
    kind:
        One of :data:`SUFFIXES`, or ``.parquet`` for the labels of a Parquet file.
    numeric, label:
        Names of the number columns and of the segment column, as the reader of that format takes them.
    sheet:
        Name of the sheet in an ``.xlsx`` file.

    Raises
    ------
    DataError
        If the file cannot be read as requested, or exceeds the limits of memory or time.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file", remedy="[data] file is relative to the run file")
    if kind == ".xlsx" and path.with_name(f"~${path.name}").exists():
        raise DataError(f"{path}: is open in a spreadsheet program", remedy="close it there, then try again")
    with tempfile.TemporaryDirectory(prefix="piga-") as name:
        folder = Path(name)
        cpu = CPU_BASE + CPU_PER_MIB * path.stat().st_size / (1 << 20)
        request = {
            "path": str(path.resolve()), "kind": kind, "numeric": list(numeric), "label": label, "sheet": sheet,
            "folder": str(folder), "cpu": cpu,
        }  # fmt: skip
        _run(path, request, 4.0 * cpu)
        return _answer(path, folder)


def _run(path: Path, request: dict[str, Any], seconds: float) -> None:
    """Run the reading process. Its failures become one clear message."""
    environment = os.environ | {
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "HDF5_PLUGIN_PRELOAD": "::",
        "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),
    }
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-W", "ignore", "-m", "piga.formats.containers.container"],
            input=json.dumps(request).encode(),
            capture_output=True,
            timeout=seconds,
            check=False,
            env=environment,
        )
    except subprocess.TimeoutExpired:
        raise _too_long(path, seconds) from None
    if (Path(request["folder"]) / "answer.json").exists() and done.returncode == 0:
        return
    if done.returncode == FULL:
        raise DataError(
            f"{path}: cannot be read: the temporary folder {tempfile.gettempdir()} is full",
            remedy="make room there, or name another folder in TMPDIR",
        )
    if done.returncode in (-24, -9):
        raise _too_long(path, request["cpu"])
    if b"MemoryError" in done.stderr:
        raise _too_large(path)
    words = done.stderr.decode("utf-8", errors="replace").strip().splitlines()
    reason = words[-1] if words else f"signal {-done.returncode}"
    raise DataError(
        f"{path}: the reading library failed on it ({reason[:200]})",
        remedy="the file is damaged: export it again",
    )


def _answer(path: Path, folder: Path) -> RawTable:
    answer = json.loads((folder / "answer.json").read_text(encoding="utf-8"))
    if "memory" in answer:
        raise _too_large(path)
    if "error" in answer:
        message = str(answer["error"]).removeprefix(f"{path.resolve()}")
        raise DataError(f"{path}{message}" if message != answer["error"] else message, remedy=answer["remedy"])
    numbers = {name: mapped(folder / f"{index}.npy") for index, name in enumerate(answer["numbers"])}
    labels = {name: (mapped(folder / "label.npy"), tuple(names)) for name, names in answer["labels"].items()}
    return RawTable(
        path, numbers, labels, answer["rows"], answer["units"],
        tuple(Event(*event) for event in answer["events"]),
        mapped(folder / "rows.npy") if answer["row_numbers"] else None,
    )  # fmt: skip


def _too_long(path: Path, seconds: float) -> DataError:
    return DataError(
        f"{path}: reading it took more than {seconds:.0f} s of computing time",
        remedy="the file is damaged or not what it says; export it again, or as Parquet",
    )


def _too_large(path: Path) -> DataError:
    return DataError(
        f"{path}: reading it needs more than {MEMORY_LIMIT >> 30} GiB of memory",
        remedy="the file is damaged, or export it as Parquet",
    )


READERS: dict[str, Callable[..., RawTable]] = {
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".hdf": read_hdf5,
    ".mat": read_mat,
    ".tdms": read_tdms,
    ".xlsx": read_xlsx,
    ".parquet": read_labels,
}
"""Reader of each format. Of Parquet only the labels are read here."""
SUFFIXES = tuple(suffix for suffix in READERS if suffix != ".parquet")
"""File name endings of containers."""


def limit_resources(cpu: float) -> None:
    """Limit memory, CPU time and file size of this process, if the platform supports it."""
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
    """The table of a request."""
    path = Path(request["path"])
    reader = READERS[request["kind"]]
    options = {"sheet": request["sheet"]} if reader is read_xlsx else {}
    return reader(path, tuple(request["numeric"]), request["label"], **options)


def write(table: RawTable, folder: Path) -> dict[str, Any]:
    """Write the arrays as plain ``.npy`` files. Returns their description."""
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
        "units": table.units,
        "events": [[event.kind, event.count, event.first_row, event.detail] for event in table.events],
        "row_numbers": table.row_numbers is not None,
    }


def main() -> None:
    """Entry point of the reading process. The request comes on stdin; the result is ``answer.json`` in the folder it names."""
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
