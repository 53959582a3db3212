"""Slow changes: a bias that follows the temperature is suggested or remarked; a slow wave of a rate log is a doubt."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.calibration.fit.one_run import fit_run
from piga.calibration.model.request import make_request
from piga.calibration.remarks import all_remarks
from piga.calibration.remarks.slow_changes import WAVE, SlowWave, slow_wave
from piga.records.run_file import EstimationTable
from tests.calibration.made.coloured_truth import HEAD, LOG, Coloured, spectral
from tests.calibration.made.independent import Bench, K, head
from tests.calibration.made.temperature import BANDS, BENCHES, TERMS, campaign, one_swing, said

SMALL = Bench(forces=head(6), seconds=20.0, rate=2.0)


SWINGING = replace(
    Bench(forces=head(16), seconds=20.0, rate=10.0),
    warmth=lambda t: 0.5 * np.sin(2.0 * np.pi * t / 400.0 + 1.57),
)
"""A bench whose temperature swings once while the head turns once."""


def remarks_of(bench, seed=1, terms=TERMS, **options):
    """Remarks on the temperature."""
    calibration = piga.calibrate(bench.record(seed), terms, **options)
    return [remark for remark in calibration.remarks if "follows the temperature" in remark]


def in_step(bench, share=1.0):
    """The bench with a swing as long as a turn of its head, in phase with the force along the axis."""
    turn = len(bench.forces) * (bench.seconds + bench.pause)
    return replace(bench, warmth=lambda t: share * np.cos(2.0 * np.pi * t / turn - 0.29))


def test_a_bias_that_is_not_excluded_is_remarked():
    (remark,) = remarks_of(in_step(SMALL))
    assert "scale_factor" in remark
    assert "hold the temperature" in remark


@pytest.mark.only_compiled
def test_what_is_asked_for_held_or_not_recorded_gets_no_remark():
    assert remarks_of(in_step(SMALL)) != []
    assert remarks_of(in_step(SMALL), terms=(*TERMS, "k0_T")) == []
    assert remarks_of(in_step(SMALL, share=1e-3)) == []
    assert remarks_of(replace(SMALL, warmth=lambda t: 0.0 * t + 2.0)) == []
    assert remarks_of(SMALL) == []


@pytest.mark.only_compiled
def test_a_remark_needs_no_phase():
    (shared,) = remarks_of(in_step(SMALL))
    (free,) = remarks_of(in_step(SMALL), phases="per-segment")
    assert shared.split(" would ")[0].startswith("the record does not exclude")
    assert free.split(" would ")[0].startswith("the record does not exclude")


@pytest.mark.only_compiled
@pytest.mark.parametrize(("period", "phase"), [(300.0, 0.0), (400.0, 0.8), (1000.0, 0.0)])
def test_the_scale_factor_moves_as_said(period, phase):
    """A bias of the bound's size is added to the record: the scale factor moves by the number in the remark."""
    bench = replace(SWINGING, warmth=lambda t: 0.5 * np.sin(2.0 * np.pi * t / period + phase))
    (remark,) = remarks_of(bench)
    bound = float(re.search(r"up to ([0-9.e+]+) ug/K", remark)[1]) * 1e-6
    shift = float(re.search(r"move scale_factor by ([0-9.e+]+) standard", remark)[1])
    pair = [piga.calibrate(replace(bench, k0_T=k0_T).record(1), TERMS) for k0_T in (0.0, bound)]
    moved = abs(pair[1]["scale_factor"].value - pair[0]["scale_factor"].value)
    assert moved / pair[0]["scale_factor"].std == pytest.approx(shift, rel=0.08)
    growth = float(re.search(r"([0-9.]+) times as large", remark)[1])
    wider = piga.calibrate(bench.record(1), (*TERMS, "k0_T"))["scale_factor"].std
    assert wider / pair[0]["scale_factor"].std == pytest.approx(growth, rel=0.03)


@pytest.mark.only_compiled
def test_the_zero_of_the_temperature_does_not_matter():
    """The same swing ten kelvin higher: the same words."""
    higher = replace(SWINGING, warmth=lambda t: 10.0 + SWINGING.warmth(t))
    assert remarks_of(higher) == remarks_of(SWINGING) != []


