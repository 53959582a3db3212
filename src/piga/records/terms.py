"""Names of the error-model terms, their units in files, and what they multiply (docs/reference/conventions).

Names follow IEEE 1293 by analogy; that standard excludes the PIGA, and no compliance is claimed.

Two terms describe the servo. Its stiffness is finite, so the transverse force tilts the rotor axis. With
``u = K f - Omega``, one unit of the coefficient adds to the indicated specific force:

- ``servo``: ``-2 (u_x/K) ((u_Y sin(alpha) - u_Z cos(alpha))/K)^2``, coefficient ``s = K ml/(2 k_i)``;
- ``servo_damping``: ``-(u_x/K)^2 (u_Y cos(alpha) + u_Z sin(alpha))/K``, coefficient ``d = c K^2/k_i``,

with ``k_i`` the integral gain of the servo [N m/(rad s)] and ``c`` the damping of the float [N m s/rad]. The SI unit of
both is 1/(m/s^2)^2. Without base rate ``u/K`` is the specific force. Derived in docs/theory/servo.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass

from piga.errors import RunFileError
from piga.units import parse_unit

UNITS = {
    "scale_factor": "rad/s/g",
    "tan_beta": "1",
    "phi": "rad",
    "k0": "g",
    "k1": "1",
    "k2": "g/g^2",
    "k3": "g/g^3",
    "k2o": "g/g^2",
    "m_Y": "rad",
    "m_Z": "rad",
    "k_XY": "g/g^2",
    "k_XZ": "g/g^2",
    "k_YY": "g/g^2",
    "k_ZZ": "g/g^2",
    "k_YZ": "g/g^2",
    "k0_t": "g/s",
    "k0_T": "g/K",
    "k1_T": "1/K",
    "servo": "g/g^3",
    "servo_damping": "g/g^3",
}
"""Unit of each coefficient in ``calibration.json``; harmonics ``s1 c1 s2 c2 ...`` are in g."""

SI_UNITS = {
    "1": "1",
    "rad": "rad",
    "1/K": "1/K",
    "rad/s/g": "rad/s/(m/s^2)",
    "g": "m/s^2",
    "g/g^2": "1/(m/s^2)",
    "g/g^3": "1/(m/s^2)^2",
    "g/s": "m/s^2/s",
    "g/K": "m/s^2/K",
}
"""SI unit of each unit in :data:`UNITS`."""

MEANING = {
    "scale_factor": "scale factor K = ml/H",
    "tan_beta": "tangent of the non-orthogonality angle",
    "phi": "phase of the output zero",
    "k0": "bias",
    "k1": "scale-factor error",
    "k2": "second-order coefficient (a_x^2)",
    "k3": "third-order coefficient (a_x^3)",
    "k2o": "odd second-order coefficient (a_x |a_x|)",
    "m_Y": "mounting misalignment (a_Y)",
    "m_Z": "mounting misalignment (a_Z)",
    "k_XY": "cross coefficient (a_x a_Y)",
    "k_XZ": "cross coefficient (a_x a_Z)",
    "k_YY": "cross coefficient (a_Y^2)",
    "k_ZZ": "cross coefficient (a_Z^2)",
    "k_YZ": "cross coefficient (a_Y a_Z)",
    "k0_t": "bias drift with time",
    "k0_T": "bias drift with temperature",
    "k1_T": "scale-factor drift with temperature",
    "servo": "finite stiffness of the servo (a_x a_t^2)",
    "servo_damping": "float damping under the servo (a_x^2 a_t, in quadrature with tan_beta)",
}


@dataclass(frozen=True)
class TermWords:
    """A term in words: what it adds to the indicated specific force, its meaning, the test that shows it.

    ``known``: a size from the literature or from the physics, with its source; empty where there is none.
    """

    formula: str
    meaning: str
    shown_by: str
    known: str


def _words(name: str, formula: str, shown_by: str, known: str) -> TermWords:
    return TermWords(formula, MEANING[name], shown_by, known)


_TUMBLE, _CENTRIFUGE = "a tumble on a dividing head", "a centrifuge, or a tumble together with a centrifuge"
_HELD = "a position held for whole revolutions"
_TEMPERATURE = "a test that changes the temperature apart from the positions"
TERM_WORDS = {
    name: _words(name, *parts)
    for name, parts in {
        "scale_factor": (
            "K a_x, the rate of the output itself",
            "any test with two levels of a_x",
            "0.8884 rad/s/g in [Wei2020]",
        ),
        "tan_beta": (
            "tan(beta) (a_Y sin(alpha) - a_Z cos(alpha))",
            "transverse force while the gimbal turns",
            "3.6e-4 in [Wei2024], 4.8e-3 in [Wei2020]",
        ),
        "phi": (
            "the angle alpha = psi + phi in the coupling",
            "comes with tan_beta",
            "any angle",
        ),
        "k0": ("k0", _TUMBLE, "1600 ug in the example of [Wei2024]"),
        "k1": (
            "k1 a_x",
            "any test with two levels of a_x; in place of scale_factor",
            "-2370 ppm in the example of [Wei2024]",
        ),
        "k2": ("k2 a_x^2", _CENTRIFUGE, "1980 ug/g^2 in the example of [Wei2024]"),
        "k3": ("k3 a_x^3", _CENTRIFUGE, ""),
        "k2o": ("k2o a_x |a_x|", _CENTRIFUGE, ""),
        "m_Y": ("m_Y a_Y", _TUMBLE, ""),
        "m_Z": ("m_Z a_Z", "a tumble with the instrument rolled by 90 deg", ""),
        "k_XY": ("k_XY a_x a_Y", _TUMBLE, ""),
        "k_XZ": ("k_XZ a_x a_Z", "a tumble with the instrument rolled by 90 deg", ""),
        "k_YY": ("k_YY a_Y^2", _CENTRIFUGE, ""),
        "k_ZZ": ("k_ZZ a_Z^2", _CENTRIFUGE, ""),
        "k_YZ": ("k_YZ a_Y a_Z", "a tumble with the instrument rolled by 45 deg", ""),
        "k0_t": ("k0_t t", "a position that is visited again later", ""),
        "k0_T": ("k0_T (T - T_ref)", _TEMPERATURE, ""),
        "k1_T": ("k1_T (T - T_ref) a_x", _TEMPERATURE, ""),
        "servo": (
            "-2 s a_x (a_Y sin(alpha) - a_Z cos(alpha))^2",
            "a tumble together with a centrifuge",
            "K ml/(2 k_i): 13 ug/g^3 for a servo of 3000 N m/(rad s), ml = 9.06e-3 kg m",
        ),
        "servo_damping": (
            "-d a_x^2 (a_Y cos(alpha) + a_Z sin(alpha))",
            "a tumble: several sizes of a_x",
            "c K^2/k_i: 13 ug/g^3 for c = 0.05 N m s/rad and the same servo",
        ),
    }.items()
} | {
    "sn": TermWords("sn sin(n psi)", "sine of n x output angle; with its partner cn", _HELD, ""),
    "cn": TermWords("cn cos(n psi)", "cosine of n x output angle; with its partner sn", _HELD, ""),
}
"""Every term in words, in the order of the docs. ``sn`` and ``cn`` stand for the harmonics s1 c1 s2 c2 and so on."""


def term_words(name: str) -> TermWords:
    """The words of a term; also of ``s2`` and of ``m_Y[run]``.

    Raises
    ------
    KeyError
        If this is not a term.
    """
    base = name.split("[", maxsplit=1)[0]
    wave = harmonic(base)
    if wave is None:
        return TERM_WORDS[base]
    words = TERM_WORDS[f"{wave[0]}n"]
    formula = f"{base} {words.formula.partition(' ')[2].replace('n psi', f'{wave[1]} psi')}"
    return TermWords(formula, meaning_of(base), words.shown_by, words.known)


SERVO_TERMS = ("servo", "servo_damping")
"""Terms of the servo. They turn with the output angle, as ``tan_beta`` does. Their phase is that of ``tan_beta``."""

_HARMONIC = re.compile(r"^([sc])([1-9]\d?)$")


def harmonic(name: str) -> tuple[str, int] | None:
    """``("s", 2)`` for ``s2``; None when the name is not a harmonic."""
    match = _HARMONIC.match(name)
    return None if match is None else (match.group(1), int(match.group(2)))


def shown_unit(name: str, unit: str) -> tuple[float, str]:
    """Factor and unit in which a coefficient is displayed, on every page and terminal: ``g/g^2`` becomes ``ug/g^2``.

    The choice depends on the coefficient, never on its value. So a column has one unit across runs and records.
    Units whose numerator is a plain ``g`` or ``rad`` become micro-units. The phase ``phi`` and rates do not
    (``rad/s/g`` stays, because the field quotes the scale factor in it).

    Examples
    --------
    >>> shown_unit("k0", "g"), shown_unit("phi", "rad")
    ((1000000.0, 'ug'), (1.0, 'rad'))
    """
    head, _, tail = unit.partition("/")
    if name.partition("[")[0] == "phi" or head not in ("g", "rad") or tail.startswith("s"):
        return 1.0, unit
    return 1e6, f"u{unit}"


def unit_of(name: str) -> str:
    """Unit of a coefficient in files; ``name`` may carry a segment in brackets."""
    base = name.split("[", maxsplit=1)[0]
    return "g" if harmonic(base) else UNITS[base]


def si_factor(name: str) -> float:
    """SI value of one file unit of the coefficient: ``value_SI = value_file * si_factor``."""
    return parse_unit(unit_of(name)).factor


def si_unit_of(name: str) -> str:
    """SI unit of a coefficient; ``name`` may carry a segment in brackets."""
    return SI_UNITS[unit_of(name)]


def check_name(name: str) -> bool:
    """True if this version knows the coefficient name."""
    return name in UNITS or harmonic(name) is not None


def meaning_of(name: str) -> str:
    """Meaning of the coefficient, in words."""
    base = name.split("[", maxsplit=1)[0]
    wave = harmonic(base)
    if wave:
        return f"{'sine' if wave[0] == 's' else 'cosine'} of {wave[1]} x output angle"
    return MEANING[base]


def term_names(terms: str | Iterable[str]) -> tuple[str, ...]:
    """Names of terms, also when they are one text: ``"scale_factor, tan_beta, k0"``.

    Examples
    --------
    >>> term_names("scale_factor, tan_beta k0")
    ('scale_factor', 'tan_beta', 'k0')
    """
    return tuple(terms.replace(",", " ").split()) if isinstance(terms, str) else tuple(terms)


def known_terms(name: str) -> str:
    """Remedy for a name that is not a term: the nearest one, and all there are."""
    known = [term for term in UNITS if term != "phi"]
    small = {term.lower(): term for term in known}
    near = difflib.get_close_matches(name.lower(), small, n=1)
    guess = "".join(f"did you mean '{small[term]}'? " for term in near)
    return f"{guess}known terms: {' '.join(known)} s1 c1 s2 c2 ..."


def check_terms(terms: tuple[str, ...], *, where: str = "terms") -> None:
    """Check the names of the wanted terms and their combination.

    Raises
    ------
    RunFileError
        For an unknown or repeated name, a harmonic without its partner, or k1 beside scale_factor.
    """
    if not terms:
        raise RunFileError(f"{where}: no term is asked for", remedy="e.g. ['scale_factor', 'tan_beta', 'k0']")
    for name in terms:
        if name == "phi":
            raise RunFileError(f"{where}: 'phi' comes with tan_beta", remedy="leave it out")
        if not check_name(name):
            raise RunFileError(f"{where}: unknown term '{name}'", remedy=known_terms(name))
        if terms.count(name) > 1:
            raise RunFileError(f"{where}: '{name}' is named twice", remedy="name it once")
        wave = harmonic(name)
        partner = wave and ("c" if wave[0] == "s" else "s") + str(wave[1])
        if partner and partner not in terms:
            raise RunFileError(
                f"{where}: '{name}' without '{partner}': the zero of the output angle is unknown, so one of "
                "the two alone has no meaning",
                remedy=f"add '{partner}'",
            )
    if "k1" in terms and "scale_factor" in terms:
        raise RunFileError(
            f"{where}: 'k1' and 'scale_factor' are the same coefficient (K (1 + k1))",
            remedy="leave one of them out",
        )
