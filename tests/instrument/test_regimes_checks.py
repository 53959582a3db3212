"""What is no array of numbers is refused by name."""

from __future__ import annotations

import pytest

from piga.errors import ArgumentError
from piga.instrument.regimes import float_array


def test_what_is_no_array_of_numbers() -> None:
    with pytest.raises(ArgumentError, match="f: not an array of numbers"):
        float_array("f", ["one", "two"])
    with pytest.raises(ArgumentError, match=r"shape \(2,\) instead of \(3,\)"):
        float_array("f", [1.0, 2.0], (3,))
    view = float_array("f", [1.0, 2.0])
    assert not view.flags.writeable
