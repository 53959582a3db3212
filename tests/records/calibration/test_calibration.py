"""A calibration is a mapping of its coefficients; coefficients know their SI values."""

from __future__ import annotations

import math

import numpy as np
import pytest

import piga
from piga.records.calibration.coefficient import Coefficient
from piga.records.terms import UNITS, si_factor
from piga.units import G0, parse_unit


def test_a_calibration_is_a_mapping_in_the_order_of_its_coefficients(cal):
    keys = [c.key for c in cal.coefficients]
    assert list(cal) == list(cal.keys()) == keys == cal._ipython_key_completions_()
    assert len(cal) == len(keys)
    assert "tan_beta" in cal
    assert "k9" not in cal
    assert dict(cal)["k0"] is cal["k0"]
    assert list(cal.values()) == list(cal.coefficients)
    assert cal.get("k9") is None
    with pytest.raises(KeyError, match="no coefficient 'k9'; there are: scale_factor"):
        cal["k9"]


@pytest.mark.parametrize("name", [*UNITS, "s2"])
def test_si_of_every_coefficient(name):
    unit = parse_unit(UNITS.get(name, "g"))
    c = Coefficient(name, 2.0, 0.25, UNITS.get(name, "g"), degrees_of_freedom=12.0)
    si = parse_unit(c.unit_si)
    assert si.factor == 1.0
    assert si.dimension == unit.dimension
    assert c.value_si == 2.0 * unit.factor == 2.0 * si_factor(name)
    assert c.std_si == 0.25 * unit.factor


def test_the_instrument_of_a_calibration(cal):
    inst = cal.instrument(alpha0="10 deg")
    assert inst.scale_factor == pytest.approx(0.8884 / G0, rel=1e-3)
    assert inst.tan_beta == pytest.approx(cal["tan_beta"].value, rel=1e-12)
    assert inst.alpha0 == math.radians(10.0)
    assert piga.Calibration.from_coefficients(
        {"k0": 1e-4}, scale_factor_nominal="0.9 rad/s/g"
    ).instrument() == (piga.Instrument("0.9 rad/s/g"))


def test_the_error_model_of_a_calibration():
    """A drift counts from the reference time of the calibration, in an error model from time zero."""
    from dataclasses import replace

    cal = piga.Calibration.from_coefficients(
        {"scale_factor": 0.8884, "k0": 1e-3, "k0_t": 1e-6, "k2": 2e-4, "k_XY": "3e-5 g/g^2"}
    )
    model = replace(cal, time_reference=100.0, temperature_reference=300.0).error_model()
    assert model.k0 == pytest.approx((1e-3 - 1e-4) * G0)
    assert model.k2 == pytest.approx(2e-4 / G0)
    assert model.k_XY == pytest.approx(3e-5 / G0)
    assert model.T_ref == 300.0
    harmonics = piga.Calibration.from_coefficients({"scale_factor": 0.8884, "s2": 1e-5, "c2": 0.0})
    with pytest.warns(piga.PigaWarning, match="leaves out s2, c2"):
        assert harmonics.error_model().k0 == 0.0


@pytest.mark.long
def test_the_model_of_a_calibration_makes_its_record():
    """Propagating instrument and error model gives the record that the calibration was made from."""
    made = piga.Calibration.from_coefficients(
        {"scale_factor": 0.8884, "tan_beta": math.tan(math.radians(1 / 3.6)), "k0": 1e-4}
    )
    t = np.arange(40_000) * 0.001
    f = G0 * np.column_stack([0.8 + 0.6 * np.sin(0.7 * t), 0.5 * np.cos(0.4 * t), 0.2 + 0 * t])
    alpha = piga.propagate(made.instrument(0.4), t, f, error_model=made.error_model(), between="linear")
    again = piga.Run.from_arrays(t[::10], alpha[::10], f[::10], scale_factor="0.8884 rad/s/g", units="SI")
    calibration = piga.calibrate(again, ["scale_factor", "tan_beta", "k0"])
    for name in made:
        assert calibration[name].value_si == pytest.approx(made[name].value_si, abs=1e-6)


