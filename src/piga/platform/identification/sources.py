"""Sources of observation of one record as groups of rows: gimbal angles, specific force, pick-off."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from piga.errors import ArgumentError
from piga.platform.identification.disturbance import Stretch, stretches
from piga.platform.identification.estimate import Group
from piga.platform.identification.observation import (
    Unknowns,
    exact_platform,
    gimbal_rows,
    misalignment_regressors,
    names,
)
from piga.platform.model.simulate import Readouts

Array = NDArray[np.float64]

STATIC_SOURCES = ("gimbals", "pick-off")
MOVING_SOURCES = ("force", "pick-off")

_FEWEST = 20
"""Samples per case turn that the specific force needs."""


@dataclass(frozen=True)
class Record:
    """A record, the sources taken from it, and the highest harmonic looked for."""

    readouts: Readouts
    sources: tuple[str, ...]
    orders: int

    @classmethod
    def checked(cls, readouts: Readouts, sources: Sequence[str], orders: int) -> Record:
        """The record, refused when a source is not known or the cases turn too little or too fast for it."""
        unknown = [s for s in sources if s not in {"gimbals", "pick-off", "force"}]
        if unknown or not sources:
            raise ArgumentError(
                f"identification: sources {list(sources)!r} must be among gimbals, pick-off, force"
            )
        record = cls(readouts, tuple(sources), orders)
        fast, slow = record.periods
        span = float(readouts.times[-1] - readouts.times[0])
        if np.isinf(slow):
            raise ArgumentError(
                "identification needs both cases turning, one is at rest",
                remedy="give [case_rotation] period and equatorial_period, or [compensation] misalignment = 'true'",
            )
        if not span >= 2.0 * slow:
            raise ArgumentError(
                f"identification needs two turns of the cases ({2.0 * slow:g} s), the record has {span:g} s",
                remedy="lengthen [identification] duration, or [compensation] misalignment = 'true'",
            )
        if "force" in sources and fast < _FEWEST * readouts.step:
            raise ArgumentError(
                f"identification from the specific force needs {_FEWEST} samples a case turn, the record has "
                f"{fast / readouts.step:.1f}",
                remedy=f"shorten [run] step to {fast / _FEWEST:g} s",
            )
        return record

    @cached_property
    def periods(self) -> tuple[float, float]:
        """Periods [s] of the faster and the slower case; infinite when a case rests."""
        r = self.readouts
        rates = [float(np.abs(np.diff(angle[:3])).max()) / r.step for angle in (r.encoder1, r.encoder2)]
        fast, slow = max(rates), min(rates)
        return (2.0 * np.pi / fast if fast > 0.0 else np.inf, 2.0 * np.pi / slow if slow > 0.0 else np.inf)

    @cached_property
    def seen(self) -> NDArray[np.int64]:
        """Which of all unknowns the sources together can see (columns of every group)."""
        tips = 4 + 4 * self.orders
        eta = range(tips, tips + 2) if "pick-off" in self.sources else ()
        slow = range(tips + 2, tips + 10) if "gimbals" in self.sources else ()
        return np.array([*range(tips), *eta, *slow])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns seen."""
        every = names(self.orders)
        return tuple(every[k] for k in self.seen)

    @cached_property
    def stretches(self) -> tuple[Stretch, ...]:
        """Parts of the record for the specific force; none where it is not used."""
        return stretches(self.readouts, self.periods) if "force" in self.sources else ()

    def moved(self, x: Unknowns, step: Array) -> Unknowns:
        """The unknowns after a step of those seen.

        Where the pick-off is no source of its own, its mean and trend still give the redundancy angle.
        """
        whole = np.zeros(len(names(self.orders)))
        whole[self.seen] = step
        x = x.moved(whole)
        if "pick-off" in self.sources:
            return x
        r = self.readouts
        _, ring = exact_platform(x, r.times, r.encoder1, r.encoder2)
        rate, start = np.polyfit(r.times, r.pickoff - ring, 1)
        return replace(x, eta0=x.eta0 + float(start), eta_rate=x.eta_rate + float(rate))

    def groups(self, x: Unknowns) -> list[Group]:
        """Rows of every source about ``x``; the force without what a slow force could have caused."""
        groups = []
        if self.stretches:
            parts = [(s, *s.rows(x)) for s in self.stretches]
            residual = np.concatenate([s.without_slow(r).ravel() for s, r, _ in parts])
            columns = np.concatenate([self._cut(s.without_slow(c)) for s, _, c in parts])
            rows = 3.0 * sum(len(s.times) - s.slow.shape[1] for s in self.stretches)
            groups.append(Group("force", residual, columns, rows))
        return [*self._angles(x), *groups]

    def _angles(self, x: Unknowns) -> Iterator[Group]:
        """Rows of the gimbal angles and of the pick-off."""
        r = self.readouts
        if "gimbals" in self.sources:
            residual, regressors = gimbal_rows(x, r)
            yield Group("gimbals", residual.ravel(), self._cut(regressors))
        if "pick-off" in self.sources:
            _, ring = exact_platform(x, r.times, r.encoder1, r.encoder2)
            _, pick = misalignment_regressors(x, r.times, r.encoder1, r.encoder2)
            yield Group("pick-off", r.pickoff - ring, self._cut(pick))

    def _cut(self, columns: Array) -> Array:
        """Columns (n, p) of the unknowns seen, zero where the source has none of them."""
        flat = columns.reshape(-1, columns.shape[-1])
        there = self.seen < flat.shape[1]
        out = np.zeros((len(flat), len(self.seen)))
        out[:, there] = flat[:, self.seen[there]]
        return out

    def in_time(self, x: Unknowns, levels: dict[str, float]) -> Iterator[tuple[Array, Array]]:
        """Times (n,) and weighted rows (n, s + p + 1) of all sources in order of time, stretch by stretch.

        The first s columns are a slow force of each stretch of its own; the last is the residual.
        """
        r = self.readouts
        times, tables = [np.zeros(0)], [np.zeros((0, len(self.seen) + 1))]
        for g in self._angles(x):
            times.append(np.repeat(r.times, len(g.residual) // len(r.times)))
            tables.append(np.column_stack([g.regressors, g.residual]) / levels[g.name])
        time, table = np.concatenate(times), np.concatenate(tables)
        after = -np.inf
        for stretch in self.stretches:
            until = np.inf if stretch is self.stretches[-1] else stretch.readouts.times[-1]
            here = (time > after) & (time <= until)
            after = until
            force = self._force_in_time(stretch, x) / levels["force"]
            angles = np.pad(table[here], ((0, 0), (force.shape[1] - table.shape[1], 0)))
            yield _sorted(
                np.concatenate([time[here], np.repeat(stretch.times, 3)]), np.concatenate([angles, force])
            )
        if not self.stretches:
            yield _sorted(time, table)

    def _force_in_time(self, stretch: Stretch, x: Unknowns) -> Array:
        residual, columns = stretch.rows(x)
        slow = np.kron(stretch.slow, np.eye(3))
        return np.column_stack([slow, self._cut(columns), residual.ravel()])


def _sorted(times: Array, rows: Array) -> tuple[Array, Array]:
    order = np.argsort(times, kind="stable")
    return times[order], np.ascontiguousarray(rows[order])
