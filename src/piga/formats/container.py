"""Open a data file of any format. HDF5, MATLAB, TDMS and XLSX are read whole: a table of the wanted columns, of limited size.

HDF5 data, including MATLAB v7.3, are read only from the file itself and with built-in filters. No plug-in is ever loaded.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
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
    column_letter,
    no_column,
    refusal,
)
from piga.formats.text.convention import (
    INFINITE,
    MISSING,
    NO_UNIT,
    check_present,
    is_units_row,
    joined_names,
    single_names,
    unit_text,
    units_in_names,
)
from piga.formats.text.reader import Fault, Faults, TextStream, missing_hint
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


class Container(TableStream):
    """The named columns of a file that is read whole.

    A format has a ``name`` and a ``remedy`` for a damaged file. Its :meth:`read` opens the file and gives the columns to
    :meth:`take`. ``sheet`` and ``missing`` are for spreadsheets: name of the sheet, and words that mean a missing value.
    """

    name = remedy = ""

    def __init__(
        self,
        path: Path,
        numeric: Iterable[str],
        label: str | None = None,
        sheet: str | None = None,
        missing: tuple[str, ...] = (),
    ) -> None:
        RecordStream.__init__(self, path, numeric, label)
        self.sheet, self.missing = sheet, missing
        open_regular(path, "the file; [data] file is relative to the run file").close()
        try:
            self.read()
        except PigaError:
            raise
        except ImportError as error:
            extra = EXTRAS[str(error.name).split(".")[0]]
            words = f"reading {self.name} needs the extra '{extra}', which is not installed"
            raise self.refusal(words, f"install it with: {install_command(extra)}") from None
        except MemoryError:
            remedy = "the file is damaged, or export it as Parquet"
            raise self.refusal("there is not enough memory to read it", remedy) from None
        except Exception as error:  # a damaged file can raise any exception in the library
            words = f"not a readable {self.name} file ({first_line(error)})"
            raise self.refusal(words, self.remedy) from None

    def read(self) -> None:
        """Read the file."""
        raise NotImplementedError

    def refusal(
        self, words: str, remedy: str, *columns: str, row: int | None = None, fixes: Sequence[Fix] = ()
    ) -> DataError:
        """The error of the file: :func:`refusal`."""
        return refusal(self.path, words, remedy, *columns, row=row, fixes=fixes)

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
_Row = tuple[int, tuple[Any, ...]]
"""Number and cells of a row."""


class Xlsx(Container):
    """The named columns of a sheet. The names stand in the first row that holds all of them. Dates become seconds."""

    name, remedy = "XLSX", "save it again as .xlsx, without a password"

    def read(self) -> None:
        """Read the sheet."""
        if self.path.with_name(f"~${self.path.name}").exists():
            raise self.refusal("is open in a spreadsheet program", "close it there, then try again")
        import openpyxl

        with open_regular(self.path) as stream:
            with zipfile.ZipFile(stream) as container:  # no part exceeds the size that it declares
                check_unpacked(self.path, sum(part.file_size for part in container.infolist()))
            stream.seek(0)
            book = openpyxl.load_workbook(stream, read_only=True, data_only=True, keep_links=False)
            rows = enumerate(self._sheet(book).iter_rows(values_only=True), 1)
            self._read_rows([(at, row) for at, row in rows if any(cell is not None for cell in row)])

    def _sheet(self, book: Any) -> Any:
        sheets, name = {sheet.title: sheet for sheet in book.worksheets}, self.sheet
        listed = ", ".join(f"'{title}'" for title in list(sheets)[:20])
        fixes = [Fix("data", "sheet", title) for title in sheets]
        if name is None and len(sheets) > 1:
            remedy = "add [data] sheet = '...' with one of them"
            raise self.refusal(f"there are {len(sheets)} sheets: {listed}", remedy, fixes=fixes)
        if not sheets or (name is not None and name not in sheets):
            words = f"no sheet '{name}'; the sheets are: {listed}"
            raise self.refusal(words, "correct [data] sheet", fixes=fixes)
        sheet = sheets[name] if name is not None else next(iter(sheets.values()))
        sheet.reset_dimensions()
        return sheet

    def _read_rows(self, rows: list[_Row]) -> None:
        """The columns of the rows of a sheet. Bad cells are collected and reported together."""
        if not rows:
            raise self.refusal("the sheet is empty", "check [data] sheet")
        place, header = self._header(rows[:_MOST_HEAD])
        at, row = rows[place]
        if all(not isinstance(cell, str) for cell in row if cell is not None):
            remedy = "add a row with the column names above the numbers"
            raise self.refusal("the first row holds numbers, not column names", remedy, row=at)
        names, units = units_in_names(single_names(header))
        check_present(self.path, at, self.wanted, names)
        following = [[*_texts(row)] for _, row in rows[place + 1 : place + 3]]
        body = rows[place + 1 :]
        if following and is_units_row(following[0], *following[1:]):
            body, written = body[1:], zip(names, map(unit_text, following[0]), strict=False)
            units |= {name: unit for name, unit in written if name and unit not in NO_UNIT}
        columns = self._cells(body, {name: names.index(name) for name in self.wanted})
        if not body:
            raise self.refusal("a header but no data", "check that the logger wrote data")
        self.take(columns.__getitem__, units)
        self.rows = np.array([number for number, _ in body])
        for name in self.numeric:  # an empty cell is a missing value
            empty = np.flatnonzero(np.isnan(columns[name]))
            if empty.size:
                self._missing[name] = empty.size, int(self.rows[empty[0]])

    def _cells(self, body: list[_Row], places: dict[str, int]) -> dict[str, Any]:
        cells, faults = _Cells({*MISSING, *INFINITE, *self.missing}), Faults()
        columns: dict[str, list[Any]] = {name: [] for name in places}
        for number, row in body:
            for name, place in places.items():
                value = row[place] if place < len(row) else None
                value = cells.number(value) if name in self.numeric else value
                if isinstance(value, Fault):
                    where = f"row {number}, column '{name}' ({column_letter(place)}): "
                    faults.add(number, value._replace(words=where + value.words, column=name))
                columns[name].append(value)
        if faults.total:
            remedy = "set the format of these cells to number and enter them again; dates: export seconds"
            raise faults.error(self.path, remedy)
        return {
            name: np.array(cells, float if name in self.numeric else object) for name, cells in columns.items()
        }

    def _header(self, head: list[_Row]) -> tuple[int, tuple[str, ...]]:
        """Index of the row of the column names, and the names: the first row, or two rows, that hold all wanted names.

        Else the row that looks most like it.
        """
        single = [_texts(row) for _, row in head]
        double = [joined_names(above, names) for above, names in pairwise(single)]
        for place, names in (*enumerate(single), *enumerate(double, 1)):
            if set(self.wanted) <= {*names, *units_in_names(names)[0]}:
                return place, names
        words = [sum(isinstance(cell, str) for cell in row) for _, row in head]
        numbers = [sum(isinstance(cell, (int, float)) for cell in row) for _, row in head]
        begin = next((k for k, count in enumerate(numbers) if count > 1), 0)
        wide = [k for k in range(begin) if words[k] > 1 and 2 * words[k] >= max(words[:begin])]
        if len(wide) > 1 and is_units_row([*single[wide[-1]]], [*single[begin]]):
            wide.pop()
        place = wide[-1] if wide else 0
        names = single[place]
        each = words[place - 1] == len(single[place - 1]) == len(names)
        if place - 1 in wide and (len(set(names)) < len(names) or "" in names or each):  # names over two rows
            return place, double[place - 1]
        return place, names


def _texts(row: tuple[Any, ...]) -> tuple[str, ...]:
    return tuple("" if cell is None else str(cell).strip() for cell in row)


class _Cells:
    """Converts cells to numbers. Times are seconds since the midnight before the first date, or of a time of day or duration."""

    def __init__(self, empty: set[str]) -> None:
        self._empty = empty
        self._first_day: datetime | None = None

    def number(self, cell: Any) -> float | Fault:
        """The number, nan for an empty cell, or the fault of the cell."""
        if isinstance(cell, (int, float)) and not isinstance(cell, bool):
            return float(cell)
        if isinstance(cell, (datetime, time, timedelta)):
            return self._seconds(cell)
        text = "" if cell is None else str(cell).strip()
        if cell is None or (isinstance(cell, str) and text in self._empty):
            return float("nan")
        with suppress(ValueError):  # a date and a time as text
            return self._seconds(datetime.fromisoformat(text if ":" in text else ""))
        word = isinstance(cell, str)
        words = f"'{text[:40]}' is {'text' if word else type(cell).__name__}, not a number"
        hint, fixes = missing_hint(text) if word and not text[0].isdigit() else ("", ())
        return Fault("not-a-number", words, hint, fixes)

    def _seconds(self, cell: datetime | time | timedelta) -> float:
        if isinstance(cell, timedelta):
            return cell.total_seconds()
        if isinstance(cell, time):
            return cell.hour * 3600.0 + cell.minute * 60.0 + cell.second + cell.microsecond * 1e-6
        if self._first_day is None:
            self._first_day = cell.replace(hour=0, minute=0, second=0, microsecond=0)
        return (cell - self._first_day).total_seconds()


CONTAINERS: dict[str, type[Container]] = {
    ".h5": Hdf5, ".hdf5": Hdf5, ".hdf": Hdf5, ".mat": Mat, ".tdms": Tdms, ".xlsx": Xlsx,
}  # fmt: skip
"""Readers of containers by the ending of the file name."""
TEXT_SUFFIXES = (".csv", ".txt", ".tsv", ".lvm", ".asc", ".dat", ".log", ".prn")
"""Endings of separated text. ``.lvm`` is written by LabVIEW."""


def columns_stream(
    path: Path,
    numeric: tuple[str, ...],
    segment: str | None = None,
    sheet: str | None = None,
    missing: tuple[str, ...] = (),
    **text: Any,
) -> RecordStream:
    """Open the number columns ``numeric`` and the segment column of a data file.

    ``sheet`` names the sheet of a spreadsheet, ``missing`` further words that mean a missing value. ``text`` holds options of
    :class:`piga.formats.text.reader.TextStream`.
    """
    kind = file_kind(path)
    if kind in TEXT_SUFFIXES:
        return TextStream(path, numeric, segment, missing=missing, **text)
    if kind in (".parquet", ".pq"):
        return ParquetStream(path, numeric, segment)
    if kind in CONTAINERS:
        return CONTAINERS[kind](path, numeric, segment, sheet, missing)
    remedy = f"give .csv, .csv.gz, .parquet or one of {', '.join(CONTAINERS)}"
    if kind in (".xls", ".xlsm", ".xlsb", ".ods"):
        remedy = "open it in the spreadsheet program and save it as .xlsx or .csv"
    raise DataError(f"{path}: piga does not read files of kind '{kind}'", remedy=remedy)


def file_kind(path: Path) -> str:
    """The ending that identifies the format of a file; ``.gz`` is skipped."""
    suffixes = ["", *(suffix.lower() for suffix in path.suffixes)]
    return suffixes[-2] if suffixes[-1] == ".gz" and len(suffixes) > 2 else suffixes[-1]
