"""Optimal design: criteria for information matrices, the least value of a mixture, and whole visits.

With ``C = M^-1`` the covariance and ``L`` the rows of interest, all criteria are logarithms of
homogeneous convex functions of ``M``: D ``log det(L C L')/r``;
power means ``(1/p) log mean((L C L')_ii^p)``, with p = 1 the A-criterion, r = 1 the c-criterion, and
large p the largest entry. Each has the derivative ``-tr(S dM)`` with ``tr(S M) = 1``, so the general
equivalence theorem reads: a mixture is optimal if and only if no candidate has
``tr(S A_j) > 1``; for D this is the statement that the largest directional derivative ``r tr(S A_j)``
equals the number r of parameters. An exchange search finds whole visits, with dwells in steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from piga.results import Array

Index = NDArray[np.int64]


_GAP = 1e-6
"""Excess of the largest directional derivative over its value at the optimum that ends the search."""
_ROUNDS = 2000
"""Most steps towards the best mixture."""
_LARGEST_POWER = 9.0
"""Power of the criterion above which the first steps towards the best mixture are not smaller."""
_SLOWER = 0.7
"""Factor on the power of the derivative in the steps after one that made the mixture worse."""
_MIXED = 1e-6
"""Share of the equal mixture in every candidate. It keeps the mixture regular if the optimum is singular."""
_RIDGE = 1e-13
"""Information added to each scaled parameter, so that a singular plan has a finite, useless value."""
_GUARD = 0.02
"""Share of the D-criterion of all parameters in a guarded criterion."""
LARGEST_POWER = 64.0
"""Power that approximates the largest variance, within a factor r^(1/64)."""
_IMPROVEMENT = 1e-7
"""Smallest improvement of the criterion that counts."""
_JUMPS = (1, 5)
"""Dwell steps moved from one visit to another at a time."""


@dataclass(frozen=True)
class Criterion:
    """The criterion to minimise: ``rows`` (r, m) of interest in scaled parameters; ``power`` 0 is D.

    ``guard`` is the share of the D-criterion of all parameters. It keeps parameters determined that are not of
    interest.
    """

    rows: Array
    power: float
    guard: float = 0.0

    def guarded(self) -> Criterion:
        """The criterion with the guard, if the rows do not cover all parameters."""
        return replace(self, guard=_GUARD if self.rows.shape[0] < self.rows.shape[1] else 0.0)

    def _parts(self) -> list[tuple[float, Array, float]]:
        """Share, rows and power of each part."""
        everything = [(self.guard, np.eye(self.rows.shape[1]), 0.0)] if self.guard else []
        return [(1.0 - self.guard, self.rows, self.power), *everything]

    def values(self, information: Array) -> Array:
        """Criterion of information matrices (..., m, m) in scaled parameters."""
        covariance = _covariance(information)
        total = np.zeros(information.shape[:-2])
        for share, rows, power in self._parts():
            reduced = rows @ covariance @ rows.T
            if power == 0.0:
                total += share * np.linalg.slogdet(reduced)[1] / rows.shape[0]
                continue
            logs = power * np.log(np.maximum(np.diagonal(reduced, axis1=-2, axis2=-1), 1e-300))
            top = logs.max(axis=-1)
            total += share * (top + np.log(np.mean(np.exp(logs - top[..., None]), axis=-1))) / power
        return total

    def sensitivity(self, information: Array) -> Array:
        """``S`` with derivative ``-tr(S dM)``, (m, m)."""
        covariance = _covariance(information)
        total = np.zeros_like(covariance)
        for share, rows, power in self._parts():
            crossed = covariance @ rows.T
            reduced = rows @ crossed
            if power == 0.0:
                total += share * crossed @ np.linalg.inv(reduced) @ crossed.T / rows.shape[0]
                continue
            variances = np.diag(reduced)
            shares = (variances / variances.max()) ** power
            total += share * (crossed * (shares / shares.sum() / variances)) @ crossed.T
        return total


def _covariance(information: Array) -> Array:
    return np.asarray(np.linalg.inv(information + _RIDGE * np.eye(information.shape[-1])), dtype=np.float64)


def least_value(candidates: Array, criterion: Criterion) -> tuple[float, float]:
    """Lower bound of the criterion over all mixtures of information matrices (n, m, m), and the largest ``tr(S A_j)`` at the best.

    The criterion of any mixture lies above that of the best one by at most the logarithm of its largest derivative. Each step
    multiplies the share of a candidate by a power of its derivative.
    """
    matrices = (1.0 - _MIXED) * candidates + _MIXED * candidates.mean(axis=0)
    shares = np.full(matrices.shape[0], 1.0 / matrices.shape[0])
    bound, largest, last, power = -np.inf, np.inf, np.inf, 1.0 / (1.0 + min(criterion.power, _LARGEST_POWER))
    for _ in range(_ROUNDS):
        total = np.tensordot(shares, matrices, 1)
        derivatives = np.einsum("ij,nji->n", criterion.sensitivity(total), matrices)
        largest = min(largest, float(derivatives.max()))
        value = float(criterion.values(total))
        bound = max(bound, value - float(np.log(derivatives.max())))
        if largest - 1.0 < _GAP:
            break
        power *= _SLOWER if value > last else 1.0
        last = value
        shares *= derivatives**power
        shares /= shares.sum()
    return bound, largest


@dataclass(frozen=True)
class PlanLimits:
    """Times in dwell steps: ``total`` (dwells and moves), ``move``, ``shortest`` and ``longest`` dwell."""

    total: float
    move: float
    shortest: int
    longest: int

    def room(self, dwells: Index) -> int:
        """Free dwell steps."""
        return int(np.floor(self.total - dwells.sum() - self.move * (dwells.size - 1) + 1e-9))


@dataclass(frozen=True)
class Schedule:
    """Visits: candidate index and dwell in steps, (k,) each, and the value of the criterion."""

    places: Index
    dwells: Index
    value: float


def improve(tables: Array, criterion: Criterion, limits: PlanLimits, places: Index, dwells: Index) -> Schedule:
    """Steepest descent over exchanges: another place, time moved between visits, one visit more or less.

    ``tables`` (n, steps, m, m) hold the information of 1, 2, ... dwell steps, scaled parameters.
    """
    places, dwells = fitted(places, dwells, limits)
    tables = np.concatenate([np.zeros_like(tables[:, :1]), tables], axis=1)  # a dwell of 0 steps tells nothing
    value = float(criterion.values(tables[places, dwells].sum(axis=0)))
    while True:
        places, dwells = np.append(places, 0), np.append(dwells, 0)  # an empty visit, for one more
        held = tables[places, dwells]
        moves = list(_moves(tables.shape[0], limits, places, dwells))
        changes = [(tables[there, steps] - held[at]).sum(axis=1) for at, there, steps in moves]
        values = criterion.values(held.sum(axis=0) + np.concatenate(changes))
        best = int(np.argmin(values))
        moved = places.copy(), dwells.copy()
        for at, there, steps in moves:
            if best < len(at):
                moved[0][at[best]], moved[1][at[best]] = there[best], steps[best]
                break
            best -= len(at)
        better = float(criterion.values(tables[moved].sum(axis=0)))
        if not better < value - _IMPROVEMENT:
            return Schedule(places[:-1], dwells[:-1], value)
        places, dwells, value = moved[0][moved[1] > 0], moved[1][moved[1] > 0], better


def _moves(
    count: int, limits: PlanLimits, places: Index, dwells: Index
) -> Iterator[tuple[Index, Index, Index]]:
    """Exchanges in groups: the visits that change, and their new places and dwells, (b, c) each.

    The last visit is empty. A dwell of 0 takes a visit out.
    """
    size, everywhere = places.size - 1, np.arange(count)
    visits = np.arange(size)
    for k in visits:
        yield _move([np.full(count, k)], [everywhere], [np.full(count, dwells[k])])
    for k in visits:
        for jump in _JUMPS:
            others = visits[(visits != k) & (dwells[:-1] + jump <= limits.longest)]
            if dwells[k] - jump >= limits.shortest and others.size:
                at = [np.full(others.size, k), others]
                yield _move(at, [places[i] for i in at], [dwells[at[0]] - jump, dwells[others] + jump])
    room = limits.room(dwells[:-1])
    if room > 0:
        yield _move([visits], [places[visits]], [np.minimum(dwells[visits] + room, limits.longest)])
    for k in visits if size > 1 else ():
        rest = visits[visits != k]
        freed = limits.room(dwells[rest])
        if freed >= 0:
            grown = np.minimum(dwells[rest] + freed, limits.longest)
            yield _move([np.full(rest.size, k), rest], [places[rest]] * 2, [np.zeros_like(rest), grown])
            spread = np.minimum(dwells[:-1] + freed // rest.size, limits.longest) * (visits != k)
            yield visits[None], places[None, :-1], spread[None]
    needed = int(np.ceil(limits.shortest + limits.move - 1e-9))
    for k in visits:
        left = dwells[k] - max(needed - room, 0)
        if left >= limits.shortest:
            at = [np.full(count, k), np.full(count, size)]
            steps = [np.full(count, left), np.full(count, limits.shortest)]
            yield _move(at, [places[at[0]], everywhere], steps)


def _move(*parts: list[Index]) -> tuple[Index, Index, Index]:
    at, there, steps = (np.stack(part, axis=1) for part in parts)
    return at, there, steps


def fitted(places: Index, dwells: Index, limits: PlanLimits) -> tuple[Index, Index]:
    """Visits within the limits: surplus visits are removed from the end, spare time is distributed."""
    dwells = np.clip(dwells, limits.shortest, limits.longest)
    while limits.room(dwells) < 0:
        if dwells.max() > limits.shortest:
            dwells[np.argmax(dwells)] -= 1
        else:
            places, dwells = places[:-1], dwells[:-1]
    while limits.room(dwells) > 0 and dwells.min() < limits.longest:
        dwells[np.argmin(dwells)] += 1
    return places, dwells
