"""Simulated tests with the servo twin: what it takes over, what it refuses, its noise."""

import math
from dataclasses import replace

import numpy as np
import pytest

from piga.errors import ArgumentError
from piga.instrument import ErrorModel, Instrument
from piga.instrument.twin.linear import UnstableDesignError
from piga.instrument.twin.parameters import PRESETS
from piga.stand import (
    DividingHead,
    Specimen,
    simulate_test,
)
from tests.stand.simulated import COUNTS, HEAD, INST, SITE

pytestmark = pytest.mark.compiled


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


@pytest.mark.only_compiled
def test_unstable_design_runs_when_forced():
    unstable = Specimen(INST, twin=replace(PRESETS["example"], proportional_gain=120.0))
    stand = DividingHead(SITE, (0.0,), dwell=0.1, move=1.0)
    test = simulate_test(stand, unstable, COUNTS, model="twin", force=True)
    assert np.all(np.isfinite(test.alpha))


@pytest.mark.only_compiled
def test_random_walk_of_the_twin_has_the_stated_level():
    stand = DividingHead(SITE, (0.0,), dwell=2.0, move=1.0)
    specimen = Specimen(Instrument("0.8884 rad/s/g"), twin=PRESETS["example-stiff"])
    e = replace(COUNTS, angle_random_walk=1e-4)
    noisy = simulate_test(stand, specimen, e, model="twin", seed=2, step=0.01)
    plain = simulate_test(stand, specimen, COUNTS, model="twin", step=0.01)
    increments = np.diff(noisy.alpha - plain.alpha)
    assert increments.std() == pytest.approx(1e-4 * math.sqrt(0.01), rel=0.15)
