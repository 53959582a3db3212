"""Open a data file of any format. HDF5, MATLAB and TDMS are read whole: a table of the wanted columns, of limited size.

A sheet (XLSX) is turned into lines of text and read as a text file is.

HDF5 data, including MATLAB v7.3, are read only from the file itself.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from datetime import datetime, time, timedelta
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from piga.errors import EXTRAS, DataError, Fix, PigaError, install_command
from piga.formats.columns import (
    MOST_LISTED,
    REMEDIES,
    ParquetStream,
    RecordStream,
    TableStream,
    no_column,
    refusal,
)
from piga.formats.text.convention import TextOptions
from piga.formats.text.reader import TextStream
from piga.tables import Column, arrow_table
from piga.text_files import check_unpacked, first_line, open_regular

_COLUMN_OF = re.compile(r"^(.*)\(:,\s*(\d+)\)$")


def _split_name(name: str) -> tuple[str, int | None]:
    """``f(:,2)`` is column 2 (counted from 1, as MATLAB does) of the matrix ``f``."""
    match = _COLUMN_OF.match(name)
    return (match.group(1), int(match.group(2))) if match else (name, None)


def _matrix_columns(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names of the columns of an array: its own, or ``f(:,1)`` and so on for a matrix with few columns."""
    if len(shape) == 2 and 1 < shape[1] <= MOST_LISTED and shape[0] > 1:
        return [f"{name}(:,{k + 1})" for k in range(shape[1])]
    return [name]


def _label_text(value: object) -> str:
    """Segment label of a cell. Bytes are decoded, whole numbers have no decimal point, None and nan give an empty text."""
    if isinstance(value, np.ndarray) and value.size == 1:  # of MATLAB
        value = value.reshape(-1)[0].item()
    if value is None:
        return ""
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    if isinstance(value, (float, np.floating)):
        number = float(value)
        return "" if np.isnan(number) else str(int(number)) if number.is_integer() else repr(number)
    return str(value).strip()


@contextmanager
def _library(path: Path, name: str, remedy: str) -> Iterator[None]:
    """Turn an error of the library that reads a format into one of the file."""
    try:
        yield
    except PigaError:
        raise
    except ImportError as error:
        extra = EXTRAS[str(error.name).split(".")[0]]
        words = f"reading {name} needs the extra '{extra}', which is not installed"
        raise refusal(path, words, f"install it with: {install_command(extra)}") from None
    except Exception as error:  # a damaged file can raise any exception in the library
        raise refusal(path, f"not a readable {name} file ({first_line(error)})", remedy) from None


class _Source(NamedTuple):
    """A vector or matrix of a container: the function that reads it, its shape, and its unit."""

    read: Callable[[], NDArray]
    shape: tuple[int, ...]
    unit: str = ""


