"""A coefficient: value, uncertainty and unit, and the same in SI."""

from __future__ import annotations

import math
from dataclasses import dataclass

from piga.records.calibration.coverage import Coverage, coverage
from piga.results import ByValue, html_of

LOOSE_PHASE = 0.5
"""A phase with a standard uncertainty [rad] above this counts as not determined."""


class SIValue(float):
    """A coefficient in SI. It is a plain number to compute with, and carries its uncertainty.

    >>> bias = Coefficient("k0", 3e-4, 1e-6, "g").si
    >>> f"{bias:.7f} {bias.unit}, u = {bias.std:.2g}"
    '0.0029420 m/s^2, u = 9.8e-06'

    Attributes
    ----------
    std, expanded, limits, unit:
        Standard uncertainty, half-width and ends of the 95 % interval, and the SI unit.
    """

    __slots__ = ("_coefficient",)
    _coefficient: Coefficient

    def __new__(cls, coefficient: Coefficient) -> SIValue:
        """The value of the coefficient in SI."""
        from piga.records.terms import si_factor

        number = super().__new__(cls, coefficient.value * si_factor(coefficient.name))
        number._coefficient = coefficient
        return number

    def __getnewargs__(self) -> tuple[Coefficient]:  # type: ignore[override]
        return (self._coefficient,)

    def __repr__(self) -> str:
        return f"{float(self)!r} +- {self.std:.2g} {self.unit}"

    @property
    def _factor(self) -> float:
        from piga.records.terms import si_factor

        return si_factor(self._coefficient.name)

    @property
    def value(self) -> float:
        """The plain number."""
        return float(self)

    @property
    def std(self) -> float:
        """Standard uncertainty."""
        return self._coefficient.std * self._factor

    @property
    def expanded(self) -> float:
        """Half-width of the 95 % interval."""
        return self._coefficient.expanded * self._factor

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the 95 % interval."""
        low, high = self._coefficient.limits
        return low * self._factor, high * self._factor

    @property
    def unit(self) -> str:
        """The SI unit."""
        from piga.records.terms import si_unit_of

        return si_unit_of(self._coefficient.name)


@dataclass(frozen=True, eq=False)
class Coefficient(ByValue):
    """One coefficient: value and standard uncertainty in ``unit``, the unit of calibration.json. ``si`` gives it in SI.

    ``value``, ``std``, ``expanded`` and ``limits`` are in ``unit``. Everything else in piga is SI: arrays, ``Run``,
    :class:`piga.Instrument`, and ``si``.

    ``segment`` and ``run`` name the segment and the run it belongs to; None: it belongs to all of them.
    ``degrees_of_freedom`` are the effective degrees of freedom of the standard uncertainty (JCGM 100, G.4).
    ``interval`` is the shortest 95 % interval of a Monte Carlo propagation (JCGM 101), where one was needed.
    """

    name: str
    value: float
    std: float
    unit: str
    segment: str | None = None
    run: str | None = None
    degrees_of_freedom: float = math.inf
    interval: tuple[float, float] | None = None

    @property
    def owner(self) -> str | None:
        """``segment``, ``run`` or ``run:segment``; None for a coefficient of the instrument."""
        parts = [part for part in (self.run, self.segment) if part is not None]
        return ":".join(parts) if parts else None

    @property
    def key(self) -> str:
        """``name`` or ``name[owner]``: the name used in the covariance."""
        return self.name if self.owner is None else f"{self.name}[{self.owner}]"

    @property
    def si(self) -> SIValue:
        """The coefficient in SI: a number with ``std``, ``expanded``, ``limits`` and ``unit``.

        ``cal["scale_factor"].si`` compares with ``Run.scale_factor`` [(rad/s)/(m/s^2)].
        """
        return SIValue(self)

    @property
    def value_si(self) -> float:
        """The value of ``si`` as a plain number."""
        return float(self.si)

    @property
    def coverage(self) -> Coverage:
        """Coverage factor, half-width and limits for 95 %: :func:`piga.records.calibration.coverage.coverage`."""
        return coverage(self)

    @property
    def determined(self) -> bool:
        """False for a phase whose standard uncertainty is above ``LOOSE_PHASE``: the data do not determine it."""
        return self.name != "phi" or self.std <= LOOSE_PHASE

    @property
    def coverage_factor(self) -> float:
        """Coverage factor for 95 %; nan where a Monte Carlo interval is used."""
        return self.coverage.factor

    @property
    def expanded(self) -> float:
        """Half-width of the 95 % interval. It is the expanded uncertainty U if the budget is complete."""
        return self.coverage.half_width

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the 95 % coverage interval."""
        return self.coverage.low, self.coverage.high

    def _repr_html_(self) -> str | None:
        return html_of(self)


def rounded(c: Coefficient) -> str:
    """The value, rounded to the last digit of its uncertainty."""
    if not (math.isfinite(c.std) and c.std > 0.0):
        return f"{c.value:.9g}"
    return f"{round(c.value, 1 - math.floor(math.log10(c.std))) + 0.0:.12g}"
