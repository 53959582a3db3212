"""The published recursion: on a small ramp, and from several starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import piga
from piga.calibration.classical.recursive import run_published
from piga.calibration.model.request import make_request
from piga.records.run_file import EstimationTable
from piga.units import G0
from tests.calibration.made.random_plans import problem


@pytest.mark.compiled
def test_published_on_a_small_ramp() -> None:
    t = np.arange(401) * 0.05
    a_x = 9.80665 * (0.5 + t / 20.0)
    f = np.column_stack([a_x, 5.0 * a_x, 0.0 * a_x])
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=np.pi / 4)
    _, rate = piga.propagate(inst, t, f, with_rate=True)
    run = piga.Run.from_arrays(t, rate, f, scale_factor="0.8884 rad/s/g", kind="rate")
    published = piga.calibrate(run, ["tan_beta", "k0", "k1", "k2"], "published")
    ours = piga.calibrate(run, ["tan_beta"])
    assert ours["tan_beta"].value == pytest.approx(0.00484817479568412, rel=1e-6)
    assert published["tan_beta"].value == pytest.approx(0.00484817479568412, rel=0.05)


@pytest.mark.compiled
def test_the_published_recursion_from_another_start() -> None:
    """From the true values with a small covariance it stays there; the wrong number of values is refused."""
    t = np.arange(401) * 0.05
    a_x = G0 * (0.5 + t / 20.0)
    f = np.column_stack([a_x, 5.0 * a_x, 0.0 * a_x])
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=np.pi / 4)
    alpha, rate = piga.propagate(inst, t, f, with_rate=True)
    tangent = np.tan(np.radians(1000.0 / 3600.0))
    start = EstimationTable(x0=(float(tangent), float(np.pi / 4)), P0=1e-9)
    for kind, output in (("rate", rate), ("angle", alpha - np.pi / 4)):
        run = piga.Run.from_arrays(t, output, f, scale_factor="0.8884 rad/s/g", kind=kind)
        calibration = piga.calibrate(replace(run, estimation=start), ["tan_beta"], "published")
        assert calibration["tan_beta"].value == pytest.approx(tangent, rel=0.05)
        assert calibration["phi"].value == pytest.approx(np.pi / 4, abs=0.05)
        wrong = EstimationTable(x0=(1e-3, 0.1, 0.0), P0=1.0)
        with pytest.raises(piga.CalibrationError, match=r"\[estimation\] x0 has 3 values, 2 are needed"):
            piga.calibrate(replace(run, estimation=wrong), ["tan_beta"], "published")


PUBLISHED_X0 = ((1e-4, 1e-2), (-np.pi, np.pi))
"""Starts of the published recursion: tan_beta and phi, in the range of its documented examples."""


@pytest.mark.slow
def test_published_recursion_depends_on_its_start() -> None:
    """The published recursion from random starts reaches 5 % of tan_beta and 0.1 rad in a part of the problems."""
    reached = 0
    for seed in range(1000):
        run, truth = problem(seed)
        rng = np.random.default_rng([seed, 72])
        start = (rng.uniform(*PUBLISHED_X0[0]), rng.uniform(*PUBLISHED_X0[1]))
        request = make_request(run, ["tan_beta", "k0", "k1", "k2"], "published")
        state = run_published(run, _with_start(request, start)).state
        size, phase = abs(state[0]), state[1] + (np.pi if state[0] < 0.0 else 0.0)
        near = abs(size / truth["tan_beta"] - 1.0) < 0.05
        reached += near and abs(np.angle(np.exp(1j * (phase - truth["phi"])))) < 0.1
    assert 0 < reached < 500


def _with_start(request, start: tuple[float, float]):
    return replace(request, x0=(*start, 0.0, 0.0, 0.0), P0=1e10)
