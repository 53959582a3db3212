"""The whole estimator on a small record: quick enough to run with the JIT off, and run compiled too."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from tests.calibration.made.synthetic import TERMS, errors, record

pytestmark = pytest.mark.compiled


def small(**options: object) -> piga.Run:
    return record(np.random.default_rng(31), seconds=12.0, rate=4.0, count=5, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "method", ["information", "rate", pytest.param("recursive", marks=pytest.mark.only_compiled)]
)
@pytest.mark.parametrize("phase", ["shared", pytest.param("per-segment", marks=pytest.mark.only_compiled)])
def test_small_record(method: str, phase: str) -> None:
    run = small(per_segment=phase == "per-segment")
    calibration = piga.calibrate(run, TERMS, method, phases=phase)
    assert all(abs(z) < 4.5 for z in errors(calibration).values()), errors(calibration)


@pytest.mark.only_compiled
def test_harmonics_turn_with_the_phase() -> None:
    run = small()
    calibration = piga.calibrate(run, [*TERMS, "s2", "c2"])
    assert abs(calibration["s2"].value) < 4.5 * calibration["s2"].std
    assert abs(calibration["c2"].value) < 4.5 * calibration["c2"].std


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
