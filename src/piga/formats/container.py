"""Open a data file of any format. HDF5, MATLAB and TDMS are read whole: a table of the wanted columns, of limited size.

A sheet (XLSX) is turned into lines of text and read as a text file is.

HDF5 data, including MATLAB v7.3, are read only from the file itself and with built-in filters. No plug-in is ever loaded.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import datetime, time, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

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
from piga.formats.text.convention import HeadRows, joined_names, units_in_names
from piga.formats.text.reader import TextStream
from piga.tables import Column, arrow_table
from piga.text_files import check_unpacked, first_line, open_regular

_COLUMN_OF = re.compile(r"^(.*)\(:,\s*(\d+)\)$")


def split_name(name: str) -> tuple[str, int | None]:
    """``f(:,2)`` is column 2 (counted from 1, as MATLAB does) of the matrix ``f``."""
    match = _COLUMN_OF.match(name)
    return (match.group(1), int(match.group(2))) if match else (name, None)


def matrix_columns(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names of the columns of an array: its own, or ``f(:,1)`` and so on for a matrix with few columns."""
    if len(shape) == 2 and 1 < shape[1] <= MOST_LISTED and shape[0] > 1:
        return [f"{name}(:,{k + 1})" for k in range(shape[1])]
    return [name]


def label_text(value: object) -> str:
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
    except MemoryError:
        words = "there is not enough memory to read it"
        raise refusal(path, words, "the file is damaged, or export it as Parquet") from None
    except Exception as error:  # a damaged file can raise any exception in the library
        raise refusal(path, f"not a readable {name} file ({first_line(error)})", remedy) from None


class Container(TableStream):
    """The named columns of a file that is read whole.

    A format has a ``name`` and a ``remedy`` for a damaged file. Its :meth:`read` opens the file and gives the columns to
    :meth:`take`.
    """

    name = remedy = ""

    def __init__(self, path: Path, numeric: Iterable[str], label: str | None = None) -> None:
        RecordStream.__init__(self, path, numeric, label)
        open_regular(path, "the file; [data] file is relative to the run file").close()
        with _library(path, self.name, self.remedy):
            self.read()

    def read(self) -> None:
        """Read the file."""
        raise NotImplementedError

    def refusal(self, words: str, remedy: str, *columns: str) -> DataError:
        """The error of the file."""
        return refusal(self.path, words, remedy, *columns)

    def vector(self, name: str, values: NDArray) -> NDArray:
        """The column ``name`` of an array: the array itself if it is a vector, or one column of a matrix."""
        plain, column = split_name(name)
        if values.ndim == 2 and column is not None:
            if 1 <= column <= values.shape[1]:
                return values[:, column - 1]
            words = f"column '{name}': the matrix has {values.shape[1]} columns"
            raise self.refusal(words, "columns count from 1", name)
        flat = values.reshape(-1) if values.ndim == 2 and 1 in values.shape else values
        if flat.ndim != 1 or column is not None:
            words = f"'{name}' has the shape {values.shape}, a column is needed"
            raise self.refusal(words, f"name a column of a matrix as '{plain}(:,1)'", name)
        return flat

    def take(self, column: Callable[[str], NDArray], units: Mapping[str, str]) -> None:
        """Read the columns; ``column`` reads one."""
        columns, first = dict[str, Column](), self.wanted[0]
        for name in self.wanted:
            values = column(name)
            if name not in self.numeric:
                values = np.array([label_text(value) for value in values.tolist()], object)
            elif values.dtype.kind not in "iuf" or values.dtype.itemsize > 8:
                words = f"column '{name}' holds {values.dtype.name}, not numbers"
                raise self.refusal(words, REMEDIES[1], name)
            values = values.astype(values.dtype.newbyteorder("="), copy=False)
            columns[name] = Column(values, units.get(name, ""))
            if values.size != columns[first].values.size:
                words = (
                    f"column '{name}' has {values.size} rows, column '{first}' has {columns[first].values.size}"
                )
                raise self.refusal(words, "export columns that were sampled together", name, first)
        if columns[first].values.size == 0:
            raise self.refusal("no data row", "check that the logger wrote data")
        TableStream.__init__(self, self.path, arrow_table(columns), self.numeric, self.label)


# -- HDF5 ----------------------------------------------------------------------------------------------

