"""A term of the error model stands at every place that a new one needs (CONTRIBUTING: adding a term)."""

from __future__ import annotations

import pytest

from piga._kernels.compensation.layout import TERMS as COMPENSATED
from piga._kernels.estimation.regressors import CODES
from piga.calibration.joint.summary import STATIC_TERMS
from piga.calibration.remarks.missing_terms import SINGLE
from piga.instrument import ErrorModel
from piga.records.terms import MEANING, SERVO_TERMS, UNITS

MOTION = ("scale_factor", "tan_beta", "phi")
TERMS = [name for name in UNITS if name not in MOTION]


def test_every_unit_has_a_meaning() -> None:
    assert list(MEANING) == list(UNITS)


def test_every_term_has_its_inverse() -> None:
    assert sorted(COMPENSATED) == sorted(TERMS)


@pytest.mark.parametrize("name", TERMS)
def test_a_term_stands_everywhere(name: str) -> None:
    assert name in SINGLE, "suggested where it is missing"
    if name in SERVO_TERMS:
        return
    assert name in CODES or name == "k1", "its column; k1 is that of a_x"
    assert name in ErrorModel.__dataclass_fields__, "the simulated instrument"
    assert name in STATIC_TERMS or name in ("k1", "k0_T", "k1_T"), (
        "stored summaries; those of temperature apart"
    )
