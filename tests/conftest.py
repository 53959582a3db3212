"""Long tests are skipped with the JIT off; a short record and its calibration, each computed once."""

from __future__ import annotations

import os
import warnings
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the commands have it; read when NumPy is loaded
os.environ["COLUMNS"] = "100"  # text as without a terminal: workers of xdist have another width

import numba
import pytest
from hypothesis import HealthCheck, settings

import piga
from piga.cli import common
from tests import json_documents
from tests.short_record import TERMS, a_run

settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")  # no test fails because a machine is busy


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests marked ``long`` are too long for interpreted kernels."""
    if not numba.config.DISABLE_JIT:
        return
    skip = pytest.mark.skip(reason="too long for interpreted kernels")
    for item in items:
        if "long" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def run() -> piga.Run:
    return a_run()


@pytest.fixture(scope="session")
def cal(run: piga.Run) -> piga.Calibration:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return piga.calibrate(run, TERMS)


@pytest.fixture(autouse=True)
def json_schemas(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every document that a command prints in this process is compared with the schema of its command."""
    print_json = common.print_json

    def one(document: Any) -> None:
        json_documents.check(document)
        print_json(document)

    monkeypatch.setattr(common, "print_json", one)
