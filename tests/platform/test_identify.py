"""Identification: exact without noise, efficient and honest with it."""

from __future__ import annotations

import numpy as np
import pytest

from piga.errors import ArgumentError, IdentifiabilityError
from piga.platform import identify, simulate
from piga.platform.geometry import apparent_gyro
from piga.platform.scenario import Gyro, PigaSensors, Sensors
from tests.platform.conftest import (
    ARCMIN,
    ARCSEC,
    AT_SEA,
    DEG,
    INTERPRETED,
    NOISE,
    calibration,
    long,
    truth,
)

pytestmark = pytest.mark.interpreted


@pytest.mark.parametrize("sources", [("gimbals", "pick-off"), ("gimbals",)])
def test_without_noise_everything_is_found(sources):
    s = calibration()
    identified = identify(simulate(s).readouts, s.place, sources=sources)
    tolerance = 1e-13 if "pick-off" in sources else 1e-12
    np.testing.assert_allclose(identified.values, truth(s)[: len(identified.values)], rtol=0, atol=tolerance)
    assert identified["polar.misalignment"].value == pytest.approx(4.0 * ARCMIN, abs=tolerance)


def test_parameters_come_back_as_amplitudes_and_phases():
    s = calibration()
    identified = identify(simulate(s).readouts, s.place)
    for gyro, name in ((s.polar, "polar"), (s.equatorial, "equatorial")):
        assert identified[f"{name}.phase"].value == pytest.approx(gyro.phase, abs=1e-9)
        for h in gyro.harmonics:
            assert identified[f"{name}.harmonic{h.order}.amplitude"].value == pytest.approx(
                h.amplitude, abs=1e-12
            )
            assert identified[f"{name}.harmonic{h.order}.phase"].value == pytest.approx(h.phase, abs=1e-6)
    with pytest.raises(KeyError, match=r"polar\.phase"):
        identified["polar.size"]


def test_a_case_fixed_drift_is_identified_as_part_of_the_misalignment():
    drift = (0.02 * DEG / 3600.0, -0.01 * DEG / 3600.0)
    s = calibration(
        polar=Gyro(4.0 * ARCMIN, 0.4, case_drift=drift), equatorial=Gyro(3.0 * ARCMIN, 1.3, case_drift=drift)
    )
    identified = identify(simulate(s).readouts, s.place)
    for gyro, rotation, seen in (
        (s.polar, s.polar_rotation, identified.knowledge.polar),
        (s.equatorial, s.equatorial_rotation, identified.knowledge.equatorial),
    ):
        apparent = apparent_gyro(gyro, rotation)
        assert abs(apparent.phase - gyro.phase) > 5e-3
        assert seen.misalignment == pytest.approx(apparent.misalignment, abs=0.01 * ARCSEC)
        assert seen.phase == pytest.approx(apparent.phase, abs=5e-5)


@pytest.mark.parametrize("sources", [("force", "pick-off"), ("force",)])
def test_the_force_alone_tells_it_too(sources):
    s = calibration()
    identified = identify(simulate(s).readouts, s.place, sources=sources)
    np.testing.assert_allclose(
        identified.values, truth(s)[: len(identified.values)], rtol=0, atol=5e-4 * ARCSEC
    )


@pytest.mark.parametrize("reversal", [1, 4])
@pytest.mark.parametrize("sources", [("gimbals", "pick-off"), ("force", "pick-off")])
def test_cases_that_reverse_are_identified_alike(sources, reversal):
    s = calibration(reversal=reversal)
    identified = identify(simulate(s).readouts, s.place, sources=sources)
    atol = 2e-3 * ARCSEC if "force" in sources else 1e-13
    np.testing.assert_allclose(identified.values, truth(s), rtol=0, atol=atol)


@pytest.mark.parametrize("step", [4.0, 8.0, 24.0])
def test_the_length_of_the_step_does_not_bias_what_the_force_tells(step):
    s = calibration(step=step)
    identified = identify(simulate(s).readouts, s.place, sources=("force", "pick-off"))
    np.testing.assert_allclose(identified.values, truth(s), rtol=0, atol=5e-4 * ARCSEC)


@long
def test_gyro_accelerometers_read_the_turn_of_the_platform_too():
    """Left out, it would show as 1.5 % of the misalignment: 3.6 arcsec."""
    piga = PigaSensors(0.8884 / 9.80665, np.arctan(3.6e-4), mounting="skewed")
    s = calibration(sensors=Sensors("piga", piga=piga), step=0.5)
    identified = identify(simulate(s).readouts, s.place, sources=("force", "pick-off"))
    np.testing.assert_allclose(identified.values[:16], truth(s)[:16], rtol=0, atol=0.005 * ARCSEC)


def test_too_few_samples_a_turn_are_refused():
    s = calibration(step=30.0)
    with pytest.raises(ArgumentError, match="20 samples a case turn"):
        identify(simulate(s).readouts, s.place, sources=("force",))


def test_a_swaying_base_does_not_spoil_it():
    s = calibration(motion=AT_SEA, step=2.0 if INTERPRETED else 1.0, sensors=NOISE)
    identified = identify(simulate(s).readouts, s.place, sources=("force", "pick-off"))
    std = np.sqrt(np.diag(identified.covariance))
    score = (identified.values - truth(s)) / std
    assert np.abs(score).max() < 4.5
    assert std[:4].max() < (0.3 if INTERPRETED else 0.1) * ARCSEC


def test_equal_speeds_leave_the_pick_off_alone_undetermined():
    s = calibration(polar=Gyro(4 * ARCMIN, 0.3), equatorial=Gyro(4 * ARCMIN, 1.0), sensors=NOISE)
    with pytest.raises(IdentifiabilityError, match="cannot tell apart"):
        identify(simulate(s).readouts, s.place, sources=("pick-off",), orders=1)


def test_unequal_speeds_separate_the_pick_off():
    s = calibration(equatorial_rotation=0.75 * 2 * np.pi / 480.0)
    run = simulate(s)
    only = identify(run.readouts, s.place, sources=("pick-off",), orders=1)
    assert only["polar.misalignment"].value == pytest.approx(4 * ARCMIN, rel=0.02)


def test_wrong_use_is_refused():
    s = calibration(duration=800.0)
    readouts = simulate(s).readouts
    with pytest.raises(ArgumentError, match="two turns"):
        identify(readouts, s.place)
    resting = simulate(calibration(equatorial_rotation=0.0)).readouts
    with pytest.raises(ArgumentError, match="one is at rest"):
        identify(resting, s.place)
    with pytest.raises(ArgumentError, match="some of gimbals"):
        identify(readouts, s.place, sources=("stars",))


def test_an_absent_misalignment_is_called_absent():
    s = calibration(polar=Gyro(), sensors=NOISE)
    identified = identify(simulate(s).readouts, s.place)
    assert any(note.startswith("polar: below") and "misalignment" in note for note in identified.notes)