_HDF5_MARK = b"\x89HDF\r\n\x1a\n"
_PLAIN_FILTERS = {1: "gzip", 2: "shuffle", 3: "fletcher32"}
"""Filters built into the HDF5 library."""
_MAX_NAMES, _MAX_LEVELS = 200, 8
"""Most names that are listed, and most groups inside each other of which they are listed."""
_MAX_CELL = 4096
"""Most characters of one text cell."""
_UNIT_KEYS = ("unit", "units", "Unit", "Units", "unit_string", "NI_UnitDescription")
"""Attributes of an HDF5 dataset or a TDMS channel that state its unit."""


def _unit(attributes: Any) -> str:
    return next((_text(attributes[key]) for key in _UNIT_KEYS if key in attributes), "")


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else ""


def _class(item: Any) -> str:
    return _text(item.attrs.get("MATLAB_class"))


class Hdf5(Container):
    """The named datasets: ``name`` or ``group/name``, ``name(:,2)`` of a matrix, ``name/field`` of a table."""

    name, remedy = "HDF5", "was it closed by the logger? copy or export it again"

    def read(self) -> None:
        """Read the datasets."""
        import h5py

        with h5py.File(self.path, "r", locking=False) as self._source:
            self.take(self._dataset, {name: _unit(self._find(name)[0].attrs) for name in self.numeric})

    def _dataset(self, name: str) -> NDArray:
        """One column of a dataset: numbers or texts (n,)."""
        import h5py

        item, field = self._find(name)
        plain, kind, matlab = split_name(name)[0], item.dtype, _class(item)
        self._check_storage(item, plain)
        text = h5py.check_string_dtype(kind) is not None
        check_unpacked(self.path, int(item.size) * (max(kind.itemsize, 64) if text else kind.itemsize))
        if text:
            return self.vector(name, np.asarray(item.asstr(errors="replace")[...], dtype=str))
        if matlab == "cell" and h5py.check_ref_dtype(kind) is h5py.Reference:
            cells = enumerate(item[...].T.reshape(-1), 1)
            return self.vector(name, np.array([self._cell(plain, *cell) for cell in cells], dtype=str))
        if kind.hasobject:
            remedy = "store numbers or text in a plain dataset"
            raise self.refusal(f"'{plain}' holds objects or references", remedy, name)
        values = np.asarray(item[field] if field else item[...])
        if matlab:  # stored column by column
            values = _characters(values) if matlab == "char" else values.T
        return self.vector(name, values)

    def _cell(self, name: str, number: int, reference: Any) -> str:
        """A cell of a MATLAB cell array, text or a single number: a reference to an object of the same file."""
        import h5py

        cell = self._source[reference] if reference else None
        if not isinstance(cell, h5py.Dataset) or cell.dtype.kind not in "uif" or cell.size > _MAX_CELL:
            words = f"'{name}', cell {number} holds no text and no number"
            raise self.refusal(words, "store one label for each sample", name)
        self._check_storage(cell, name)
        values = np.asarray(cell[...])
        if cell.attrs.get("MATLAB_empty") or values.size == 0:
            return ""
        if _class(cell) == "char":
            return "".join(_characters(values))
        return label_text(values.reshape(-1)[0].item())

    def _find(self, name: str) -> tuple[Any, str | None]:
        """Find a dataset by name, only through hard links, and the field of a compound dataset."""
        import h5py

        plain = split_name(name)[0]
        for path in (plain.strip("/"), plain.replace(".", "/")):
            item, field = self._source, None
            for part in path.split("/"):
                link = item.get(part, getlink=True) if isinstance(item, h5py.Group) else None
                if link is not None and not isinstance(link, h5py.HardLink):
                    words = (
                        f"'{part}' is a link to another place ({type(link).__name__}), which is not followed"
                    )
                    raise self.refusal(words, "copy the dataset into the file (h5repack or h5copy)", name)
                if link is not None:
                    item = item[part]
                elif isinstance(item, h5py.Dataset) and field is None:
                    field = part
                else:
                    item = None
            if isinstance(item, h5py.Dataset) and field in (item.dtype.names or (None,)):
                return item, field
        raise no_column(self.path, plain, self._names())

    def _names(self) -> list[str]:
        """Names of the datasets of the file itself, up to a limit. Links are not followed."""
        import h5py

        names: list[str] = []

        def visit(name: str, item: Any) -> bool | None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#") and name.count("/") <= _MAX_LEVELS:
                shape = item.shape[::-1] if _class(item) else item.shape
                fields = [f"{name}/{part}" for part in item.dtype.names or ()]
                names.extend(fields or matrix_columns(name, shape or ()))
            return len(names) >= _MAX_NAMES or None

        self._source.visititems(visit)
        return names

    def _check_storage(self, item: Any, name: str) -> None:
        if item.is_virtual or item.external:
            remedy = "repack it into one file (h5repack)"
            raise self.refusal(f"the data of '{name}' lie in other files", remedy, name)
        plan = item.id.get_create_plist()
        strange = {plan.get_filter(index)[0] for index in range(plan.get_nfilters())} - set(_PLAIN_FILTERS)
        if strange:
            plain = ", ".join(_PLAIN_FILTERS.values())
            words = f"'{name}' is packed with filter {min(strange)}; only {plain} are read"
            raise self.refusal(words, "repack it: h5repack -f GZIP=4", name)


