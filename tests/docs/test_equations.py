"""Every equation of the pages has a label, and every label an entry that evaluates it literally."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from .equations import EQUATIONS
from .pages import DOCS

THEORY = [
    *(page for folder in ("understanding", "theory") for page in sorted((DOCS / folder).glob("*.md"))),
    DOCS / "reference" / "terms.md",
]
_DISPLAYED = re.compile(r"^ *\$\$$(.*?)^ *\$\$ *(?:\(([\w-]+)\))?$", re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("label", EQUATIONS)
def test_equation(label: str) -> None:
    pairs = list(EQUATIONS[label]())
    assert pairs
    for literal, library, tolerance in pairs:
        assert np.shape(literal) == np.shape(library)
        worst = np.abs(np.asarray(literal) - np.asarray(library)).max()
        assert worst <= tolerance, f"{label}: {worst:.3g} above {tolerance:.3g}"


def labels(page: Path) -> list[str]:
    return [one[1] for one in _DISPLAYED.findall(page.read_text(encoding="utf-8"))]


def test_every_equation_has_an_entry() -> None:
    seen = [label for page in THEORY for label in labels(page)]
    assert "" not in seen
    assert sorted(seen) == sorted(EQUATIONS)
