"""The servo's two terms against the rigid body that SciPy integrates, and their prediction from the servo's parameters."""

import math
from dataclasses import replace

import pytest

from piga.errors import ArgumentError
from piga.instrument.twin.linear import ServoParameters, servo_terms
from piga.instrument.twin.parameters import PRESETS
from tests.instrument.servo_truth import Design, G, mean_rate, waves

CASE = Design(K=0.8884 / G)
"""The reference case of the theory page."""


def of_design(p):
    return ServoParameters(p.K, p.ml, p.k_i, p.k_p, p.k_d, p.c)


def head(angle, gravity=G):
    return (gravity * math.cos(angle), -gravity * math.sin(angle), 0.0)


@pytest.mark.parametrize(
    ("degrees", "ppm"), [(15, -0.8811), (30, -3.2884), (45, -6.5769), (60, -9.8654), (75, -12.2729)]
)
def test_mean_rate_of_the_rigid_body_falls_by_the_servo_term(degrees, ppm):
    f = head(math.radians(degrees))
    shift = mean_rate(CASE, f) / (CASE.K * f[0]) - 1.0
    assert shift * 1e6 == pytest.approx(ppm, abs=1e-4)
    at_rest, turning = servo_terms(of_design(CASE)), servo_terms(of_design(CASE), rate=CASE.K * f[0])
    assert shift == pytest.approx(-at_rest.servo * f[1] ** 2, rel=1e-4)
    assert shift == pytest.approx(-turning.servo * f[1] ** 2, rel=2e-5)


def test_terms_of_a_twin_and_of_its_numbers_are_the_same():
    p = replace(PRESETS["example"], integral_gain=3000.0)
    numbers = ServoParameters(p.K, p.pendulosity, 3000.0, p.proportional_gain, 0.0, p.damping)
    assert servo_terms(p) == servo_terms(numbers)
    assert servo_terms(p).servo * G**2 == pytest.approx(0.8884 * 0.08884 / 6000.0)
    assert servo_terms(p).servo_damping * G**2 == pytest.approx(0.05 * 0.8884**2 / 3000.0)


def test_uncertainty_of_the_parameters_moves_both_terms():
    p = replace(PRESETS["example"], integral_gain=3000.0)
    terms = servo_terms(p, {"integral_gain": 30.0, "damping": 5e-4})
    assert terms.sources["integral_gain"] == pytest.approx(
        (-0.01 * terms.servo, -0.01 * terms.servo_damping), rel=1e-6
    )
    assert terms.sources["damping"] == pytest.approx((0.0, 0.01 * terms.servo_damping), rel=1e-6)
    assert terms.u_servo == pytest.approx(0.01 * terms.servo, rel=1e-6)
    assert terms.u_servo_damping == pytest.approx(math.sqrt(2.0) * 0.01 * terms.servo_damping, rel=1e-6)
    assert servo_terms(p).u_servo == 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"integral_gain": 0.0}, r"integral_gain = 0: must be positive"),
        ({"scale_factor": -1.0}, "scale_factor"),
        ({"damping": -0.1}, "damping = -0.1: must be zero or more"),
        ({"pendulosity": math.nan}, "pendulosity"),
    ],
)
def test_a_servo_that_cannot_be_is_refused(change, words):
    with pytest.raises(ArgumentError, match=words):
        ServoParameters(**{"scale_factor": 0.09, "pendulosity": 9e-3, "integral_gain": 3e3, **change})


def test_an_unknown_source_is_refused():
    with pytest.raises(ArgumentError, match="unknown parameter 'gain'"):
        servo_terms(PRESETS["example"], {"gain": 1.0})


@pytest.mark.parametrize("friction", [1e-3, 5e-3])
def test_friction_on_the_outer_axis_does_not_change_the_mean_rate(friction):
    f = head(math.radians(45.0))
    smooth, rough = mean_rate(CASE, f), mean_rate(replace(CASE, friction=friction), f)
    assert rough / smooth - 1.0 == pytest.approx(0.0, abs=1e-12)


def test_the_turning_base_counts_as_transverse_input():
    """A centrifuge arm that carries the instrument round: u = K f - Omega, not the force alone, ripples the tilt.

    The float carried round by the base, ``B q'/H`` (docs/twin.md), is taken off the wave once a turn.
    """
    f, turn = (5.0 * G, 0.0, G), (0.0, 0.0, 7.0)
    mean, sine, cosine, _, double = waves(CASE, f, turn)
    across, terms = CASE.K * G - 7.0, servo_terms(of_design(CASE), rate=CASE.K * f[0])
    shift = -terms.servo * CASE.K * f[0] * (across / CASE.K) ** 2
    assert mean == pytest.approx(shift, rel=0.012)
    assert double == pytest.approx(-shift, rel=0.012)
    assert sine == pytest.approx(CASE.J_y / CASE.H * CASE.K * f[0] * 7.0, rel=0.012)
    damped = -terms.servo_damping * f[0] ** 2 / CASE.K * CASE.K * abs(across)
    assert cosine == pytest.approx(damped, rel=0.012)


def test_next_order_changes_the_coupling_with_the_cube_of_the_rate():
    """``(B k_i - c k_p) w^3/k_i^2``: the damping's part has the opposite sign of the inertia's."""
    for level in (10.0, -8.0):
        w = CASE.K * level * G
        sine = waves(CASE, (level * G, G, 0.0))[1] / (CASE.K * G)
        assert sine == pytest.approx((CASE.J_y * CASE.k_i - CASE.c * CASE.k_p) / CASE.k_i**2 * w**3, rel=5e-3)
        assert abs(sine) == pytest.approx(CASE.c * CASE.k_p / CASE.k_i**2 * abs(w) ** 3, rel=0.12)
