"""A source of Type B as written in a run file: its size and its distribution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

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


class Given(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """``{ value = "3000 N m/(rad s)", standard = "60 N m/(rad s)" }``: a value with its uncertainty, as in :class:`Spread`."""

    value: str | float | int
    standard: str | float | int | None = None
    half_width: str | float | int | None = None
    distribution: Shape = "normal"
    degrees_of_freedom: float | None = None

    @property
    def spread(self) -> Spread | None:
        """The uncertainty of the value; None if none is given."""
        if self.standard is None and self.half_width is None:
            return None
        return Spread(None, self.standard, self.half_width, self.distribution, self.degrees_of_freedom)


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
    """A parameter in SI with its standard uncertainty (0 if none is given).

    Raises
    ------
    RunFileError, UnitError
        If unit or uncertainty is wrong. The message names the entry.
    """
    entry = given if isinstance(given, Given) else Given(given)
    value, spread = to_si(entry.value, like, what=what), entry.spread
    if spread is None:
        return GivenParameter(name, value, 0.0, like)
    return GivenParameter(name, value, standard_uncertainty(spread, like, what), like, *shape_of(spread))


def standard_uncertainty(given: Spread | str | float, like: str, what: str) -> float:
    """Standard uncertainty in SI.

    Raises
    ------
    RunFileError
        If the entry is negative, ambiguous or incomplete.
    """
    spread = given if isinstance(given, Spread) else Spread(standard=given)
    named = [n for n in ("value", "standard", "half_width") if getattr(spread, n) is not None]
    bounded = spread.distribution in _DIVISORS
    if len(named) != 1:
        raise RunFileError(f"{what}: give either standard or half_width", remedy="write exactly one of them")
    if named == ["value"] and bounded:
        raise RunFileError(
            f"{what}: 'value' of a {spread.distribution} distribution could be half-width or standard uncertainty",
            remedy="write half_width = ... or standard = ...",
        )
    if named == ["half_width"] and not bounded:
        raise RunFileError(
            f"{what}: a {spread.distribution} distribution has no half-width", remedy="give standard"
        )
    if spread.distribution == "t" and not (spread.degrees_of_freedom or 0.0) > 2.0:
        raise RunFileError(
            f"{what}: distribution 't' needs more than two degrees_of_freedom", remedy="add degrees_of_freedom"
        )
    if spread.degrees_of_freedom is not None and not spread.degrees_of_freedom > 0.0:
        raise RunFileError(f"{what}: degrees_of_freedom must be positive", remedy="leave it out if infinite")
    size = to_si(getattr(spread, named[0]), like, what=what)
    if size < 0.0:
        raise RunFileError(
            f"{what}: '{getattr(spread, named[0])}' is negative", remedy="give a standard uncertainty"
        )
    return size / _DIVISORS[spread.distribution] if named == ["half_width"] else size


def shape_of(given: Spread | str | float) -> tuple[str, float]:
    """Distribution and degrees of freedom (infinite if not given)."""
    if not isinstance(given, Spread):
        return "normal", math.inf
    nu = given.degrees_of_freedom
    return given.distribution, math.inf if nu is None else float(nu)
