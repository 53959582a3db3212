"""A page rendered in a process of its own is the page that is rendered here; what goes wrong there is told here."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from piga.errors import PigaError
from piga.reports import Axis, Figure, FigureBlock, Page, Panel, Section, Series, Text, page_html
from piga.reports.apart import write_page_apart

CURVE = Series(np.linspace(0.0, 1.0, 50), np.sin(np.arange(50.0)), "измерено, µ", role="data")
FIGURE = Figure("drift", "Drift.", (Panel(Axis("time", "s"), Axis("angle", "µrad"), (CURVE,)),))
PAGE = Page("A test", sections=(Section("Drift", "part", (Text("It grows."), FigureBlock(FIGURE))),))


def test_the_same_bytes(tmp_path: Path) -> None:
    assert write_page_apart(PAGE, tmp_path / "page.html").read_text(encoding="utf-8") == page_html(PAGE)


def test_a_process_that_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (tmp_path / "jinja2.py").write_text("raise ImportError('half of it is missing')")
    with pytest.raises(PigaError, match=r"cannot be drawn \(ImportError: half of it is missing\)") as caught:
        write_page_apart(PAGE, tmp_path / "page.html")
    assert "piga[report]" in (caught.value.remedy or "")
    assert not (tmp_path / "page.html").exists()
