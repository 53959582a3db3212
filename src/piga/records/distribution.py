"""A source of Type B as written in a run file: its size and its distribution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NoReturn

import msgspec

from piga.errors import RunFileError
from piga.units import to_si

Shape = Literal["normal", "rectangular", "triangular", "arcsine", "t"]

_DIVISORS = {"rectangular": math.sqrt(3.0), "triangular": math.sqrt(6.0), "arcsine": math.sqrt(2.0)}
"""Half-width divided by standard uncertainty (JCGM 100, 4.3.7 and 4.3.9; JCGM 101, 6.4.6)."""


class Spread(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``{ half_width = "10 ppm", distribution = "rectangular", degrees_of_freedom = 8 }``.

    ``standard`` is the standard uncertainty of any distribution. ``half_width`` is the half-width of a bounded one.
    ``value`` is the standard uncertainty of a normal or t distribution. A plain string is the standard uncertainty of
    a normal distribution.
    """

    value: str | float | int | None = None
    standard: str | float | int | None = None
    half_width: str | float | int | None = None
    distribution: Shape = "normal"
    degrees_of_freedom: float | None = None


class Given(Spread, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``{ value = "3000 N m/(rad s)", standard = "60 N m/(rad s)" }``: a value with its uncertainty, as in :class:`Spread`."""

    value: str | float | int


@dataclass(frozen=True)
class GivenParameter:
    """A parameter given in a file: SI value and standard uncertainty; ``unit`` and distribution for the budget."""

    name: str
    value: float
    standard: float
    unit: str
    distribution: str = "normal"
    degrees_of_freedom: float = math.inf


def given_parameter(name: str, given: Given | str | float, like: str, what: str) -> GivenParameter:
    """A parameter in SI with its standard uncertainty (0 if none is given). ``what`` names the entry in messages."""
    entry = given if isinstance(given, Given) else Given(value=given)
    value = to_si(entry.value, like, what=what)
    if entry.standard is None and entry.half_width is None:
        return GivenParameter(name, value, 0.0, like)
    spread = Spread(None, entry.standard, entry.half_width, entry.distribution, entry.degrees_of_freedom)
    return GivenParameter(name, value, standard_uncertainty(spread, like, what), like, *shape_of(spread))


def standard_uncertainty(given: Spread | str | float, like: str, what: str) -> float:
    """Standard uncertainty in SI. An entry that is negative, ambiguous or incomplete is refused."""
    spread = given if isinstance(given, Spread) else Spread(standard=given)
    named = [n for n in ("value", "standard", "half_width") if getattr(spread, n) is not None]
    bounded, shape, nu = spread.distribution in _DIVISORS, spread.distribution, spread.degrees_of_freedom

    def refuse(message: str, remedy: str) -> NoReturn:
        raise RunFileError(f"{what}: {message}", remedy=remedy)

    if len(named) != 1:
        refuse("give either standard or half_width", "write exactly one of them")
    if named == ["value"] and bounded:
        why = f"'value' of a {shape} distribution could be half-width or standard uncertainty"
        refuse(why, "write half_width = ... or standard = ...")
    if named == ["half_width"] and not bounded:
        refuse(f"a {shape} distribution has no half-width", "give standard")
    if shape == "t" and not (nu or 0.0) > 2.0:
        refuse("distribution 't' needs more than two degrees_of_freedom", "add degrees_of_freedom")
    if nu is not None and not nu > 0.0:
        refuse("degrees_of_freedom must be positive", "leave it out if infinite")
    size = to_si(getattr(spread, named[0]), like, what=what)
    if size < 0.0:
        refuse(f"'{getattr(spread, named[0])}' is negative", "give a standard uncertainty")
    return size / _DIVISORS[shape] if named == ["half_width"] else size


def shape_of(given: Spread | str | float) -> tuple[str, float]:
    """Distribution and degrees of freedom (infinite if not given)."""
    if not isinstance(given, Spread):
        return "normal", math.inf
    nu = given.degrees_of_freedom
    return given.distribution, math.inf if nu is None else float(nu)
