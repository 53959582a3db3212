"""The phase of a record at rest: found, with its uncertainty, or refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from piga.compensation import PhaseFinder, identify_phase
from tests.compensation.twin_data import K_G, TAN_BETA, calibration_of, constant_force, run_of


def rest_record(phi: float, noise: float, seed: int, kind: str = "angle"):
    t = np.arange(0.0, 30.0, 0.02)
    run = run_of(t, constant_force(t, 0.7, 0.7, 0.1), phi=phi, kind=kind)
    run.output[:] += noise * np.random.default_rng(seed).standard_normal(t.size)
    return run


def test_noiseless_phase_is_found():
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA}, angle_rms=1e-8)
    assert abs(identify_phase(rest_record(2.5, 0.0, 0), cal, 30.0).value - 2.5) < 1e-4


@pytest.mark.long
def test_phase_error_fits_its_uncertainty():
    """300 power-ups with 0.1 mrad of angle noise: the mean square of error over uncertainty is 1 within 3.5 of its std."""
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA}, angle_rms=1e-4)
    quiet, rng = rest_record(-1.0, 0.0, 0), np.random.default_rng(50)
    outputs = (quiet.output + 1e-4 * rng.standard_normal(quiet.size) for _ in range(300))
    seen = [identify_phase(replace(quiet, output=output), cal, 30.0) for output in outputs]
    scores = np.array([(p.value + 1.0) / p.std for p in seen])
    assert abs(np.mean(scores**2) - 1.0) < 3.5 * math.sqrt(2.0 / 300.0)
    assert 1e-4 < seen[0].std < 1e-2


def test_phase_is_found_on_line_once_the_output_has_turned():
    cal = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA}, angle_rms=1e-4)
    run, finder = rest_record(0.4, 1e-4, 1), PhaseFinder(cal)
    phases = [
        finder.push(run.t[i : i + 50], run.output[i : i + 50], run.f[i : i + 50, 1], run.f[i : i + 50, 2])
        for i in range(0, 1500, 50)
    ]
    assert phases[0] is None
    assert phases[-1].std < phases[15].std
    assert abs(phases[-1].value - identify_phase(run, cal, 30.0).value) < 1e-9
