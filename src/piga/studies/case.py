"""Parts of a reproduction: judged numbers (cases), chapters of ``published.toml``, and the published instrument."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, Final, Literal

import msgspec

from piga.instrument import Instrument
from piga.records.run_file import TomlTable
from piga.reports.render.figure import Figure
from piga.results import finite

Verdict = Literal["pass", "fail", "info"]


class Case(TomlTable, frozen=True):
    """A published number, as ``published.toml`` has it, beside that of piga.

    Attributes
    ----------
    source:
        Key of the publication with its equation or example, e.g. ``[Wei2024] eq. 12-18``.
    quantity, unit:
        The compared quantity, and the unit of all numbers.
    note:
        Reason for the tolerance; for ``info`` the reason why there is no verdict.
    published:
        The published number; None if none is printed.
    tolerance:
        Largest difference that counts as agreement; None if the numbers are not comparable (verdict ``info``).
    limit:
        True: the publication prints an upper limit. Any size from zero up to it agrees.
    id, computed:
        Name of the chapter, a dot, the name of the case; and the number of piga. Both come from the run.
    """

    source: str
    quantity: str
    unit: str
    note: str
    published: float | None = None
    tolerance: float | None = None
    limit: bool = False
    id: str = ""
    computed: float = math.nan

    @property
    def difference(self) -> float | None:
        """Computed minus published number; None if nothing is published."""
        return None if self.published is None else self.computed - self.published

    @property
    def verdict(self) -> Verdict:
        """``pass`` within the tolerance, ``fail`` outside it, ``info`` without a tolerance."""
        if self.published is None or self.tolerance is None:
            return "info"
        if self.limit:
            return "pass" if abs(self.computed) <= self.published else "fail"
        return "pass" if abs(self.computed - self.published) <= self.tolerance else "fail"

    def document(self) -> dict[str, Any]:
        """The case in the JSON of ``piga reproduce``. A non-finite number becomes null."""
        keys = "id source quantity unit published computed difference tolerance verdict note"
        return {key: finite(getattr(self, key)) for key in keys.split()}


class Chapter(TomlTable, frozen=True):
    """One part of a publication, as ``published.toml`` has it: ``text`` describes method and result; cases by name, in order.

    ``id`` and ``figures`` come from the run.
    """

    title: str
    source: str
    text: str
    cases: dict[str, Case]
    id: str = ""
    figures: tuple[Any, ...] = ()


@cache
def published_chapters() -> dict[str, Chapter]:
    """Every chapter of ``published.toml``, in the order of the publications."""
    text = files("piga.data").joinpath("published.toml").read_bytes()
    return msgspec.toml.decode(text, type=dict[str, Chapter])


@dataclass(frozen=True)
class Value:
    """A computed number with parts of its case that come from the run, too. ``words`` fill quantity and note."""

    computed: float
    published: float | None = None
    tolerance: float | None = None
    words: Mapping[str, float] = field(default_factory=dict)


def chapter_of(name: str, values: Mapping[str, float | Value], figures: Sequence[Figure] = ()) -> Chapter:
    """The chapter ``name`` with the computed ``values`` of its cases, which also fill its text."""
    printed = published_chapters()[name]
    if set(values) != set(printed.cases):
        raise ValueError(f"{name}: the cases differ: {sorted(set(values) ^ set(printed.cases))}")
    held = {key: given if isinstance(given, Value) else Value(given) for key, given in values.items()}
    cases = {}
    for key, case in printed.cases.items():
        value = held[key]
        of_run = {
            "published": case.published if value.published is None else value.published,
            "tolerance": case.tolerance if value.tolerance is None else value.tolerance,
            "quantity": case.quantity.format(**value.words),
            "note": case.note.format(**value.words),
        }
        cases[key] = msgspec.structs.replace(case, id=f"{name}.{key}", computed=value.computed, **of_run)
    text = printed.text.format(**{key: value.computed for key, value in held.items()})
    return msgspec.structs.replace(printed, id=name, text=text, cases=cases, figures=tuple(figures))


SCALE: Final = "0.8884 rad/s/g"
INSTRUMENT: Final = Instrument(SCALE, "1000 arcsec", 0.25 * math.pi)
"""K, beta and alpha0 of all published runs except the five-coefficient one [Wei2020], [Wei2024]."""
TRANSVERSE: Final = 5.0
"""a_Y of the examples [g]. In the time-varying run a_Y = 5 a_x."""
RATIO: Final = TRANSVERSE * INSTRUMENT.tan_beta
"""r of the time-varying run, and a_x of the critical example [g]."""
