"""Errors keep message, place and remedy, also on their way from another process."""

from __future__ import annotations

import copy
import sys
from pathlib import Path

import pytest

from piga import errors
from piga.errors import DataError, Fix, IdentifiabilityError, PigaError, Where, missing_package
from tests.short_record import pickled

KINDS = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, PigaError)]


@pytest.mark.parametrize("kind", KINDS)
def test_every_error_needs_a_remedy(kind: type[PigaError]) -> None:
    with pytest.raises(TypeError, match="remedy"):
        kind("it is wrong")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("passed_on", [copy.copy, pickled])
def test_an_error_of_another_process_is_the_same(kind: type[PigaError], passed_on) -> None:
    again = passed_on(kind("it is wrong", remedy="mend it"))
    assert type(again) is kind
    assert (again.message, again.remedy, str(again)) == (
        "it is wrong",
        "mend it",
        "it is wrong\n  remedy: mend it",
    )


def test_what_an_error_carries_besides_goes_with_it() -> None:
    error = IdentifiabilityError("cannot tell", remedy="add a run", terms=("k0", "k2"))
    assert pickled(error).terms == ("k0", "k2")
    where, fix = Where(Path("run.csv"), 7, ("n",)), Fix("data", "decimal", ",")
    error = pickled(DataError("no number", remedy="repair it", where=where, columns=["t", "n"], fixes=[fix]))
    assert (error.where, error.columns, error.fixes) == (where, ("t", "n"), (fix,))
    assert isinstance(pickled(missing_package("scipy")), ImportError)


def test_a_long_text_is_not_echoed() -> None:
    error = PigaError(f"run.toml: [instrument] scale_factor: '{'a' * 1_000_000}' is wrong", remedy="mend it")
    assert len(error.message) < 400
    assert error.message.startswith("run.toml: [instrument] scale_factor: 'aaa")


def test_a_package_is_installed_for_the_python_that_runs() -> None:
    assert f"{sys.executable} -m pip install 'piga[xlsx]'" in str(missing_package("openpyxl"))
