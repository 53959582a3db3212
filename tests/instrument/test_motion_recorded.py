"""Motion under recorded input: order, exactness, independent integrators, segments, fleets, bad input."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import piga
from piga.instrument import ErrorModel, Instrument, closed_form, propagate, propagate_fleet, propagate_segments
from piga.units import G0
from tests.instrument.references import EPS, constant_cases, linear_record

pytestmark = pytest.mark.interpreted

INST = Instrument("0.8884 rad/s/g", "1 deg", 0.4)


def refined(t, f, parts):
    """The same piecewise linear input on a finer grid."""
    fine = np.unique(np.concatenate([np.linspace(a, b, parts + 1) for a, b in itertools.pairwise(t)]))
    return fine, np.column_stack([np.interp(fine, t, f[:, k]) for k in range(3)])


def dop853(inst, t, f, *, error=lambda _t, _f, _alpha: 0.0, omega=None):
    """Independent reference: scipy's DOP853 from knot to knot."""
    alpha = [inst.alpha0]
    omega = np.zeros_like(f) if omega is None else omega
    for k in range(t.size - 1):

        def slope(s, x, k=k):
            w = (s - t[k]) / (t[k + 1] - t[k])
            force = f[k] + w * (f[k + 1] - f[k])
            u = inst.scale_factor * force - (omega[k] + w * (omega[k + 1] - omega[k]))
            pull = u[1] * math.sin(x[0]) - u[2] * math.cos(x[0])
            return [u[0] + inst.tan_beta * pull + inst.scale_factor * error(s, force, x[0])]

        run = solve_ivp(slope, (t[k], t[k + 1]), [alpha[-1]], method="DOP853", rtol=1e-13, atol=1e-14)
        alpha.append(run.y[0, -1])
    return np.array(alpha)


@pytest.mark.parametrize("steps", [1, 16])
def test_constant_input_is_exact_whatever_the_step(steps):
    for case in constant_cases():
        if case.t <= 0.0 or abs(case.turns) > 1e5 or case.case.startswith("many"):
            continue
        t = np.linspace(0.0, case.t, steps + 1)
        alpha = propagate(case.inst, t, np.tile(case.force, (t.size, 1)), between="linear")[-1]
        reference = 2 * math.pi * case.turns + case.rest
        tolerance = 1e-12 + 100 * EPS * max(1.0, case.kappa) * max(1.0, abs(case.turns))
        assert abs(alpha - reference) < tolerance, case


@pytest.mark.parametrize("seed", range(3))
def test_fourth_order_against_high_precision(seed):
    inst, t, f, reference = linear_record(seed)
    errors = []
    for parts in (1, 2, 4, 8, 16):
        fine, force = refined(t, f, parts)
        errors.append(np.abs(propagate(inst, fine, force, between="linear")[::parts] - reference).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] == pytest.approx(4.0, abs=0.1)
    assert errors[-1] < 1e-7
    fine, force = refined(t, f, 400)
    assert propagate(inst, fine, force, between="linear")[::400] == pytest.approx(reference, abs=1e-12)


@pytest.mark.parametrize("seed", [1, 2])
def test_agrees_with_dop853_with_base_rate(seed):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.05, 0.3, 8))
    f, omega = rng.normal(0.0, 3 * G0, (8, 3)), rng.normal(0.0, 0.2, (8, 3))
    fine, force = refined(t, f, 64)
    rates = refined(t, omega, 64)[1]
    alpha, rate = propagate(INST, fine, force, rates, with_rate=True, between="linear")
    assert alpha[::64] == pytest.approx(dop853(INST, t, f, omega=omega), abs=1e-11)
    u = INST.scale_factor * force - rates
    expected = u[:, 0] + INST.tan_beta * (u[:, 1] * np.sin(alpha) - u[:, 2] * np.cos(alpha))
    assert rate == pytest.approx(expected, abs=1e-14)


def test_constant_base_rate_may_be_given_once():
    t, f = np.linspace(0, 1, 5), np.ones((5, 3))
    once = propagate(INST, t, f, [1e-4, 2e-4, -3e-4], between="linear")
    assert np.array_equal(once, propagate(INST, t, f, np.tile([1e-4, 2e-4, -3e-4], (5, 1)), between="linear"))


