"""Few wrong readings at the ends of a segment are left out; a slip of the counter is subtracted from what follows, and said.

Records are of :mod:`tests.calibration.made.independent`; limits are those of use: phi within 4 u, u within 20 % of the clean one's.
"""

from __future__ import annotations

import numpy as np
import pytest

import piga
from tests.calibration.made.independent import Bench

pytestmark = pytest.mark.long

TERMS = ("scale_factor", "tan_beta", "k0")
BENCH = Bench()
ENDS = {"start": (True, False), "end": (False, True), "both": (True, True)}


def spoiled(angle: np.ndarray, position: int, ends: tuple[bool, bool], count: int, offset: float) -> np.ndarray:
    """The angles with ``count`` readings at the ends of a position off by ``offset``."""
    result = angle.copy()
    if ends[0]:
        result[position, :count] += offset
    if ends[1]:
        result[position, -count:] -= offset
    return result


def check(bench: Bench, result: piga.Calibration, clean: piga.Calibration) -> None:
    """Phase and tan_beta within 4 u, and u of the phase not above 1.2 of the clean record's."""
    for name in ("phi", "tan_beta"):
        assert abs(bench.miss(result, name)) < 4.0 * clean[name].std, name
    assert result["phi"].std < 1.2 * clean["phi"].std


@pytest.fixture(scope="module")
def angle() -> np.ndarray:
    return BENCH.angles(np.random.default_rng([1, 19]))


@pytest.fixture(scope="module")
def clean(angle: np.ndarray) -> piga.Calibration:
    return piga.calibrate(BENCH.run(angle), TERMS)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(
    ("position", "count", "offset"),
    [(0, 3, np.pi), (3, 3, 0.5), (3, 7, 0.1), (7, 7, 0.5)],
)
def test_few_wrong_readings_do_not_turn_the_phase(ends, position, count, offset, angle, clean):
    run = BENCH.run(spoiled(angle, position, ENDS[ends], count, offset))
    check(BENCH, piga.calibrate(run, TERMS), clean)


def test_many_wrong_readings_at_an_end_are_a_doubt_with_its_remedy(angle, clean):
    """They look like a slip. The residuals say that the phase is wrong, and the remedy gives the coefficients."""
    run = BENCH.run(spoiled(angle, 3, (False, True), 15, 0.3))
    (event,) = [one for one in piga.calibrate(run, TERMS).quality.events if one.kind == "outlier-jump"]
    assert "phases = 'per-segment'" in event.detail
    assert piga.calibrate(run, TERMS).verdict.grade != "clear"
    free = piga.calibrate(run, TERMS, phases="per-segment")
    for name in TERMS:
        assert abs(BENCH.miss(free, name)) < 4.0 * clean[name].std, name


@pytest.mark.parametrize("offset", [0.05, 0.3])
def test_a_slip_of_the_counter_is_taken_off_what_follows(offset, angle, clean):
    """Two thirds of the way through a position, and 15 readings before its end."""
    for row in (534, 801 - 15):
        slipped = angle.copy()
        slipped[4, row:] += offset
        slipped[5:] += offset
        calibration = piga.calibrate(BENCH.run(slipped), TERMS)
        check(BENCH, calibration, clean)
        texts = [event.detail for event in calibration.quality.events if event.kind == "outlier-jump"]
        assert len(texts) == 1
        assert "all later readings are corrected by it" in texts[0]


def test_a_jump_ends_with_its_segment_where_each_has_a_phase(angle):
    """A slip in position 2 that the counter loses again at the next position: later phases stay as they are."""
    slipped = angle.copy()
    slipped[2, 400:] += 0.3
    before, after = (piga.calibrate(BENCH.run(a), TERMS, phases="per-segment") for a in (angle, slipped))
    for one, other in zip(after.coefficients, before.coefficients, strict=True):
        assert one.value == pytest.approx(other.value, abs=other.std), one.key


@pytest.mark.parametrize(("position", "count"), [(3, 2), (3, 7), (7, 7)])
def test_the_note_of_a_slip_near_the_end_of_a_segment_says_so(position, count, angle):
    """Nothing follows the last position, where a slip is as good as wrong readings."""
    slipped = angle.copy()
    slipped[position, -count:] += 0.3
    slipped[position + 1 :] += 0.3
    calibration = piga.calibrate(BENCH.run(slipped), TERMS)
    (event,) = [event for event in calibration.quality.events if event.kind == "outlier-spike"]
    assert event.count == count
    assert ("slip of the counter" in event.detail) == (position < 7)
    assert (f"{count} from t = " in event.detail) == (position < 7)
    inner = angle.copy()
    inner[3, 100:103] += 0.3
    (event,) = piga.calibrate(BENCH.run(inner), TERMS).quality.events
    assert "slip" not in event.detail