@pytest.mark.only_compiled
def test_a_temperature_in_step_has_no_bound_of_its_own():
    """Nothing bounds the bias here: the largest possible one is taken, and 'k0_T' is not the first cure."""
    (remark,) = remarks_of(SWINGING)
    assert "50 ug/K, the largest that is taken to be possible" in remark
    assert "another order" in remark
    assert "times as large" in remark


@pytest.mark.only_compiled
@pytest.mark.parametrize(
    "warmth",
    [
        lambda t: 3.0 * t / 400.0,
        lambda t: 0.5 * np.sin(2.0 * np.pi * t / 90.0),
        lambda t: 1e-3 * np.sin(2.0 * np.pi * t / 400.0 + 1.57),
        lambda t: 2.0 + 1e-3 * np.random.default_rng(3).standard_normal(np.shape(t)),
    ],
    ids=["ramp", "quick", "faint", "noise of the thermometer"],
)
def test_a_harmless_temperature_gets_no_remark(warmth):
    assert [remarks_of(replace(SWINGING, warmth=warmth), seed) for seed in range(5)] == [[]] * 5


@pytest.mark.only_compiled
def test_a_suggestion_stands_alone():
    """What is suggested is not remarked again."""
    bench = replace(SWINGING, warmth=lambda t: 0.5 * np.sin(2.0 * np.pi * t / 300.0), k0_T=4e-5)
    calibration = piga.calibrate(bench.record(1), TERMS)
    assert calibration.diagnostics.missing_terms[0].terms == ("k0_T",)
    assert not said(calibration).remarked


@pytest.mark.only_compiled
@pytest.mark.parametrize("period", [150.0, 300.0, 700.0, 2000.0])
def test_shift_and_signature_are_one(period):
    """``|K' - K|/u = |t| sqrt(u'^2/u^2 - 1)``, where t is k0_T over its standard uncertainty: no two facts, but one."""
    for seed, bench in enumerate(BENCHES):
        free = replace(bench, warmth=lambda t: np.sin(2.0 * np.pi * t / period + 0.4)).record(seed)
        noise = EstimationTable(angle_rms="2.5e-5 rad", angle_random_walk=f"{bench.walk} rad/sqrt(s)")
        run = replace(free, estimation=noise)
        short, long = piga.calibrate(run, TERMS), piga.calibrate(run, (*TERMS, "k0_T"))
        old, new, added = short["scale_factor"], long["scale_factor"], long["k0_T"]
        growth = math.sqrt((new.std / old.std) ** 2 - 1.0)
        assert abs(new.value - old.value) / old.std == pytest.approx(
            abs(added.value) / added.std * growth, rel=0.01
        )


@pytest.mark.only_compiled
def test_no_test_can_see_every_bias_that_matters():
    """The best test of 1 % false alarms misses most of what moves K by 1.2 u in slow swings; a remark stands there."""
    swings = [one_swing(seed, (300.0, 3000.0), shift=1.2) for seed in range(16)]
    biased = [swing for swing in swings if swing.moved and swing.shift > 1.0]
    assert len(biased) >= 3
    assert np.mean([swing.best_power for swing in biased]) < 0.5
    assert all(swing.moved.anything for swing in biased)


@pytest.mark.slow
@pytest.mark.only_compiled
@pytest.mark.parametrize("band", BANDS)
def test_every_period_and_phase_is_told(band):
    """30 records of each band in which K moves by 1 to 5 u: 95 % are told. Sound records: 1 % get a suggestion."""
    shares = campaign(band, 30)
    assert shares["suggested or remarked"] >= 95.0
    assert shares["sound: suggested"] <= 1.0
    assert shares["suggested"] > 0.7 * shares["best test"] - 15.0
    if band[0] >= 100.0:
        assert shares["best test"] < 95.0


@pytest.mark.slow
@pytest.mark.only_compiled
def test_the_smallest_shift_that_counts_is_told():
    """300 records, in many of which K moves by 1.05 u, where the demand is hardest."""
    swings = [one_swing(seed, (100.0, 3000.0), shift=1.05) for seed in range(300)]
    biased = [swing.moved.anything for swing in swings if swing.moved and swing.shift > 1.0]
    assert len(biased) > 50
    assert np.mean(biased) >= 0.95