def test_error_model_against_dop853():
    model = ErrorModel(
        k0="2e-3 g", k1=1e-3, k2="2e-3 g/g^2", k3="1e-3 g/g^3", k2o="1e-3 g/g^2", k1a=5e-4, m_Y=1e-3, m_Z=-2e-3,
        k_XY="1e-3 g/g^2", k_XZ="-2e-3 g/g^2", k_YY="3e-3 g/g^2", k_ZZ="1e-3 g/g^2", k_YZ="2e-3 g/g^2",
        s1="3e-3 g", c1="-2e-3 g", k0_t="1e-3 g/s", k0_T="1e-4 g/K", k1_T=1e-4, T_ref="20 degC",
    )  # fmt: skip
    rng = np.random.default_rng(5)
    t = np.cumsum(rng.uniform(0.2, 0.5, 5))
    f = rng.uniform(0.2, 2, (5, 3)) * G0
    kelvin = np.interp(t, [t[0], t[-1]], [290.0, 300.0])

    def error(s, force, alpha):
        x, y, z = force / G0
        warm = 290.0 + 10.0 * (s - t[0]) / (t[-1] - t[0]) - 293.15
        return G0 * (
            2e-3 + 1e-3 * x + 2e-3 * x**2 + 1e-3 * x**3 + 1e-3 * x * abs(x) + 5e-4 * abs(x) + 1e-3 * y - 2e-3 * z
            + 1e-3 * x * y - 2e-3 * x * z + 3e-3 * y**2 + 1e-3 * z**2 + 2e-3 * y * z
            + 3e-3 * math.sin(alpha) - 2e-3 * math.cos(alpha) + 1e-3 * s + (1e-4 + 1e-4 * x) * warm
        )  # fmt: skip

    reference = dop853(INST, t, f, error=error)
    errors = []
    for parts in (1, 2, 4, 8, 16):
        fine, force = refined(t, f, parts)
        alpha = propagate(
            INST, fine, force, error_model=model, temperature=np.interp(fine, t, kelvin), between="linear"
        )
        errors.append(np.abs(alpha[::parts] - reference).max())
    assert errors[-1] < 1e-10
    assert math.log2(errors[-3] / errors[-2]) == pytest.approx(4.0, abs=0.3)


def test_turns_are_counted_through_steps_of_many_revolutions():
    inst = Instrument("0.8884 rad/s/g", "1000 arcsec", -100.0)
    t = np.arange(0.0, 5001.0, 100.0)
    force = (-3 * G0, 5 * G0, G0)
    reference, _ = closed_form(inst, t, *force)
    alpha = propagate(inst, t, np.tile(force, (t.size, 1)), between="linear")
    assert alpha[0] == -100.0
    assert alpha == pytest.approx(reference, abs=1e-10)
    assert abs(alpha[-1]) > 13000


@pytest.mark.long
def test_a_million_samples_do_not_lose_the_angle():
    t = np.arange(1_000_001) * 1e-3
    force = (0.5 * G0, 5 * G0, 0.0)
    reference, _ = closed_form(INST, t[-1], *force)
    alpha = propagate(INST, t, np.tile(force, (t.size, 1)), between="linear")
    assert alpha[-1] == pytest.approx(reference, abs=2e-12)


def test_one_sample_and_zero_force():
    assert np.array_equal(propagate(INST, [3.0], [[1.0, 2.0, 3.0]], between="linear"), [0.4])
    assert propagate(INST, [0.0, 1.0], np.zeros((2, 3)), between="linear") == pytest.approx(
        [0.4, 0.4], abs=1e-16
    )


