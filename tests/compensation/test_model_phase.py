"""The phase of a record at rest: found, with its uncertainty, or refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.compensation import PhaseFinder, identify_phase
from piga.units import G0
from tests.compensation.run_files import CAL
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of

PLAIN = {"scale_factor": K_G, "tan_beta": TAN_BETA}


def rest_record(phi: float, noise: float = 0.0, **more: object) -> piga.Run:
    t = np.arange(0.0, 30.0, 0.02)
    run = run_of(t, constant_force(t, 0.7, 0.7, 0.1), phi=phi, **more)
    run.output[:] += noise * np.random.default_rng(1).standard_normal(t.size)
    return run


def test_a_first_harmonic_does_not_move_the_phase():
    """It is as large as the coupling, at another angle: what is known of it is taken out before the phase is sought."""
    errors = {"s1": 2e-3, "c1": -3e-3}
    for known in ({}, errors):
        phase = identify_phase(
            rest_record(2.5, errors=known), calibration_of({**PLAIN, **known}, angle_rms=1e-8), 30.0
        )
        assert phase.value == pytest.approx(2.5, abs=1e-4)


@pytest.mark.long
def test_phase_error_fits_its_uncertainty():
    """300 power-ups with 0.1 mrad of angle noise: the mean square of error over uncertainty is 1 within 3.5 of its std."""
    cal, quiet, rng = calibration_of(PLAIN, angle_rms=1e-4), rest_record(-1.0), np.random.default_rng(50)
    outputs = (quiet.output + 1e-4 * rng.standard_normal(quiet.size) for _ in range(300))
    seen = [identify_phase(replace(quiet, output=output), cal, 30.0) for output in outputs]
    scores = np.array([(p.value + 1.0) / p.std for p in seen])
    assert abs(np.mean(scores**2) - 1.0) < 3.5 * math.sqrt(2.0 / 300.0)
    assert 1e-4 < seen[0].std < 1e-2


def test_phase_is_found_on_line_once_the_output_has_turned():
    cal = calibration_of(PLAIN, angle_rms=1e-4)
    run, finder = rest_record(0.4, 1e-4), PhaseFinder(cal)
    phases = [
        finder.push(run.t[i : i + 50], run.output[i : i + 50], run.f[i : i + 50, 1], run.f[i : i + 50, 2])
        for i in range(0, 1500, 50)
    ]
    assert phases[0] is None
    assert phases[-1].std < phases[15].std
    assert abs(phases[-1].value - identify_phase(run, cal, 30.0).value) < 1e-9


def test_a_phase_that_cannot_be_found():
    with pytest.raises(piga.CalibrationError, match="no cross-coupling: there is no phase to find"):
        PhaseFinder(calibration_of({"scale_factor": K_G, "k0": 1e-3}))
    t = 0.01 * np.arange(3000)
    cal = calibration_of(CAL, angle_rms=1e-6)
    still = run_of(t[:100], constant_force(t[:100], 1.0, 3.0), phi=0.3)
    with pytest.raises(piga.CalibrationError, match=r"the output does not turn once in the first 0\.5 s"):
        identify_phase(still, cal, 0.5)
    alone = run_of(t, constant_force(t, 1.0, 0.0), phi=0.3)
    with pytest.raises(piga.CalibrationError, match="no transverse specific force"):
        identify_phase(alone, cal, 30.0)
    weak = run_of(t, constant_force(t, 1.0, 1e-3), phi=0.3)
    noisy = calibration_of(CAL, angle_rms=1e-4)
    with pytest.raises(piga.CalibrationError, match=r"known to .* rad only after 30 s(?s:.*)more transverse"):
        identify_phase(weak, noisy, 30.0)


def test_the_phase_of_a_record_of_rates_up_to_its_first_gap():
    """Behind the gap another phase begins: it must not be looked at."""
    t = 0.01 * np.arange(3000)
    f = constant_force(t, 1.0, 3.0)
    first, second = run_of(t, f, phi=0.3, kind="rate"), run_of(t, f, phi=2.0, kind="rate")
    record = piga.Run.from_arrays(
        np.concatenate((t, t + 100.0)), np.concatenate((first.output, second.output)), np.concatenate((f, f)),
        scale_factor=K_G / G0, kind="rate", segment=np.repeat([0, 1], t.size), units="SI",
    )  # fmt: skip
    cal = calibration_of(CAL, angle_rms=1e-6)
    phase = identify_phase(record, cal, 1000.0)
    assert abs(phase.value - 0.3) < 1e-3
    by_angle = identify_phase(run_of(t, f, phi=0.3), cal, 30.0)
    assert abs(phase.value - by_angle.value) < 1e-3
