"""A coefficient: value, uncertainty and unit, also in SI; its coverage factor k, expanded uncertainty U and limits; its budget.

Every number for 95 % comes from :class:`Coefficient`. Only the joint region of a DCC uses another factor, :func:`joint_factor`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from piga.records.terms import si_factor, si_unit_of, unit_of
from piga.results import ByValue, Result, Shown
from piga.tables import Column, Tabular, columns_of

PROBABILITY = 0.95
"""Coverage probability of every interval that piga states."""
NO_REFERENCE = "the reference's uncertainty was not given"
"""Remark beside every uncertainty of a calibration whose budget has no source of Type B of the reference."""
_LOOSE_PHASE = 0.5
"""A phase with a standard uncertainty [rad] above this counts as not determined."""
OF_THE_MODEL = ("servo ", "k3 ", "meaning of ", "earth_rate", "height")
"""Prefixes of the names of Type B sources that belong to the model, or whose size nobody stated."""

Number = Annotated[float, Meta(ge=-1e100, le=1e100)]
"""Any finite number. The limit is far above every quantity here; squares and unit conversions stay finite."""
Level = Annotated[float, Meta(ge=0.0, le=1e100)]
"""A non-negative number, such as a standard uncertainty, a noise level or a largest residual."""


@dataclass(frozen=True)
class StandSource:
    """A source of Type B that exists on the stand of a record, by its key in ``[uncertainty]`` or ``[uncertainty] waived``.

    ``bounded``: not stated, and in the budget with what the record does not exclude. ``assumed``: not stated, and in the budget
    with a size that piga assumes. ``effects`` are changes of each coefficient (file unit) by one ``unit``, by component and
    coefficient; empty for a stated source: its row of the budget has its sensitivities. ``reason``: why it was waived, or the
    size that is bounded or assumed.
    """

    name: str
    status: Literal["stated", "bounded", "waived", "assumed", "unstated"]
    unit: str = "1"
    effects: dict[str, dict[str, Number]] = field(default_factory=dict)
    reason: str = ""


def coverage_factor(degrees_of_freedom: ArrayLike, probability: float = PROBABILITY) -> Any:
    """Student's t for a two-sided interval of this probability (JCGM 100, G.3): a float, or an array for an array.

    Infinite degrees of freedom give the factor of the normal distribution. Zero or unknown degrees of freedom give nan.
    """
    from scipy.special import ndtri, stdtrit

    tail, nu = 0.5 * (1.0 + probability), np.asarray(degrees_of_freedom, dtype=float)
    known = np.isinf(nu)
    factor = np.where(known, ndtri(tail), stdtrit(np.where(known, 1.0, nu), tail))
    return float(factor) if factor.ndim == 0 else factor


def welch_satterthwaite(components: ArrayLike, degrees: ArrayLike) -> Any:
    """Degrees of freedom of a sum of independent components (JCGM 100, eq. G.2b): a float, or (...,) for several sums.

    ``components`` (..., n) are standard uncertainties in one unit; ``degrees`` (..., n) are ``inf`` for a known component.
    """
    variance, nu = np.asarray(components, dtype=float) ** 2, np.asarray(degrees, dtype=float)
    known = np.sum(variance**2 / nu, axis=-1)
    result = np.where(known > 0.0, np.sum(variance, axis=-1) ** 2 / np.where(known > 0.0, known, 1.0), math.inf)
    return float(result) if result.ndim == 0 else result


def joint_factor(coefficients: Iterable[Coefficient]) -> float:
    """Coverage factor of the ellipsoid that holds all coefficients together with 95 %.

    The region is ``(x - y)' V^-1 (x - y) <= k_p^2`` (JCGM 102, 6.5.2). If one estimated variance with nu degrees of
    freedom scales the covariance V of n coefficients, ``k_p = sqrt(n F_0.95(n, nu))``; ``sqrt(chi2_0.95(n))`` for infinite
    nu. Here nu is the smallest of all. The region is exact if all are equal, else it holds at least 95 %.
    """
    from scipy.special import chdtri, fdtri

    degrees = [coefficient.degrees_of_freedom for coefficient in coefficients]
    count, fewest = len(degrees), min(degrees)
    if math.isinf(fewest):
        return math.sqrt(float(chdtri(count, 1.0 - PROBABILITY)))
    return math.sqrt(count * float(fdtri(count, fewest, PROBABILITY)))


@dataclass(frozen=True, eq=False)
class Coefficient(ByValue, Shown):
    """One coefficient: value and standard uncertainty in ``unit``, the unit of calibration.json.

    ``value``, ``std``, ``expanded`` and ``limits`` are in ``unit``. Everything else in piga is SI: arrays, ``Run``,
    :class:`piga.Instrument`, and ``value_si``, ``std_si``.

    ``segment`` and ``run`` name the segment and the run it belongs to; None: it belongs to all of them.
    ``degrees_of_freedom`` are the effective degrees of freedom of the standard uncertainty (JCGM 100, G.4).
    ``interval`` is the shortest 95 % interval of a Monte Carlo propagation (JCGM 101), where one was needed.
    """

    name: str
    value: Number
    std: Level
    unit: str
    segment: str | None = None
    run: str | None = None
    degrees_of_freedom: Level = math.inf
    interval: tuple[Number, Number] | None = None

    @property
    def owner(self) -> str | None:
        """``segment``, ``run`` or ``run:segment``; None for a coefficient of the instrument."""
        return ":".join(part for part in (self.run, self.segment) if part is not None) or None

    @property
    def key(self) -> str:
        """``name`` or ``name[owner]``: the name used in the covariance."""
        return self.name if self.owner is None else f"{self.name}[{self.owner}]"

    @property
    def value_si(self) -> float:
        """The value in SI: ``cal["scale_factor"].value_si`` compares with ``Run.scale_factor`` [(rad/s)/(m/s^2)]."""
        return self.value * si_factor(self.name)

    @property
    def std_si(self) -> float:
        """The standard uncertainty in SI."""
        return self.std * si_factor(self.name)

    @property
    def unit_si(self) -> str:
        """Unit of ``value_si`` and ``std_si``."""
        return si_unit_of(self.name, self.unit.removesuffix("/g"))

    @property
    def determined(self) -> bool:
        """False for a phase whose standard uncertainty is above ``_LOOSE_PHASE``: the data do not determine it."""
        return self.name != "phi" or self.std <= _LOOSE_PHASE

    @property
    def coverage_factor(self) -> float:
        """K for 95 %: Student's t for the effective degrees of freedom (JCGM 100, G.4).

        It is nan where a Monte Carlo interval is used, which has no factor (JCGM 101, 5.3).
        """
        return math.nan if self.interval is not None else coverage_factor(self.degrees_of_freedom)

    @property
    def expanded(self) -> float:
        """Half-width of the 95 % interval, ``U = k u``. It is the expanded uncertainty if the budget is complete.

        If a Monte Carlo propagation replaced the first order (``interval``), it is half that interval (JCGM 101, 8.1).
        """
        if self.interval is not None:
            return 0.5 * (self.interval[1] - self.interval[0])
        return self.coverage_factor * self.std

    @property
    def limits(self) -> tuple[float, float]:
        """Ends of the 95 % coverage interval: value -+ U, or the Monte Carlo interval."""
        return self.interval or (self.value - self.expanded, self.value + self.expanded)

    def in_brief(self) -> list[tuple[str, str]]:
        """Value with standard uncertainty, and 95 % interval."""
        low, high = self.limits
        value = f"{self.value:.9g} +- {self.std:.3g} {self.unit}"
        return [(self.key, value), ("95 % interval", f"{low:.9g} to {high:.9g} {self.unit}")]


def short_way(turn: ArrayLike) -> NDArray[np.float64]:
    """A change of an angle [rad] the short way round, in (-pi, pi]."""
    return np.angle(np.exp(1j * np.asarray(turn)))


def changes(
    coefficients: Iterable[Coefficient], before: NDArray[np.float64], after: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Changes of coefficients from one set of values (n,) to another; that of a phase is the short way round."""
    moved = after - before
    return np.where([c.name == "phi" for c in coefficients], short_way(moved), moved)


