"""Calibration of simulated tests finds the truth of every stand again."""

import math
from dataclasses import replace

import numpy as np
import pytest

from piga.calibration.calibrate import calibrate
from piga.instrument import ErrorModel
from piga.instrument.twin.electronics import Electronics
from piga.instrument.twin.parameters import PRESETS
from piga.stand import (
    Centrifuge,
    Composite,
    DividingHead,
    Drive,
    LoggedProfile,
    RateTable,
    Specimen,
    SpinPlan,
    VibrationTable,
    read_scenario,
    simulate_test,
)
from piga.stand.simulate import straightened
from tests.stand.simulated import INST, SCENARIO, SITE, predicted_angle_error, saved, truth_of

pytestmark = pytest.mark.interpreted

SHORT = {
    "dividing-head": (DividingHead(SITE, tuple(0.15 + np.arange(12) * math.pi / 6), 20.0, 5.0), 20.0),
    "centrifuge": (Centrifuge(SITE, 1.0, SpinPlan((3.0, 6.0, 9.0, 5.0), 20.0, 5.0)), 50.0),
    "rate-table": (
        RateTable(SITE, SpinPlan((0.05, 0.1, -0.1), 40.0, 10.0), along="Z0", horizontal=True),
        100.0,
    ),
    "vibration-table": (
        VibrationTable(
            SITE, (Drive("rest", 10.0), Drive("sine", 40.0, 0.3, amplitude=5.0)) * 3, axis="Y0", up="X0"
        ),
        50.0,
    ),
    "composite": (
        Composite(
            (
                DividingHead(SITE, (0.0, 1.0, 2.5), 20.0, 5.0),
                Centrifuge(SITE, 1.0, SpinPlan((4.0, 8.0), 20.0, 5.0)),
            ),
            10.0,
        ),
        50.0,
    ),
}
_TIMES = np.arange(0.0, 120.5, 0.5)
_SWING = np.column_stack(
    [1.0 + 0.4 * np.sin(0.2 * _TIMES), 0.5 * np.cos(0.13 * _TIMES), 0.3 * np.sin(0.17 * _TIMES)]
)
SHORT["profile"] = (LoggedProfile(_TIMES, 9.80665 * _SWING, np.full((_TIMES.size, 3), 4e-5)), 50.0)

TERMS = {
    "profile": ["scale_factor", "tan_beta", "k0"],
    "dividing-head": ["scale_factor", "tan_beta", "k0", "k2"],
    "centrifuge": ["scale_factor", "tan_beta", "k0", "k2"],
    "rate-table": ["scale_factor", "tan_beta", "k0"],
    "vibration-table": ["tan_beta", "k0"],
    "composite": ["scale_factor", "tan_beta", "k0", "k2"],
}


def run_record(test, folder, terms):
    """The test as a lab would hand it over, read back."""
    path = folder / "scenario.toml"
    path.write_text(SCENARIO, encoding="utf-8")
    scenario = read_scenario(path)
    table = replace_struct(scenario.table, model={"terms": terms})
    return saved(replace(scenario, table=table), test, folder)


def replace_struct(struct, **changes):
    import msgspec

    return msgspec.structs.replace(struct, **changes)


def scores(cal, test):
    """Error and uncertainty by name; tan beta and its phase as one complex coefficient."""
    truth = truth_of(test)
    result = {
        c.key: (c.value - truth.get((c.name, c.segment), 0.0), c.std)
        for c in cal.coefficients
        if c.name not in ("tan_beta", "phi")
    }
    size, phase = cal["tan_beta"], cal["phi"]
    error = size.value * np.exp(1j * phase.value) - truth["tan_beta", None] * np.exp(1j * truth["phi", None])
    return result | {"coupling": (error, math.hypot(size.std, size.value * phase.std))}


