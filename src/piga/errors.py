"""Errors and warnings that users of piga see.

Every error message names what was wrong, where (file, row, column, argument) and how to go on.
The command line turns a :class:`PigaError` into one message on stderr and exit code 2.
"""

from __future__ import annotations

import copyreg
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

_MOST_MESSAGE = 20_000
"""Most characters of a message. A longer one quotes a text that is much longer than anything a person wrote: it is cut."""

_LONG_WORD = re.compile(r"(\S{60})\S{300,}")


@dataclass(frozen=True)
class Where:
    """Where the fault of an error is.

    Attributes
    ----------
    path:
        The file.
    row:
        The first faulty row, counted from 1 as an editor does; None if no row is at fault.
    columns:
        Names of the columns at fault, in the file or in the run file.
    """

    path: Path
    row: int | None = None
    columns: tuple[str, ...] = ()


@dataclass(frozen=True)
class Fix:
    """A key of the run file that resolves an error.

    ``value`` is the value to give it. None: the user, or a program that tries, must choose a value. Several fixes with the
    same key are alternatives.
    """

    table: str
    key: str
    value: Any = None


class PigaError(Exception):
    """Base of all errors caused by input that piga cannot use.

    Parameters
    ----------
    message:
        What is wrong, with file, row, column or argument, and the value met.
    remedy:
        What the user can do about it; appended to the message. Every error has one.
    where:
        File, row and columns of the fault, for programs. None if the error is not about a file.
    columns:
        The columns that the file has, where a wanted one is missing.
    fixes:
        Keys of the run file that resolve the error, the likeliest first.
    """

    def __init__(
        self,
        message: str,
        *,
        remedy: str,
        where: Where | None = None,
        columns: Sequence[str] = (),
        fixes: Sequence[Fix] = (),
    ) -> None:
        if len(message) > _MOST_MESSAGE:
            message = f"{message[: _MOST_MESSAGE // 2]} ... {message[-_MOST_MESSAGE // 10 :]}"
        message = _LONG_WORD.sub(r"\1...", message)
        self.message = message
        self.remedy = remedy
        self.where = where
        self.columns = tuple(columns)
        self.fixes = tuple(fixes)
        super().__init__(f"{message}\n  remedy: {remedy}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Errors pass from one process to another with all that they carry."""
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


class MissingPackageError(PigaError, ImportError):
    """A package that the small core leaves out is not installed; the message names the extra that brings it."""


class UnitError(PigaError):
    """A quantity has no unit, an unknown unit, or a unit of the wrong dimension."""


class ArgumentError(PigaError):
    """An argument of a library call has the wrong shape, type or range."""


class RunFileError(PigaError):
    """A run, scenario or plan file (TOML) is not valid."""


class DataError(PigaError):
    """A data file cannot be read as the run file says."""


class IdentifiabilityError(PigaError):
    """The record cannot tell the requested coefficients apart; ``terms`` names them."""

    def __init__(self, message: str, *, remedy: str, terms: tuple[str, ...] = ()) -> None:
        self.terms = terms
        super().__init__(message, remedy=remedy)


class CalibrationError(PigaError):
    """A calibration cannot be computed, read or applied."""


class StoreError(PigaError):
    """A store or an export of records cannot be opened, read, written or trusted."""


class CancelledError(PigaError):
    """A long call was stopped by its ``progress`` function. Nothing is half done."""


class PigaWarning(UserWarning):
    """Something was repaired, left out or assumed; the result says so too."""


class CalibrationWarning(PigaWarning):
    """A doubt about a calibration; its verdict says so too."""


EXTRAS = {
    "scipy": "lab",
    "pyarrow": "lab",
    "jinja2": "lab",
    "matplotlib": "report",
    "pandas": "notebook",
    "uncertainties": "notebook",
    "h5py": "hdf5",
    "nptdms": "tdms",
    "openpyxl": "xlsx",
    "sqlalchemy": "records",
    "psycopg": "postgres",
    "lxml": "certificate",
    "signxml": "certificate",
    "cryptography": "certificate",
    "distributed": "campaign",
    "starlette": "ui",
    "uvicorn": "ui",
    "tomlkit": "ui",
}
"""Extra of the distribution that brings a package which the core leaves out."""


def install_command(extra: str) -> str:
    """The command that installs an extra for the Python that runs."""
    return f"{sys.executable} -m pip install 'piga[{extra}]'"


def missing_package(package: str) -> MissingPackageError:
    """The error for a package of :data:`EXTRAS` that is not installed."""
    return MissingPackageError(
        f"this needs the package {package}, which the small core leaves out",
        remedy=install_command(EXTRAS[package]),
    )


def needed(package: str) -> Any:
    """A package of :data:`EXTRAS`, imported.

    Raises
    ------
    MissingPackageError
        If it is not installed.
    """
    try:
        return import_module(package)
    except ImportError:
        raise missing_package(package) from None