def test_from_coefficients_compensates_as_the_estimate_does(run, cal):
    given = piga.Calibration.from_coefficients(dict(cal), covariance=cal.covariance, serial="T-1")
    assert given["tan_beta"] == cal["tan_beta"]
    assert np.array_equal(given.covariance, cal.covariance)
    one, other = piga.compensate(run, cal), piga.compensate(run, given)
    assert np.array_equal(one.ax, other.ax, equal_nan=True)
    numbers = piga.Calibration.from_coefficients({name: (c.value, c.std) for name, c in cal.items()})
    assert [c.std for c in numbers.values()] == pytest.approx([c.std for c in cal.values()])
    text = piga.Calibration.from_coefficients({"scale_factor": "0.8884 rad/s/g", "k0": ("300 ug", "2 ug")})
    assert text["k0"].value == pytest.approx(3e-4)
    assert text["k0"].std == pytest.approx(2e-6)
    assert text.verdict.headline == f"Doubt: {text.notes[0]}."
    assert "given, not estimated" in repr(text)
    assert not text.type_a_only
    phases = piga.Calibration.from_coefficients(
        {"scale_factor": 0.9, "tan_beta": 1e-3, "phi[3]": 0.1, "phi[4]": 0.2}
    )
    assert phases.phases == "per-segment"
    assert phases["phi[4]"].segment == "4"


@pytest.mark.parametrize(
    ("coefficients", "settings", "said"),
    [
        ({}, {}, "there is no positive scale factor"),
        ({"k9": 1.0}, {}, "unknown coefficient 'k9'"),
        ({"scale_factor": "0.9 rad"}, {}, "a quantity in 'rad/s/g' is needed"),
        ({"scale_factor": math.nan}, {}, "not a finite number"),
        ({"scale_factor": -0.9}, {}, "there is no positive scale factor"),
        ({"scale_factor": 0.9, "tan_beta": -1.0}, {}, "must not be negative"),
        ({"scale_factor": (0.9, -1e-6)}, {}, "float` >= 0.0"),
        ({"scale_factor": 0.9, "k0[3]": 0.0}, {}, "only a phase can belong to a segment"),
        ({"scale_factor": 0.9}, {"covariance": np.eye(2)}, "shape \\(2, 2\\), but there are 1"),
        (
            {"scale_factor": 0.9, "k0": 0.0},
            {"covariance": [[1.0, 2.0], [2.0, 1.0]]},
            "not positive semi-definite",
        ),
        ({"scale_factor": 0.9, "k0": 0.0}, {"covariance": [[1.0, 0.5], [0.2, 1.0]]}, "not symmetric"),
        (
            {"scale_factor": (0.9, 1e-3)},
            {"covariance": [[1.0]]},
            "uncertainty of .scale_factor. is 0.001, but the covariance gives 1",
        ),
        ({"scale_factor": 0.9}, {"phase_source": "both"}, "Invalid enum value 'both'"),
        ({"k0": Coefficient("k2", 1.0, 0.0, "g/g^2")}, {}, "'k0' is the coefficient 'k2'"),
    ],
)
def test_impossible_coefficients_are_refused(coefficients, settings, said):
    with pytest.raises(piga.PigaError, match=said) as refusal:
        piga.Calibration.from_coefficients(coefficients, **settings)
    assert "from_coefficients" in str(refusal.value)


def test_given_coefficients_get_no_certificate(cal):
    from piga.certificate.certificate_file import missing_items
    from tests.certificate.certificate_data import complete

    given = piga.Calibration.from_coefficients(dict(cal), serial="T-1")
    assert any("given, not estimated" in item for item in missing_items(complete("T-1"), given))
    assert not any("given, not estimated" in item for item in missing_items(complete("T-1"), cal))
