"""Optimal design: criteria for information matrices, and the search for visits.

With ``C = M^-1`` the covariance and ``L`` the rows of interest, all criteria are logarithms of
homogeneous convex functions of ``M``: D ``log det(L C L')/r``;
power means ``(1/p) log mean((L C L')_ii^p)``, with p = 1 the A-criterion, r = 1 the c-criterion, and
large p the largest entry.

A test has visits in pairs: the calibration refuses a position that alone determines a coefficient, and two visits show its
scatter. All dwells are equal, but for whole revolutions. For each number of pairs the search begins with evenly spaced
positions, and exchanges pairs as long as the criterion falls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from piga.errors import IdentifiabilityError
from piga.planning.candidates import Candidate, PlanRequest, Prediction, Visit, information_tables, predict
from piga.records.terms import unit_of
from piga.results import Array

_RIDGE = 1e-13
"""Information added to each scaled parameter, so that a singular plan has a finite, useless value."""
_ROUNDING = 1e-14
"""Least share of that in the trace, so that rounding does not swallow it."""
_GUARD = 0.1
"""Share of the D-criterion of all parameters in a guarded criterion."""
_WANTED_POWER = 64.0
"""Power that approximates the largest variance, within a factor r^(1/64)."""
_IMPROVEMENT = 1e-7
"""Smallest improvement of the criterion that counts."""
_NUMBERS = 8
"""Most numbers of pairs that are tried, evenly spaced on a logarithmic scale."""
_DWELLS = 6
"""Dwells of the tables of information, from the shortest to the longest."""
_STRIDE = 0.381966
"""Step from one visit to the next in shuffled order, as a share of the visits (the golden section)."""
_ATTEMPTS = 20
"""Most durations tried to reach a wanted uncertainty."""
_SHORTER = 0.75
"""Duration tried first, as a share of that of a test whose variances fall as its time grows."""
_LONGER = 1.2
"""Factor on the duration after a test that the calibration would refuse."""


@dataclass(frozen=True)
class Criterion:
    """The criterion to minimise: ``rows`` (r, m) of interest in scaled parameters; ``power`` 0 is D.

    ``guard`` is the share of the D-criterion of all parameters. It keeps parameters determined that are not of
    interest.
    """

    rows: Array
    power: float
    guard: float = 0.0

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


def _covariance(information: Array) -> Array:
    """Inverse of information matrices (..., m, m); that of a singular one is large and finite."""
    ridge = np.maximum(_RIDGE, _ROUNDING * np.trace(information, axis1=-2, axis2=-1))
    added = ridge[..., None, None] * np.eye(information.shape[-1])
    return np.asarray(np.linalg.inv(information + added), dtype=np.float64)


def whole_pairs(matrices: Array, criterion: Criterion, count: int) -> tuple[float, NDArray[np.int64]]:
    """Criterion and places (count,) of the best pairs found from evenly spaced places on.

    ``matrices`` (n, m, m) hold the information of a pair at each place.
    """
    places = ((np.arange(count) + 0.5) * len(matrices) / count).astype(np.int64)
    value = float(criterion.values(matrices[places].sum(axis=0)))
    while True:
        taken, first = np.unique(places, return_index=True)
        total = matrices[places].sum(axis=0)
        tried = (criterion.values(total - matrices[place] + matrices) for place in taken)
        _, at, there = min((float(values.min()), at, int(values.argmin())) for at, values in enumerate(tried))
        moved = places.copy()
        moved[first[at]] = there
        better = float(criterion.values(matrices[moved].sum(axis=0)))
        if not better < value - _IMPROVEMENT:
            return value, places
        places, value = moved, better


@dataclass(frozen=True)
class Search:
    """Information of a visit (n, d, m, m) at each usable candidate for the ``dwells`` (d,) [s], and the criterion.

    Both are in scaled parameters (``scaled = file / scale``). The scale is the uncertainty of equal time on all candidates.
    """

    request: PlanRequest
    usable: tuple[Candidate, ...]
    dwells: Array
    tables: Array
    scale: Array
    criterion: Criterion

    @classmethod
    def of(cls, request: PlanRequest, usable: tuple[Candidate, ...]) -> Search:
        """The tables of the usable candidates; refuses confounded terms."""
        longest = min(request.longest_dwell, request.duration)
        steps = np.geomspace(request.minimum_dwell, longest, _DWELLS)
        dwells = np.unique([request.whole_samples(dwell) for dwell in steps])
        tables = information_tables(request, usable, dwells)
        equal = tables[:, -1].mean(axis=0)
        plain = 1.0 / np.sqrt(np.diag(equal))
        scale = np.sqrt(np.diag(np.linalg.inv(equal * np.outer(plain, plain)) * np.outer(plain, plain)))
        criterion = _criterion(request, scale, request.table.plan.criterion, request.wanted)
        return cls(request, usable, dwells, tables * np.outer(scale, scale), scale, criterion)

    def value(self, prediction: Prediction) -> float:
        """The criterion of a predicted covariance; infinite if there is none."""
        if prediction.refusal:
            return math.inf
        keep = [k for k, c in enumerate(prediction.coefficients) if c.segment is None]
        covariance = prediction.covariance[np.ix_(keep, keep)] / np.outer(self.scale, self.scale)
        return float(self.criterion.values(np.asarray(np.linalg.inv(covariance), dtype=np.float64)))

    def best(self, standard: tuple[Prediction, ...]) -> Prediction:
        """The best test; a standard plan that keeps the margin if no test is better."""
        planned = self._test("planned", self.request.duration)
        value = self.value(planned)
        for prediction in standard:
            other, margin = self.value(prediction), self.request.table.plan.margin
            if other < value and all(visit.candidate.margin >= margin for visit in prediction.visits):
                planned, value = replace(prediction, name="planned"), other
        if not math.isfinite(value):
            raise IdentifiabilityError(
                planned.refusal, remedy="give the test more time, a shorter minimum_dwell, or fewer terms"
            )
        return planned

    def cheapest(self, best: Prediction) -> Prediction:
        """The shortest test found that reaches the wanted standard uncertainties. Its refusal says why there is none.

        Type B of the stand is included.
        """
        request, targets = self.request, {}
        for name, wanted in request.wanted.items():
            by_stand = best.uncertainty(name)[1]
            if by_stand >= wanted:
                added = f"the stand alone adds {by_stand:.2g} {unit_of(name, request.unit)} to {name}"
                refusal = f"{added}: {wanted:.2g} cannot be reached in any time"
                return Prediction("cheapest", (), math.inf, refusal=refusal)
            targets[name] = math.sqrt(wanted**2 - by_stand**2)
        search = replace(self, criterion=_criterion(request, self.scale, "wanted", targets))
        plan, least = search._test("cheapest", request.duration), 2.0 * request.minimum_dwell + request.move
        over = 1.0 if plan.refusal else max(plan.std(name) / target for name, target in targets.items())
        duration = max(_SHORTER * over**2 * request.duration, least)
        for _ in range(_ATTEMPTS):
            plan = search._test("cheapest", duration)
            ratio = max(plan.combined(name) / wanted for name, wanted in request.wanted.items())
            if ratio <= 1.0:
                return plan
            duration *= _LONGER if plan.refusal else min(max(ratio**2, 1.005), 2.0)
        return replace(plan, refusal="no test was found that reaches it: add positions or allow longer dwells")

    def _test(self, name: str, duration: float) -> Prediction:
        """The best test of this duration [s] that the calibration does not refuse, of several numbers of pairs."""
        request, found, (of_interest, every) = self.request, [], self.criterion.rows.shape
        guarded = replace(self.criterion, guard=_GUARD if of_interest < every else 0.0)
        ends = [0.5 * (duration + request.move) / (dwell + request.move) for dwell in self.dwells[[-1, 0]]]
        for count in sorted({math.floor(x + 1e-9) for x in np.geomspace(max(ends[0], 1.0), ends[1], _NUMBERS)}):
            dwells = self._cut(min(0.5 * (duration + request.move) / count - request.move, self.dwells[-1]))
            pairs = 2.0 * self._information(dwells)
            value, places = whole_pairs(pairs, guarded, count)
            found.append((value, [(int(k), float(dwells[k])) for k in np.repeat(np.sort(places), 2)]))
        for _, visits in sorted(found):
            held = tuple(Visit(self.usable[k], request.whole_samples(dwell)) for k, dwell in visits)
            planned = predict(request, name, in_order(request, held))
            if not planned.refusal:
                break
        return planned

    def _cut(self, dwell: float) -> Array:
        """The dwell [s] at each candidate, cut to whole revolutions of the gimbal if that leaves the least dwell."""
        turns = np.array([min(candidate.revolution, 1e9) for candidate in self.usable])
        whole = np.floor(dwell / turns + 1e-9) * turns
        usual = self.request.table.plan.whole_revolutions & (whole >= self.request.minimum_dwell)
        return np.where(usual, whole, dwell)

    def _information(self, dwells: Array) -> Array:
        """Information of a visit of these dwells (n,) [s] at each candidate, linear between those of the tables."""
        known = np.append(0.0, self.dwells)
        tables = np.concatenate([np.zeros_like(self.tables[:, :1]), self.tables], axis=1)
        at = np.clip(np.searchsorted(known, dwells), 1, known.size - 1)
        share = ((dwells - known[at - 1]) / (known[at] - known[at - 1]))[:, None, None]
        each = np.arange(len(tables))
        return (1.0 - share) * tables[each, at - 1] + share * tables[each, at]


def _criterion(request: PlanRequest, scale: Array, kind: str, wanted: dict[str, float]) -> Criterion:
    """The criterion in scaled parameters."""
    plan, names = request.table.plan, request.names
    rows = np.diag(scale)
    if kind == "c":
        return Criterion(np.array([[plan.combination.get(n, 0.0) for n in names]]) * scale, 1.0)
    if kind == "wanted":
        chosen = [names.index(n) for n in wanted]
        return Criterion(rows[chosen] / np.array(list(wanted.values()))[:, None], _WANTED_POWER)
    chosen = [names.index(n) for n in plan.coefficients or names]
    sizes = np.array([wanted.get(n, scale[names.index(n)]) for n in names])
    return Criterion((rows / sizes[:, None])[chosen], 0.0 if kind == "D" else 1.0)


def in_order(request: PlanRequest, visits: tuple[Visit, ...]) -> tuple[Visit, ...]:
    """The visits of each stand in shuffled order, unless the plan asks for that of the stand.

    A slow change of the bias then moves no coefficient as a whole: the next position lies 0.38 of the test further on, as
    near to the golden section as the number of visits allows. Of 4 and 6 visits, every second comes first.
    """
    if not request.table.plan.shuffle:
        return visits
    ordered: list[Visit] = []
    for _, group in groupby(visits, key=lambda visit: type(visit.candidate.table)):
        part = list(group)
        step = max(round(_STRIDE * len(part)), 1)
        while math.gcd(step, len(part)) > 1:
            step += 1
        if step < len(part) - 1:
            ordered += [part[(step * k) % len(part)] for k in range(len(part))]
        else:
            ordered += [*part[::2], *part[1::2]]
    return tuple(ordered)
