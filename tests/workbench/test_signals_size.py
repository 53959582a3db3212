"""Large files on the page Signals: the first picture, zooms, memory."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.workbench.size import SIZES, measure


@pytest.mark.slow
@pytest.mark.only_compiled
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("kind", SIZES)
def test_a_large_file_is_drawn_at_once(tmp_path: Path, kind: str) -> None:
    seen = measure(tmp_path, kind, SIZES[kind])
    assert seen["first"] < 2.0
    assert seen["zoom"] < 0.1
    assert seen["server"] < 100.0
    assert seen["job"] < 600.0
