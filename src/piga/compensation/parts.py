"""Parts of a result that are whole on disk: what a stopped run continues from.

Beside the target lies a folder ``.OUT.parts``: ``key.json`` says of which input, calibration and options the parts are;
``N.parquet`` holds rows, ``N.json`` what the compensation carries on behind them. A part is whole when its
``N.json`` is there: each file is written under another name, brought to the disk and renamed, in this order.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.compensation.writers import TableWriter
from piga.errors import ArgumentError
from piga.records.calibration import Calibration
from piga.records.calibration_json import calibration_to_bytes
from piga.records.run import Run
from piga.records.spool import spans

PART_ROWS = 1 << 22
"""Rows of a part: at most so many are worked off again after a stop."""


def key_of(options: Any, calibration: Calibration, record: Run) -> str:
    """What a result depends on, as SHA-256: options, version, calibration, and every sample that was read.

    The samples hold all inputs as they were parsed: data, run file, stand and the profile that it follows.
    """
    digest = hashlib.sha256(repr((__version__, options, record.serial, record.kind, record.labels)).encode())
    digest.update(repr((record.scale_factor, record.phase_group, record.resolution)).encode())
    digest.update(calibration_to_bytes(calibration))
    columns = (record.t, record.output, *record.f.T, record.segment, record.begins)
    columns += () if record.base_rate is None else tuple(record.base_rate.T)
    columns += () if record.temperature is None else (record.temperature,)
    for values in columns:
        for part in spans(values.size):
            digest.update(np.ascontiguousarray(values[part]).data)
    return digest.hexdigest()


@dataclass
class Parts:
    """The parts of one result.

    Parameters
    ----------
    out:
        The target.
    key:
        From :func:`key_of`.

    Raises
    ------
    ArgumentError
        If parts of another run lie there, or none can.
    """

    out: Path
    key: str

    def __post_init__(self) -> None:
        self.folder = self.out.with_name(f".{self.out.name}.parts")
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise ArgumentError(
                f"{self.out}: cannot be written ({error.strerror})", remedy="choose another --out"
            ) from None
        mark = self.folder / "key.json"
        if mark.exists() and json.loads(mark.read_text(encoding="utf-8")) != self.key:
            raise ArgumentError(
                f"--resume: {self.folder} holds parts of another input, calibration or set of options",
                remedy=f"run the command that was stopped, or delete {self.folder} to begin again",
            )
        _place(mark, json.dumps(self.key).encode())
        self.count = 0
        while (self.folder / f"{self.count}.json").exists():
            self.count += 1

    def carried(self) -> dict[str, Any] | None:
        """What the last whole part carries on; None when there is none."""
        if self.count == 0:
            return None
        found: dict[str, Any] = json.loads((self.folder / f"{self.count - 1}.json").read_text(encoding="utf-8"))
        return found

    def writer(self) -> TableWriter:
        """Writer of the next part."""
        return TableWriter(self.folder / "part.new", "parquet")

    def keep(self, carried: Mapping[str, Any], rows: int) -> None:
        """The next part, of so many rows, is complete: bring it to the disk, then what it carries on."""
        if rows:  # at a slower rate there may be none
            path = self.folder / "part.new"
            with path.open("rb") as stream:
                os.fsync(stream.fileno())
            path.replace(self.folder / f"{self.count}.parquet")
        _place(self.folder / f"{self.count}.json", json.dumps(dict(carried)).encode())
        self.count += 1

    def rows(self) -> Iterator[dict[str, NDArray]]:
        """All rows, in the pieces in which they were written."""
        from pyarrow import parquet

        for path in (self.folder / f"{index}.parquet" for index in range(self.count)):
            if not path.exists():
                continue
            with parquet.ParquetFile(path, pre_buffer=False) as source:
                for group in range(source.num_row_groups):
                    table = source.read_row_group(group, use_threads=False).combine_chunks()
                    yield {name: _numbers(table.column(name).chunk(0)) for name in table.column_names}

    def remove(self) -> None:
        """The result stands: the parts may go."""
        shutil.rmtree(self.folder)


def _numbers(column: Any) -> NDArray:
    kind = np.int32 if str(column.type) == "int32" else np.float64
    return np.frombuffer(column.buffers()[1], dtype=kind)[column.offset : column.offset + len(column)]


def _place(path: Path, content: bytes) -> None:
    """Write a small file whole, or not at all; the folder is on the disk afterwards."""
    new = path.with_name(path.name + ".new")
    with new.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    new.replace(path)
    handle = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