@pytest.mark.parametrize(
    ("t", "f", "kwargs", "message"),
    [
        ([], np.zeros((0, 3)), {}, r"t: shape \(0,\)"),
        ([[0.0]], np.zeros((1, 3)), {}, r"t: shape \(1, 1\)"),
        ([0.0, 1.0], np.zeros((3, 3)), {}, r"f: shape \(3, 3\) instead of \(2, 3\)"),
        ([0.0, 1.0], ["one", "two"], {}, "f: not an array of numbers"),
        ([0.0, math.nan], np.zeros((2, 3)), {}, "t: nan at index 1"),
        ([0.0, 2.0, 1.0], np.zeros((3, 3)), {}, "t: 1.0 s at index 2 is not after 2.0 s at index 1"),
        ([0.0, 1.0, 1.0], np.zeros((3, 3)), {}, "index 2"),
        ([0.0, 1.0], [[0, 0, 0], [0, math.inf, 0]], {}, r"f: inf at index \(1, 1\)"),
        ([0.0, 1.0], np.zeros((2, 3)), {"base_rate": np.zeros((3, 3))}, "base_rate: shape"),
        ([0.0, 1.0], np.zeros((2, 3)), {"base_rate": [0, math.nan, 0]}, r"base_rate: nan at index \(0, 1\)"),
        ([0.0, 1.0], np.zeros((2, 3)), {"error_model": ErrorModel(k0_T=1e-6)}, "temperature: missing"),
        (
            [0.0, 1.0],
            np.zeros((2, 3)),
            {"error_model": ErrorModel(k0_T=1e-6), "temperature": [290.0]},
            "temperature: shape",
        ),
    ],
)
def test_bad_input_is_named_with_its_index(t, f, kwargs, message):
    with pytest.raises(piga.ArgumentError, match=message):
        propagate(INST, t, f, **kwargs, between="linear")


SHORT = Instrument(0.0906, 0.3, 0.4)


@pytest.mark.parametrize("h", [0.05, 0.7, 3.0, 20.0])
def test_the_rate_is_that_of_the_angle_whatever_the_step(h: float) -> None:
    """Steps of many turns are taken one by one: the rate at a sample must still be the one of its own angle."""
    t = h * np.arange(12)
    f = np.array([-30.0, 40.0, 3.0]) + np.sin(np.arange(12))[:, None]
    alpha, rate = propagate(SHORT, t, f, with_rate=True, between="linear")
    u = SHORT.scale_factor * f
    expected = u[:, 0] + SHORT.tan_beta * (u[:, 1] * np.sin(alpha) - u[:, 2] * np.cos(alpha))
    assert rate == pytest.approx(expected, abs=1e-12 + 4.0 * np.spacing(np.abs(alpha).max()))


FLEET = [Instrument(0.09 + 0.001 * k, 0.01 * (k - 1), 0.5 * k) for k in range(3)]
TIMES = np.arange(400) * 0.02
FORCES, RATES = np.random.default_rng(7).normal(0.0, [[[[2 * G0]]], [[[0.1]]]], (2, 3, TIMES.size, 3))


@pytest.mark.parametrize("between", ["smooth", "linear"])
def test_rows_of_a_fleet_are_single_runs(between):
    one = propagate_fleet(FLEET, TIMES, FORCES[0], between=between)
    assert np.array_equal(one, [propagate(inst, TIMES, FORCES[0], between=between) for inst in FLEET])
    inputs = propagate_fleet(FLEET[1], TIMES, FORCES, between=between)
    assert np.array_equal(inputs, [propagate(FLEET[1], TIMES, f, between=between) for f in FORCES])
    paired = propagate_fleet(FLEET, TIMES, FORCES, RATES, output="rate", between=between)
    for row, inst, f, omega in zip(paired, FLEET, FORCES, RATES, strict=True):
        assert np.array_equal(row, propagate(inst, TIMES, f, omega, with_rate=True, between=between)[1])


def test_faults_of_a_fleet_name_motion_and_index():
    bad = FORCES.copy()
    bad[2, 5, 1] = math.nan
    with pytest.raises(piga.ArgumentError, match=r"motion 2: f: nan at index \(5, 1\)"):
        propagate_fleet(FLEET, TIMES, bad)
    with pytest.raises(piga.ArgumentError, match=r"do not match: .*'instruments': 2, 'f': 3"):
        propagate_fleet(FLEET[:2], TIMES, FORCES)
    for fleet, forces in (([], FORCES[0]), (FLEET[0], FORCES[:0])):
        with pytest.raises(piga.ArgumentError, match="do not match"):
            propagate_fleet(fleet, TIMES, forces)
    with pytest.raises(piga.ArgumentError, match="output: 'velocity' is not known"):
        propagate_fleet(FLEET, TIMES, FORCES[0], output="velocity")


def swaying(t):
    """A smooth force and base rate whose direction turns."""
    f = G0 * (
        np.array([0.4, 0.0, 1.0]) + np.array([0.3, 3.0, 2.0]) * np.sin(np.multiply.outer(t, [2.0, 1.3, 0.9]))
    )
    return f, np.multiply.outer(np.cos(1.7 * t), [0.05, -0.3, 0.2])