WAVING = replace(LOG, forces=head(12), seconds=20.0, pause=10.0)


SPAN = 12 * 30.0 - 10.0


def waves(test: Coloured, seed: int) -> SlowWave | None:
    run = test.record(seed)
    return slow_wave(fit_run(run, make_request(run, test.terms)))


def test_a_clear_wave_has_its_period_and_its_amplitude() -> None:
    """Three cycles in the record, of ten times the noise of a mean rate: no coefficient looks like them."""
    wave = waves(replace(WAVING, wave=(4e-5, SPAN / 3.0)), 1)
    assert wave is not None
    assert wave.period == pytest.approx(SPAN / 3.0, rel=0.06)
    assert wave.amplitude == pytest.approx(4e-5 / K, rel=0.25)
    assert wave.probability < 1e-6
    assert f"{1e6 * wave.amplitude:.2g} ug" in wave.words


@pytest.mark.only_compiled
def test_white_noise_has_its_share_of_waves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 100 sound records as many are below each probability as it says, or fewer (four binomial deviations)."""
    monkeypatch.setattr("piga.calibration.remarks.slow_changes.WAVE", replace(WAVE, chance=2.0))
    said = [waves(WAVING, seed) for seed in range(100)]
    chances = np.array([wave.probability for wave in said if wave is not None])
    assert chances.size == 100
    for limit in (0.01, 0.1, 0.5):
        count = int((chances < limit).sum())
        assert count <= 100 * limit + 4.0 * math.sqrt(100 * limit * (1.0 - limit))
    assert (chances < 0.5).sum() > 20, "not far too careful"


@pytest.mark.only_compiled
def test_no_wave_is_looked_for_in_angle_logs_and_short_records() -> None:
    assert waves(replace(HEAD, forces=head(12), seconds=20.0, rate=2.0, wave=(4e-5, 100.0)), 1) is None
    assert waves(replace(WAVING, seconds=4.0, wave=(4e-5, 100.0)), 1) is None


def test_the_verdict_names_it_where_nothing_else_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wave too faint for a doubt by coloured noise; beside such a doubt there is no second one."""
    seen = SlowWave(120.0, 3e-6, 1e-4)
    monkeypatch.setattr(all_remarks, "slow_wave", lambda _: seen)
    quiet = piga.calibrate(WAVING.record(2), WAVING.terms)
    assert [doubt.what for doubt in quiet.verdict.doubts if "slow wave" in doubt.what] == [seen.words]
    loud = piga.calibrate(replace(WAVING, wave=(2e-4, 150.0)).record(2), WAVING.terms)
    doubts = [doubt.what for doubt in loud.verdict.doubts]
    assert any("coloured noise" in what for what in doubts)
    assert not any("slow wave" in what for what in doubts)


def test_flicker_noise_of_the_truth_has_its_variance_in_each_decade() -> None:
    rng, power = np.random.default_rng(1), np.zeros(4097)
    for _ in range(40):
        series = spectral(rng, 8192, 0.1, 2.0)
        window = np.hanning(8192)
        power += np.abs(np.fft.rfft(series * window)) ** 2 * 2.0 * 0.1 / (window**2).sum() / 40.0
    frequency = np.fft.rfftfreq(8192, 0.1)
    for low, high in ((0.02, 0.2), (0.2, 2.0)):
        inside = (frequency >= low) & (frequency < high)
        assert power[inside].sum() * frequency[1] == pytest.approx(4.0, rel=0.12)


@pytest.mark.only_compiled
def test_the_truth_without_noise_comes_back() -> None:
    """Angle and rate logs of the independent motion: its coefficients, to the error of the sampled rates."""
    for test, error in ((replace(HEAD, white=0.0, walk=0.0), 1e-9), (replace(LOG, walk=0.0), 1e-6)):
        small = replace(test, forces=head(12), seconds=20.0)
        result = piga.calibrate(small.record(1), small.terms)
        off = [abs(c.value - small.true(c.name)) for c in result.coefficients if c.name != "phi"]
        assert max(off) < error