def _characters(values: NDArray) -> NDArray:
    """Rows of a MATLAB char array as text: UTF-16 units, stored column by column, padded with blanks."""
    rows = np.atleast_2d(values.T).astype("<u2")
    return np.array([row.tobytes().decode("utf-16-le", errors="replace").rstrip(" \0") for row in rows])


# -- MATLAB --------------------------------------------------------------------------------------------

_MAX_STRUCTS = 4
"""Most structs inside each other."""


class Mat(Hdf5):
    """The named variables: ``name``, ``struct.field``, or ``name(:,2)`` for a column of a matrix."""

    name, remedy = "MATLAB", "save it again with -v7 or -v7.3"

    def read(self) -> None:
        """Read the variables."""
        with open_regular(self.path) as stream:
            head = stream.read(520)
        if _HDF5_MARK in (head[:8], head[512:520]):
            super().read()
            return
        self._read = self._variables([split_name(name)[0].split(".")[0] for name in self.wanted])
        self.take(self._variable, {})

    def _variables(self, names: list[str] | None) -> dict[str, Any]:
        """The named variables (None: all). A variable that is there and not named is None."""
        from scipy.io import loadmat, whosmat

        shapes = {name: shape for name, shape, _ in whosmat(self.path)}
        for name in shapes if names is None else set(names) & set(shapes):
            check_unpacked(self.path, 8 * math.prod(shapes[name]))
        variables = loadmat(self.path, variable_names=names, chars_as_strings=True, struct_as_record=True)
        return {name: variables.get(name) for name in shapes}

    def _variable(self, name: str) -> NDArray:
        first, *fields = split_name(name)[0].split(".")
        item = self._read.get(first)
        for field in fields[:_MAX_STRUCTS]:
            item = _fields(item).get(field)
        if not isinstance(item, np.ndarray) or item.dtype.names:
            everything = self._variables(None).items()
            raise no_column(self.path, name, [one for part in everything for one in _names_below(*part, 0)])
        return self.vector(name, item)


def _fields(item: object) -> dict[str, Any]:
    if not isinstance(item, np.ndarray) or item.size != 1:
        return {}
    return {field: item[field].reshape(-1)[0] for field in item.dtype.names or ()}


def _names_below(name: str, item: object, depth: int) -> list[str]:
    """Names of all columns of a variable: itself, columns of a matrix, and these in structs."""
    fields = _fields(item) if depth < _MAX_STRUCTS else {}
    if fields:
        below = ((f"{name}.{field}", part) for field, part in fields.items())
        return [one for path, part in below for one in _names_below(path, part, depth + 1)]
    return matrix_columns(name, item.shape) if isinstance(item, np.ndarray) else [name]


# -- TDMS ----------------------------------------------------------------------------------------------

_WAVEFORM_TIME = "waveform time"
"""Name of the time of a waveform: its channels state the interval between samples, and no channel holds the time."""


class Tdms(Container):
    """The named channels: ``channel`` if only one group has it, else ``group/channel``."""

    name, remedy = "TDMS", "was the logger stopped? copy it again"

    def read(self) -> None:
        """Read the channels."""
        import nptdms

        with open_regular(self.path) as stream, nptdms.TdmsFile.open(stream) as source:
            channels = [channel for group in source.groups() for channel in group.channels()]
            self._columns = {f"{one.group_name}/{one.name}": one for one in channels} | _times(channels)
            columns = [(name, self._find(name)) for name in self.numeric]
            units = {name: "s" if isinstance(one, tuple) else _unit(one.properties) for name, one in columns}
            self.take(self._samples, units)

    def _find(self, name: str) -> Any:
        """The channel of this name, or start, interval and length of a waveform."""
        short = {one: getattr(column, "name", _WAVEFORM_TIME) for one, column in self._columns.items()}
        matching = [one for one in short if name in (one, short[one])]
        if not matching:
            raise no_column(self.path, name, list(self._columns))
        if len(matching) > 1:
            remedy = f"name it as one of {', '.join(map(repr, matching[:5]))}"
            raise self.refusal(f"several groups have a channel '{name}'", remedy, name)
        return self._columns[matching[0]]

    def _samples(self, name: str) -> NDArray:
        column = self._find(name)
        if isinstance(column, tuple):
            start, step, count = column
            check_unpacked(self.path, 8 * count)
            return start + step * np.arange(count)
        check_unpacked(self.path, 8 * len(column))
        return np.asarray(column[:])


