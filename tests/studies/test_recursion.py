"""The published recursion: the published ramp, its wrong solution from constant input."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga.studies import published_recursion
from piga.studies.recursion import model_residual, raw_state, record
from piga.units import G0


def small_ramp(kind: str) -> piga.Run:
    t = np.arange(401) * 0.05
    a_x = G0 * (0.5 + t / 20.0)
    f = np.column_stack([a_x, 5.0 * a_x, 0.0 * a_x])
    inst = piga.Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=np.pi / 4)
    alpha, rate = piga.propagate(inst, t, f, with_rate=True, between="linear")
    output = rate if kind == "rate" else alpha - np.pi / 4
    return piga.Run.from_arrays(t, output, f, scale_factor="0.8884 rad/s/g", kind=kind, units="SI")


@pytest.mark.long
def test_the_published_ramp() -> None:
    calibration = published_recursion(record("ramp"))
    assert calibration["tan_beta"].value == pytest.approx(4.84683e-3, abs=5e-9)
    assert calibration["phi"].value == pytest.approx(0.78672, abs=1e-5)
    assert np.abs(model_residual(record("ramp"), calibration)).max() == pytest.approx(1.67e-3, abs=5e-6)


@pytest.mark.long
def test_a_constant_input_leads_to_a_wrong_solution() -> None:
    calibration = published_recursion(record("constant"))
    assert raw_state("constant") == [pytest.approx(-2.6e-3, abs=5e-5), pytest.approx(-3.24, abs=5e-3)]
    assert calibration["tan_beta"].value == pytest.approx(2.6e-3, abs=5e-5)
    assert calibration["phi"].value == pytest.approx(-3.24 + np.pi, abs=5e-3)
    ours = piga.calibrate(record("constant"), ["tan_beta"])
    assert ours["tan_beta"].value == pytest.approx(0.00484817479568412, rel=1e-9)
    assert ours["phi"].value == pytest.approx(np.pi / 4, abs=1e-7)


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", ["rate", "angle"])
def test_the_true_values_stay_with_a_small_covariance(kind: str) -> None:
    tangent = float(np.tan(np.radians(1000.0 / 3600.0)))
    calibration = published_recursion(small_ramp(kind), start=(tangent, np.pi / 4), variance=1e-9)
    assert calibration["tan_beta"].value == pytest.approx(tangent, rel=0.05)
    assert calibration["phi"].value == pytest.approx(np.pi / 4, abs=0.05)


def test_other_terms_and_too_many_starts_are_refused() -> None:
    with pytest.raises(piga.CalibrationError, match="published recursion estimates"):
        published_recursion(small_ramp("rate"), ("tan_beta", "k0"))
    with pytest.raises(piga.CalibrationError, match="published recursion estimates"):
        published_recursion(small_ramp("rate"), start=(1e-3, 0.1, 0.0))
    with pytest.raises(piga.ArgumentError, match="published") as refused:
        piga.calibrate(small_ramp("rate"), ["tan_beta"], "published")
    assert "piga.studies.published_recursion" in refused.value.remedy
