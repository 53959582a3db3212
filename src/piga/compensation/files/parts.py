"""Parts of a result that are whole on disk: what a stopped run continues from.

Beside the target lies a folder ``.OUT.parts``: ``key.json`` says of which input, calibration and options the parts are;
``N.parquet`` holds rows, ``N.json`` what the compensation carries on behind them. A part is whole when its
``N.json`` is there: each file is written under another name, brought to the disk and renamed, in this order. One process
at a time holds the folder (``lock``). When the result stands it is renamed, then deleted: a stop in between leaves nothing
that the next run would take for parts.
"""

from __future__ import annotations

import errno
import hashlib
import json
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga._version import __version__
from piga.compensation.writers import TableWriter
from piga.errors import ArgumentError
from piga.output import hold, put_in_place, write_whole
from piga.records.calibration import Calibration
from piga.records.calibration_json import calibration_to_bytes
from piga.records.run import Run
from piga.records.spool import spans

FOLDER, GOING = ".parts", "-done-"
"""End of the name of the folder, and what stands behind it while the folder is deleted."""
LOCK = "lock"
"""File in the folder that the process which works on the parts holds."""
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


class Parts:
    """The parts of one result, of this process alone until :meth:`remove` or its end.

    Parameters
    ----------
    out:
        The target.
    key:
        From :func:`key_of`.
    restart:
        True: parts of another run are removed.

    Raises
    ------
    ArgumentError
        If another process works on them, if parts of another run lie there, or none can.
    """

    def __init__(self, out: Path, key: str, restart: bool = False) -> None:
        self.folder, self.count = out.with_name(f".{out.name}{FOLDER}"), 0
        for left in _going(out):
            shutil.rmtree(left, ignore_errors=True)
        try:
            self.folder.mkdir(exist_ok=True)
            self._release = self._hold(out)
        except OSError as error:
            raise ArgumentError(
                f"{out}: cannot be written ({error.strerror})", remedy="choose another --out"
            ) from None
        mark = self.folder / "key.json"
        owner = _content(mark)
        if owner not in (None, key):
            if not restart:
                self.close()
                raise ArgumentError(
                    f"--resume: {self.folder} holds parts of another input, calibration or set of options",
                    remedy="run the command that was stopped, or begin again with --force",
                )
            for path in self.folder.iterdir():
                if path.name != LOCK:
                    path.unlink()
        write_whole(mark, lambda path: path.write_bytes(json.dumps(key).encode()))
        while (self.folder / f"{self.count}.json").exists():
            self.count += 1

    def _hold(self, out: Path) -> Callable[[], None]:
        """Keep other processes off the parts."""
        try:
            return hold(self.folder / LOCK)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK):
                raise ArgumentError(
                    f"--resume: another process writes {out}", remedy="wait for it, or choose another --out"
                ) from None
            raise

    def close(self) -> None:
        """Let other processes work on the parts."""
        release, self._release = self._release, lambda: None
        release()

    def carried(self) -> dict[str, Any] | None:
        """What the last whole part carries on; None when there is none."""
        if self.count == 0:
            return None
        found: dict[str, Any] = _content(self.folder / f"{self.count - 1}.json")
        return found

    def writer(self) -> TableWriter:
        """Writer of the next part."""
        return TableWriter(self.folder / "part.new", "parquet")

    def keep(self, carried: Mapping[str, Any], rows: int) -> None:
        """The next part, of so many rows, is complete: bring it to the disk, then what it carries on."""
        if rows:  # at a slower rate there may be none
            put_in_place(self.folder / "part.new", self.folder / f"{self.count}.parquet")
        text = json.dumps(dict(carried)).encode()
        write_whole(self.folder / f"{self.count}.json", lambda path: path.write_bytes(text))
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
        """The result stands: the parts may go, all at once."""
        gone = self.folder.with_name(f"{self.folder.name}{GOING}{secrets.token_hex(4)}")
        self.folder.replace(gone)
        self.close()
        shutil.rmtree(gone, ignore_errors=True)


def was_begun(out: Path) -> bool:
    """True when a run with ``--resume`` was stopped: before its result stood, or before its parts were gone."""
    return out.with_name(f".{out.name}{FOLDER}").exists() or bool(_going(out))


def _going(out: Path) -> list[Path]:
    """Parts whose deletion was stopped."""
    start = f".{out.name}{FOLDER}{GOING}"
    return [path for path in out.parent.iterdir() if path.name.startswith(start)] if out.parent.is_dir() else []


def _content(path: Path) -> Any:
    """What a small file says; None when it is not there."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _numbers(column: Any) -> NDArray:
    kind = np.int32 if str(column.type) == "int32" else np.float64
    return np.frombuffer(column.buffers()[1], dtype=kind)[column.offset : column.offset + len(column)]
