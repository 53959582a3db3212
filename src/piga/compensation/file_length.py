"""How long a data file is, known before it is read: rows, not bytes, decide whether it is held in memory."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

from piga.records.run_file import DataTable
from piga.records.stream import TEXT_SUFFIXES, file_kind, open_stream

BLOCK = 1 << 20
"""Bytes looked at at a time."""
ROWS_PER_BYTE = 2
"""More rows than this per byte no container holds: so small ones are not opened to be asked."""


def holds_more(folder: Path, data: DataTable, most: int) -> bool:
    """True when the data file of a run file holds more than ``most`` rows.

    Lines are counted no further than that; Parquet knows its rows. A file that is not there, or cannot be unpacked,
    holds none: who reads it says what is wrong.

    Raises
    ------
    DataError
        If a file of another kind cannot be opened.
    """
    path = folder / data.file
    if not path.is_file():
        return False
    kind = file_kind(path)
    if kind in TEXT_SUFFIXES:
        return _has_lines(path, most)
    if kind not in (".parquet", ".pq") and path.stat().st_size * ROWS_PER_BYTE <= most:
        return False
    return open_stream(folder, data).expected_rows > most


def _has_lines(path: Path, most: int) -> bool:
    feeds = returns = 0
    try:
        with gzip.open(path) if path.suffix.lower() == ".gz" else path.open("rb") as stream:
            while max(feeds, returns) <= most and (block := stream.read(BLOCK)):
                feeds, returns = feeds + block.count(b"\n"), returns + block.count(b"\r")
    except (OSError, EOFError, zlib.error):
        return False
    return max(feeds, returns) > most
