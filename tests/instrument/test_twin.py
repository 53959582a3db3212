"""The servo twin against an independent rigid body, independent integrators, and what theory predicts."""

from __future__ import annotations

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from piga._kernels import servo
from piga.errors import ArgumentError, PigaError
from piga.instrument import Instrument, propagate
from piga.instrument.twin import PRESETS, TwinParameters, predicted_k2, run_twin, twin_parameters
from piga.units import G0
from tests.instrument.rigid_body import RICH, accelerations, solve
from tests.instrument.twin_predicted import stiffened, tilt_compliance

pytestmark = pytest.mark.interpreted

SLOW_PYTHON = bool(numba.config.DISABLE_JIT)
EXAMPLE = PRESETS["example"]


def constant(f, duration, step=1e-3, omega=(0.0, 0.0, 0.0)):
    t = np.arange(round(duration / step) + 1) * step
    return t, np.tile(np.asarray(f, float), (t.size, 1)), np.tile(np.asarray(omega, float), (t.size, 1))


def ramp_inputs(t):
    force = np.column_stack([G0 * (1 + t), 0.3 * G0 - 2 * t, 0.2 * G0 + t])
    return force, np.column_stack([0.1 * t, 0.05 + 0.02 * t, -0.03 * t])


def rigid_body(motion, t, slower=1.0, **options):
    """The independent rigid body from the first state of a motion under :func:`ramp_inputs`."""
    start = [motion.alpha[0], motion.beta[0], motion.rate[0], motion.tilt_rate[0], motion.integral[0]]
    return solve(
        RICH,
        start,
        t,
        lambda s: ramp_inputs(np.array([s / slower]))[0][0],
        lambda s: (ramp_inputs(np.array([s / slower]))[1][0], np.array([0.1, 0.02, -0.03]) / slower),
        **options,
    )


def revolutions(p, a_x, a_t, count, step=2e-3):
    """Motion over ``count`` revolutions, and the mean rate over them."""
    duration = (count + 0.2) * 2 * math.pi / (p.K * a_x)
    t, f, _ = constant((a_x, a_t, 0.0), duration, step)
    motion = run_twin(p, t, f)
    end = motion.alpha[0] + 2 * math.pi * count
    return motion, 2 * math.pi * count / np.interp(end, motion.alpha, t)


# -- equations ------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_equations_are_those_of_a_rigid_body(seed):
    rng = np.random.default_rng(seed)
    state = rng.normal(size=5) * [3, 0, 1, 1, 1e-3]
    state[1] = RICH.pick_off_null + rng.uniform(-5e-3, 5e-3)
    f, omega, omega_rate = rng.normal(size=3) * 10, rng.normal(size=3) * 0.1, rng.normal(size=3) * 0.1
    out = np.zeros(5)
    servo.derivative(RICH.constants(), 0.3, state, np.array([*f, *omega, 0.0, 0.0, 0.0, *omega_rate]), out)
    expected = accelerations(RICH, 0.3, state, f, omega, omega_rate)
    assert out[2:4] == pytest.approx(expected, rel=1e-11, abs=1e-7)
    assert out[:2] == pytest.approx([state[2], state[3]])
    assert out[4] in (0.0, pytest.approx(state[1] - RICH.pick_off_null))


# -- integration ----------------------------------------------------------------------------------


def test_motion_agrees_with_the_independent_rigid_body():
    t = np.linspace(0.0, 0.05, 51)
    force, omega = ramp_inputs(t)
    motion = run_twin(RICH, t, force, omega, start="transient")
    truth = rigid_body(motion, t[::10])
    assert motion.alpha[::10] == pytest.approx(truth[:, 0], abs=1e-12)
    assert motion.beta[::10] == pytest.approx(truth[:, 1], abs=1e-12)


@pytest.mark.slow
def test_ten_seconds_against_the_independent_rigid_body():
    t = np.linspace(0.0, 10.0, 10001)
    force, omega = ramp_inputs(t / 10)
    motion = run_twin(RICH, t, force, omega)
    truth = rigid_body(motion, t[::500], 10.0, rtol=1e-11, atol=1e-13)
    assert np.max(np.abs(motion.alpha[::500] - truth[:, 0])) < 1e-9


# -- slow manifold ---------------------------------------------------------------------------------


def test_slow_manifold_has_no_transient():
    """Started on it, the tilt follows its slow ripple at once; started at null it rings first."""
    p = replace(EXAMPLE, alpha0=0.7)
    t, f, _ = constant((G0, 0.5 * G0, 0.0), 0.05, 5e-4)
    smooth, rough = run_twin(p, t, f), run_twin(p, t, f, start="transient")
    bend = np.abs(np.diff(smooth.beta, 3)).max()
    assert bend < 1e-5 * np.abs(np.diff(rough.beta, 3)).max()
    assert smooth.alpha[0] == 0.7


