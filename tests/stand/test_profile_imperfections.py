"""Imperfections of a stand: read from text, refused by name, drawn with the stated spread."""

import math
from dataclasses import fields

import numpy as np
import pytest

from piga.records.run_file import REPEATED, UNCERTAINTY_UNITS
from piga.stand.profile import Imperfections, imperfections
from piga.units import ARCSEC, G0


def test_imperfections_from_text():
    errors = imperfections(
        {
            "reference_scale": "10 ppm",
            "levelling": ["1 arcsec", "0 arcsec"],
            "angle_harmonics": [[1, "1 arcsec", "90 deg"]],
            "gravity": "1 ug",
        }
    )
    assert errors.reference_scale == pytest.approx(1e-5)
    assert errors.levelling == pytest.approx((ARCSEC, 0.0))
    assert errors.angle_harmonics == ((1, pytest.approx(ARCSEC), pytest.approx(math.pi / 2)),)
    assert errors.gravity == pytest.approx(1e-6 * G0)


def test_every_type_b_source_of_a_run_file_is_an_imperfection_with_that_unit():
    units = {entry.name: entry.metadata["unit"] for entry in fields(Imperfections)}
    of_the_stand = {name: unit for name, unit in UNCERTAINTY_UNITS.items() if name != "vibration"}
    known = {name: units[REPEATED[name][0] if name in REPEATED else name] for name in of_the_stand}
    assert known == of_the_stand  # the vibration acts through k2 of the instrument


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"referenc_scale": 1.0}, "unknown key 'referenc_scale'"),
        ({"reference_scale": "1 m"}, "reference_scale"),
        ({"levelling": "1 arcsec"}, "a list is needed"),
        ({"levelling": ["1 arcsec"]}, "2 needed"),
        ({"angle_harmonics": [["1 arcsec", 1]]}, "order"),
    ],
)
def test_bad_imperfections_are_named(values, words):
    with pytest.raises(Exception, match=words):
        imperfections(values)


def test_drawn_imperfections_have_the_stated_spread():
    rng = np.random.default_rng(5)
    drawn = [imperfections({"reference_scale": "2 ppm", "levelling": "3 urad"}, rng=rng) for _ in range(2000)]
    assert np.std([d.reference_scale for d in drawn]) == pytest.approx(2e-6, rel=0.07)
    assert np.std([d.levelling for d in drawn]) == pytest.approx(3e-6, rel=0.07)
