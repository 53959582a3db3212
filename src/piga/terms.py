"""The table of terms of the error model. Columns, candidates, truth, order of the inverse, units and words come from it.

A term with ``factors`` adds its coefficient times the product of these inputs to the indicated specific force:
``x``, ``y``, ``z`` the specific force along X0, Y0, Z0, ``|x|`` the size of the first, ``t`` the time and ``T`` the
temperature from their references, ``v`` the root mean square of a vibration that the samples do not
show. Names follow IEEE 1293 by analogy; that standard excludes the PIGA, and no compliance is
claimed.

Two terms describe the servo. Its stiffness is finite, so the transverse force tilts the rotor axis. With
``u = K f - Omega``, one unit of the coefficient adds to the indicated specific force:

- ``servo``: ``-2 (u_x/K) ((u_Y sin(alpha) - u_Z cos(alpha))/K)^2``, coefficient ``s = K ml/(2 k_i)``;
- ``servo_damping``: ``-(u_x/K)^2 (u_Y cos(alpha) + u_Z sin(alpha))/K``, coefficient ``d = c K^2/k_i``,

with ``k_i`` the integral gain of the servo [N m/(rad s)] and ``c`` the damping of the float [N m s/rad]. The SI unit of
both is 1/(m/s^2)^2. Without base rate ``u/K`` is the specific force. Derived in docs/understanding/servo.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Factor = Literal["x", "|x|", "y", "z", "t", "T", "v"]


@dataclass(frozen=True)
class Term:
    """A term: its unit in files, what it adds to the indicated specific force, its meaning, the test that shows it.

    ``known``: a size from the literature or from the physics, with its source; empty where there is none. ``factors``: the
    inputs whose product it multiplies; None for a term that is no such product.
    """

    unit: str
    formula: str
    meaning: str
    shown_by: str
    known: str = ""
    factors: tuple[Factor, ...] | None = None


_TUMBLE, _CENTRIFUGE = "a tumble on a dividing head", "a centrifuge, or a tumble together with a centrifuge"
_ROLLED = "a tumble with the instrument rolled by 90 deg"
_LEVELS = "any test with two levels of a_x"
_CYCLE = "a test that changes the temperature apart from the positions"
_HELD = "a position held for whole revolutions"

TERMS: dict[str, Term] = {
    "scale_factor": Term(
        "rad/s/g",
        "K a_x, the rate of the output itself",
        "scale factor K",
        _LEVELS,
        "ml/H = 0.8884 rad/s/g in [Wei2020]",
        ("x",),
    ),
    "tan_beta": Term(
        "1",
        "tan(beta) (a_Y sin(alpha) - a_Z cos(alpha))",
        "tangent of the non-orthogonality angle",
        "transverse force while the gimbal turns",
        "3.6e-4 in [Wei2024], 4.8e-3 in [Wei2020]",
    ),
    "phi": Term(
        "rad",
        "the angle alpha = psi + phi in the coupling",
        "phase of the output zero",
        "comes with tan_beta",
        "any angle",
    ),
    "k0": Term("g", "k0", "bias", _TUMBLE, "1600 ug in the example of [Wei2024]", ()),
    "k1": Term(
        "1",
        "k1 a_x",
        "scale-factor error",
        f"{_LEVELS}; in place of scale_factor",
        "-2370 ppm in the example of [Wei2024]",
        ("x",),
    ),
    "k2": Term(
        "g/g^2",
        "k2 a_x^2",
        "second-order coefficient (a_x^2)",
        _CENTRIFUGE,
        "1980 ug/g^2 in the example of [Wei2024]",
        ("x", "x"),
    ),
    "k3": Term("g/g^3", "k3 a_x^3", "third-order coefficient (a_x^3)", _CENTRIFUGE, factors=("x", "x", "x")),
    "k2o": Term(
        "g/g^2",
        "k2o a_x |a_x|",
        "odd second-order coefficient (a_x |a_x|)",
        _CENTRIFUGE,
        factors=("x", "|x|"),
    ),
    "k1a": Term(
        "1",
        "k1a |a_x|",
        "asymmetry of the scale factor (|a_x|): K (1 + k1a) for a_x above 0, K (1 - k1a) below",
        "a tumble, or a centrifuge with both ends of the axis outward",
        factors=("|x|",),
    ),
    "m_Y": Term("rad", "m_Y a_Y", "mounting misalignment (a_Y)", _TUMBLE, factors=("y",)),
    "m_Z": Term("rad", "m_Z a_Z", "mounting misalignment (a_Z)", _ROLLED, factors=("z",)),
    "k_XY": Term("g/g^2", "k_XY a_x a_Y", "cross coefficient (a_x a_Y)", _TUMBLE, factors=("x", "y")),
    "k_XZ": Term("g/g^2", "k_XZ a_x a_Z", "cross coefficient (a_x a_Z)", _ROLLED, factors=("x", "z")),
    "k_YY": Term("g/g^2", "k_YY a_Y^2", "cross coefficient (a_Y^2)", _CENTRIFUGE, factors=("y", "y")),
    "k_ZZ": Term("g/g^2", "k_ZZ a_Z^2", "cross coefficient (a_Z^2)", _CENTRIFUGE, factors=("z", "z")),
    "k_YZ": Term(
        "g/g^2",
        "k_YZ a_Y a_Z",
        "cross coefficient (a_Y a_Z)",
        "a tumble with the instrument rolled by 45 deg",
        factors=("y", "z"),
    ),
    "k0_t": Term(
        "g/s", "k0_t t", "bias drift with time", "a position that is visited again later", factors=("t",)
    ),
    "k0_T": Term("g/K", "k0_T (T - T_ref)", "bias drift with temperature", _CYCLE, factors=("T",)),
    "k1_T": Term(
        "1/K", "k1_T (T - T_ref) a_x", "scale-factor drift with temperature", _CYCLE, factors=("x", "T")
    ),
    "k2v": Term(
        "g/g^2",
        "k2v v^2, v the rms of the vibration in its column",
        "vibration rectification (square of the rms of a vibration)",
        "a vibration table: several sizes of the vibration at one position",
        factors=("v", "v"),
    ),
    "servo": Term(
        "g/g^3",
        "-2 s a_x (a_Y sin(alpha) - a_Z cos(alpha))^2",
        "finite stiffness of the servo (a_x a_t^2)",
        "a tumble together with a centrifuge",
        "K ml/(2 k_i): 13 ug/g^3 for a servo of 3000 N m/(rad s), ml = 9.06e-3 kg m",
    ),
    "servo_damping": Term(
        "g/g^3",
        "-d a_x^2 (a_Y cos(alpha) + a_Z sin(alpha))",
        "float damping under the servo (a_x^2 a_t, in quadrature with tan_beta)",
        "a tumble: several sizes of a_x",
        "c K^2/k_i: 13 ug/g^3 for c = 0.05 N m s/rad and the same servo",
    ),
}
"""Every term but the harmonics, in the order of the docs; with the phase of the output."""

HARMONICS = {
    "sn": Term("g", "sn sin(n psi)", "sine of n x output angle; with its partner cn", _HELD),
    "cn": Term("g", "cn cos(n psi)", "cosine of n x output angle; with its partner sn", _HELD),
}
"""The harmonics s1 c1 s2 c2 and so on."""

MOTION = ("scale_factor", "tan_beta", "phi")
"""Coefficients that belong to the instrument or to its output, not to the error model."""
ERROR_TERMS = tuple(name for name in TERMS if name not in MOTION)
"""Terms of the error model."""
PRODUCTS = {name: term.factors for name, term in TERMS.items() if term.factors is not None}
"""Factors of the terms that are products of inputs."""
LOGGED_TERMS = {
    name: column
    for name, factors in PRODUCTS.items()
    for factor, column in (("T", "temperature"), ("v", "vibration"))
    if factor in factors
}
"""Terms that need a column of the log, and what it holds."""
THERMAL_TERMS = tuple(name for name, factors in PRODUCTS.items() if "T" in factors)
"""Terms that need a temperature."""
