"""Remarks come without a cause in less than one record in a hundred, and find what is wrong.

The full table is printed by ``python -m tests.calibration.made.alarms``; its figures stand in docs/theory/calibration.md.
"""

from __future__ import annotations

import pytest

from tests.calibration.made.alarms import OMISSIONS, SOUND, count_all, faulty, omitted, sound

VISIBLE = [
    *(
        (name, fault)
        for name in SOUND
        for fault in (
            "X0 and Y0 swapped",
            "X0 negative",
            "output negative",
            "g said to be m/s²",
            "mg said to be g",
        )
    ),
    *(("everywhere", fault) for fault in ("Y0 and Z0 swapped", "Y0 negative", "degrees said to be rad")),
]
"""Faults that a scenario shows; a tumble in one plane, or a centrifuge, cannot tell all signs of Y0 and Z0."""


@pytest.mark.long
def test_a_few_sound_records_get_no_remark() -> None:
    for counted in count_all([(sound, (name,)) for name in SOUND], 4):
        assert counted["none"] == 4


@pytest.mark.slow
@pytest.mark.parametrize("name", SOUND)
def test_false_alarms_stay_below_one_in_a_hundred(name: str) -> None:
    (counted,) = count_all([(sound, (name,))], 1000, 2)
    assert counted["none"] >= 990, dict(counted)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "term"), OMISSIONS)
def test_an_omitted_term_is_named(name: str, term: str) -> None:
    (counted,) = count_all([(omitted, (name, term))], 50, 2)
    assert counted["named"] >= 47, dict(counted)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "fault"), VISIBLE)
def test_data_read_wrongly_are_named(name: str, fault: str) -> None:
    (counted,) = count_all([(faulty, (name, fault))], 50, 2)
    assert counted["named"] >= 47, dict(counted)