def test_smooth_input_is_of_fourth_order_and_linear_input_of_second():
    def slope(t, x):
        u = INST.scale_factor * swaying(t)[0] - swaying(t)[1]
        return [u[0] + INST.tan_beta * (u[1] * math.sin(x[0]) - u[2] * math.cos(x[0]))]

    errors = {"smooth": [], "linear": []}
    for parts in (40, 80, 160):
        t = np.linspace(0.0, 4.0, parts + 1)
        exact = solve_ivp(slope, (0.0, 4.0), [INST.alpha0], "DOP853", t, rtol=1e-13, atol=1e-14).y[0]
        for between, left in errors.items():
            left.append(np.abs(propagate(INST, t, *swaying(t), between=between) - exact).max())
    assert math.log2(errors["smooth"][1] / errors["smooth"][2]) > 3.7
    assert math.log2(errors["linear"][1] / errors["linear"][2]) == pytest.approx(2.0, abs=0.1)
    assert errors["smooth"][2] < 1e-7 < errors["linear"][2]


def test_a_step_of_the_force_does_not_ring():
    """The samples beside a jump are straight: the second derivatives there have opposite signs."""
    t = np.arange(40.0) * 0.1
    f = np.tile([0.3 * G0, 0.0, 0.0], (40, 1))
    f[20:, 0] = 0.5 * G0
    smooth, linear = (propagate(INST, t, f, between=between) for between in ("smooth", "linear"))
    assert smooth == pytest.approx(linear, abs=1e-14)


def test_an_unknown_way_between_samples_is_refused():
    with pytest.raises(piga.ArgumentError, match="between: 'cubic' is not known"):
        propagate(INST, [0.0, 1.0], np.zeros((2, 3)), between="cubic")


def test_propagate_and_calibrate_mean_the_same_force_between_samples():
    """Without noise K and k0 come back; with a linear force K was 8.3 ppm and k0 8.3 micro-g off."""
    t = np.arange(0.0, 30.0, 0.01)
    f = G0 * np.column_stack([1 + 0.3 * np.sin(t), 5 * np.cos(0.4 * t), 0 * t])
    inst = Instrument("0.8884 rad/s/g", "1000 arcsec", 0.785)
    left = {}
    for between in ("smooth", "linear"):
        run = piga.Run.from_arrays(
            t, propagate(inst, t, f, between=between), f, scale_factor="0.8884 rad/s/g", units="SI"
        )
        with pytest.warns(piga.CalibrationWarning):
            cal = piga.calibrate(run, ["scale_factor", "tan_beta", "k0"])
        left[between] = abs(cal["scale_factor"].value / 0.8884 - 1.0), abs(cal["k0"].value)
    assert max(left["smooth"]) < 5e-9
    assert min(left["linear"]) > 5e-6


def test_segments_are_exact_whatever_their_length():
    for case in constant_cases():
        if case.t < 0.0:
            continue
        alpha, rate = propagate_segments(case.inst, [case.t], [case.force])
        exact = closed_form(case.inst, case.t, *case.force)
        assert (alpha[0], rate[0]) == exact
    lengths, omega = [1e5, 0.0, 3e5, 2.0], [1e-3, 0.1, 0.0]
    f = [(0.3, 9.0, 2.0)] * 3 + [(5.0, -9.0, 1.0)]
    alpha, rate = propagate_segments(INST, lengths, f, np.tile(omega, (4, 1)))
    whole, _ = closed_form(INST, [1e5, 1e5, 4e5], *f[0], base_rate=omega)
    assert alpha[:3] == pytest.approx(whole, abs=2e-11)
    last = closed_form(Instrument(INST.scale_factor, INST.beta, alpha[2]), 2.0, *f[3], base_rate=omega)
    assert [alpha[3], rate[3]] == pytest.approx(np.array(last), abs=1e-11)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: propagate_segments(INST, [1.0, -2.0], np.zeros((2, 3))), "durations: -2.0 s at index 1"),
        (lambda: propagate_segments(INST, [1.0, math.nan], np.zeros((2, 3))), "durations: nan at index 1"),
        (lambda: propagate_segments(INST, [], np.zeros((0, 3))), "durations: shape"),
    ],
)
def test_bad_segments_are_named(call, message):
    with pytest.raises(piga.ArgumentError, match=message):
        call()
