"""The page of validation on data of others has the numbers of today, as far as the data are here."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_shipped_comparisons_hold_and_stand_on_the_page() -> None:
    spec = importlib.util.spec_from_file_location("validate", ROOT / "validation" / "validate.py")
    assert spec is not None
    assert spec.loader is not None
    validate = importlib.util.module_from_spec(spec)
    sys.modules["validate"] = validate
    spec.loader.exec_module(validate)
    results = [*validate.xsens(), *validate.imucal(), *validate.nist_suite()]
    assert all(one.holds for one in results)
    page = (ROOT / "docs" / "validation-data.md").read_text(encoding="utf-8")
    for row in validate.page(results).splitlines():
        assert row in page
