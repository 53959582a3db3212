"""Read HDF5, MATLAB, TDMS and XLSX files whole: one table of the wanted columns. Their size is limited."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from piga.errors import EXTRAS, DataError, PigaError
from piga.formats.columns import RawTable
from piga.formats.hdf5 import read_hdf5
from piga.formats.mat import read_mat
from piga.formats.tdms import read_tdms
from piga.formats.xlsx import read_xlsx
from piga.records.limits import check_regular, extra_missing, first_line


class Container(NamedTuple):
    """A kind of file: its name, its reader, and what to do with a damaged file."""

    name: str
    read: Callable[[Path, tuple[str, ...], str | None], RawTable]
    remedy: str


_HDF5 = Container("HDF5", read_hdf5, "was it closed by the logger? copy or export it again")
CONTAINERS = {
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".hdf": _HDF5,
    ".mat": Container("MATLAB", read_mat, "save it again with -v7 or -v7.3"),
    ".tdms": Container("TDMS", read_tdms, "was the logger stopped? copy it again"),
    ".xlsx": Container("XLSX", read_xlsx, "save it again as .xlsx, without a password"),
}
"""Kinds of containers by the ending of the file name."""


def read_container(
    path: Path, kind: str, numeric: tuple[str, ...], label: str | None, sheet: str | None = None
) -> RawTable:
    """Read the named columns of a container.

    Parameters
    ----------
    path:
        The file.
    kind:
        One of :data:`CONTAINERS`.
    numeric, label:
        Names of the number columns and of the segment column, as the reader of that format takes them.
    sheet:
        Name of the sheet in an ``.xlsx`` file.

    Raises
    ------
    DataError
        If the file cannot be read as requested, or unpacks to more than is read.
    """
    container = CONTAINERS[kind]
    check_regular(path, "[data] file is relative to the run file")
    if kind == ".xlsx" and path.with_name(f"~${path.name}").exists():
        raise DataError(f"{path}: is open in a spreadsheet program", remedy="close it there, then try again")
    try:
        if kind == ".xlsx":
            return read_xlsx(path, numeric, label, sheet)
        return container.read(path, numeric, label)
    except PigaError:
        raise
    except ImportError as error:
        raise extra_missing(path, container.name, EXTRAS[str(error.name).split(".")[0]]) from None
    except MemoryError:
        raise DataError(
            f"{path}: there is not enough memory to read it",
            remedy="the file is damaged, or export it as Parquet",
        ) from None
    except Exception as error:  # a damaged file can raise any exception in the library
        raise DataError(
            f"{path}: not a readable {container.name} file ({first_line(error)})", remedy=container.remedy
        ) from None
