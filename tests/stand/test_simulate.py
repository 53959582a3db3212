"""Simulated tests: the log holds the motion that was simulated, with what disturbs it; with the servo twin, too."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from piga.calibration.calibrate import calibrate
from piga.earth import Site
from piga.errors import ArgumentError
from piga.instrument import ErrorModel, Instrument
from piga.instrument.electronics import Electronics, Temperature, flicker_noise, markov_noise
from piga.instrument.twin import PRESETS, UnstableDesignError
from piga.stand import (
    Centrifuge,
    Composite,
    DividingHead,
    Drive,
    Imperfections,
    LoggedProfile,
    RateTable,
    Specimen,
    SpinPlan,
    VibrationTable,
    read_scenario,
    simulate_test,
)
from piga.stand.simulate import straightened
from piga.units import G0
from tests.instrument.servo_truth import Design, motion
from tests.stand.simulated import (
    COUNTS,
    HEAD,
    INST,
    SCENARIO,
    SITE,
    predicted_angle_error,
    saved,
    truth_of,
)

pytestmark = pytest.mark.interpreted


def test_log_holds_what_the_gimbal_did():
    test = simulate_test(HEAD, Specimen(INST), COUNTS)
    assert test.log.labels == ("0", "1", "2", "3")
    assert test.log.t.size == 4 * 201
    rows = np.searchsorted(test.profile.t, test.log.t - 1e-9)
    psi = test.log.output * 2 * math.pi / 72000
    assert np.abs(psi + 0.5 - test.alpha[rows]).max() <= math.pi / 72000 * 1.0001
    assert test.phases == (0.5,) * 4
    assert np.all(test.log.reference == test.profile.reference[rows])


def test_harmonics_of_the_gimbal_angle_enter_the_motion():
    """Second harmonic by iteration, against a direct integration."""
    harmonics = {1: (2e-3, 1e-3), 2: (3e-3, -1e-3)}
    stand = DividingHead(SITE, (0.3,), dwell=10.0, move=1.0)
    test = simulate_test(stand, Specimen(INST, harmonics=harmonics), COUNTS, step=2e-3)
    f, omega = test.profile.force[0], test.profile.base_rate[0]
    u = INST.scale_factor * f - omega

    def slope(_t, x):
        extra = sum(s * math.sin(n * x[0]) + c * math.cos(n * x[0]) for n, (s, c) in harmonics.items())
        pull = u[1] * math.sin(x[0]) - u[2] * math.cos(x[0])
        return [u[0] + INST.tan_beta * pull + INST.scale_factor * extra]

    truth = solve_ivp(slope, (0.0, 10.0), [0.8], method="DOP853", rtol=1e-12, atol=1e-12)
    assert test.alpha[-1] == pytest.approx(truth.y[0, -1], abs=1e-8)


@pytest.mark.parametrize("level", [1.0, 6.0])
def test_servo_terms_enter_the_motion_as_the_rigid_body_has_them(level):
    """The angle over 5 s at 45 deg, against rotor, float and servo integrated by SciPy; gravity 1 g and 6 g."""
    p = Design(K=INST.scale_factor, beta=INST.beta)
    stand = DividingHead(Site(SITE.latitude, gravity=level * G0), (math.pi / 4,), dwell=5.0, move=1.0)
    f, omega = (v[0] for v in stand.motion(np.zeros(1), Imperfections()))
    body = motion(p, f, omega, 0.3, np.concatenate([[0.0], 1.0 + np.arange(51) * 0.1]))[1:, 0]
    start = Instrument(INST.scale_factor, INST.beta, body[0])
    terms = {"servo": p.K * p.ml / (2.0 * p.k_i), "servo_damping": p.c * p.K**2 / p.k_i}
    off = {}
    for name, own in (("with", terms), ("without", {})):
        test = simulate_test(stand, Specimen(start, **own), COUNTS)
        off[name] = np.abs(np.interp(np.arange(51) * 0.1, test.profile.t, test.alpha) - body).max()
    assert off["without"] > 1e-5 * level**3
    assert off["with"] < 0.02 * off["without"]


def test_random_walk_enters_the_motion_exactly():
    """With rate noise the walked angle acts as phase: against an integration with the same increments."""
    stand = DividingHead(SITE, (1.0,), dwell=10.0, move=1.0)
    e = replace(COUNTS, angle_random_walk=1e-2, kind="angle")
    specimen = Specimen(Instrument("0.8884 rad/s/g", "2 deg", 0.8))
    test = simulate_test(stand, specimen, e, seed=3, step=0.01)
    plain = simulate_test(stand, specimen, replace(e, angle_random_walk=0.0), step=0.01)
    walk = np.concatenate([[0.0], np.cumsum(1e-3 * np.random.default_rng(3).spawn(4)[0].standard_normal(1000))])
    u = INST.scale_factor * test.profile.force - test.profile.base_rate
    tangent = specimen.instrument.tan_beta
    alpha = [0.8]
    for k in range(1000):
        parts = 50
        x = alpha[-1]
        for j in range(parts):
            w = walk[k] + (walk[k + 1] - walk[k]) * (j + 0.5) / parts - walk[k]
            mid = x + w
            x += (u[k, 0] + tangent * (u[k, 1] * math.sin(mid) - u[k, 2] * math.cos(mid))) * 0.01 / parts
        alpha.append(x + walk[k + 1] - walk[k])
    assert np.std(test.alpha - plain.alpha) > 1e-3
    assert test.alpha == pytest.approx(np.array(alpha), abs=1e-4)


def test_clock_errors_shift_the_samples():
    late = simulate_test(HEAD, Specimen(INST), replace(COUNTS, kind="angle", clock_offset=0.02))
    plain = simulate_test(HEAD, Specimen(INST), replace(COUNTS, kind="angle"))
    rate = np.interp(late.log.t, late.profile.t, late.rate)
    assert late.log.output - plain.log.output == pytest.approx(0.02 * rate, abs=2e-4)
    fast = simulate_test(
        HEAD, Specimen(INST), replace(COUNTS, kind="angle"), imperfections=Imperfections(timing=1e-3)
    )
    shift = fast.log.output - plain.log.output
    assert shift[100] == pytest.approx(1e-3 * fast.log.t[100] * rate[100], rel=1e-2)
    assert np.all(fast.log.t == plain.log.t)


def test_temperature_is_felt_and_logged_with_its_error():
    specimen = Specimen(INST, ErrorModel(k0_T="1e-4 g/K"))
    warm = simulate_test(
        HEAD,
        specimen,
        COUNTS,
        temperature=Temperature(303.15),
        imperfections=Imperfections(temperature=0.5),
    )
    assert warm.log.temperature == pytest.approx(302.65)
    plain = simulate_test(HEAD, Specimen(INST), COUNTS)
    assert (warm.alpha[-1] - plain.alpha[-1]) == pytest.approx(
        INST.scale_factor * 1e-3 * G0 * warm.profile.t[-1], rel=1e-2
    )


def test_flicker_has_the_same_variance_in_each_decade():
    rng, spectra = np.random.default_rng(4), []
    for _ in range(20):
        noise = flicker_noise(rng, 20_000, 3.0) * np.hanning(20_000) * np.sqrt(8.0 / 3.0)
        spectra.append(2.0 * np.abs(np.fft.rfft(noise)) ** 2 / noise.size**2)
    frequency, power = np.fft.rfftfreq(20_000, 0.05), np.mean(spectra, axis=0)
    decades = [power[(frequency >= low) & (frequency < 10.0 * low)].sum() for low in (0.01, 0.1, 0.9)]
    assert np.sqrt(decades) == pytest.approx(3.0, rel=0.05)


def test_markov_noise_forgets_in_its_time():
    noise = markov_noise(np.random.default_rng(5), 400_000, 0.05, 2.0, 5.0)
    assert noise.std() == pytest.approx(2.0, rel=0.03)
    assert np.mean(noise[100:] * noise[:-100]) == pytest.approx(4.0 * math.exp(-1.0), rel=0.1)
    assert noise[0] != 0.0


@pytest.mark.parametrize(
    "coloured",
    [{"bias_flicker": 1e-4}, {"bias_markov": 1e-4, "bias_markov_time": 5.0}, {"bias_random_walk": 3e-5}],
    ids=["flicker", "markov", "walk"],
)
@pytest.mark.parametrize("kind", ["angle", "rate"])
def test_coloured_bias_turns_the_output(coloured: dict[str, float], kind: str):
    e = Electronics(sample_rate=10.0, kind=kind)
    plain = simulate_test(HEAD, Specimen(INST), e)
    assert kind == "angle" or plain.log.output[0] == pytest.approx(plain.rate[0])
    noisy = simulate_test(HEAD, Specimen(INST), replace(e, **coloured))
    change = noisy.log.output - plain.log.output
    rate = change if kind == "rate" else np.gradient(change, noisy.log.t)
    assert INST.scale_factor * 3e-5 < np.std(rate) < INST.scale_factor * 1e-3
    assert np.array_equal(
        noisy.log.output, simulate_test(HEAD, Specimen(INST), replace(e, **coloured)).log.output
    )


def test_twin_takes_k_beta_and_start_from_the_instrument():
    specimen = Specimen(INST, twin=PRESETS["example"])
    assert (specimen.design.K, specimen.design.pick_off_null, specimen.design.alpha0) == (
        pytest.approx(INST.scale_factor),
        INST.beta,
        0.8,
    )
    stand = DividingHead(SITE, (0.0,), dwell=1.0, move=1.0)
    test = simulate_test(stand, specimen, COUNTS, model="twin")
    assert test.motion is not None
    assert test.alpha[0] == 0.8
    assert test.rate[-1] == pytest.approx(INST.scale_factor * 9.80166, rel=1e-4)


def test_twin_refuses_what_it_cannot_do():
    with pytest.raises(ArgumentError, match=r"needs \[twin\] parameters"):
        simulate_test(HEAD, Specimen(INST), COUNTS, model="twin")
    unstable = Specimen(INST, twin=replace(PRESETS["example"], proportional_gain=300.0))
    with pytest.raises(UnstableDesignError, match="unstable"):
        simulate_test(HEAD, unstable, COUNTS, model="twin")
    with pytest.raises(ArgumentError, match="its servo makes them"):
        simulate_test(HEAD, Specimen(INST, servo=1e-7, twin=PRESETS["example"]), COUNTS, model="twin")
    with pytest.raises(ArgumentError, match="makes its own"):
        simulate_test(HEAD, Specimen(INST, ErrorModel(s1=1e-3), twin=PRESETS["example"]), COUNTS, model="twin")


@pytest.mark.long
def test_random_walk_of_the_twin_has_the_stated_level():
    stand = DividingHead(SITE, (0.0,), dwell=2.0, move=1.0)
    specimen = Specimen(Instrument("0.8884 rad/s/g"), twin=PRESETS["example-stiff"])
    e = replace(COUNTS, angle_random_walk=1e-4)
    noisy = simulate_test(stand, specimen, e, model="twin", seed=2, step=0.01)
    plain = simulate_test(stand, specimen, COUNTS, model="twin", step=0.01)
    increments = np.diff(noisy.alpha - plain.alpha)
    assert increments.std() == pytest.approx(1e-4 * math.sqrt(0.01), rel=0.15)


SHORT_HEAD = DividingHead(SITE, (0.0, 1.0), dwell=4.0, move=2.0)


def test_bad_steps_and_harmonics() -> None:
    with pytest.raises(ArgumentError, match="step: 0 s is not positive"):
        simulate_test(SHORT_HEAD, Specimen(INST), COUNTS, step=0.0)
    huge = Specimen(INST, harmonics={2: (30.0 * G0, 0.0)})
    with pytest.raises(ArgumentError, match="too large to be simulated"):
        simulate_test(SHORT_HEAD, huge, COUNTS)


# -- calibration finds the truth again ------------------------------------------------------------------

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
    table = msgspec.structs.replace(scenario.table, model={"terms": terms})
    return saved(replace(scenario, table=table), test, folder)


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
