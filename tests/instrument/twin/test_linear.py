"""Linear analysis of the servo loop, and the servo's two terms, against the kernel and the rigid body that SciPy integrates."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from piga._kernels import servo
from piga.errors import ArgumentError
from piga.instrument.twin.linear import (
    ServoParameters,
    UnstableDesignError,
    analyse_loop,
    loop_poles,
    open_loop,
    rate_response,
    require_stable,
    servo_terms,
    step_response,
    tilt_compliance,
)
from piga.instrument.twin.parameters import PRESETS
from piga.instrument.twin.run import run_twin
from piga.units import G0
from tests.instrument.servo_truth import Design, G, mean_rate, waves


def jacobian(p):
    """Derivative of (beta', w', v', z') with respect to (beta, w, v, z), base at rest, no force."""
    constants, matrix = p.constants(), np.zeros((4, 4))
    for column in range(4):
        for sign in (1.0, -1.0):
            x, out = np.zeros(5), np.zeros(5)
            x[1] = p.pick_off_null
            x[column + 1] += sign * 1e-6
            servo.derivative(constants, 0.0, x, np.zeros(12), out)
            matrix[:, column] += sign * out[1:] / 2e-6
    return matrix


@pytest.mark.parametrize("name", PRESETS)
def test_poles_and_compliance_are_those_of_the_linearised_twin(name):
    p = PRESETS[name]
    matrix = jacobian(p)
    own, kernel = np.sort_complex(loop_poles(p)), np.sort_complex(np.linalg.eigvals(matrix))
    assert own == pytest.approx(kernel, rel=1e-5)
    push = np.array([0.0, 1.0 / p.J_x, 0.0, 0.0])  # a torque about the outer axis
    for w in (0.5, 20.0, 400.0):
        tilt = np.linalg.solve(1j * w * np.eye(4) - matrix, push)[0]
        assert tilt_compliance(p, [w])[0] == pytest.approx(tilt, rel=1e-5)


def test_all_presets_are_stable_with_margin():
    for p in PRESETS.values():
        analysis = require_stable(p)
        assert analysis.phase_margin > math.radians(35)
        assert analysis.gain_margin > 2.0


def test_nutation_of_the_theory_example():
    p = PRESETS["example"]
    assert p.nutation == pytest.approx(math.sqrt(2) * 1000.0)
    analysis = analyse_loop(p)
    assert analysis.nutation == pytest.approx(p.nutation, rel=0.1)
    free = analyse_loop(replace(p, damping=1e-6, proportional_gain=1e-3, integral_gain=0.0))
    assert free.nutation == pytest.approx(p.nutation, rel=1e-6)


def test_margins_are_where_the_loop_becomes_unstable():
    p = PRESETS["example"]
    analysis = analyse_loop(p)
    assert analyse_loop(p.stiffened(0.999 * analysis.gain_margin)).stable
    assert not analyse_loop(p.stiffened(1.001 * analysis.gain_margin)).stable
    assert abs(open_loop(p, [analysis.crossover])[0]) == pytest.approx(1.0, rel=1e-4)
    assert abs(rate_response(p, [analysis.bandwidth])[0]) == pytest.approx(math.sqrt(0.5), rel=1e-3)


def test_step_response_is_that_of_the_twin():
    p = PRESETS["example"]
    t = np.linspace(0.0, 0.05, 101)
    small = 1e-4 * G0
    motion = run_twin(p, t, np.tile([small, 0.0, 0.0], (t.size, 1)), start="transient")
    assert motion.rate / (p.K * small) == pytest.approx(step_response(p, t), abs=1e-4)


def test_unstable_design_is_refused_with_reason():
    with pytest.raises(
        UnstableDesignError, match=r"unstable: closed-loop pole .*oscillating at .* Hz"
    ) as caught:
        require_stable(replace(PRESETS["example"], proportional_gain=300.0))
    assert "lower the gains" in str(caught.value)


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


def test_the_turning_base_counts_as_transverse_input():
    """A centrifuge arm that carries the instrument round: u = K f - Omega, not the force alone, ripples the tilt.

    The float carried round by the base, ``B q'/H`` (docs/theory/twin.md), is taken off the wave once a turn.
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
