"""What differs between two records: coefficients with uncertainty, inputs, wishes, software."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from piga.ledger.store.record import Record
from piga.ledger.store.store import Store


@dataclass(frozen=True)
class Change:
    """A coefficient in two records, both in ``unit``; the uncertainty of the difference takes them as independent."""

    key: str
    unit: str
    first: float | None
    second: float | None
    difference: float | None
    std: float | None

    @property
    def ratio(self) -> float | None:
        """Difference over its standard uncertainty."""
        return self.difference / self.std if self.difference is not None and self.std else None


@dataclass(frozen=True)
class Difference:
    """Two records compared: coefficients, and what differs otherwise as ``name: (first, second)``.

    ``type_a_only``: records whose uncertainties are of Type A only.
    """

    first: Record
    second: Record
    coefficients: tuple[Change, ...]
    facts: dict[str, tuple[Any, Any]]
    type_a_only: tuple[str, ...] = ()


def difference(store: Store, first: str | int, second: str | int) -> Difference:
    """Compare two records.

    Raises
    ------
    StoreError
        If one is not there or holds no calibration.
    """
    a, b = store.record(first), store.record(second)
    calibrations = {record.id: store.calibration(record.id) for record in (a, b)}
    old, new = ({c.key: c for c in calibrations[record.id].coefficients} for record in (a, b))
    changes = []
    for key in dict.fromkeys((*old, *new)):
        x, y = old.get(key), new.get(key)
        both = x is not None and y is not None
        delta = y.value - x.value if both and x and y else None
        if delta is not None and key.split("[", maxsplit=1)[0] == "phi":
            delta = math.remainder(delta, 2.0 * math.pi)
        std = math.hypot(x.std, y.std) if both and x and y else None
        unit = x.unit if x is not None else y.unit if y is not None else ""
        changes.append(Change(key, unit, x.value if x else None, y.value if y else None, delta, std))
    alone = tuple(name for name, calibration in calibrations.items() if calibration.type_a_only)
    return Difference(a, b, tuple(changes), _facts(a, b), alone)


def _facts(a: Record, b: Record) -> dict[str, tuple[Any, Any]]:
    first, second = _plain(a), _plain(b)
    return {
        name: (first.get(name), second.get(name))
        for name in dict.fromkeys((*first, *second))
        if first.get(name) != second.get(name)
    }


def _plain(record: Record) -> dict[str, Any]:
    document = record.document
    plain: dict[str, Any] = {
        "instrument": document.serial,
        "operator": document.operator,
        "measured": document.measured,
    }
    plain |= {
        f"file {file.role}": file.sha256
        for file in document.files
        if file.role not in ("report", "calibration")
    }
    plain |= {f"request {name}": value for name, value in document.request.items()}
    return plain | {f"software {name}": value for name, value in document.software.items()}
