"""The published closed forms against the one form for all regimes."""

import math

import numpy as np
import pytest

import piga
from piga.instrument import Instrument, closed_form
from piga.studies.constant import published_closed_form
from piga.units import G0

PUBLISHED = Instrument("0.8884 rad/s/g", "1000 arcsec", math.pi / 4)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("number", "a_x"), [(1, 0.0), (2, 5 * PUBLISHED.tan_beta), (3, 0.01), (4, 1.0)])
def test_published_forms_with_signed_ratio(number, a_x, sign):
    t = np.linspace(0.0, 6.0, 13)
    alpha, rate = closed_form(PUBLISHED, t, sign * a_x * G0, 5 * G0, 0.0)
    wrapped, published_rate = published_closed_form(number, PUBLISHED, t, sign * a_x * G0, 5 * G0, 0.0)
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * alpha), abs=1e-12)
    assert published_rate == pytest.approx(rate, abs=1e-13)


@pytest.mark.parametrize(("number", "a_x"), [(2, 5 * PUBLISHED.tan_beta), (3, 0.01), (4, 1.0)])
def test_published_forms_as_printed_are_wrong_for_negative_input_only(number, a_x):
    t = np.linspace(0.0, 6.0, 13)
    for sign, low, high in ((1.0, 0.0, 1e-13), (-1.0, 0.02, 0.05)):
        _, rate = closed_form(PUBLISHED, t, sign * a_x * G0, 5 * G0, 0.0)
        _, printed = published_closed_form(
            number, PUBLISHED, t, sign * a_x * G0, 5 * G0, 0.0, as_published=True
        )
        assert low <= np.abs(printed - rate).max() < high


def test_published_forms_refuse_another_regime():
    with pytest.raises(piga.ArgumentError, match="no real value"):
        published_closed_form(1, PUBLISHED, 1.0, G0, 0.0, 0.0)
    with pytest.raises(piga.ArgumentError, match="no real value"):
        published_closed_form(3, PUBLISHED, 1.0, G0, G0, 0.0)
