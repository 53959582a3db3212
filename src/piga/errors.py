"""Errors and warnings that users of piga see.

Every error message names what was wrong, where (file, row, column, argument) and how to go on.
The command line turns a :class:`PigaError` into one message on stderr and exit code 2.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any


class PigaError(Exception):
    """Base of all errors caused by input that piga cannot use.

    Parameters
    ----------
    message:
        What is wrong, with file, row, column or argument, and the value met.
    remedy:
        What the user can do about it; appended to the message. Every error has one.
    """

    def __init__(self, message: str, *, remedy: str) -> None:
        self.message = message
        self.remedy = remedy
        super().__init__(f"{message}\n  remedy: {remedy}")

    def __reduce__(self) -> tuple[Callable[..., PigaError], tuple[type[PigaError], dict[str, Any]]]:
        return _restored, (type(self), {**self.__dict__, "args": self.args})


def _restored(kind: type[PigaError], state: dict[str, Any]) -> PigaError:
    """An error that comes from another process, with message and remedy."""
    error = kind.__new__(kind)
    for name, value in state.items():
        setattr(error, name, value)
    return error


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
    "xarray": "notebook",
    "uncertainties": "notebook",
    "GTC": "notebook",
    "h5py": "hdf5",
    "nptdms": "tdms",
    "openpyxl": "xlsx",
    "sqlalchemy": "records",
    "alembic": "records",
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


def missing_package(package: str) -> MissingPackageError:
    """The error for a package of :data:`EXTRAS` that is not installed."""
    return MissingPackageError(
        f"this needs the package {package}, which the small core leaves out",
        remedy=f"pip install 'piga[{EXTRAS[package]}]'",
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
