"""Read HDF5, MATLAB and TDMS files whole: one table of the wanted columns. Their size is limited.

HDF5 data, including MATLAB v7.3, are read only from the file itself and with built-in filters. No plug-in is ever loaded.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.formats.columns import Container, label_text, matrix_columns, no_column, split_name
from piga.formats.xlsx import Xlsx
from piga.records.limits import check_unpacked, open_regular

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
    """Class of a MATLAB array in HDF5; empty for other data."""
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
        """Refuse data that lie in other files or need a plug-in."""
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
    """Fields of a struct by name; none of anything else."""
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


CONTAINERS: dict[str, type[Container]] = {
    ".h5": Hdf5,
    ".hdf5": Hdf5,
    ".hdf": Hdf5,
    ".mat": Mat,
    ".tdms": Tdms,
    ".xlsx": Xlsx,
}
"""Readers of containers by the ending of the file name."""
