from __future__ import annotations

import subprocess

import pytest

from piga.compensation import warm_up


@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_kernels_are_compiled_apart_only_when_they_are_not_there(monkeypatch, kind):
    """Where they are (or are interpreted) no process is started; where not, it is told the kind."""
    called = []
    monkeypatch.setattr(subprocess, "run", lambda words, **_: called.append(words))
    monkeypatch.setattr(warm_up, "_is_compiled", lambda _kind: True)
    warm_up.compile_apart(kind)
    assert not called
    monkeypatch.setattr(warm_up, "_is_compiled", lambda _kind: False)
    warm_up.compile_apart(kind)
    assert called[0][1:] == ["-m", "piga.compensation.warm_up", kind]
    warm_up.compile_here(kind)
