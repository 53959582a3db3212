"""Read any data file as chunks of columns. All record files are read here.

:func:`open_stream` returns a :class:`RecordStream`. Its ``chunks()`` are the rows in order, in the units of the file.
Text and Parquet are read piece by piece, so a file of any length needs a bounded memory. Containers (HDF5,
MATLAB, TDMS, XLSX) cannot be larger than 2 GiB. A separate process reads them whole; then they are given in
chunks. Results, events and errors do not depend on the size of the pieces.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from piga.errors import DataError
from piga.formats.columns import CHUNK_ROWS, RecordStream

if TYPE_CHECKING:
    from piga.records.run_file import DataTable

TEXT_SUFFIXES = (".csv", ".txt", ".tsv")


def open_stream(
    folder: Path,
    data: DataTable,
    see: Callable[[bytes | bytearray], object] | None = None,
) -> RecordStream:
    """Open the data file of a run file.

    Parameters
    ----------
    folder:
        Folder of the run file. The data file is relative to it.
    data:
        The run file's ``[data]`` table: ``read_run_file(path).data``.
    see:
        Function that gets the bytes of a text file as they are read (for a digest). Not called for other formats.

    Raises
    ------
    DataError
        If the file cannot be read as requested: at once, or while its chunks are taken. Names file, row and column.
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
    """The ending that identifies the format of a file; ``.gz`` is skipped."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] == [".gz"] and len(suffixes) > 1:
        return suffixes[-2]
    return (suffixes[-1:] or [""])[0]
