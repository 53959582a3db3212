"""What a reproduction consists of: one number judged, and a chapter of numbers and figures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from piga.reports.render.figure import Figure

Verdict = Literal["pass", "fail", "info"]


@dataclass(frozen=True)
class Case:
    """One published number beside ours.

    Attributes
    ----------
    id:
        Name of the chapter, a dot, name of the case.
    source:
        Key of the publication with its equation or example, e.g. ``[Wei2024] eq. 12-18``.
    quantity, unit:
        What is compared, and the unit of all four numbers.
    published:
        The publication's number; None where it prints none.
    computed:
        Ours, from a run of the library.
    tolerance:
        Largest difference that still agrees; None where the numbers are not comparable (verdict ``info``).
    note:
        Why the tolerance is what it is; for ``info`` why there is no verdict.
    limit:
        The publication prints an upper limit: any size from zero up to it agrees.
    """

    id: str
    source: str
    quantity: str
    unit: str
    published: float | None
    computed: float
    tolerance: float | None
    note: str
    limit: bool = False

    @property
    def difference(self) -> float | None:
        """Computed less published; None where nothing is published."""
        return None if self.published is None else self.computed - self.published

    @property
    def verdict(self) -> Verdict:
        """``pass`` within the tolerance, ``fail`` outside it, ``info`` where there is none."""
        if self.published is None or self.tolerance is None:
            return "info"
        if self.limit:
            return "pass" if abs(self.computed) <= self.published else "fail"
        return "pass" if abs(self.computed - self.published) <= self.tolerance else "fail"

    def document(self) -> dict[str, Any]:
        """The case as the JSON of ``piga reproduce`` holds it; a number that is not finite becomes null."""
        return {
            "id": self.id,
            "source": self.source,
            "quantity": self.quantity,
            "unit": self.unit,
            "published": self.published,
            "computed": _finite(self.computed),
            "difference": _finite(self.difference),
            "tolerance": self.tolerance,
            "verdict": self.verdict,
            "note": self.note,
        }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


@dataclass(frozen=True)
class Chapter:
    """Cases and figures of one part of a publication; ``text`` says what was done and what is to be seen."""

    id: str
    title: str
    source: str
    text: str
    cases: tuple[Case, ...]
    figures: tuple[Figure, ...]

    def __post_init__(self) -> None:
        for case in self.cases:
            if not case.id.startswith(f"{self.id}."):
                raise ValueError(f"case '{case.id}' does not belong to chapter '{self.id}'")