# -- what theory predicts ----------------------------------------------------------------------------


@pytest.mark.long
def test_stiff_servo_goes_to_the_quasi_steady_model_with_first_order():
    """All gains times s: the difference to the quasi-steady angle falls as 1/s."""
    t, f, _ = constant((2 * G0, G0, 0.0), 5.0, 5e-3)
    inst = Instrument(EXAMPLE.K, 1e-3, 0.2)
    quasi = propagate(inst, t, f, between="linear")
    factors = np.array([2.0, 4.0, 8.0, 16.0])
    errors = []
    for factor in factors:
        p = stiffened(replace(EXAMPLE, pick_off_null=1e-3, alpha0=0.2, rate_gain=0.1), factor)
        errors.append(np.max(np.abs(run_twin(p, t, f).alpha - quasi)))
    order = -np.polyfit(np.log(factors), np.log(errors), 1)[0]
    assert order == pytest.approx(1.0, abs=0.05)


@pytest.mark.long
@pytest.mark.parametrize("k_i", np.geomspace(600.0, 6000.0, 5))
def test_rectification_and_second_harmonic_over_a_decade_of_integral_gain(k_i):
    p = replace(EXAMPLE, integral_gain=k_i, proportional_gain=60.0, rate_gain=0.1)
    a_x, a_t = 2 * G0, G0
    motion, mean = revolutions(p, a_x, a_t, 3)
    w = p.K * a_x
    textbook = -p.K * a_t**2 * p.pendulosity * w / (2.0 * k_i)
    assert mean - w == pytest.approx(textbook, rel=0.05)
    compliance = 0.5 * p.K * a_t**2 * p.pendulosity * tilt_compliance(p, w)
    assert mean - w == pytest.approx(-compliance.imag, rel=0.02)
    one = motion.alpha < motion.alpha[0] + 2 * math.pi
    phase, ripple = motion.alpha[one], motion.rate[one] - w
    basis = np.column_stack([np.ones(phase.size)] + [f(n * phase) for n in (1, 2) for f in (np.cos, np.sin)])
    fit = np.linalg.lstsq(basis, ripple, rcond=None)[0]
    assert math.hypot(fit[3], fit[4]) == pytest.approx(-textbook, rel=0.05)
    assert math.hypot(fit[3], fit[4]) == pytest.approx(abs(compliance), rel=0.03)


@pytest.mark.long
def test_coulomb_friction_shifts_beta_not_the_mean_rate():
    friction = 2e-3
    smooth = replace(EXAMPLE, integral_gain=0.0)
    rough = replace(smooth, coulomb_friction=friction)
    motion_0, mean_0 = revolutions(smooth, 6 * G0, 0.3 * G0, 1)
    motion_1, mean_1 = revolutions(rough, 6 * G0, 0.3 * G0, 1)
    shift = np.mean(motion_1.beta[:500]) - np.mean(motion_0.beta[:500])
    assert shift == pytest.approx(-friction / smooth.proportional_gain, rel=0.01)
    assert mean_1 == pytest.approx(mean_0, rel=1e-6)
    held = replace(EXAMPLE, coulomb_friction=friction)
    motion_2, _ = revolutions(held, 6 * G0, 0.3 * G0, 1)
    motion_3, _ = revolutions(EXAMPLE, 6 * G0, 0.3 * G0, 1)
    assert np.mean(motion_2.beta[:500] - motion_3.beta[:500]) == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize(
    "design",
    [
        replace(EXAMPLE, product_of_inertia=2e-6),
        replace(EXAMPLE, float_inertia_z=3e-5, pick_off_null=1e-2),
        replace(EXAMPLE, product_of_inertia=-1e-6, float_inertia_z=8e-5, pick_off_null=-5e-3),
    ],
)
def test_k2_comes_from_the_floats_inertia(design):
    """Even part of the indicated specific force at +- 2 g, against D K^2/ml and the unequal inertias."""
    a = 2 * G0
    even = 0.0
    for sign in (1.0, -1.0):
        t, f, _ = constant((sign * a, 0.0, 0.0), 0.2, 1e-2)
        motion = run_twin(design, t, f)
        even += 0.5 * ((motion.alpha[-1] - motion.alpha[0]) / t[-1] / design.K - sign * a)
    assert even / a**2 == pytest.approx(predicted_k2(design), rel=1e-3)
    if design.pick_off_null == 0.0:
        assert predicted_k2(design) * G0 == pytest.approx(
            design.product_of_inertia * design.K**2 * G0 / design.pendulosity
        )


