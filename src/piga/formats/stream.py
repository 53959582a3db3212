"""Any data file as chunks of columns: the one way that record files are read.

:func:`open_stream` gives a :class:`RecordStream`; its ``chunks()`` are the rows in order, in the units of the file.
Text and Parquet are read piece by piece, so that a file of any length needs a bounded memory; containers (HDF5,
MATLAB, TDMS, XLSX), which cannot be larger than 2 GiB, are read in a process of their own and then handed on in
chunks. What is read, what is found and what is refused do not depend on the size of the pieces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError
from piga.records.calibration import Event

if TYPE_CHECKING:
    from piga.records.run_file import DataTable

TEXT_SUFFIXES = (".csv", ".txt", ".tsv")
CHUNK_ROWS = 1 << 16
"""Rows of a chunk of Parquet or a container."""


@dataclass(frozen=True)
class Chunk:
    """Rows that follow each other in a file.

    Attributes
    ----------
    numbers:
        Column name to float64 values, shape (n,), in the unit of the file; a missing value is nan.
    codes:
        Index into the stream's ``label_names`` for the segment column (-1 where there is none), or None.
    rows:
        1-based file row of each.
    """

    numbers: dict[str, NDArray[np.float64]]
    codes: NDArray[np.int32] | None
    rows: NDArray[np.int64]


class RecordStream(Protocol):
    """A data file being read.

    ``units``: unit of a column where the file has one. ``label_names``: segment labels met so far, in order of
    appearance. ``chunks()`` gives the rows once; ``events()``, after the last chunk, what was found and left out.
    """

    units: dict[str, str]
    label_names: list[str]

    @property
    def expected_rows(self) -> int:
        """About how many rows there will be; 0 when nothing is known."""
        ...

    def chunks(self) -> Iterator[Chunk]:
        """The rows in order."""
        ...

    def events(self) -> list[Event]:
        """What was found, after the last chunk."""
        ...


def open_stream(
    folder: Path,
    data: DataTable,
    see: Callable[[bytes | bytearray], object] | None = None,
) -> RecordStream:
    """Open the data file of a run file.

    Parameters
    ----------
    folder:
        Where the run file lies; the data file is looked for there.
    data:
        The run file's ``[data]`` table: ``read_run_file(path).data``.
    see:
        Is shown the bytes of a text file as they are read (for a digest); the other kinds read in their own order.

    Raises
    ------
    DataError
        If the file cannot be read as asked; here, or while its chunks are taken. Names file, row and column.
    """
    path = folder / data.file
    numeric = tuple(data.number_columns())
    kind = file_kind(path)
    if data.sheet is not None and kind != ".xlsx":
        raise DataError(f"{path}: [data] sheet is for .xlsx files", remedy="leave it out")
    if kind in TEXT_SUFFIXES:
        from piga.formats.text.reader import TextStream

        return TextStream(
            path, numeric, data.segment, separator=data.delimiter, decimal=data.decimal, encoding=data.encoding,
            missing=data.missing, mask_damaged=data.damaged_rows == "mask", see=see or len,
        )  # fmt: skip
    if kind in (".parquet", ".pq"):
        from piga.formats.containers.parquet_reader import ParquetStream

        return ParquetStream(path, numeric, data.segment, CHUNK_ROWS)
    from piga.formats.containers.container import SUFFIXES, ContainerStream

    if kind in SUFFIXES:
        return ContainerStream(path, kind, numeric, data.segment, data.sheet, CHUNK_ROWS)
    spreadsheet = kind in (".xls", ".xlsm", ".xlsb", ".ods")
    raise DataError(
        f"{path}: files of kind '{kind}' are not read",
        remedy="open it in the spreadsheet program and save it as .xlsx or .csv"
        if spreadsheet
        else f"give .csv, .csv.gz, .parquet or one of {', '.join(SUFFIXES)}",
    )


def file_kind(path: Path) -> str:
    """The ending that says what a file is, ``.gz`` looked through."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] == [".gz"] and len(suffixes) > 1:
        return suffixes[-2]
    return (suffixes[-1:] or [""])[0]


def plain_values(column: Any, kind: type[np.generic]) -> NDArray[Any]:
    """Copy of the memory of an Arrow array, anything where it is null.

    Its own ``to_numpy`` and ``fill_null`` would load pandas where there is one, and 40 MB with it.
    """
    values = np.frombuffer(column.buffers()[1] or b"", dtype=kind, count=column.offset + len(column))
    return np.array(values[column.offset :])


def numbers_of(column: Any) -> NDArray[np.float64]:
    """Values of an Arrow array of numbers as float64; nan where it is null."""
    import pyarrow as pa

    whole = column if str(column.type) == "double" else column.cast(pa.float64(), safe=False)
    values = plain_values(whole, np.float64)
    if whole.null_count:
        values[nulls_of(whole)] = np.nan
    return values


def nulls_of(column: Any) -> NDArray[np.bool_]:
    """Where an Arrow array is null."""
    bitmap = column.buffers()[0]
    if bitmap is None:
        return np.zeros(len(column), dtype=np.bool_)
    bits = np.unpackbits(np.frombuffer(bitmap, dtype=np.uint8), bitorder="little")
    return bits[column.offset : column.offset + len(column)] == 0


@dataclass
class LabelCodes:
    """Codes of label cells, the same name the same code through all chunks; fills ``names``."""

    names: list[str]
    known: dict[str, int] = field(default_factory=dict)

    def of(self, column: Any) -> NDArray[np.int32]:
        """Codes of an Arrow array; -1 where it is null."""
        import pyarrow as pa

        coded = pa.types.is_dictionary(column.type)
        encoded = column if coded else column.cast(pa.string()).dictionary_encode()
        indices = encoded.indices.cast(pa.int32())
        index, empty = plain_values(indices, np.int32), nulls_of(indices)
        index[empty] = len(encoded.dictionary)
        table = np.full(len(encoded.dictionary) + 1, -1, dtype=np.int32)
        used, first = np.unique(index[~empty], return_index=True)
        used = used[np.argsort(first)]
        words = encoded.dictionary.take(pa.array(used)).cast(pa.string()).to_pylist()
        for place, word in zip(used, words, strict=True):
            table[place] = -1 if word is None else self.code(word)
        return table[index]

    def code(self, word: str) -> int:
        """Code of a label, a new one at the end."""
        if word not in self.known:
            self.known[word] = len(self.names)
            self.names.append(word)
        return self.known[word]


@dataclass
class MissingCount:
    """Missing values by column: how many, and the file row of the first."""

    found: dict[str, tuple[int, int]] = field(default_factory=dict)

    def add(self, name: str, mask: NDArray[np.bool_], rows: NDArray[np.int64]) -> None:
        """Count a chunk's missing values."""
        count, first = self.found.get(name, (0, int(rows[np.argmax(mask)])))
        self.found[name] = count + int(np.count_nonzero(mask)), first

    def events(self, order: tuple[str, ...]) -> list[Event]:
        """One event for each column with missing values."""
        counts = [(name, *self.found[name]) for name in order if name in self.found]
        return [Event("missing-value", count, first, f"column '{name}'") for name, count, first in counts]
