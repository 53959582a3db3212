"""Linear analysis of the servo loop, and the servo's two terms, against the kernel and the rigid body that SciPy integrates."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from piga._kernels import servo
from piga.instrument.twin import (
    PRESETS,
    UnstableDesignError,
    analyse_loop,
    loop_poles,
    open_loop,
    require_stable,
    servo_terms,
)
from tests.instrument.servo_truth import Design, G, mean_rate, waves
from tests.instrument.twin_predicted import stiffened


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
def test_poles_are_those_of_the_linearised_twin(name):
    p = PRESETS[name]
    own, kernel = np.sort_complex(loop_poles(p)), np.sort_complex(np.linalg.eigvals(jacobian(p)))
    assert own == pytest.approx(kernel, rel=1e-5)


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
    for factor, stable in ((0.999, True), (1.001, False)):
        assert analyse_loop(stiffened(p, factor * analysis.gain_margin)).stable == stable
    assert abs(open_loop(p, [analysis.crossover])[0]) == pytest.approx(1.0, rel=1e-4)


def test_unstable_design_is_refused_with_reason():
    with pytest.raises(
        UnstableDesignError, match=r"unstable: closed-loop pole .*oscillating at .* Hz"
    ) as caught:
        require_stable(replace(PRESETS["example"], proportional_gain=300.0))
    assert "lower the gains" in str(caught.value)


CASE = Design(K=0.8884 / G)
"""The reference case of the theory page."""


def terms_of(p, rate=0.0):
    return servo_terms(p.K, p.ml, p.k_i, p.k_p, p.k_d, p.c, rate=rate)


def head(angle, gravity=G):
    return (gravity * math.cos(angle), -gravity * math.sin(angle), 0.0)


@pytest.mark.parametrize(
    ("degrees", "ppm"), [(15, -0.8811), (30, -3.2884), (45, -6.5769), (60, -9.8654), (75, -12.2729)]
)
def test_mean_rate_of_the_rigid_body_falls_by_the_servo_term(degrees, ppm):
    f = head(math.radians(degrees))
    shift = mean_rate(CASE, f) / (CASE.K * f[0]) - 1.0
    assert shift * 1e6 == pytest.approx(ppm, abs=1e-4)
    assert shift == pytest.approx(-terms_of(CASE)[0] * f[1] ** 2, rel=1e-4)
    assert shift == pytest.approx(-terms_of(CASE, CASE.K * f[0])[0] * f[1] ** 2, rel=2e-5)


def test_terms_of_the_theory_page():
    terms = servo_terms(0.8884 / G, 0.08884 / G, 3000.0, damping=0.05)
    assert terms[0] * G**2 == pytest.approx(0.8884 * 0.08884 / 6000.0)
    assert terms[1] * G**2 == pytest.approx(0.05 * 0.8884**2 / 3000.0)


def test_the_turning_base_counts_as_transverse_input():
    """A centrifuge arm that carries the instrument round: u = K f - Omega, not the force alone, ripples the tilt.

    The float carried round by the base, ``B q'/H`` (docs/theory/twin.md), is taken off the wave once a turn.
    """
    f, turn = (5.0 * G, 0.0, G), (0.0, 0.0, 7.0)
    mean, sine, cosine, _, double = waves(CASE, f, turn)
    across, (stiff, damping) = CASE.K * G - 7.0, terms_of(CASE, CASE.K * f[0])
    shift = -stiff * CASE.K * f[0] * (across / CASE.K) ** 2
    assert mean == pytest.approx(shift, rel=0.012)
    assert double == pytest.approx(-shift, rel=0.012)
    assert sine == pytest.approx(CASE.J_y / CASE.H * CASE.K * f[0] * 7.0, rel=0.012)
    damped = -damping * f[0] ** 2 / CASE.K * CASE.K * abs(across)
    assert cosine == pytest.approx(damped, rel=0.012)


def test_next_order_changes_the_coupling_with_the_cube_of_the_rate():
    """``(B k_i - c k_p) w^3/k_i^2``: the damping's part has the opposite sign of the inertia's."""
    for level in (10.0, -8.0):
        w = CASE.K * level * G
        sine = waves(CASE, (level * G, G, 0.0))[1] / (CASE.K * G)
        assert sine == pytest.approx((CASE.J_y * CASE.k_i - CASE.c * CASE.k_p) / CASE.k_i**2 * w**3, rel=5e-3)
        assert abs(sine) == pytest.approx(CASE.c * CASE.k_p / CASE.k_i**2 * abs(w) ** 3, rel=0.12)