@pytest.mark.long
def test_a_simulated_sine_has_the_integrals_of_a_sine():
    """Truth: SciPy's integral of the equation of motion under the sine itself, between samples too."""
    from scipy.integrate import solve_ivp

    drive = Drive("sine", 4.0, 20.0, amplitude=30.0)
    table = VibrationTable(SITE, (drive,), axis="X0", up="X0")
    e = Electronics(sample_rate=1000.0, kind="angle")
    test = simulate_test(table, Specimen(INST, ErrorModel(k0="3e-4 g")), e)
    t, K = test.profile.t, INST.scale_factor
    rest = test.profile.force[0]
    bias = K * ErrorModel(k0="3e-4 g").specific_force(np.zeros(1), np.zeros((1, 3)), None)[0]

    def rate(time, alpha):
        force = rest[:, None] + np.outer([1.0, 0.0, 0.0], drive.acceleration(np.atleast_1d(time - start))[0])
        u = K * force[:, 0] - test.profile.base_rate[0]
        return u[0] + bias + INST.tan_beta * (u[1] * np.sin(alpha) - u[2] * np.cos(alpha))

    start = next(s.start for s in test.profile.segments if s.label)
    rows = (t >= start) & (t <= start + drive.duration)
    integrated = solve_ivp(
        rate,
        (t[rows][0], t[rows][-1]),
        [test.alpha[rows][0]],
        t_eval=t[rows],
        rtol=1e-12,
        atol=1e-12,
        max_step=2e-3,
    )
    assert np.abs(test.alpha[rows] - integrated.y[0]).max() < 1e-8  # straight lines: 3e-5
    true_rates = [rate(time, alpha)[()] for time, alpha in zip(t[rows], integrated.y[0], strict=True)]
    assert np.abs(test.rate[rows] - np.ravel(true_rates)).max() < 1e-9


def test_straight_lines_stay_by_a_step_or_a_kink():
    t = np.arange(0.0, 1.0, 0.01)[:, None]
    for values in (np.where(t > 0.5, 3.0, 0.0), np.abs(t - 0.5), np.ones_like(t), t):
        np.testing.assert_array_equal(straightened(values), values)
    wave = np.sin(8.0 * t)
    assert np.abs(straightened(wave) - wave * np.tan(0.04) / 0.04)[4:-4].max() < 1e-9


@pytest.mark.long
@pytest.mark.parametrize("kind", SHORT)
def test_calibration_finds_the_truth_of_every_stand(kind, tmp_path):
    stand, sample_rate = SHORT[kind]
    model = ErrorModel(k0="3e-4 g", k2="4e-6 g/g^2" if "k2" in TERMS[kind] else 0.0)
    e = Electronics(sample_rate=sample_rate, zero=0.5, angle_random_walk=1e-6)
    test = simulate_test(stand, Specimen(INST, model), e, seed=11)
    cal = calibrate(run_record(test, tmp_path, TERMS[kind]))
    for key, (error, std) in scores(cal, test).items():
        assert abs(error) < 4.0 * std, key


@pytest.mark.long
@pytest.mark.parametrize("kind", ["dividing-head", "centrifuge"])
def test_calibration_of_a_twin_run_is_off_by_the_predicted_model_error(kind, tmp_path):
    """Within the uncertainty plus the predicted model error; taken off first, within the uncertainty."""
    stand, sample_rate = SHORT[kind]
    twin = replace(PRESETS["example-stiff"], product_of_inertia=1e-6 if "k2" in TERMS[kind] else 0.0)
    e = Electronics(sample_rate=sample_rate, zero=0.5, angle_noise=3e-5, angle_random_walk=1e-6)
    model = ErrorModel(k0="3e-4 g")
    test = simulate_test(stand, Specimen(INST, model, twin=twin), e, model="twin", step=0.005)
    run = run_record(test, tmp_path, TERMS[kind])
    raw = scores(calibrate(run), test)
    corrected = scores(calibrate(replace(run, output=run.output - predicted_angle_error(test))), test)
    for key, (error, std) in corrected.items():
        model_error = raw[key][0] - error
        assert abs(error) < 4.0 * std + 0.1 * abs(model_error), key
        assert abs(raw[key][0]) < 4.0 * std + 1.2 * abs(model_error), key
