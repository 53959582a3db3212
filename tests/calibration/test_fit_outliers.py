"""Spikes, jumps and stuck readings are found, left out with their times, and leave right intervals behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.constant_force import ConstantForce, tumble

import piga
from piga.calibration.fit import limit
from piga.units import G0
from tests.calibration.made.independent import Bench
from tests.calibration.made.scenarios import COUPLED
from tests.calibration.made.synthetic import BETA, SCALE, TERMS, errors, record

pytestmark = pytest.mark.long

NOISE = {"white": 2.5e-5, "walk": 1e-5, "seconds": 20.0}


def spiked(run: piga.Run, seed: int, share: float, size: float) -> tuple[piga.Run, np.ndarray]:
    rng = np.random.default_rng([seed, 9])
    bad = np.sort(rng.choice(run.size, int(share * run.size), replace=False))
    output = run.output.copy()
    output[bad] += size * rng.standard_normal(bad.size)
    return replace(run, output=output), bad


@pytest.mark.parametrize(("share", "size"), [(0.001, 1e-3), (0.05, 1.0), (0.2, 1e-3), (0.2, 1e3)])
def test_spikes_are_left_out(share: float, size: float) -> None:
    run = record(np.random.default_rng(31), **NOISE)
    bad, where = spiked(run, 31, share, size)
    calibration, clean = piga.calibrate(bad, TERMS), piga.calibrate(run, TERMS)
    result = sum(outlier.samples for outlier in calibration.outliers)
    assert 0.85 * where.size <= result <= where.size + 12
    assert {outlier.kind for outlier in calibration.outliers} == {"spike"}
    assert calibration.quality.used == run.size - result
    assert all(abs(z) < 4.0 for z in errors(calibration).values()), errors(calibration)
    for name in TERMS:
        assert calibration[name].std == pytest.approx(clean[name].std, rel=0.3)
        assert calibration[name].value == pytest.approx(clean[name].value, abs=clean[name].std)


def test_spikes_are_left_out_where_the_positions_scatter() -> None:
    """Directions that are wrong by 200 arcsec neither hide spikes nor look like some."""
    rng = np.random.default_rng(36)
    run = record(rng, **NOISE)
    rate = 1e-3 * 0.0906 * G0 * rng.standard_normal(len(run.labels))[run.segment_index]
    run = replace(run, output=run.output + np.cumsum(rate * np.diff(run.t, prepend=run.t[0]) * ~run.begins))
    where = np.sort(rng.choice(run.size, 12, replace=False))
    output = run.output.copy()
    output[where] += 30.0 * NOISE["white"] * rng.choice((-1.0, 1.0), where.size)
    rows = {outlier.row for outlier in piga.calibrate(replace(run, output=output), TERMS).outliers}
    assert rows == set(run.row[where].tolist())


def test_jumps_and_stuck_readings_have_their_times() -> None:
    run = record(np.random.default_rng(32), **NOISE)
    output = run.output.copy()
    output[1500:] += 0.3
    output[4500:] -= 2e-3
    output[2500:2560] = output[2500]
    calibration = piga.calibrate(replace(run, output=output), TERMS)
    assert all(abs(z) < 4.0 for z in errors(calibration).values())
    jumps = [o for o in calibration.outliers if o.kind == "jump"]
    assert [o.time for o in jumps] == [run.t[1500], run.t[4500]]
    assert [o.size for o in jumps] == [pytest.approx(0.3, abs=2e-4), pytest.approx(2e-3, abs=2e-4)]
    stuck = [o for o in calibration.outliers if o.kind == "stuck"]
    assert len(stuck) == 1
    assert stuck[0].samples == pytest.approx(59, abs=2)
    assert sum(e.count for e in calibration.quality.events if e.kind == "outlier-jump") == 2


def test_too_much_is_refused() -> None:
    run = record(np.random.default_rng(34), **NOISE)
    with pytest.raises(piga.DataError, match=r"% of the samples contradict the reference"):
        piga.calibrate(spiked(run, 34, 0.5, 1.0)[0], TERMS)


@pytest.mark.parametrize(("size", "bad"), [(30.0, 30), (300.0, 1), (-5e4, 30)])
def test_spikes_of_a_rate_log_do_not_turn_its_phase(size: float, bad: int) -> None:
    """Their integral is radians: with it the coupling of the rest of the log would be at another phase."""
    t = 0.1 * np.arange(600)
    f = G0 * np.column_stack([0.2 + np.cos(0.05 * t), np.sin(0.05 * t), 0.3 + 0.0 * t])
    _, rate = piga.propagate(
        piga.Instrument(scale_factor=SCALE, beta=BETA, alpha0=0.5), t, f, with_rate=True, between="linear"
    )
    rng = np.random.default_rng(3)
    rate += 1e-6 * rng.standard_normal(t.size)
    rate[rng.choice(np.arange(200, 500), bad, replace=False)] += size
    run = piga.Run.from_arrays(t, rate, f, scale_factor=SCALE, kind="rate", units="SI")
    calibration = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"])
    assert sum(o.samples for o in calibration.outliers) == bad
    assert calibration["tan_beta"].value == pytest.approx(np.tan(BETA), rel=2e-3)


def test_clean_records_stay_whole() -> None:
    """10 records, 48 000 good samples: fewer than 4 are left out (0.5 expected)."""
    lost = 0
    for seed in range(10):
        calibration = piga.calibrate(
            record(np.random.default_rng([seed, 36]), **NOISE, levels=(1.0,)), TERMS[:3]
        )
        lost += sum(outlier.samples for outlier in calibration.outliers)
    assert lost < 4
    assert limit(1_000_000, 5) == pytest.approx(5.45, abs=0.01)


@pytest.mark.parametrize("count", [2.0 * np.pi / 3600, 2.0 * np.pi / 360])
def test_coarse_counts_are_no_outliers(count: float) -> None:
    run = record(np.random.default_rng(37), white=1e-7, count_angle=count)
    assert piga.calibrate(run, TERMS).outliers == ()
    assert piga.calibrate(replace(run, resolution=0.0), TERMS).outliers == ()


def test_missing_terms_are_no_outliers() -> None:
    run = record(np.random.default_rng(38), white=1e-7)
    assert piga.calibrate(run, ["scale_factor"]).outliers == ()


@pytest.mark.parametrize("rate", [0.004, 0.05, 0.6])
def test_spikes_are_found_among_readings_that_stand_still(rate: float) -> None:
    """A path of so many counts a sample: most readings repeat the one before, and are no outliers."""
    run = slow_counter(rate)
    assert piga.calibrate(run, ["scale_factor"]).outliers == ()
    bad, where = spiked(run, 12, 0.1, 0.05)
    calibration = piga.calibrate(bad, ["scale_factor"])
    assert sum(outlier.samples for outlier in calibration.outliers) == pytest.approx(where.size, rel=0.02)
    assert abs(calibration["scale_factor"].value - G0) < 5.0 * calibration["scale_factor"].std


def slow_counter(rate: float) -> piga.Run:
    """20 000 samples of a path of ``rate`` counts a sample, swinging by half of it, read in whole counts."""
    count, n = 1e-4, 20_000
    t = 0.01 * np.arange(n)
    f = np.zeros((n, 3))
    f[:, 0] = rate * count / 0.01 * (1.0 + 0.5 * np.sin(0.1 * t))
    alpha = np.append(0.0, np.cumsum(0.005 * (f[1:, 0] + f[:-1, 0])))
    alpha += 0.05 * count * np.random.default_rng(5).standard_normal(n)
    return piga.Run.from_arrays(
        t, count * np.round(alpha / count), f, scale_factor=1.0, resolution=count, units="SI"
    )


@pytest.mark.parametrize("zero", [0, 2**24 - 3000])
def test_counts_that_fit_to_the_last_bit_are_no_outliers(zero: int) -> None:
    """More than a quarter of the increments lie on the path without any miss: the core has no width."""
    count = 2.0 * np.pi / 72000.0
    t = np.arange(40) * 0.05
    output = (np.rint(10179.0 * t) + zero) * count
    force = np.tile(G0 * np.array([1.0, 0.1, 0.0]), (40, 1))
    run = replace(
        piga.Run.from_arrays(t, output, force, scale_factor=0.8884 / G0, units="SI"), resolution=count
    )
    with pytest.warns(piga.PigaWarning, match="Type A and 0 of"):
        calibration = piga.calibrate(run, ["scale_factor"])
    assert calibration.outliers == ()
    assert calibration.quality.used == 40
    assert calibration["scale_factor"].value == pytest.approx(10179.0 * count, rel=1e-3)  # rad/s/g


def test_one_wrong_reading_of_thirty_two() -> None:
    """15 records of eight positions: sound ones keep all readings, of others the wrong one alone is left out."""
    kept = alone = 0
    for seed in range(15):
        rng = np.random.default_rng([seed, 8])
        run = ConstantForce("few", tumble(8), 4.0, 0.75, 2.5e-5).record(rng)
        kept += not piga.calibrate(run, COUPLED).outliers
        output = run.output.copy()
        output[rng.integers(run.size)] += 1e-3
        result = piga.calibrate(replace(run, output=output), COUPLED)
        alone += sum(outlier.samples for outlier in result.outliers) == 1
    assert kept >= 14
    assert alone >= 12


# --- wrong readings at the ends of a segment, and slips of the counter; limits are those of use


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
    return piga.calibrate(BENCH.run(angle), COUPLED)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize(
    ("position", "count", "offset"),
    [(0, 3, np.pi), (3, 3, 0.5), (3, 7, 0.1), (7, 7, 0.5)],
)
def test_few_wrong_readings_do_not_turn_the_phase(ends, position, count, offset, angle, clean):
    run = BENCH.run(spoiled(angle, position, ENDS[ends], count, offset))
    check(BENCH, piga.calibrate(run, COUPLED), clean)


def test_many_wrong_readings_at_an_end_are_a_doubt_with_its_remedy(angle, clean):
    """They look like a slip. The residuals say that the phase is wrong, and the remedy gives the coefficients."""
    run = BENCH.run(spoiled(angle, 3, (False, True), 15, 0.3))
    (event,) = [one for one in piga.calibrate(run, COUPLED).quality.events if one.kind == "outlier-jump"]
    assert "phases = 'per-segment'" in event.detail
    assert piga.calibrate(run, COUPLED).verdict.grade != "clear"
    free = piga.calibrate(run, COUPLED, phases="per-segment")
    for name in COUPLED:
        assert abs(BENCH.miss(free, name)) < 4.0 * clean[name].std, name


@pytest.mark.parametrize("offset", [0.05, 0.3])
def test_a_slip_of_the_counter_is_taken_off_what_follows(offset, angle, clean):
    """Two thirds of the way through a position, and 15 readings before its end."""
    for row in (534, 801 - 15):
        slipped = angle.copy()
        slipped[4, row:] += offset
        slipped[5:] += offset
        calibration = piga.calibrate(BENCH.run(slipped), COUPLED)
        check(BENCH, calibration, clean)
        texts = [event.detail for event in calibration.quality.events if event.kind == "outlier-jump"]
        assert len(texts) == 1
        assert "all later readings are corrected by it" in texts[0]


def test_a_jump_ends_with_its_segment_where_each_has_a_phase(angle):
    """A slip in position 2 that the counter loses again at the next position: later phases stay as they are."""
    slipped = angle.copy()
    slipped[2, 400:] += 0.3
    before, after = (piga.calibrate(BENCH.run(a), COUPLED, phases="per-segment") for a in (angle, slipped))
    for one, other in zip(after.coefficients, before.coefficients, strict=True):
        assert one.value == pytest.approx(other.value, abs=other.std), one.key