def test_wheel_spins_up_and_hunts_by_definition():
    """``H (1 - (1 - s0) exp(-t/t_s)) (1 + h sin(2 pi f t + phi))`` and its derivative by a central difference."""
    p = replace(
        EXAMPLE, spin_start=0.8, spin_time=0.3, hunting=1e-2, hunting_frequency=2.0, hunting_phase=0.7
    ).constants()

    def defined(t):
        return p.H * (1.0 - 0.2 * np.exp(-t / 0.3)) * (1.0 + 1e-2 * np.sin(4.0 * np.pi * t + 0.7))

    for t in (0.0, 0.1, 0.4, 2.0):
        momentum, change = servo.wheel(p, t)
        assert momentum == pytest.approx(defined(t), rel=1e-14)
        assert change == pytest.approx((defined(t + 1e-5) - defined(t - 1e-5)) / 2e-5, rel=1e-6)


@pytest.mark.long
def test_saturated_torque_motor_loses_lock_and_recovers():
    p = replace(EXAMPLE, torque_limit=0.03, pick_off_range=5e-3, stop_angle=0.02)
    t = np.arange(0, 1.5, 1e-3)
    f = np.zeros((t.size, 3))
    f[:, 0] = G0
    f[:, 1] = np.where((t > 0.1) & (t < 0.3), 6 * G0, 0.0)
    motion = run_twin(p, t, f)
    changes = motion.lock_changes()
    assert changes[0][1] == "lost"
    assert 0.1 <= changes[0][0] <= 0.12
    assert changes[-1][1] == "recovered"
    assert np.max(np.abs(motion.torque)) <= 0.03
    assert np.max(np.abs(motion.beta)) < 0.1
    assert motion.rate[-1] == pytest.approx(p.K * G0, rel=1e-4)
    assert abs(motion.beta[-1]) < 1e-5


def test_noise_is_held_and_disturbs():
    t, f, omega = constant((G0, 0.0, 0.0), 0.5)
    noise = np.zeros((t.size, 3))
    noise[:, 1] = 1e-6
    motion = run_twin(EXAMPLE, t, f, omega, noise=noise)
    assert motion.rate[-1] == pytest.approx(EXAMPLE.K * G0 - 1e-6 / EXAMPLE.angular_momentum, abs=1e-9)


# -- parameters and errors ----------------------------------------------------------------------------


def test_parameters_from_text():
    p = twin_parameters({"preset": "example-stiff", "damping": "0.3 Nm s/rad", "hunting_frequency": "2 Hz"})
    assert (p.damping, p.hunting_frequency) == (0.3, 2.0)
    assert p.proportional_gain == PRESETS["example-stiff"].proportional_gain


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"preset": "best"}, "preset"),
        ({"dampin": 1.0}, "dampin"),
        ({"damping": -1.0}, "damping"),
        ({"damping": "1 m"}, "damping"),
        ({"product_of_inertia": 6e-5}, "product_of_inertia"),
    ],
)
def test_bad_parameters_are_named(values, words):
    with pytest.raises(PigaError, match=words):
        twin_parameters(values)


def test_bad_inputs_are_named():
    t, f, omega = constant((G0, 0.0, 0.0), 0.01)
    with pytest.raises(ArgumentError, match=r"t: 0.009.* at index 1 is not after 0.01 s"):
        run_twin(EXAMPLE, t[::-1], f)
    with pytest.raises(ArgumentError, match="f: shape"):
        run_twin(EXAMPLE, t, f[:-1])
    with pytest.raises(ArgumentError, match=r"f: nan at index \(3, 0\)"):
        run_twin(EXAMPLE, t, np.where(np.arange(t.size)[:, None] == 3, np.nan, f))
    with pytest.raises(ArgumentError, match="noise"):
        run_twin(EXAMPLE, t, f, omega, noise=f[:-1])
    with pytest.raises(ArgumentError, match="start"):
        run_twin(EXAMPLE, t, f, start="cold")


def test_unstable_design_has_no_manifold_but_can_be_forced():
    p = TwinParameters(proportional_gain=150.0)
    t, f, _ = constant((G0, G0, 0.0), 0.05)
    with pytest.raises(PigaError, match="no slow manifold"):
        run_twin(p, t, f)
    assert np.all(np.isfinite(run_twin(p, t, f, start="transient").alpha))


def test_a_motion_too_fast_to_follow() -> None:
    """Forces of a thousand million g leave the stops no chance."""
    p = replace(PRESETS["example"], stop_angle=1e-3)
    t, f = np.linspace(0.0, 10.0, 3), np.tile([1e12, 1e12, 0.0], (3, 1))
    with pytest.raises(PigaError, match="cannot be followed"):
        run_twin(p, t, f, start="transient")
