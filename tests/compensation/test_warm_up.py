from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from piga.compensation import warm_up


@pytest.mark.parametrize("kind", ["angle", "rate", "set"])
def test_kernels_are_compiled_apart_only_when_they_are_not_there(monkeypatch, kind):
    """Where they are (or are interpreted) no process is started; where not, it is told the kind, until all is done."""
    called, status = [], [warm_up.MORE, warm_up.MORE, 0]

    def run(words, **_):
        called.append(words)
        return SimpleNamespace(returncode=status[len(called) - 1])

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(warm_up, "_is_compiled", lambda _kind: True)
    warm_up.compile_apart(kind)
    assert not called
    monkeypatch.setattr(warm_up, "_is_compiled", lambda _kind: False)
    warm_up.compile_apart(kind)
    assert called == [[called[0][0], "-m", "piga.compensation.warm_up", kind]] * 3
    warm_up.compile_here(kind)


def test_a_process_that_has_grown_leaves_when_a_kernel_is_done(monkeypatch):
    """Never before one of ours is on disk, or there would be no end; not while it is small."""
    left = []
    ours, other = (
        SimpleNamespace(data={"dispatcher": SimpleNamespace(py_func=SimpleNamespace(__module__=name))})
        for name in ("piga._kernels.motion.step", "numba.np.arraymath")
    )
    monkeypatch.setattr(os, "_exit", left.append)
    monkeypatch.setattr(warm_up, "_memory", lambda: warm_up.MOST_BYTES + 1)
    watch = warm_up._Leave()
    watch.on_start(ours)
    watch.on_start(other)
    watch.on_end(other)
    watch.on_start(ours)
    assert not left
    watch.on_end(ours)
    watch.on_start(ours)
    assert left == [warm_up.MORE]
    monkeypatch.setattr(warm_up, "_memory", lambda: 0)
    watch.on_start(ours)
    assert left == [warm_up.MORE]


def test_memory_of_this_process_is_told_in_bytes():
    assert 20e6 < warm_up._memory() < 100e9 or os.name == "nt"


@pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="elsewhere the caller's memory is not told apart"
)
def test_memory_of_the_caller_is_not_counted():
    """A process is born with what its caller held in its resource usage: it would leave after every kernel."""
    held = np.ones(50_000_000)
    words = [sys.executable, "-c", "from piga.compensation import warm_up; print(warm_up._memory())"]
    found = int(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    assert 20e6 < found < held.nbytes - 50e6
