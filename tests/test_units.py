"""Every unit against its definition (SciPy's constants, SI brochure), texts with units, and the grammar of units."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import constants as si

from piga.errors import UnitError
from piga.units import _ATOMS, G0, conversion_factor, from_si, offset_to_si, parse_unit, to_si


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
        (0.0, "rad", 0.0),
        (2.5, "1", 2.5),
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
        (2.5, "rad", 'write its unit, e.g. deg; piga 0.2 took it as "2.5 rad"'),
        (0.8884, "rad/s/g", 'piga 0.2 took it as "0.8884 rad/s/g"'),
        (0.0, "K", "has no unit"),
        (1e-5, "ppm", "has no unit"),
        ("10", "ppm", 'took it as "10 ppm"'),
        ("5 deg", "s", "given in 'deg', but a quantity in 's'"),
        ("1 ppm", "rad", "'ppm'"),
        ("x g", "g", "not a number with a unit"),
        ("5 furlong", "m", "unknown unit 'furlong'"),
        ("5 g/(s", "g", "cannot be read at"),
        ("5 rad^x", "rad", "cannot be read at"),
        ("5 m$", "m", "cannot be read at"),
        ("0,8884 rad/s/g", "rad/s/g", "has a comma in the number"),
        ("5 /s", "Hz", "cannot be read at"),
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


DEFINITIONS = {
    "1": (1, "1"), "%": (si.centi, "1"), "ppm": (si.micro, "1"), "ppb": (si.nano, "1"),
    "m": (1, "m"), "km": (si.kilo, "m"), "cm": (si.centi, "m"), "mm": (si.milli, "m"), "um": (si.micron, "m"),
    "nm": (si.nano, "m"),
    "s": (1, "s"), "sec": (1, "s"), "ms": (si.milli, "s"), "us": (si.micro, "s"), "ns": (si.nano, "s"),
    "min": (si.minute, "s"), "h": (si.hour, "s"), "hr": (si.hour, "s"), "d": (si.day, "s"), "day": (si.day, "s"),
    "year": (si.Julian_year, "s"), "Hz": (1, "1/s"), "kHz": (si.kilo, "1/s"), "MHz": (si.mega, "1/s"),
    "rad": (1, "rad"), "mrad": (si.milli, "rad"), "urad": (si.micro, "rad"), "nrad": (si.nano, "rad"),
    "deg": (si.degree, "rad"), "arcmin": (si.arcminute, "rad"), "arcsec": (si.arcsecond, "rad"),
    "mas": (si.arcsecond / 1000, "rad"), "rev": (2 * math.pi, "rad"), "rpm": (2 * math.pi / si.minute, "rad/s"),
    "g": (si.g, "m/s^2"), "mg": (si.g / 1e3, "m/s^2"), "ug": (si.g / 1e6, "m/s^2"), "ng": (si.g / 1e9, "m/s^2"),
    "mGal": (si.milli * si.centi, "m/s^2"), "uGal": (si.micro * si.centi, "m/s^2"),
    "kg": (1, "kg"), "gram": (si.gram, "kg"), "N": (1, "kg m/s^2"), "mN": (si.milli, "kg m/s^2"),
    "Nm": (1, "kg m^2/s^2"), "mNm": (si.milli, "kg m^2/s^2"), "uNm": (si.micro, "kg m^2/s^2"),
    "Pa": (1, "N/m^2"),
    "hPa": (si.hecto, "N/m^2"),
    "kPa": (si.kilo, "N/m^2"),
    "K": (1, "K"), "degC": (1, "K"), "V": (1, "V"), "mV": (si.milli, "V"), "uV": (si.micro, "V"),
    "A": (1, "A"), "mA": (si.milli, "A"), "uA": (si.micro, "A"), "count": (1, "count"), "counts": (1, "count"),
}  # fmt: skip


@pytest.mark.parametrize("unit", sorted(_ATOMS))
def test_every_unit_is_what_its_definition_says(unit: str) -> None:
    factor, base = DEFINITIONS[unit]
    assert conversion_factor(unit, base) == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    ("unit", "like", "factor"),
    [
        ("rad/s/g", "rad/(m/s^2)/s", 1 / G0),
        ("g/g^2", "1/g", 1.0),
        ("g^3/g", "g^2", 1.0),
        ("km^-2", "1/m^2", 1e-6),
        ("m^0.5", "sqrt(m)", 1.0),
        ("sqrt(km h)", "sqrt(m)*sqrt(s)", math.sqrt(3.6e6)),
        ("deg/sqrt(h)", "rad/sqrt(s)", math.pi / 180 / 60),
        ("(m/s)/(km/h)", "1", 3.6),
        ("kg·m", "kg m", 1.0),
        ("rev/min", "rpm", 1.0),
        ("m/s/s", "m/s^2", 1.0),
    ],
)
def test_grammar(unit: str, like: str, factor: float) -> None:
    assert conversion_factor(unit, like) == pytest.approx(factor, rel=1e-15)


@pytest.mark.parametrize(
    ("unit", "message"),
    [("sqrt m", "unknown unit 'sqrt'"), ("m)", "at ."), ("(m", "at '.m'"), ("m^", "at '.'"), ("m^s", "at '.s'"),
     ("m/", "at '/'")],
)  # fmt: skip
def test_broken_units(unit: str, message: str) -> None:
    with pytest.raises(UnitError, match=message):
        parse_unit(unit)


def test_temperatures_have_an_offset_as_quantities_only() -> None:
    assert to_si("0 degC", "K") == 273.15
    assert to_si("0 °C", "K") == 273.15
    assert to_si("2 1/degC", "1/K") == 2.0
    assert (offset_to_si("degC"), offset_to_si("K")) == (273.15, 0.0)
    assert from_si(300.0, "degC") == pytest.approx(26.85, abs=1e-13)
    assert from_si(0.5, "mrad") == 500.0