class Container(TableStream):
    """The named columns of a file that is read whole.

    A format has a ``name`` and a ``remedy`` for a damaged file. Its :meth:`sources` opens the file.
    """

    name = remedy = ""

    def __init__(self, path: Path, numeric: Iterable[str], label: str | None = None) -> None:
        RecordStream.__init__(self, path, numeric, label)
        open_regular(path, "the file; [data] file is relative to the run file").close()
        with _library(path, self.name, self.remedy), ExitStack() as stack:
            self._sources = self.sources(stack)
            TableStream.__init__(self, path, arrow_table(self._columns()), numeric, label)

    def sources(self, stack: ExitStack) -> dict[str, _Source]:
        """What the file holds, by name. The file stays open as long as ``stack``."""
        raise NotImplementedError

    def matching(self, name: str) -> list[str]:
        """Names of sources that a name without the column of a matrix means."""
        return [
            one
            for one in dict.fromkeys((name, name.strip("/"), name.replace(".", "/")))
            if one in self._sources
        ]

    def refusal(self, words: str, remedy: str, *columns: str) -> DataError:
        """The error of the file."""
        return refusal(self.path, words, remedy, *columns)

    def _columns(self) -> dict[str, Column]:
        columns, first = dict[str, Column](), self.wanted[0]
        for name in self.wanted:
            plain, number = _split_name(name)
            found = self.matching(plain)
            if not found:
                listed = [
                    part for one, source in self._sources.items() for part in _matrix_columns(one, source.shape)
                ]
                raise no_column(self.path, plain, listed)
            if len(found) > 1:
                remedy = f"name it as one of {', '.join(map(repr, found[:5]))}"
                raise self.refusal(f"several groups have a channel '{name}'", remedy, name)
            source = self._sources[found[0]]
            values = self._vector(name, plain, number, source.read())
            if name not in self.numeric:
                values = np.array([_label_text(value) for value in values.tolist()], object)
            elif values.dtype.kind not in "iuf" or values.dtype.itemsize > 8:
                words = f"column '{name}' holds {values.dtype.name}, not numbers"
                raise self.refusal(words, REMEDIES[1], name)
            values = values.astype(values.dtype.newbyteorder("="), copy=False)
            columns[name] = Column(values, source.unit if name in self.numeric else "")
            if values.size != columns[first].values.size:
                words = (
                    f"column '{name}' has {values.size} rows, column '{first}' has {columns[first].values.size}"
                )
                raise self.refusal(words, "export columns that were sampled together", name, first)
        if columns[first].values.size == 0:
            raise self.refusal("no data row", "check that the logger wrote data")
        return columns

    def _vector(self, name: str, plain: str, number: int | None, values: NDArray) -> NDArray:
        """The array itself if it is a vector, or one column of a matrix."""
        if values.ndim == 2 and number is not None:
            if 1 <= number <= values.shape[1]:
                return values[:, number - 1]
            words = f"column '{name}': the matrix has {values.shape[1]} columns"
            raise self.refusal(words, "columns count from 1", name)
        flat = values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values
        if flat.ndim != 1 or number is not None:
            words = f"'{name}' has the shape {values.shape}, a column is needed"
            raise self.refusal(words, f"name a column of a matrix as '{plain}(:,1)'", name)
        return flat


# -- HDF5 ----------------------------------------------------------------------------------------------

_HDF5_MARK = b"\x89HDF\r\n\x1a\n"
_UNIT_KEYS = ("unit", "units", "Unit", "Units", "unit_string", "NI_UnitDescription")
"""Attributes of an HDF5 dataset or a TDMS channel that state its unit."""


def _unit(attributes: Any) -> str:
    given = next((attributes[key] for key in _UNIT_KEYS if key in attributes), "")
    given = given.item() if isinstance(given, np.ndarray) and given.size == 1 else given
    return given.decode("utf-8", errors="replace") if isinstance(given, bytes) else str(given)


class Hdf5(Container):
    """The named datasets: ``name`` or ``group/name``, ``name(:,2)`` of a matrix, ``name/field`` of a table.

    Only datasets of the file itself are found: links to other places are not followed.
    """

    name, remedy = "HDF5", "was it closed by the logger? copy or export it again"

    def sources(self, stack: ExitStack) -> dict[str, _Source]:
        """The datasets, and the fields of those that are tables."""
        import h5py

        found: dict[str, _Source] = {}

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                shape = (item.shape or ())[:: -1 if "MATLAB_class" in item.attrs else 1]
                for field in item.dtype.names or ("",):
                    read = partial(self._dataset, item, name, field)
                    found[f"{name}/{field}" if field else name] = _Source(read, shape, _unit(item.attrs))

        stack.enter_context(h5py.File(self.path, "r", locking=False)).visititems(visit)
        return found

    def _dataset(self, item: Any, name: str, field: str) -> NDArray:
        """Numbers or texts of a dataset."""
        import h5py

        kind = item.dtype
        if item.is_virtual or item.external:
            remedy = "repack it into one file (h5repack)"
            raise self.refusal(f"the data of '{name}' lie in other files", remedy, name)
        text = h5py.check_string_dtype(kind) is not None
        check_unpacked(self.path, int(item.size) * (max(kind.itemsize, 64) if text else kind.itemsize))
        if text:
            return np.asarray(item.asstr(errors="replace")[...], dtype=str)
        if kind.hasobject or item.attrs.get("MATLAB_class") in (b"char", b"cell", "char", "cell"):
            remedy = "store numbers in a plain dataset"
            raise self.refusal(f"'{name}' holds objects, references or text of MATLAB v7.3", remedy, name)
        values = np.asarray(item[field] if field else item[...])
        return values.T if "MATLAB_class" in item.attrs else values  # stored column by column


# -- MATLAB --------------------------------------------------------------------------------------------

_MAX_STRUCTS = 4
"""Most structs inside each other."""


