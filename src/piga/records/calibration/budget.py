"""The uncertainty budget: its sources, and what each contributes to each coefficient."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Literal, NamedTuple, overload

import numpy as np
from msgspec import Meta

from piga.records.calibration.coefficient import Coefficient
from piga.results import MOST_LINES, ByValue, Column, Result, Tabular, first_lines, html_of, shortened

Number = Annotated[float, Meta(ge=-1e100, le=1e100)]
"""Any finite number. The limit is far above every quantity here; squares and unit conversions stay finite."""


Level = Annotated[float, Meta(ge=0.0, le=1e100)]
"""A non-negative number, such as a standard uncertainty, a noise level or a largest residual."""


@dataclass(frozen=True)
class Amount:
    """A value with its unit."""

    value: Number
    unit: str


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class BudgetEntry(Result):
    """One source of the uncertainty budget.

    Attributes
    ----------
    source, type, distribution:
        Name, type (A or B) and distribution.
    standard_uncertainty:
        Size of the source; None if it has no size of its own.
    degrees_of_freedom:
        Degrees of freedom of the standard uncertainty. None if it is known exactly, or if each coefficient has its own (Type A).
    contributions:
        Change of each coefficient, by key and in its unit, for one standard uncertainty of the source.
    sensitivities:
        Change of each coefficient for one unit of the source (JCGM 100, 5.1.3); empty if the source has no size.
    """

    source: str
    type: Literal["A", "B"]
    distribution: str = "normal"
    standard_uncertainty: Amount | None = None
    degrees_of_freedom: Level | None = None
    contributions: dict[str, Number]
    sensitivities: dict[str, Amount] = field(default_factory=dict)

    def contribution(self, coefficient: Coefficient) -> float:
        """Change of a coefficient; 0 if the source does not act on it."""
        return self.contributions.get(coefficient.key, 0.0)

    def renamed(self, names: dict[str, str]) -> BudgetEntry:
        """The entry for some of the coefficients, renamed. The argument gives the new key by old key."""
        return replace(
            self,
            contributions={names[k]: v for k, v in self.contributions.items() if k in names},
            sensitivities={names[k]: v for k, v in self.sensitivities.items() if k in names},
        )

    def document(self) -> dict[str, Any]:
        """The entry as plain data for JSON."""
        document = asdict(self)
        if not self.sensitivities:
            del document["sensitivities"]
        return document


@dataclass(frozen=True, eq=False, repr=False)
class BudgetTable(ByValue, Tabular):
    """The uncertainty budget: its sources in order. As a table it has one row for each source and coefficient.

    It is iterated and indexed as a tuple of :class:`BudgetEntry` is. It is not a tuple itself, because tools that read
    Arrow take a tuple for rows.
    """

    entries: tuple[BudgetEntry, ...] = ()

    def __iter__(self) -> Iterator[BudgetEntry]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    @overload
    def __getitem__(self, index: int) -> BudgetEntry: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[BudgetEntry, ...]: ...
    def __getitem__(self, index: int | slice) -> BudgetEntry | tuple[BudgetEntry, ...]:
        return self.entries[index]

    def __repr__(self) -> str:
        rows = [f"{entry.source}, type {entry.type}, {entry.distribution}" for entry in self]
        lines = ["<BudgetTable", *first_lines(rows, MOST_LINES - 1)]
        return "\n  ".join(shortened(line) for line in lines) + ">"

    def _repr_html_(self) -> str | None:
        return html_of(self)

    def table_columns(self) -> dict[str, Column]:
        """Source, type and distribution, the coefficient, and the contribution in the unit of the coefficient."""
        from piga.records.terms import unit_of

        rows = [(entry, key, value) for entry in self for key, value in entry.contributions.items()]
        texts = {
            "source": [entry.source for entry, _, _ in rows],
            "type": [entry.type for entry, _, _ in rows],
            "distribution": [entry.distribution for entry, _, _ in rows],
            "coefficient": [key for _, key, _ in rows],
            "unit": [unit_of(key) for _, key, _ in rows],
        }
        columns = {name: Column(np.array(values, dtype=object)) for name, values in texts.items()}
        size = np.array(
            [math.nan if e.standard_uncertainty is None else e.standard_uncertainty.value for e, _, _ in rows]
        )
        units = [e.standard_uncertainty.unit if e.standard_uncertainty else "" for e, _, _ in rows]
        contribution = np.array([value for _, _, value in rows], dtype=float)
        return columns | {
            "contribution": Column(contribution, "as in column unit"),
            "standard_uncertainty": Column(size, "as in column unit_of_source"),
            "unit_of_source": Column(np.array(units, dtype=object)),
        }


class TypeB(NamedTuple):
    """A source of Type B: its contribution to each coefficient, in its unit, and its degrees of freedom."""

    source: str
    degrees_of_freedom: float
    contributions: dict[str, float]
