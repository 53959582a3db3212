"""Noise of a static record: rates, angles, gaps, run files, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga.errors import ArgumentError, DataError
from piga.noise import read_static_log
from piga.reports.noise import noise_document

STEP = 0.2


@pytest.fixture(scope="module")
def record():
    """Rates of white noise with a mean, and their times."""
    rng = np.random.default_rng(21)
    return 5.0 + 0.3 / np.sqrt(STEP) * rng.standard_normal(6000), STEP * np.arange(6000)


def test_a_rate_and_its_integral_are_the_same_noise(record):
    rate, t = record
    of_rate = piga.analyse_noise(rate, t, unit="V")
    angle = np.concatenate(([7.0], 7.0 + STEP * np.cumsum(rate)))
    of_angle = piga.analyse_noise(angle, STEP * np.arange(6001), kind="angle", unit="V s/s")
    for one, other in zip(of_rate.deviations, of_angle.deviations, strict=True):
        assert one.deviation == pytest.approx(other.deviation, rel=1e-6)
    assert of_rate.levels[1].value == pytest.approx(of_angle.levels[1].value, rel=1e-2)
    assert of_rate.levels[1].lower < 0.3 < of_rate.levels[1].upper
    assert of_rate.duration == pytest.approx(1200.0)


def test_a_gap_ends_a_stretch(record):
    """A jump across a gap is in no difference: the levels stay."""
    rate, t = record
    kept = np.r_[0:2500, 2600:6000]
    noise = piga.analyse_noise(rate[kept] + 40.0 * (kept > 2550), t[kept])
    assert noise.stretches == 2
    assert noise.levels[1].lower < 0.3 < noise.levels[1].upper
    assert not noise.levels[4].seen
    jump = piga.analyse_noise(rate + 40.0 * (t > 510.0), t)
    assert jump.levels[3].seen


def test_a_run_file_gives_rate_and_acceleration(tmp_path):
    """A gyro accelerometer at rest, its angle with a random walk: N in rad/sqrt(s), and as acceleration by K."""
    rng, n = np.random.default_rng(22), 4000
    t = STEP * np.arange(n)
    psi = 0.8884 * t + np.cumsum(2e-5 * np.sqrt(STEP) * rng.standard_normal(n))
    np.savetxt(
        tmp_path / "run.csv", np.column_stack((t, psi)), delimiter=",", header="t,psi", comments="", fmt="%.12g"
    )
    (tmp_path / "run.toml").write_text(
        '[instrument]\nserial = "G"\nscale_factor = "0.8884 rad/s/g"\n[data]\nfile = "run.csv"\n'
        'time = { column = "t", unit = "s" }\noutput = { column = "psi", kind = "angle", unit = "rad" }\n'
    )
    noise = read_static_log(tmp_path / "run.toml")
    assert noise.unit == "rad/s"
    assert noise.levels[1].lower < 2e-5 < noise.levels[1].upper
    assert noise.scale_factor == pytest.approx(0.8884 / 9.80665)
    with pytest.raises(ArgumentError, match="states column"):
        read_static_log(tmp_path / "run.toml", column="psi")
    text = noise.summary()
    assert text.count("Levels") == 1
    assert "as acceleration" in text
    assert f"{noise.levels[1].value / np.pi * 648000:.2f}"[:4] in text


def test_quantisation_alone_has_no_random_walk():
    """Levels that are not seen have no value in JSON."""
    t = STEP * np.arange(6000)
    angle = t + 2.0 * np.random.default_rng(23).standard_normal(6000)
    noise = piga.analyse_noise(angle, t, kind="angle")
    levels = noise_document(noise)["levels"]
    assert levels["quantisation"]["value"] == pytest.approx(2.0, rel=0.05)
    assert [one["value"] for name, one in levels.items() if name != "quantisation"] == [None] * 4
    assert levels["random_walk"]["interval_95"] == [0.0, noise.levels[1].upper]


def test_a_column_without_a_unit_keeps_its_numbers(tmp_path, record):
    rate, t = record
    np.savetxt(tmp_path / "log.csv", np.column_stack((t, rate)), delimiter=",", header="t,rate", comments="")
    noise = read_static_log(tmp_path / "log.csv", column="rate")
    assert noise.unit == "1"
    assert noise.levels[1].lower < 0.3 < noise.levels[1].upper


def test_what_is_refused(tmp_path, record):
    rate, t = record
    with pytest.raises(ArgumentError, match="10 samples"):
        piga.analyse_noise(rate[:10], t[:10])
    with pytest.raises(ArgumentError, match="not finite"):
        piga.analyse_noise(np.where(t > 3.0, np.nan, rate), t)
    np.savetxt(tmp_path / "two.csv", np.column_stack((rate, rate)), delimiter=",", header="U,V", comments="")
    with pytest.raises(DataError, match="it may be: U, V"):
        read_static_log(tmp_path / "two.csv")
    with pytest.raises(DataError, match="no column 'W'"):
        read_static_log(tmp_path / "two.csv", column="W")
    with pytest.raises(DataError, match="no column holds the time"):
        read_static_log(tmp_path / "two.csv", column="U")
    assert read_static_log(tmp_path / "two.csv", column="U", sample_rate="5 Hz").samples == 6000


def test_a_rate_that_contradicts_the_log_is_refused(tmp_path, record):
    """It replaced the time of the log in silence; where both agree to rounding, that of the log counts."""
    rate, t = record
    log = tmp_path / "log.csv"
    np.savetxt(log, np.column_stack((t, rate)), delimiter=",", header="t [s],rate [V]", comments="")
    assert read_static_log(log, sample_rate="5.01 Hz").step == pytest.approx(STEP)
    with pytest.raises(ArgumentError, match=r"--sample-rate 20 Hz, but the time in the log gives 5 Hz"):
        read_static_log(log, sample_rate="20 Hz")