class Mat(Hdf5):
    """The named variables: ``name``, ``struct.field``, or ``name(:,2)`` for a column of a matrix."""

    name, remedy = "MATLAB", "save it again with -v7 or -v7.3"

    def sources(self, stack: ExitStack) -> dict[str, _Source]:
        """The wanted variables, or all if one is not there; in place of a struct its fields."""
        with open_regular(self.path) as stream:
            head = stream.read(520)
        if _HDF5_MARK in (head[:8], head[512:520]):
            return super().sources(stack)
        from scipy.io import loadmat, whosmat

        shapes = {name: shape for name, shape, _ in whosmat(self.path)}
        names = {_split_name(name)[0].split(".")[0] for name in self.wanted}
        names = names if names <= {*shapes} else {*shapes}
        for name in names:
            check_unpacked(self.path, 8 * math.prod(shapes[name]))
        variables = loadmat(self.path, variable_names=names, chars_as_strings=True, struct_as_record=True)
        parts = (part for name in shapes if name in names for part in _below(name, variables.get(name), 0))
        return {name: _Source(item.view, item.shape) for name, item in parts}


def _below(name: str, item: object, depth: int) -> Iterator[tuple[str, NDArray]]:
    """The arrays of a variable by name: itself, or those in a struct."""
    if not isinstance(item, np.ndarray):
        return
    if item.dtype.names is None:
        yield name, item
    elif item.size == 1 and depth < _MAX_STRUCTS:
        for field in item.dtype.names:
            yield from _below(f"{name}.{field}", item[field].reshape(-1)[0], depth + 1)


# -- TDMS ----------------------------------------------------------------------------------------------


class Tdms(Container):
    """The named channels: ``channel`` if only one group has it, else ``group/channel``.

    The channels of a waveform state the interval between samples; no channel holds the time. It is ``waveform time``.
    """

    name, remedy = "TDMS", "was the logger stopped? copy it again"

    def matching(self, name: str) -> list[str]:
        """Channels with this name, with or without that of their group."""
        return [one for one in self._sources if name in (one, one.partition("/")[2])]

    def sources(self, stack: ExitStack) -> dict[str, _Source]:
        """The channels, and the times of the groups whose channels are one waveform."""
        import nptdms

        stream = stack.enter_context(open_regular(self.path))
        source = stack.enter_context(nptdms.TdmsFile.open(stream))
        found: dict[str, _Source] = {}
        for group in source.groups():
            waveforms = set()
            for one in group.channels():
                found[f"{group.name}/{one.name}"] = _Source(
                    partial(self._samples, one), (len(one),), _unit(one.properties)
                )
                start, step = (
                    float(one.properties.get(key, 0.0)) for key in ("wf_start_offset", "wf_increment")
                )
                waveforms.add((start, step, len(one)))
            if len(waveforms) == 1 and (waveform := waveforms.pop())[1] > 0.0:
                found[f"{group.name}/waveform time"] = _Source(
                    partial(self._times, *waveform), (waveform[2],), "s"
                )
        return found

    def _samples(self, channel: Any) -> NDArray:
        check_unpacked(self.path, 8 * len(channel))
        return np.asarray(channel[:])

    def _times(self, start: float, step: float, count: int) -> NDArray:
        check_unpacked(self.path, 8 * count)
        return start + step * np.arange(count)


# -- XLSX ----------------------------------------------------------------------------------------------

_ODD_SIGNS = re.compile(r'[\t\r\n"]')
"""What would end a cell or a line of text."""


