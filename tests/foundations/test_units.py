from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from piga.errors import UnitError
from piga.units import ARCSEC, G0, conversion_factor, from_si, parse_unit, to_si


@pytest.mark.parametrize(
    ("text", "like", "value"),
    [
        ("0.8884 rad/s/g", "rad/s/(m/s^2)", 0.8884 / 9.80665),
        ("1000 arcsec", "rad", 1000 * math.pi / 648000),
        ("5 g", "m/s^2", 49.03325),
        ("8 min", "s", 480.0),
        ("0.01 deg/h", "rad/s", math.pi / 180 * 0.01 / 3600),
        ("20 degC", "K", 293.15),
        ("10 ppm", "1", 1e-5),
        ("1.5", "1", 1.5),
        ("3e-4 rad/sqrt(s)", "rad/s^0.5", 3e-4),
        ("2 ug/g^2", "1/(m/s^2)", 2e-6 / G0),
        ("100 mGal", "m/s^2", 1e-3),
        ("1 rpm", "rad/s", 2 * math.pi / 60),
        (2.5, "rad", 2.5),
        ("-1 °", "rad", -math.pi / 180),
        ("5 µg", "g", 5e-6 * G0),
        ("1 rev", "rad", 2 * math.pi),
    ],
)
def test_values(text: str | float, like: str, value: float) -> None:
    assert to_si(text, like) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "like", "message"),
    [
        ("5", "s", "has no unit"),
        ("5 deg", "s", "given in 'deg', but a quantity in 's'"),
        ("1 ppm", "rad", "'ppm'"),
        ("x g", "g", "not a number with a unit"),
        ("5 furlong", "m", "unknown unit 'furlong'"),
        ("5 g/(s", "g", "not closed"),
        ("5 rad^x", "rad", "number must follow"),
        ("5 m$", "m", "cannot be read at"),
        ("5 /s", "Hz", "unknown unit"),
        ("1e999 m", "m", "not a finite"),
        (float("nan"), "m", "not a finite"),
        (True, "m", "is not a quantity"),
        (None, "m", "is not a quantity"),
    ],
)
def test_refusals_name_the_quantity(text: object, like: str, message: str) -> None:
    with pytest.raises(UnitError, match=message.replace("^", r"\^")) as caught:
        to_si(text, like, what="[a] b")  # type: ignore[arg-type]
    assert str(caught.value).startswith("[a] b")


def test_the_unit_g_and_the_arcsecond() -> None:
    assert parse_unit("g").factor == 9.80665
    assert parse_unit("arcsec").factor == ARCSEC
    assert conversion_factor("g", "mg") == pytest.approx(1000.0, rel=1e-15)
    with pytest.raises(UnitError, match="does not measure the same"):
        conversion_factor("g", "rad")
    with pytest.raises(UnitError, match="missing"):
        parse_unit(" ")


UNITS = ["m", "s", "rad", "deg/h", "rad/s/g", "g/g^2", "degC", "arcsec", "ppm", "rad/sqrt(s)"]


@given(st.floats(-1e12, 1e12), st.sampled_from(UNITS))
def test_round_trip(value: float, unit: str) -> None:
    si = to_si(f"{value!r} {unit}", unit)
    assert from_si(si, unit) == pytest.approx(value, rel=1e-12, abs=1e-10)


@given(st.text(max_size=20))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        assert math.isfinite(to_si(text, "rad"))
    except UnitError as error:
        assert error.message  # noqa: PT017 - either outcome is right, nothing else may happen
