"""From a mixture to a test: whole visits, dwells in steps, within the time (exchange search)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.planning.criterion import Criterion, Mixture

Array = NDArray[np.float64]
Index = NDArray[np.int64]

IMPROVEMENT = 1e-7
"""Smallest improvement of the criterion that counts."""
JUMPS = (1, 5)
"""Dwell steps that pass from one visit to another at a time."""


@dataclass(frozen=True)
class Limits:
    """Times in dwell steps: ``total`` (dwells and moves between them), ``move``, ``shortest`` dwell."""

    total: float
    move: float
    shortest: int
    longest: int

    def room(self, dwells: Index) -> int:
        """Dwell steps that are left."""
        return int(np.floor(self.total - dwells.sum() - self.move * (dwells.size - 1) + 1e-9))


@dataclass(frozen=True)
class Schedule:
    """Visits: candidate index and dwell in steps, (k,) each, and the value of the criterion."""

    places: Index
    dwells: Index
    value: float


def improve(tables: Array, criterion: Criterion, limits: Limits, places: Index, dwells: Index) -> Schedule:
    """Steepest descent over exchanges: another place, time from visit to visit, a visit more or less.

    ``tables`` (n, steps, m, m) hold the information of 1, 2, ... dwell steps, scaled parameters.
    """
    places, dwells = _fitted(places, dwells, limits)
    value = float(criterion.values(_information(tables, places, dwells)))
    while True:
        options = list(_neighbours(tables, limits, places, dwells))
        matrices = np.concatenate([change for change, _ in options])
        values = criterion.values(_information(tables, places, dwells) + matrices)
        best = int(np.argmin(values))
        if not values[best] < value - IMPROVEMENT:
            return Schedule(places, dwells, value)
        for change, take in options:
            if best < change.shape[0]:
                places, dwells = take(best)
                break
            best -= change.shape[0]
        value = float(criterion.values(_information(tables, places, dwells)))


def _information(tables: Array, places: Index, dwells: Index) -> Array:
    return tables[places, dwells - 1].sum(axis=0)


def _fitted(places: Index, dwells: Index, limits: Limits) -> tuple[Index, Index]:
    """Dwells within the limits, visits left out from the end until the test fits, time to spare given away."""
    dwells = np.clip(dwells, limits.shortest, limits.longest)
    while limits.room(dwells) < 0:
        if dwells.max() > limits.shortest:
            dwells[np.argmax(dwells)] -= 1
        else:
            places, dwells = places[:-1], dwells[:-1]
    while limits.room(dwells) > 0 and dwells.min() < limits.longest:
        dwells[np.argmin(dwells)] += 1
    return places, dwells


def _neighbours(tables: Array, limits: Limits, places: Index, dwells: Index) -> Iterator[tuple]:
    """Changes of the information (b, m, m) with the function that makes the visits of each."""
    own = tables[places, dwells - 1]
    count = tables.shape[0]
    for k in range(places.size):
        yield tables[:, dwells[k] - 1] - own[k], lambda i, k=k: (_put(places, k, i), dwells)
    for k in range(places.size):
        for jump in JUMPS:
            if dwells[k] - jump < limits.shortest:
                continue
            others = np.flatnonzero((np.arange(places.size) != k) & (dwells + jump <= limits.longest))
            loss = tables[places[k], dwells[k] - jump - 1] - own[k]
            gain = tables[places[others], dwells[others] + jump - 1] - own[others]
            yield (
                loss + gain,
                lambda i, k=k, j=jump, o=others: (
                    places,
                    _put(_put(dwells, k, dwells[k] - j), o[i], dwells[o[i]] + j),
                ),
            )
    room = limits.room(dwells)
    if room > 0:
        grown = np.minimum(dwells + room, limits.longest)
        yield tables[places, grown - 1] - own, lambda i: (places, _put(dwells, i, grown[i]))
    yield from _fewer(tables, limits, places, dwells, own)
    needed = int(np.ceil(limits.shortest + limits.move - 1e-9))
    for k in range(places.size):
        left = dwells[k] - max(needed - room, 0)
        if left >= limits.shortest:
            change = tables[places[k], left - 1] - own[k] + tables[:, limits.shortest - 1]
            yield (
                change,
                lambda i, k=k, n=left: (
                    np.append(places, i % count),
                    np.append(_put(dwells, k, n), limits.shortest),
                ),
            )


def _fewer(tables: Array, limits: Limits, places: Index, dwells: Index, own: Array) -> Iterator[tuple]:
    """One visit less, its time and its move to another or in equal parts to all."""
    if places.size < 2:
        return
    for k in range(places.size):
        rest, kept = np.delete(places, k), np.delete(dwells, k)
        freed = limits.room(kept)
        if freed < 0:
            continue
        grown = np.minimum(kept + freed, limits.longest)
        base = np.delete(own, k, axis=0)
        yield tables[rest, grown - 1] - base - own[k], lambda i, r=rest, d=kept, g=grown: (r, _put(d, i, g[i]))
        shared = np.minimum(kept + freed // kept.size, limits.longest)
        change = (tables[rest, shared - 1] - base).sum(axis=0) - own[k]
        yield change[None], lambda _, r=rest, d=shared: (r, d)


def _put(values: Index, at: int, value: Any) -> Index:
    changed = values.copy()
    changed[at] = value
    return changed


def start_of(mixture: Mixture, steps: int, limits: Limits) -> tuple[Index, Index]:
    """Visits that share the time as the mixture does, the small ones left out.

    The candidates of the mixture are (place, dwell) pairs, ``steps`` dwells per place.
    """
    share = mixture.weights.reshape(-1, steps).sum(axis=1) * (limits.total + limits.move)
    typical = (mixture.weights.reshape(-1, steps) * np.arange(1, steps + 1)).sum(axis=1)
    typical = typical / np.maximum(mixture.weights.reshape(-1, steps).sum(axis=1), 1e-300)
    wanted = np.where(share > 0.5 * (limits.shortest + limits.move), share, 0.0)
    if not wanted.any():
        wanted[np.argmax(share)] = limits.total
    places, dwells = [], []
    for place in np.flatnonzero(wanted):
        number = max(1, round(wanted[place] / (typical[place] + limits.move)))
        places += [place] * number
        dwells += [max(limits.shortest, round(wanted[place] / number - limits.move))] * number
    order = np.argsort(-np.array(dwells), kind="stable")
    return np.array(places)[order], np.array(dwells)[order]
