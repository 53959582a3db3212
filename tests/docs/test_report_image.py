"""The picture of the report shows the product's numbers, or the build of the docs fails."""

from __future__ import annotations

import json

import pytest

pytest.importorskip("PIL")

from builders.build_report_image import OUT, numbers_file, stale


def test_the_shipped_picture_is_the_one_whose_numbers_stand_beside_it():
    kept = json.loads(numbers_file(OUT).read_text(encoding="utf-8"))
    assert stale(OUT, {name: value for name, value in kept.items() if name != "picture"}) == ""
