"""Names of the terms in run files: what is a term, which go together, units and words of one (:mod:`piga.terms`)."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import replace
from typing import NoReturn

from piga.errors import RunFileError
from piga.terms import HARMONICS, TERMS, Term
from piga.units import parse_unit, to_si

UNITS = {name: term.unit for name, term in TERMS.items()}
"""Unit of each coefficient in ``calibration.json``; harmonics ``s1 c1 s2 c2 ...`` are in g."""

_SI_UNITS = {"g": "m/s^2", "g/g^2": "1/(m/s^2)", "g/g^3": "1/(m/s^2)^2", "g/s": "m/s^2/s", "g/K": "m/s^2/K"}
"""SI unit of the units that begin with g. In others ``/g`` is per m/s^2."""

TERM_WORDS = TERMS | HARMONICS
"""Every term in words, in the order of the docs. ``sn`` and ``cn`` stand for the harmonics s1 c1 s2 c2 and so on."""


def term_words(name: str) -> Term:
    """The words of a term; also of ``s2`` and of ``m_Y[run]``. A :class:`KeyError` if this is not a term."""
    base = name.partition("[")[0]
    if base in TERM_WORDS:
        return TERM_WORDS[base]
    wave = harmonic(base)
    if wave is None:
        raise KeyError(base)
    kind, order = wave
    words = HARMONICS[f"{kind}n"]
    formula = f"{base} {words.formula.partition(' ')[2].replace('n psi', f'{order} psi')}"
    meaning = f"{'sine' if kind == 's' else 'cosine'} of {order} x output angle"
    return replace(words, formula=formula, meaning=meaning)


GYRO = "rad/s"
"""Unit of the output rate of a gyro accelerometer. Any other unit is that of a direct instrument, as text; its output and its
K are numbers in this unit, not in SI."""


def integral_unit(unit: str) -> str:
    """Unit of the output integrated over time: rad of rad/s, count of count/s, V s of V."""
    return unit.removesuffix("/s") if unit.endswith("/s") else f"{unit} s"


def scale_factor_in(value: str | float, unit: str, what: str = "scale_factor") -> float:
    """K [unit per m/s^2] of an instrument whose output rate has this unit, from text with any unit of its kind."""
    return level_in(value, unit, what, f"{unit}/g")


def level_in(value: str | float, unit: str, what: str = "noise", like: str = "") -> float:
    """A level of the output in this unit, from text with any unit of its kind (``like``)."""
    number = to_si(value, like or unit, what=what)
    return number / parse_unit(unit).factor if isinstance(value, str) else number


SERVO_TERMS = ("servo", "servo_damping")
"""Terms of the servo. They turn with the output angle, as ``tan_beta`` does. Their phase is that of ``tan_beta``."""


def turns(name: str) -> bool:
    """True for a term that turns with the gimbal: only a gyro accelerometer has it."""
    return name in ("tan_beta", "phi", *SERVO_TERMS) or harmonic(name) is not None


_HARMONIC = re.compile(r"^([sc])([1-9]\d?)$")


def harmonic(name: str) -> tuple[str, int] | None:
    """``("s", 2)`` for ``s2``; None when the name is not a harmonic."""
    match = _HARMONIC.match(name)
    return None if match is None else (match.group(1), int(match.group(2)))


def shown_unit(name: str, unit: str) -> tuple[float, str]:
    """Factor and unit in which a coefficient is displayed, on every page and terminal: ``g/g^2`` becomes ``ug/g^2``.

    The choice depends on the coefficient, never on its value. So a column has one unit across runs and records.
    The phase ``phi`` and rates stay (the field quotes the scale factor in ``rad/s/g``).
    """
    head, _, tail = unit.partition("/")
    if name.partition("[")[0] in ("phi", "scale_factor") or head not in ("g", "rad") or tail.startswith("s"):
        return 1.0, unit
    return 1e6, f"u{unit}"


def unit_of(name: str, output: str = GYRO) -> str:
    """Unit of a coefficient in files; ``name`` may carry a segment in brackets. ``output`` is the unit of the output rate."""
    return f"{output}/g" if name.partition("[")[0] == "scale_factor" else term_words(name).unit


def si_factor(name: str) -> float:
    """SI value of one file unit of the coefficient: ``value_SI = value_file * si_factor``.

    The K of a direct instrument is in the unit of its output per m/s^2.
    """
    return parse_unit(unit_of(name)).factor


def si_unit_of(name: str, output: str = GYRO) -> str:
    """SI unit of a coefficient; ``name`` may carry a segment in brackets. ``output`` as for :func:`unit_of`."""
    unit = unit_of(name, output)
    return _SI_UNITS.get(unit) or unit.replace("/g", "/(m/s^2)")


def check_name(name: str) -> bool:
    """True if this version knows the coefficient name."""
    return name in UNITS or harmonic(name) is not None


def term_names(terms: str | Iterable[str]) -> tuple[str, ...]:
    """Names of terms, also when they are one text: ``"scale_factor, tan_beta k0"``."""
    return tuple(terms.replace(",", " ").split()) if isinstance(terms, str) else tuple(terms)


def known_terms(name: str) -> str:
    """Remedy for a name that is not a term: the nearest one, and all there are."""
    known = [term for term in UNITS if term != "phi"]
    small = {term.lower(): term for term in known}
    near = difflib.get_close_matches(name.lower(), small, n=1)
    guess = "".join(f"did you mean '{small[term]}'? " for term in near)
    return f"{guess}known terms: {' '.join(known)} s1 c1 s2 c2 ..."


def check_terms(terms: tuple[str, ...], *, where: str = "terms", output: str = GYRO) -> None:
    """Check the names of the wanted terms and their combination, for an instrument whose output rate has this unit."""

    def refuse(message: str, remedy: str = "leave it out") -> NoReturn:
        raise RunFileError(f"{where}: {message}", remedy=remedy)

    if not terms:
        refuse("no term is asked for", "e.g. ['scale_factor', 'tan_beta', 'k0']")
    for name in terms:
        wave = harmonic(name)
        partner = wave and ("c" if wave[0] == "s" else "s") + str(wave[1])
        if name == "phi":
            refuse("'phi' comes with tan_beta")
        if not check_name(name):
            refuse(f"unknown term '{name}'", known_terms(name))
        if terms.count(name) > 1:
            refuse(f"'{name}' is named twice", "name it once")
        if output != GYRO and turns(name):
            refuse(f"'{name}' turns with the gimbal of a gyro accelerometer, and the instrument is direct")
        if partner and partner not in terms:
            alone = "the zero of the output angle is unknown, so one of the two alone has no meaning"
            refuse(f"'{name}' without '{partner}': {alone}", f"add '{partner}'")
    if "k1" in terms and "scale_factor" in terms:
        refuse("'k1' and 'scale_factor' are the same coefficient (K (1 + k1))", "leave one of them out")
