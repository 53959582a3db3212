"""Few wrong readings at the ends of a segment, and slips of the counter: which side of a jump carries the phase.

Records are of :mod:`tests.calibration.made.independent`; limits are those of use: phi within 4 u, u within 20 % of the clean one's.
"""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga.calibration.fit.cleaning import JumpStretch
from tests.calibration.made.independent import Bench, head

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


@pytest.mark.only_compiled
@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(
    ("position", "count", "offset"),
    [(0, 3, np.pi), (0, 50, 0.1), (3, 3, 0.5), (3, 7, 0.1), (4, 15, np.pi), (4, 50, 2.5e-4), (7, 50, 0.5)],
)
def test_few_wrong_readings_do_not_turn_the_phase(ends, position, count, offset, angle, clean):
    run = BENCH.run(spoiled(angle, position, ENDS[ends], count, offset))
    check(BENCH, piga.calibrate(run, TERMS), clean)


@pytest.mark.only_compiled
def test_the_note_says_which_readings_were_off(angle, clean):
    calibration = piga.calibrate(BENCH.run(spoiled(angle, 3, (True, True), 15, 0.3)), TERMS)
    events = [event for event in calibration.quality.events if event.kind == "outlier-jump"]
    assert [event.count for event in events] == [2]
    assert "the 15 readings before it" in events[0].detail
    assert "the 15 readings from it" in events[0].detail
    assert [o.size for o in calibration.outliers] == [pytest.approx(0.3, abs=3e-4)] * 2
    assert clean.outliers == ()


@pytest.mark.only_compiled
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
        assert texts[0].endswith("all later readings are corrected by it")


@pytest.mark.only_compiled
def test_the_longer_side_gives_the_phase_where_nothing_else_can(angle, clean):
    """A record of one phase a segment: the other positions say nothing."""
    before = piga.calibrate(BENCH.run(angle), TERMS, phases="per-segment")
    for ends in ENDS.values():
        run = BENCH.run(spoiled(angle, 2, ends, 50, 0.3))
        calibration = piga.calibrate(run, TERMS, phases="per-segment")
        for one, other in zip(calibration.coefficients, before.coefficients, strict=True):
            assert one.value == pytest.approx(other.value, abs=other.std), one.key


@pytest.mark.slow
@pytest.mark.only_compiled
@pytest.mark.parametrize("bench", [BENCH, Bench(walk=0.0), Bench(forces=head(12), seconds=20.0, white=1e-5)])
def test_every_end_count_and_offset(bench):
    """3, 7, 15 and 50 readings, 10 sigma to pi, both ends and both of them, first, inner and last position."""
    for seed in range(3):
        clear = bench.angles(np.random.default_rng([seed, 21]))
        clean = piga.calibrate(bench.run(clear), TERMS)
        moved, last = bench.miss(clean, "phi") / clean["phi"].std, len(bench.forces) - 1
        for ends in ENDS.values():
            for position in (0, 3, last):
                for count in (3, 7, 15, 50):
                    for offset in (10.0 * bench.white, 1e-2, 0.1, 0.5, np.pi):
                        run = bench.run(spoiled(clear, position, ends, count, offset))
                        calibration = piga.calibrate(run, TERMS)
                        miss = bench.miss(calibration, "phi") / clean["phi"].std
                        assert abs(miss) < 4.0, (seed, ends, position, count, offset, miss, moved)
                        assert calibration["phi"].std < 1.2 * clean["phi"].std, (
                            seed,
                            ends,
                            position,
                            count,
                            offset,
                        )


def test_choices_of_a_stretch():
    """Few readings at an end are wrong, half a stretch has slipped, until phases say otherwise."""
    few = JumpStretch((0, 3, 100), (0.0, 0.3), (3, 97), anew=False)
    half = JumpStretch((0, 50, 100), (0.0, 0.3), (50, 50), anew=False)
    ends = JumpStretch((0, 5, 95, 100), (0.0, 0.3, -0.1), (5, 90, 5), anew=False)
    assert min(few.choices(first=False), key=few.cost) == (1, 1)
    assert min(half.choices(first=False), key=half.cost) == (0, 1)
    assert min(ends.choices(first=False), key=ends.cost) == (1, 1)
    assert few.choices(first=True) == [(1, 1)]


@pytest.mark.only_compiled
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
