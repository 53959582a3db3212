"""The light: green, amber and red, each with its reason."""

from __future__ import annotations

from dataclasses import replace

import pytest

from piga.records.calibration import StandSource
from piga.workbench.pages.record import light
from tests.certificate.certificate_data import budgeted
from tests.reports.example import calibration

GOOD = budgeted(calibration(serial="a", with_residuals=False))


def with_k(ratio: float) -> object:
    nominal = GOOD.scale_factor_nominal * 9.80665
    changed = [replace(c, value=ratio * nominal) if c.name == "scale_factor" else c for c in GOOD.coefficients]
    return replace(GOOD, coefficients=tuple(changed))


@pytest.mark.parametrize(("ratio", "grade"), [(1.009, "same"), (1.011, "red"), (9.0, "red"), (0.98, "red")])
def test_k_off_nominal_is_red_and_cannot_be_kept(ratio: float, grade: str) -> None:
    shown = light(with_k(ratio))  # type: ignore[arg-type]
    assert shown.grade == (light(GOOD).grade if grade == "same" else "red")
    assert shown.may_keep == (grade != "red")
    if ratio == 9.0:
        assert "9 times" in shown.reason


def test_a_fit_that_leaves_more_than_it_explains_is_red() -> None:
    garbage = replace(GOOD, residual_rms_before=8.0, residual_rms=7.8)
    assert light(garbage).grade == "red"
    assert "leaves more" in light(garbage).reason
    assert light(replace(GOOD, residual_rms_before=8.0, residual_rms=0.1)).grade != "red"
    small = replace(GOOD, residual_rms_before=2.0e-5, residual_rms=1.99e-5)  # little to explain is no fault
    assert light(small).grade == light(GOOD).grade


def test_a_doubt_is_amber_and_a_remark_is_not() -> None:
    clean = replace(GOOD, notes=())
    assert light(clean).grade == "green"
    assert light(replace(clean, remarks=("k2 is small",))).more == ("k2 is small",)
    assert light(replace(clean, notes=("the noise grew",))).grade == "amber"
    assert light(replace(clean, notes=("the noise grew",))).reason == "the noise grew"


def test_a_source_that_nobody_stated_is_amber() -> None:
    source = StandSource("arm_radius", "unstated", "um", {"arm_radius": {"scale_factor": 1e-6}})
    shown = light(replace(GOOD, notes=(), sources=(StandSource("timing", "stated", "ppm"), source)))
    assert shown.grade == "amber"
    assert "Type A and 1 of 2 sources" in shown.reason
    assert "1 um of arm_radius changes scale_factor by 1e-6" in shown.reason
