"""Linear analysis of the servo loop against the linearised kernel and the twin's own motion."""

import math
from dataclasses import replace

import numpy as np
import pytest

from piga._kernels.motion import servo
from piga.instrument.twin.linear import (
    UnstableDesignError,
    analyse_loop,
    loop_poles,
    open_loop,
    rate_response,
    require_stable,
    step_response,
    tilt_compliance,
)
from piga.instrument.twin.parameters import PRESETS
from piga.instrument.twin.run import run_twin
from piga.units import G0


def jacobian(p):
    """Derivative of (beta', w', v', z') with respect to (beta, w, v, z), base at rest, no force."""
    constants, matrix = p.constants(), np.zeros((4, 4))
    for column in range(4):
        for sign in (1.0, -1.0):
            x, out = np.zeros(5), np.zeros(5)
            x[1] = p.pick_off_null
            x[column + 1] += sign * 1e-6
            servo.derivative(constants, 0.0, x, servo.Inputs(*np.zeros(9), 0.0, 0.0, 0.0), out)
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


def test_compliance_goes_to_its_limits():
    p = PRESETS["example-stiff"]
    assert tilt_compliance(p, [1e-3])[0] == pytest.approx(1e-3j / p.integral_gain, rel=1e-3)
    loose = replace(p, integral_gain=0.0)
    assert tilt_compliance(loose, [1e-3])[0] == pytest.approx(1.0 / p.proportional_gain, rel=1e-3)


def test_unstable_design_is_refused_with_reason():
    with pytest.raises(
        UnstableDesignError, match=r"unstable: closed-loop pole .*oscillating at .* Hz"
    ) as caught:
        require_stable(replace(PRESETS["example"], proportional_gain=300.0))
    assert "lower the gains" in str(caught.value)