class Sheet:
    """A sheet as lines of text, a tab between the cells: it is read as a text file is. Dates become seconds.

    ``sheet`` is its name; None: the only one.
    """

    encoding, cut = "utf-8", False

    def __init__(self, path: Path, sheet: str | None = None) -> None:
        self.path = path
        self._first_day: datetime | None = None
        if path.with_name(f"~${path.name}").exists():
            raise refusal(path, "is open in a spreadsheet program", "close it there, then try again")
        with _library(path, "XLSX", "save it again as .xlsx, without a password"):
            cells = list(self._rows(sheet))
            dates = [(j, cell) for row in cells for j, cell in enumerate(row) if isinstance(cell, datetime)]
            if dates:  # a date above the table is not that of the rows
                column = Counter(j for j, _ in dates).most_common(1)[0][0]
                self._first_day = _midnight(next(cell for j, cell in dates if j == column))
            rows = [[self._text(cell) for cell in row] for row in cells]
        width = max(map(len, rows), default=0)
        lines = ("\t".join([*row, *[""] * (width - len(row))]) if any(row) else "" for row in rows)
        self.head = "".join(f"{line}\n" for line in lines).encode()

    def pieces(self, skip: int) -> Iterator[bytes]:
        """All lines, without the first ``skip``."""
        yield b"".join(self.head.splitlines(keepends=True)[skip:])

    def _rows(self, name: str | None) -> Iterator[tuple[Any, ...]]:
        import openpyxl

        with open_regular(self.path) as stream:
            with zipfile.ZipFile(stream) as container:  # no part exceeds the size that it declares
                check_unpacked(self.path, sum(part.file_size for part in container.infolist()))
            stream.seek(0)
            book = openpyxl.load_workbook(stream, read_only=True, data_only=True, keep_links=False)
            sheets = {sheet.title: sheet for sheet in book.worksheets}
            listed = ", ".join(f"'{title}'" for title in list(sheets)[:20])
            fixes = [Fix("data", "sheet", title) for title in sheets]
            if name is None and len(sheets) > 1:
                words, remedy = (
                    f"there are {len(sheets)} sheets: {listed}",
                    "add [data] sheet = '...' with one of them",
                )
                raise refusal(self.path, words, remedy, fixes=fixes)
            if not sheets or (name is not None and name not in sheets):
                words = f"no sheet '{name}'; the sheets are: {listed}"
                raise refusal(self.path, words, "correct [data] sheet", fixes=fixes)
            sheet = sheets[name] if name is not None else next(iter(sheets.values()))
            sheet.reset_dimensions()
            yield from sheet.iter_rows(values_only=True)

    def _text(self, cell: Any) -> str:
        """A cell as text. Times are seconds since the midnight before the first date, or of a time of day or duration."""
        if isinstance(cell, str) and ":" in cell:
            with suppress(ValueError):  # a date and a time as text
                cell = datetime.fromisoformat(cell.strip())
        if isinstance(cell, datetime):
            self._first_day = self._first_day or _midnight(cell)
            cell -= self._first_day
        elif isinstance(cell, time):
            cell = timedelta(
                hours=cell.hour, minutes=cell.minute, seconds=cell.second, microseconds=cell.microsecond
            )
        cell = cell.total_seconds() if isinstance(cell, timedelta) else cell
        return _ODD_SIGNS.sub(" ", _label_text(cell))


def _midnight(moment: datetime) -> datetime:
    return moment.replace(hour=0, minute=0, second=0, microsecond=0)


CONTAINERS: dict[str, type[Container]] = {
    ".h5": Hdf5, ".hdf5": Hdf5, ".hdf": Hdf5, ".mat": Mat, ".tdms": Tdms,
}  # fmt: skip
"""Readers of containers by the ending of the file name."""
TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".lvm", ".asc", ".dat", ".log", ".prn", ".xlsx")
"""Endings of separated text. ``.lvm`` is written by LabVIEW. A sheet is read as text."""


def columns_stream(
    path: Path, numeric: tuple[str, ...], segment: str | None = None, options: TextOptions | None = None
) -> RecordStream:
    """Open the number columns ``numeric`` and the segment column of a data file; ``options`` are those of text and sheets."""
    kind, options = file_kind(path), options or TextOptions()
    if kind == ".xlsx":
        options = replace(options, separator="\t", decimal=".")
        return TextStream(path, numeric, segment, options, Sheet(path, options.sheet))
    if kind in TEXT_SUFFIXES:
        return TextStream(path, numeric, segment, options)
    if kind in (".parquet", ".pq"):
        return ParquetStream(path, numeric, segment)
    if kind in CONTAINERS:
        return CONTAINERS[kind](path, numeric, segment)
    remedy = f"give .csv, .csv.gz, .xlsx, .parquet or one of {', '.join(CONTAINERS)}"
    if kind in (".xls", ".xlsm", ".xlsb", ".ods"):
        remedy = "open it in the spreadsheet program and save it as .xlsx or .csv"
    raise DataError(f"{path}: piga does not read files of kind '{kind}'", remedy=remedy)


def file_kind(path: Path) -> str:
    """The ending that identifies the format of a file; ``.gz`` is skipped."""
    suffixes = ["", *(suffix.lower() for suffix in path.suffixes)]
    return suffixes[-2] if suffixes[-1] == ".gz" and len(suffixes) > 2 else suffixes[-1]
