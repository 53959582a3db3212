"""The n-th-call fault loop: whatever call of the operating system fails, the old or the new state is there."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).with_name("fault_shim.c")
OPERATIONS = 7


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("the fault shim needs Linux and a C compiler (cc)")
    library = tmp_path_factory.mktemp("shim") / "fault_shim.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-w", "-o", library, SOURCE, "-ldl"], check=True)
    return library


def run(shim: Path, folder: Path, step: int) -> dict[str, dict[str, int]]:
    arguments = [sys.executable, "-m", "tests.ledger.store.fault_worker", str(folder), str(step)]
    done = subprocess.run(
        arguments, env=os.environ | {"LD_PRELOAD": str(shim)}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


@pytest.mark.only_compiled
def test_some_calls_fail(shim: Path, memory_path: Path) -> None:
    outcome = run(shim, memory_path, 9)
    assert len(outcome) == OPERATIONS
    assert all(counts["points"] > 0 for counts in outcome.values())


@pytest.mark.slow
def test_every_call_fails_once(shim: Path, memory_path: Path) -> None:
    """Every call, every kind of failure, every operation."""
    outcome = run(shim, memory_path, 1)
    for name, counts in outcome.items():
        print(name, counts)
    print("points", sum(counts["points"] for counts in outcome.values()))
    assert len(outcome) == 5 * OPERATIONS