def _times(channels: list[Any]) -> dict[str, tuple[float, float, int]]:
    """Start [s], interval [s] and length of the waveforms, by name. A group whose channels differ has none."""
    groups: dict[str, set[tuple[float, float, int]]] = {}
    for channel in channels:
        step, start = (float(channel.properties.get(key, 0.0)) for key in ("wf_increment", "wf_start_offset"))
        groups.setdefault(channel.group_name, set()).add((start, step, len(channel)))
    same = {group: min(one) for group, one in groups.items() if len(one) == 1 and min(one)[1] > 0.0}
    return {f"{group}/{_WAVEFORM_TIME}": one for group, one in same.items()}


# -- XLSX ----------------------------------------------------------------------------------------------

_MOST_HEAD = 100
"""Rows of a sheet within which the column names must stand."""
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
            rows = [[self._text(cell) for cell in row] for row in self._rows(sheet)]
        width = max(map(len, rows), default=0)
        lines = ("\t".join([*row, *[""] * (width - len(row))]) if any(row) else "" for row in rows)
        self.head = "".join(f"{line}\n" for line in lines).encode()

    def pieces(self, skip: int) -> Iterator[bytes]:
        """All lines, without the first ``skip``."""
        yield b"".join(self.head.splitlines(keepends=True)[skip:])

    def names_row(self, wanted: Iterable[str]) -> int | tuple[int, int] | None:
        """The first row that holds all wanted names, counted from 1, or the two rows over which these stand; None without one."""
        single = [tuple(line.split("\t")) for line in self.head.decode().split("\n")[:_MOST_HEAD]]
        for at, names in enumerate(single, 1):
            if {*wanted} <= {*names, *units_in_names(names)[0]}:
                return at
        for at, names in enumerate((joined_names(above, names) for above, names in pairwise(single)), 1):
            if {*wanted} <= {*names, *units_in_names(names)[0]}:
                return at, at + 1
        return None

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
            self._first_day = self._first_day or cell.replace(hour=0, minute=0, second=0, microsecond=0)
            cell -= self._first_day
        elif isinstance(cell, time):
            cell = timedelta(
                hours=cell.hour, minutes=cell.minute, seconds=cell.second, microseconds=cell.microsecond
            )
        cell = cell.total_seconds() if isinstance(cell, timedelta) else cell
        return _ODD_SIGNS.sub(" ", label_text(cell))


CONTAINERS: dict[str, type[Container]] = {
    ".h5": Hdf5, ".hdf5": Hdf5, ".hdf": Hdf5, ".mat": Mat, ".tdms": Tdms,
}  # fmt: skip
"""Readers of containers by the ending of the file name."""
TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".lvm", ".asc", ".dat", ".log", ".prn", ".xlsx")
"""Endings of separated text. ``.lvm`` is written by LabVIEW. A sheet is read as text."""


def columns_stream(
    path: Path,
    numeric: tuple[str, ...],
    segment: str | None = None,
    sheet: str | None = None,
    rows: HeadRows | None = None,
    **text: Any,
) -> RecordStream:
    """Open the number columns ``numeric`` and the segment column of a data file.

    ``sheet`` names the sheet of a spreadsheet. ``rows`` and ``text`` are options of
    :class:`piga.formats.text.reader.TextStream`.
    """
    kind, rows = file_kind(path), rows or HeadRows()
    if kind == ".xlsx":
        source = Sheet(path, sheet)
        if rows.header is None:
            rows = replace(rows, header=source.names_row([*numeric, *([segment] if segment else [])]))
        text |= {"separator": "\t", "decimal": "."}
        return TextStream(path, numeric, segment, rows=rows, source=source, **text)
    if kind in TEXT_SUFFIXES:
        return TextStream(path, numeric, segment, rows=rows, **text)
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