def rounded(c: Coefficient) -> str:
    """The value, rounded to the last digit of its uncertainty."""
    if not (math.isfinite(c.std) and c.std > 0.0):
        return f"{c.value:.9g}"
    return f"{round(c.value, 1 - math.floor(math.log10(c.std))) + 0.0:.12g}"


@dataclass(frozen=True)
class Amount:
    """A value with its unit."""

    value: Number
    unit: str


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class BudgetEntry(Result):
    """One source of the uncertainty budget. ``standard_uncertainty`` is its size; None if it has no size of its own.

    ``degrees_of_freedom`` are None if the size is known exactly, or if each coefficient has its own (Type A). ``contributions``
    are changes of each coefficient, by key and in its unit, for one standard uncertainty of the source. Divided by its size
    they are the sensitivities (JCGM 100, 5.1.3).
    """

    source: str
    type: Literal["A", "B"]
    distribution: str = "normal"
    standard_uncertainty: Amount | None = None
    degrees_of_freedom: Level | None = None
    contributions: dict[str, Number]

    def contribution(self, coefficient: Coefficient) -> float:
        """Change of a coefficient; 0 if the source does not act on it."""
        return self.contributions.get(coefficient.key, 0.0)

    def renamed(self, names: dict[str, str]) -> BudgetEntry:
        """The entry for some of the coefficients, renamed. The argument gives the new key by old key."""
        return replace(self, contributions={names[k]: v for k, v in self.contributions.items() if k in names})


@dataclass(frozen=True, eq=False, repr=False)
class BudgetTable(Result, Tabular):
    """The uncertainty budget: its sources in order. As a table it has one row for each source and coefficient.

    It is iterated and indexed as a tuple of :class:`BudgetEntry` is. It is not a tuple itself, because tools that read
    Arrow take a tuple for rows.
    """

    entries: tuple[BudgetEntry, ...] = ()

    def __iter__(self) -> Iterator[BudgetEntry]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> BudgetEntry:
        return self.entries[index]

    def in_brief(self) -> list[tuple[str, str]]:
        """Sources with type and distribution."""
        return [(entry.source, f"type {entry.type}, {entry.distribution}") for entry in self]

    def table_columns(self) -> dict[str, Column]:
        """Source, type and distribution, the coefficient, and the contribution in the unit of the coefficient."""
        rows: list[dict[str, Any]] = []
        for entry in self:
            size = entry.standard_uncertainty or Amount(math.nan, "")
            source = {"source": entry.source, "type": entry.type, "distribution": entry.distribution}
            sized = {"standard_uncertainty": size.value, "unit_of_source": size.unit}
            for key, change in entry.contributions.items():
                rows.append(source | {"coefficient": key, "unit": unit_of(key), "contribution": change} | sized)
        units = {"contribution": "as in column unit", "standard_uncertainty": "as in column unit_of_source"}
        return columns_of(rows, units)
