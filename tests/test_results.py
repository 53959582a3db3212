"""Equality of results."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from piga.results import ByValue, same


@dataclass(frozen=True, eq=False)
class Held(ByValue):
    name: str
    values: np.ndarray
    table: dict[str, np.ndarray] = field(default_factory=dict)
    size: float = math.nan
    more: tuple[object, ...] = ()
    ignored: object = field(default=None, compare=False)


def held(**changes) -> Held:
    return replace(Held("a", np.array([1.0, math.nan, -0.0]), {"x": np.arange(3)}), **changes)


def test_equal_means_equal_values():
    assert held() == held()
    assert held() == held(values=np.array([1, math.nan, 0.0]))
    assert held() == held(ignored=1)


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "b"},
        {"values": np.array([1.0, math.nan, 1.0])},
        {"values": np.array([1.0, math.nan])},
        {"values": np.array([[1.0, math.nan, -0.0]])},
        {"table": {"x": np.array([0, 1, 3])}},
        {"table": {"y": np.arange(3)}},
        {"table": {}},
        {"size": 1.0},
        {"more": (np.arange(2),)},
    ],
)
def test_a_single_difference_is_seen(changes):
    assert held() != held(**changes)
    assert not held() == held(**changes)  # noqa: SIM201 - the other operator


def test_other_kinds_are_not_equal_and_nothing_raises():
    assert held() != "a"
    assert not same(np.arange(3), (0, 1, 2))
    assert same([np.arange(2)], [np.arange(2)])
