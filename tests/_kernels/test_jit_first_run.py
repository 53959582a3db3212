"""What a first run compiles: which kernels, how often each, and that of several processes one does."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.only_compiled

COUNTED = """
import json, sys
from numba.core.event import Listener, register

compiled = []

class Count(Listener):
    def on_start(self, event):
        function = event.data["dispatcher"].py_func
        compiled.append(f"{function.__module__}.{function.__qualname__}")

    def on_end(self, event):
        pass

register("numba:compile", Count())
from piga.cli.main import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print("COMPILED", json.dumps(compiled))
"""
MOST_IN_CALIBRATE = 34
"""Functions that the first calibration of the shipped record compiles, parts of Numba included: 31."""
MOST_IN_COMPENSATE = 57
"""What the compensation of it compiles besides: 52."""


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(folder / "cache")}
    return subprocess.Popen(
        [sys.executable, "-c", COUNTED, *words], cwd=folder, env=environment, text=True, stdout=subprocess.PIPE
    )


def compiled_by(process: subprocess.Popen[str]) -> list[str]:
    out, _ = process.communicate()
    assert process.returncode == 0
    names: list[str] = json.loads(out.rsplit("COMPILED", 1)[1])
    return names


def test_first_run_compiles_each_kernel_once(tmp_path: Path) -> None:
    from piga.data import copy_example

    run = str(copy_example(tmp_path))
    both = [start(tmp_path, "calibrate", run, "--out", str(tmp_path / name)) for name in "ab"]
    compiled = [name for process in both for name in compiled_by(process)]
    ours = [name for name in compiled if name.startswith("piga.")]
    assert len(ours) == len(set(ours)) > 10
    assert len(compiled) <= MOST_IN_CALIBRATE

    more = compiled_by(start(tmp_path, "demo", "--out", str(tmp_path / "demo")))
    assert not set(more) & set(ours)  # kept from the calibration
    assert more.count("piga._kernels.compensation.record.compensate_record") == 1
    assert len(more) <= MOST_IN_COMPENSATE
    assert compiled_by(start(tmp_path, "demo", "--out", str(tmp_path / "again"))) == []
