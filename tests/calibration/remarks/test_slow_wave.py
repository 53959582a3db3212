"""A slow wave of the rate in a rate log is a doubt where it is seen; records are from outside (coloured_truth)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.calibration.fit.one_run import fit_run
from piga.calibration.model.request import make_request
from piga.calibration.remarks import all_remarks
from piga.calibration.remarks.slow_changes import WAVE, SlowWave, slow_wave
from tests.calibration.made.coloured_truth import HEAD, LOG, Coloured, spectral
from tests.calibration.made.independent import K, head

SMALL = replace(LOG, forces=head(12), seconds=20.0, pause=10.0)
SPAN = 12 * 30.0 - 10.0


def waves(test: Coloured, seed: int) -> SlowWave | None:
    run = test.record(seed)
    return slow_wave(fit_run(run, make_request(run, test.terms, None, None, None, None)))


def test_a_clear_wave_has_its_period_and_its_amplitude() -> None:
    """Three cycles in the record, of ten times the noise of a mean rate: no coefficient looks like them."""
    wave = waves(replace(SMALL, wave=(4e-5, SPAN / 3.0)), 1)
    assert wave is not None
    assert wave.period == pytest.approx(SPAN / 3.0, rel=0.06)
    assert wave.amplitude == pytest.approx(4e-5 / K, rel=0.25)
    assert wave.probability < 1e-6
    assert f"{1e6 * wave.amplitude:.2g} ug" in wave.words


@pytest.mark.only_compiled
def test_white_noise_has_its_share_of_waves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 100 sound records as many are below each probability as it says, or fewer (four binomial deviations)."""
    monkeypatch.setattr("piga.calibration.remarks.slow_changes.WAVE", replace(WAVE, chance=2.0))
    said = [waves(SMALL, seed) for seed in range(100)]
    chances = np.array([wave.probability for wave in said if wave is not None])
    assert chances.size == 100
    for limit in (0.01, 0.1, 0.5):
        count = int((chances < limit).sum())
        assert count <= 100 * limit + 4.0 * math.sqrt(100 * limit * (1.0 - limit))
    assert (chances < 0.5).sum() > 20, "not far too careful"


@pytest.mark.only_compiled
def test_no_wave_is_looked_for_in_angle_logs_and_short_records() -> None:
    assert waves(replace(HEAD, forces=head(12), seconds=20.0, rate=2.0, wave=(4e-5, 100.0)), 1) is None
    assert waves(replace(SMALL, seconds=4.0, wave=(4e-5, 100.0)), 1) is None


def test_the_verdict_names_it_where_nothing_else_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wave too faint for a doubt by coloured noise; beside such a doubt there is no second one."""
    seen = SlowWave(120.0, 3e-6, 1e-4)
    monkeypatch.setattr(all_remarks, "slow_wave", lambda _: seen)
    quiet = piga.calibrate(SMALL.record(2), SMALL.terms)
    assert [doubt.what for doubt in quiet.verdict.doubts if "slow wave" in doubt.what] == [seen.words]
    loud = piga.calibrate(replace(SMALL, wave=(2e-4, 150.0)).record(2), SMALL.terms)
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
