"""Instrument, error model and regimes."""

import math

import pytest

import piga
from piga.instrument import ErrorModel, Instrument, regime
from piga.units import ARCSEC, G0

INST = Instrument(scale_factor="0.8884 rad/s/g", beta="1000 arcsec", alpha0=0.785)


def test_numbers_are_si_and_text_carries_units():
    assert INST.scale_factor == pytest.approx(0.8884 / G0, rel=1e-15)
    assert INST.beta == pytest.approx(1000 * ARCSEC, rel=1e-15)
    assert INST.alpha0 == 0.785
    assert INST.tan_beta == pytest.approx(0.00484817479568412257, rel=1e-15)
    assert Instrument(0.09) == Instrument(scale_factor=0.09, beta=0.0, alpha0=0.0)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"scale_factor": 0.0}, "scale_factor: 0.0 is not positive"),
        ({"scale_factor": "-1 rad/s/g"}, "not positive"),
        ({"scale_factor": "0.9"}, "no unit"),
        ({"scale_factor": "0.9 rad"}, "needed"),
        ({"scale_factor": 0.09, "beta": "90 deg"}, "between -90 and 90"),
        ({"scale_factor": math.nan}, "not a finite number"),
    ],
)
def test_bad_parameters_are_named(kwargs, message):
    with pytest.raises(piga.PigaError, match=message):
        Instrument(**kwargs)


def test_error_model_units_and_names():
    model = ErrorModel(k0="1e-3 g", k2="2e-6 g/g^2", T_ref="25 degC")
    assert model.k0 == pytest.approx(1e-3 * G0)
    assert model.k2 == pytest.approx(2e-6 / G0)
    assert model.T_ref == pytest.approx(298.15)
    with pytest.raises(piga.ArgumentError, match="term 's2' cannot be propagated"):
        ErrorModel(s2=1e-6)
    with pytest.raises(piga.UnitError, match="ErrorModel k2"):
        ErrorModel(k2="1 g")


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_regimes_of_the_published_cases(sign):
    transverse = (5 * G0, 0.0)
    assert regime(INST, 0.0 * sign, *transverse) == "zero"
    assert regime(INST, sign * 5 * G0 * INST.tan_beta, *transverse) == "critical"
    assert regime(INST, sign * 5 * INST.tan_beta * G0, *transverse) == "critical"
    assert regime(INST, sign * 0.01 * G0, *transverse) == "locked"
    assert regime(INST, sign * G0, *transverse) == "running"


def test_regime_separates_what_float64_separates():
    for a_t in (1e-200, 1.0, 49.03325, 1e200):
        b = a_t * INST.tan_beta
        assert regime(INST, b * (1 + 1e-15), a_t, 0.0) == "running"
        assert regime(INST, b * (1 - 1e-15), 0.0, a_t) == "locked"
        assert regime(INST, b, 0.0, -a_t) == "critical"


def test_base_rate_shifts_the_regime():
    K = INST.scale_factor
    assert regime(INST, 0.01 * G0, 5 * G0, 0.0, base_rate=[K * (0.01 * G0), 0.0, 0.0]) == "zero"
    assert regime(INST, 0.01 * G0, 5 * G0, 0.0, base_rate=[0.0, K * 5 * G0, 0.0]) == "running"


def test_without_coupling_every_input_runs():
    assert regime(Instrument(0.09), 1e-12, 5 * G0, 0.0) == "running"
    assert regime(Instrument(0.09), 0.0, 5 * G0, 0.0) == "zero"
    with pytest.raises(piga.ArgumentError, match="a_Z"):
        regime(INST, 1.0, 1.0, math.nan)
