"""Optimal design: criteria for information matrices, the best mixture, and whole visits derived from it.

With ``C = M^-1`` the covariance and ``L`` the rows of interest, all criteria are logarithms of
homogeneous convex functions of ``M``: D ``log det(L C L')/r``;
power means ``(1/p) log mean((L C L')_ii^p)``, with p = 1 the A-criterion, r = 1 the c-criterion, and
large p the largest entry. Each has the derivative ``-tr(S dM)`` with ``tr(S M) = 1``, so the general
equivalence theorem reads: a mixture is optimal if and only if no candidate has
``tr(S A_j) > 1``; for D this is the statement that the largest directional derivative ``r tr(S A_j)``
equals the number r of parameters. An exchange search turns a mixture into whole visits, with dwells in steps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import CalibrationError
from piga.results import Array

Index = NDArray[np.int64]


_GAP = 1e-6
"""Excess of the largest directional derivative over its value at the optimum that ends the search."""
_ROUNDS = 60
"""Most rounds of the search."""
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
        left_out = self.rows.shape[0] < self.rows.shape[1]
        return replace(self, guard=_GUARD) if left_out else self

    def _all(self) -> Criterion:
        return Criterion(np.eye(self.rows.shape[1]), 0.0)

    def values(self, information: Array) -> Array:
        """Criterion of information matrices (..., m, m) in scaled parameters."""
        if self.guard:
            own = replace(self, guard=0.0).values(information)
            return (1.0 - self.guard) * own + self.guard * self._all().values(information)
        m = information.shape[-1]
        covariance = np.linalg.inv(information + _RIDGE * np.eye(m))
        reduced = self.rows @ covariance @ self.rows.T
        if self.power == 0.0:
            return np.linalg.slogdet(reduced)[1] / self.rows.shape[0]
        variances = np.maximum(np.diagonal(reduced, axis1=-2, axis2=-1), 1e-300)
        logs = self.power * np.log(variances)
        top = logs.max(axis=-1, keepdims=True)
        return (top[..., 0] + np.log(np.mean(np.exp(logs - top), axis=-1))) / self.power

    def sensitivity(self, information: Array) -> Array:
        """``S`` with derivative ``-tr(S dM)``, (m, m)."""
        if self.guard:
            own = replace(self, guard=0.0).sensitivity(information)
            return (1.0 - self.guard) * own + self.guard * self._all().sensitivity(information)
        m = information.shape[-1]
        covariance = np.linalg.inv(information + _RIDGE * np.eye(m))
        crossed = covariance @ self.rows.T
        reduced = self.rows @ crossed
        if self.power == 0.0:
            return crossed @ np.linalg.inv(reduced) @ crossed.T / self.rows.shape[0]
        variances = np.diag(reduced)
        shares = (variances / variances.max()) ** self.power
        return (crossed * (shares / shares.sum() / variances)) @ crossed.T


@dataclass(frozen=True)
class Mixture:
    """The best mixture: ``weights`` (n,) that sum to 1, ``information`` (m, m), criterion ``value``.

    ``derivatives`` (n,) are ``tr(S A_j)``, at most ``1 + gap``: the certificate of the optimum. The criterion
    is at most the gap above it.
    """

    weights: Array
    information: Array
    value: float
    derivatives: Array


def best_mixture(candidates: Array, criterion: Criterion) -> Mixture:
    """Optimal weights for candidate information matrices (n, m, m) per unit of cost, scaled parameters.

    The convex problem is solved on a few candidates (sequential quadratic programming, SciPy). The candidates with
    the largest directional derivative are added, and the problem is solved again. The certificate covers all candidates.

    Raises
    ------
    CalibrationError
        If the certificate is not reached.
    """
    matrices = (1.0 - _MIXED) * candidates + _MIXED * candidates.mean(axis=0)
    active = np.unique(np.argmax(np.einsum("njj->nj", matrices), axis=0))
    derivatives = _derivatives(matrices, criterion, matrices.mean(axis=0))
    active = np.union1d(active, np.argsort(-derivatives)[:30])
    weights = np.full(active.size, 1.0 / active.size)
    for _ in range(_ROUNDS):
        weights = _solve(matrices[active], criterion, weights)
        total = np.tensordot(weights, matrices[active], 1)
        derivatives = _derivatives(matrices, criterion, total)
        if derivatives.max() - 1.0 < _GAP:
            break
        keep = weights > 1e-12
        new = np.setdiff1d(np.argsort(-derivatives)[:10], active[keep])
        share = 1e-3 if new.size else 0.0
        active = np.concatenate([active[keep], new])
        weights = np.concatenate([(1.0 - share) * weights[keep], np.full(new.size, share / max(new.size, 1))])
        weights /= weights.sum()
    if derivatives.max() - 1.0 > 1e3 * _GAP:
        raise CalibrationError(
            f"the search for the best times did not converge (directional derivative {derivatives.max() - 1.0:.2g} too large)",
            remedy="use fewer candidates, or criterion 'D'",
        )
    full = np.zeros(matrices.shape[0])
    full[active] = weights
    return Mixture(full, total, float(criterion.values(total)), derivatives)


def _derivatives(matrices: Array, criterion: Criterion, information: Array) -> Array:
    return np.einsum("ij,nji->n", criterion.sensitivity(information), matrices)


def _solve(matrices: Array, criterion: Criterion, start: Array) -> Array:
    """Weights on a few candidates."""
    from scipy.optimize import minimize

    def value(weights: Array) -> float:
        return float(criterion.values(np.tensordot(weights, matrices, 1)))

    def slope(weights: Array) -> Array:
        return -_derivatives(matrices, criterion, np.tensordot(weights, matrices, 1))

    optimum = minimize(
        value,
        start,
        jac=slope,
        method="SLSQP",
        bounds=[(0.0, 1.0)] * start.size,
        constraints={"type": "eq", "fun": lambda w: w.sum() - 1.0, "jac": np.ones_like},
        options={"ftol": 1e-14, "maxiter": 300},
    )
    weights = np.maximum(optimum.x, 0.0)
    weights = weights / weights.sum()
    return weights if value(weights) <= value(start) else start


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
    value = float(criterion.values(_information(tables, places, dwells)))
    while True:
        options = list(_neighbours(tables, limits, places, dwells))
        matrices = np.concatenate([change for change, _ in options])
        values = criterion.values(_information(tables, places, dwells) + matrices)
        best = int(np.argmin(values))
        if not values[best] < value - _IMPROVEMENT:
            return Schedule(places, dwells, value)
        for change, take in options:
            if best < change.shape[0]:
                taken = take(best)
                break
            best -= change.shape[0]
        better = float(criterion.values(_information(tables, *taken)))
        if (
            not better < value - _IMPROVEMENT
        ):  # rounding of a nearly singular plan: it would go round in circles
            return Schedule(places, dwells, value)
        (places, dwells), value = taken, better


def _information(tables: Array, places: Index, dwells: Index) -> Array:
    return tables[places, dwells - 1].sum(axis=0)


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


def _neighbours(tables: Array, limits: PlanLimits, places: Index, dwells: Index) -> Iterator[tuple]:
    """Changed information matrices (b, m, m), and a function that builds the visits of each."""
    own = tables[places, dwells - 1]
    count = tables.shape[0]
    for k in range(places.size):
        yield tables[:, dwells[k] - 1] - own[k], lambda i, k=k: (_put(places, k, i), dwells)
    for k in range(places.size):
        for jump in _JUMPS:
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


def _fewer(tables: Array, limits: PlanLimits, places: Index, dwells: Index, own: Array) -> Iterator[tuple]:
    """One visit less; its dwell and move time go to one other visit or equally to all."""
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


def start_of(mixture: Mixture, steps: int, limits: PlanLimits) -> tuple[Index, Index]:
    """Visits with the time shares of the mixture; small shares are dropped.

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
