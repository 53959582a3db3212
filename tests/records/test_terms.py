"""Names of terms in run files, their combinations and words."""

from __future__ import annotations

import pytest

import piga
from piga.records.terms import check_terms, term_words


def test_the_sizes_of_the_servo_are_those_of_its_formulas() -> None:
    """docs/understanding/servo: s = K ml/(2 k_i), d = c K^2/k_i."""
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
