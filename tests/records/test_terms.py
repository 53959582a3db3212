"""A term of the error model stands at every place that a new one needs (CONTRIBUTING: adding a term)."""

from __future__ import annotations

import numpy as np
import pytest

import piga
from piga._kernels.compensation.data import TERMS as COMPENSATED
from piga._kernels.estimation.regressors import CODES
from piga.calibration.joint.summary import STATIC_TERMS
from piga.calibration.remarks.missing_terms import SINGLE, term_values
from piga.instrument import ErrorModel
from piga.instrument.parameters import _ERROR_UNITS
from piga.records.terms import MEANING, SERVO_TERMS, UNITS, check_terms, meaning_of, term_words

MOTION = ("scale_factor", "tan_beta", "phi")


TERMS = [name for name in UNITS if name not in MOTION]


def test_every_unit_has_a_meaning() -> None:
    assert list(MEANING) == list(UNITS)


def test_every_term_has_its_inverse() -> None:
    assert sorted(COMPENSATED) == sorted(TERMS)


@pytest.mark.parametrize("name", TERMS)
def test_a_term_stands_everywhere(name: str) -> None:
    """All places that lack the term are named at once."""
    servo, warm = name in SERVO_TERMS, name in ("k0_T", "k1_T")
    places = {
        "CODES in _kernels/estimation/regressors.py": servo or name == "k1" or name in CODES,
        "TERMS in _kernels/compensation/data.py": name in COMPENSATED,
        "ErrorModel in instrument/parameters.py": servo or name in ErrorModel.__dataclass_fields__,
        "_ERROR_UNITS in instrument/parameters.py": servo or name in _ERROR_UNITS,
        "SINGLE in calibration/remarks/missing_terms.py": name in SINGLE,
        "STATIC_TERMS in calibration/joint/summary.py": servo or warm or name == "k1" or name in STATIC_TERMS,
    }
    assert all(places.values()), f"{name} is missing in " + ", ".join(
        place for place, there in places.items() if not there
    )


@pytest.mark.parametrize("name", [name for name in SINGLE if name not in SERVO_TERMS])
def test_a_suggested_term_has_the_column_of_the_simulated_one(name: str) -> None:
    """``term_values`` (calibration/remarks/missing_terms.py) and ``ErrorModel`` are one error."""
    rng = np.random.default_rng(1)
    t, warm, a = rng.normal(size=5), rng.normal(size=5), rng.normal(size=(3, 5))
    model = ErrorModel(**{name: 1.0, "T_ref": 0.0})
    simulated = model.specific_force(t, a.T, warm)
    assert term_values([name], a, t, warm, a, t)[0] == pytest.approx(simulated, rel=1e-14)


def test_the_sizes_of_the_servo_are_those_of_its_formulas() -> None:
    """docs/theory/servo: s = K ml/(2 k_i), d = c K^2/k_i."""
    scale, pendulosity, gain, damping = 0.8884 / 9.80665, 9.06e-3, 3000.0, 0.05
    known = 1e6 * 9.80665**2
    assert f"{known * scale * pendulosity / (2.0 * gain):.0f} ug/g^3" in term_words("servo").known
    assert f"{known * damping * scale**2 / gain:.0f} ug/g^3" in term_words("servo_damping").known


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ((), "no term is asked for"),
        (("k0", "phi"), "'phi' comes with tan_beta"),
        (("k0", "k0"), "'k0' is named twice"),
        (("k0", "s2"), "'s2' without 'c2'"),
        (("c3", "k0"), "'c3' without 's3'"),
        (("k1", "scale_factor"), "the same coefficient"),
        (("s100", "c100"), "unknown term 's100'"),
    ],
)
def test_terms_that_do_not_go_together(terms: tuple[str, ...], message: str) -> None:
    with pytest.raises(piga.RunFileError, match=message) as caught:
        check_terms(terms)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("name", "near"), [("k_1", "k1"), ("k2k", "k2"), ("tanbeta", "tan_beta"), ("k_xy", "k_XY")]
)
def test_a_mistyped_term_is_answered_with_the_nearest(name: str, near: str) -> None:
    with pytest.raises(piga.RunFileError) as caught:
        check_terms((name,))
    assert caught.value.remedy.startswith(f"did you mean '{near}'? known terms: scale_factor")


def test_coefficients_in_words() -> None:
    assert meaning_of("s2") == "sine of 2 x output angle"
    assert meaning_of("c12[3]") == "cosine of 12 x output angle"
    assert meaning_of("k0[up]") == "bias"
