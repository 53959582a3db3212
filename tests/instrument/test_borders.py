"""The instrument's functions at the borders of what they take."""

from __future__ import annotations

import math
import os
from dataclasses import replace

import numpy as np
import pytest

from piga.errors import ArgumentError, PigaError
from piga.instrument import Instrument, closed_form, propagate_function, propagate_segments
from piga.instrument.checks import float_array
from piga.instrument.motion.sampled_motion import available_cores
from piga.instrument.twin.linear import analyse_loop
from piga.instrument.twin.parameters import PRESETS
from piga.instrument.twin.run import run_twin
from piga.units import G0

INST = Instrument("0.8884 rad/s/g", "74 arcsec", 0.3)


def test_what_is_no_array_of_numbers() -> None:
    with pytest.raises(ArgumentError, match="f: not an array of numbers"):
        float_array("f", ["one", "two"])
    with pytest.raises(ArgumentError, match=r"shape \(2,\) instead of \(3,\)"):
        float_array("f", [1.0, 2.0], (3,))
    view = float_array("f", [1.0, 2.0])
    assert not view.flags.writeable


def test_cores_without_affinity(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert available_cores() == 1


def test_a_function_that_returns_no_numbers() -> None:
    with pytest.raises(ArgumentError, match="f: does not return three numbers"):
        propagate_function(INST, [0.0, 1.0], lambda s: ["a", "b", "c"])
    with pytest.raises(ArgumentError, match="which is not finite"):
        propagate_function(INST, [0.0, 1.0], lambda s: (math.nan, 0.0, 0.0))


def test_start_of_the_twin() -> None:
    t, f = np.linspace(0.0, 0.01, 3), np.tile([G0, 0.0, 0.0], (3, 1))
    with pytest.raises(ArgumentError, match="a state has 5 numbers"):
        run_twin(PRESETS["example"], t, f, start=[0.0, 1.0])
    given = run_twin(PRESETS["example"], t, f, start=[0.2, 0.0, 0.5, 0.0, 0.0])
    assert (given.alpha[0], given.rate[0]) == (0.2, 0.5)


def test_a_motion_too_fast_to_follow() -> None:
    """A start of a million radians per second of tilt leaves the stops no chance."""
    p = replace(PRESETS["example"], stop_angle=1e-3)
    t, f = np.linspace(0.0, 10.0, 3), np.tile([G0, 0.0, 0.0], (3, 1))
    with pytest.raises(PigaError, match="cannot be followed"):
        run_twin(p, t, f, start=[0.0, 0.0, 1e12, 1e14, 0.0])


def test_a_loop_that_never_crosses_has_all_margins() -> None:
    weak = replace(
        PRESETS["example"],
        proportional_gain=1e-9,
        integral_gain=0.0,
        rate_gain=0.0,
        restoring=1.0,
        viscous_friction=1e-3,
    )
    loop = analyse_loop(weak)
    assert loop.phase_margin == math.inf
    assert loop.crossover == 0.0


def test_segments_with_base_rate_are_closed_forms_one_after_the_other() -> None:
    """All three components of the base rate, each as large as the coupling makes it count."""
    force = G0 * np.array([[0.6, 2.0, -1.0], [0.3, -4.0, 2.0]])
    turn = np.array([[0.02, -0.3, 0.5], [-0.01, 0.4, 0.2]])
    alpha, rate = propagate_segments(INST, [3.0, 5.0], force, turn)
    middle, _ = closed_form(INST, 3.0, *force[0], base_rate=turn[0])
    last, speed = closed_form(replace(INST, alpha0=float(middle)), 5.0, *force[1], base_rate=turn[1])
    assert alpha == pytest.approx([float(middle), float(last)], abs=2e-15)
    assert rate[1] == pytest.approx(float(speed), abs=1e-15)
    u_x, u_Y, u_Z = INST.scale_factor * force[1] - turn[1]
    literal = u_x + INST.tan_beta * (u_Y * math.sin(alpha[1]) - u_Z * math.cos(alpha[1]))
    assert rate[1] == pytest.approx(literal, abs=1e-14)
