"""A term of the table stands at every place that a new one needs (CONTRIBUTING: adding a term)."""

from __future__ import annotations

import pytest

from piga._kernels.compensation.data import INSTRUMENT
from piga.calibration.joint import STATIC_TERMS
from piga.instrument import ErrorModel
from piga.records.terms import SERVO_TERMS
from piga.terms import ERROR_TERMS, LOGGED_TERMS, PRODUCTS, THERMAL_TERMS


@pytest.mark.parametrize("name", ERROR_TERMS)
def test_a_term_stands_everywhere(name: str) -> None:
    """All places that lack the term are named at once."""
    servo = name in (*SERVO_TERMS, "k2v")  # the simulator has them apart from the error model
    places = {
        "Instrument in _kernels/compensation/data.py": name in INSTRUMENT.names,
        "ErrorModel in instrument/parameters.py": servo or name in ErrorModel.__dataclass_fields__,
        "STATIC_TERMS in calibration/summary.py": name in ("k1", *LOGGED_TERMS) or name in STATIC_TERMS,
        "factors in terms.py": name in SERVO_TERMS or name in PRODUCTS,
    }
    assert all(places.values()), f"{name} is missing in " + ", ".join(
        place for place, there in places.items() if not there
    )


def test_terms_of_the_temperature() -> None:
    assert THERMAL_TERMS == ("k0_T", "k1_T")
    assert LOGGED_TERMS == {"k0_T": "temperature", "k1_T": "temperature", "k2v": "vibration"}
