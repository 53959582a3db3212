"""The linear model of a record: blocks of regressor columns, one segment at a time.

Integrated over a sample interval the error model (docs/theory/calibration) is linear in

    K, K tan_beta cos(phi), K tan_beta sin(phi), K k0, K k2, ...

The two columns of the coupling and those of the harmonics turn with the unknown phase. They are *local* to a phase
group. All others are *shared*. Column order: local, shared, observation. The servo terms turn with the phase, too: five local
columns span them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from piga._kernels.arithmetic import weigh_neighbours
from piga._kernels.estimation import (
    coupling_columns,
    mean_rows,
    merge_rows,
    product_at,
    product_column,
    servo_columns,
    smooth_bows,
)
from piga.calibration.model.request import Request, harmonics_of, phase_angle, shared_of
from piga.calibration.model.solution import PHASELESS, phaseless_columns
from piga.errors import DataError
from piga.instrument.twin import servo_terms
from piga.records.arrays import spans
from piga.records.run import Run
from piga.records.terms import SERVO_TERMS
from piga.results import Array
from piga.terms import PRODUCTS

Names = tuple[str, ...]


def given_servo(run: Run) -> dict[str, float]:
    """Servo coefficients [1/(m/s^2)^2] predicted from ``[instrument] servo`` of the run file; empty without it.

    They are valid at the root-mean-square rate of the record. ``servo_damping`` is included if the damping is given.
    """
    if not run.servo:
        return {}
    given = {parameter.name: parameter.value for parameter in run.servo}
    lever = given.get("pendulosity", run.scale_factor * given.get("angular_momentum", 0.0))
    plain = {
        name: given.get(name, 0.0) for name in ("integral_gain", "proportional_gain", "rate_gain", "damping")
    }
    rate = run.scale_factor * math.sqrt(float(run.f[:, 0] @ run.f[:, 0]) / run.size)
    servo, damping = servo_terms(run.scale_factor, lever, **plain, rate=rate)
    return {"servo": servo} | ({"servo_damping": damping} if "damping" in given else {})


_CHUNK = 1 << 16
"""Rows per block."""
_CACHE_BYTES = 256 << 20
"""Memory for blocks that are kept for the next pass [bytes]."""
_MOST_BEND = 0.3
"""Largest sag of the output angle between samples [rad] that the product integration may correct to first
order. Its error is then below ``bend^2/4`` of tan_beta."""
_MOST_CHANGE = 0.5
"""Largest relative change of K inside the regressors. Above it the model does not fit the record."""
_MEANS = 1 << 15
"""Rows above which neighbouring samples are averaged (:attr:`Design.means`)."""
_TURN = 0.3
"""Largest turn of the output in a mean [rad]; it loses 0.8 % of the information of a column that turns."""
_MOVED = 1e-3
"""Largest mean square of the force about the means, relative to that of the force; more would lose information."""
_EVEN = 0.1
"""Largest relative difference of an interval from the usual one, in a record that is averaged."""
_PIECES = 0.01
"""Largest share of other intervals, and of rows in pieces shorter than two means, in a record that is averaged."""
_SHARED = 16
"""Fewest means in a segment, and half the fewest in a stretch of usual length."""


@dataclass(frozen=True)
class Block:
    """Rows ``start`` .. ``stop`` of the record (as interval ends): ``columns`` (m + 1, n) and ``h`` (n,).

    ``h`` is 0 for rows without an increment. It is -1 for samples that are left out; the next increment reaches across
    them. The columns of both are 0.
    """

    start: int
    stop: int
    segment: int
    h: Array
    columns: Array


def joined_rows(h: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    """First rows of groups of ``count`` rows, and their intervals (0: a stretch begins, -1: all rows left out)."""
    begins = h == 0.0
    first = begins.copy()
    first[1:] |= begins[:-1]
    first[::count] = True
    starts = np.flatnonzero(first)
    total = np.add.reduceat(np.maximum(h, 0.0), starts)
    return starts, np.where((total == 0.0) & (h[starts] < 0.0), -1.0, total)


@dataclass
class Design:
    """Regressor blocks of a run for one request.

    ``scale_factor`` is the K used inside regressors (base rate, sag): nominal at first, then estimated.
    ``per_segment`` is True if every segment has its own phase; ``groups`` is the phase group of every segment.
    """

    run: Run
    request: Request
    scale_factor: float
    _cache: dict[int, Block] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        run = self.run
        self.estimates_scale_factor = "scale_factor" in self.request.terms
        self._orders = harmonics_of(self.request.terms)
        turning = ("p", "q") if "tan_beta" in self.request.terms else ()
        self.turning_names = turning + tuple(f"{kind}{order}" for order in self._orders for kind in ("s", "c"))
        self.local_names = self.turning_names + phaseless_columns((*self.request.terms, *given_servo(self.run)))
        self.shared_names = tuple(t for t in shared_of(self.request.terms) if t not in SERVO_TERMS)
        self.names = self.local_names + self.shared_names
        self.per_segment = self.request.phases == "per-segment" and bool(self.turning_names)
        count = len(run.labels)
        self.groups = tuple(range(count)) if self.per_segment else (0,) * count
        self.point = run.kind == "rate"
        self.mode = "samples" if self.point else "rates" if self.request.method == "rate" else "increments"
        self._force = np.ascontiguousarray(run.f.T)
        self.phase_angle = phase_angle(run, self.request, self.scale_factor)
        self.time_reference = 0.5 * float(run.t[0] + run.t[-1])
        self._ranges = _ranges(run)
        self._check_bend()

    @property
    def rows(self) -> int:
        """Number of observations: formed increments (samples for a rate log)."""
        run = self.run
        if run.left_out is None:
            return run.size if self.point else run.size - int(np.count_nonzero(run.begins))
        return run.size - int(np.count_nonzero(run.left_out if self.point else run.begins | run.left_out))

    def with_scale_factor(self, scale_factor: float) -> Design:
        """The same model with another K inside the regressors; returns itself if they do not depend on K."""
        relative = abs(scale_factor / self.scale_factor - 1.0)
        absurd = relative > _MOST_CHANGE
        if relative < 1e-8 or absurd or (self.run.base_rate is None and relative < 1e-3):
            return self
        return Design(self.run, self.request, scale_factor)

    def of(self, run: Run) -> Design:
        """The same model, from means of as many samples, for a record with the same segments."""
        result = Design(run, self.request, self.scale_factor)
        result.__dict__["mean_size"] = self.mean_size
        return result

    def with_phase_of(self, other: Design) -> Design:
        """The same observations with the phase of another output reading inside the regressors."""
        result = Design(self.run, self.request, other.scale_factor)
        result.phase_angle = other.phase_angle
        return result

    def blocks(self, *, keep: bool = True) -> Iterator[Block]:
        """All blocks in order; with ``keep`` a short record keeps them for the next pass."""
        keep = keep and self.run.size * (len(self.names) + 2) * 8 <= _CACHE_BYTES
        for index in range(len(self._ranges)):
            block = self._cache.get(index) or self._build(index)
            if keep:
                self._cache[index] = block
            yield block

    @cached_property
    def means(self) -> Design:
        """The design of the means of neighbouring samples of a long record; of any other this design itself.

        A row is then the change from mean to mean, for the observation and all columns alike: nothing is approximated, and slow
        columns lose no information. All reductions use it.
        """
        return self if self.mean_size == 1 else MeanDesign(self, self.mean_size)

    @cached_property
    def mean_size(self) -> int:
        """Number of samples of a mean, so that the model changes little in it; 1 for a short record."""
        run, most = self.run, float(self.run.size // _MEANS)
        if most <= 1.0 or self.request.method != "information":
            return 1
        lengths = np.diff(np.append(np.flatnonzero(run.begins), run.size))
        most = min(most, np.diff(run.segment_edges()).min() // _SHARED)
        most = min(most, 2 * np.median(lengths) // _SHARED)
        if self.turning_names:
            orders = max((1, *self._orders))
            every = run.size // _MEANS
            turn = float(np.quantile(np.abs(np.diff(self.phase_angle[::every])), 0.9)) / every
            most = min(most, _TURN / max(orders * turn, 1e-300))
        count = max(1, int(most))
        steps = np.diff(run.t)[~run.begins[1:]]
        even = np.mean(np.abs(steps / run.median_step - 1.0) > _EVEN) < _PIECES
        if not even or lengths[lengths < 2 * count].sum() > _PIECES * run.size:
            return 1
        places = np.linspace(0, run.size - count, 1024).astype(np.int64)[:, None] + np.arange(count)
        force = run.f[places[~run.begins[places[:, 1:]].any(axis=1)]]
        about = force - force.mean(axis=1, keepdims=True)
        return count if np.mean(about**2) <= _MOVED * np.mean(force**2) else 1

    def means_of(self, values: Array) -> Array:
        """Values of the samples, one for each row of the design."""
        return values

    def beside(self, request: Request) -> Iterator[Block]:
        """Blocks of the columns of another request, row by row beside those of this design.

        Of means they are the columns of the mean inputs, not the means of the columns. They differ by less than a percent.
        """
        other = Design(self.run, request, self.scale_factor)
        other._ranges, other.phase_angle = self._ranges, self.phase_angle
        yield from other.blocks(keep=False)

    def forget(self) -> None:
        """Free the memory of kept blocks; they are built again on demand."""
        self._cache.clear()

    def _build(self, index: int) -> Block:
        start, stop, segment = self._ranges[index]
        first = start if self.point else max(start - 1, 0)
        h, observation = self._observation(start, stop, first)
        bows = self._bows(first, stop)
        if bows is not None and (self.run.base_rate is not None or not self.estimates_scale_factor):
            known = 0.0 if self.estimates_scale_factor else self.run.scale_factor
            observation += np.maximum(h, 0.0) * (bows[3] - known * bows[0])
        columns = np.empty((len(self.names) + 1, h.size))
        columns[-1] = observation
        if self.local_names:
            self._fill_local(columns[: len(self.local_names)], slice(first, stop), h, bows)
        self._fill_shared(columns[len(self.local_names) : -1], slice(first, stop), h, bows)
        left_out = None if self.run.left_out is None else self.run.left_out[stop - h.size : stop]
        if left_out is not None and self.point:
            columns[:, left_out], h[left_out] = 0.0, -1.0
        elif left_out is not None:
            merge_rows(columns, h, left_out)
        return Block(stop - h.size, stop, segment, h, columns)

    def _bows(self, first: int, stop: int) -> Array | None:
        """Curvature corrections ("bows") of force and base rate (6, n), intervals ``first`` to ``stop - 1``; None if all are zero.

        They do not depend on which output samples are left out.
        """
        if self.point:
            return None
        run = self.run
        low, high = max(first - 2, 0), min(stop + 2, run.size)
        h = np.diff(run.t[low:high])
        h[run.begins[low + 1 : high]] = 0.0
        inputs = [*self._force[:, low:high]]
        inputs += [] if run.base_rate is None else [*run.base_rate[low:high].T]
        bows, (before, after, share, bend) = np.zeros((6, h.size)), np.empty((4, h.size))
        weigh_neighbours(np.where(h != 0.0, h, 1.0), before, after, share)  # those beside a gap are not used
        for bow, samples in zip(bows, inputs, strict=False):
            smooth_bows(np.ascontiguousarray(samples), h, before, after, share, bend, bow)
        return bows[:, first - low : stop - 1 - low] if bows.any() else None

    def _observation(self, start: int, stop: int, first: int) -> tuple[Array, Array]:
        """Interval lengths (0 without an increment), and the observed increment of psi plus base rotation."""
        run = self.run
        omega = None if run.base_rate is None else run.base_rate[first:stop, 0]
        if self.point:
            y = run.output[start:stop].copy()
            if omega is not None:
                y += omega
            if not self.estimates_scale_factor:
                y -= run.scale_factor * run.f[start:stop, 0]
            return np.ones(stop - start), y
        h = np.diff(run.t[first:stop])
        h[run.begins[first + 1 : stop]] = 0.0
        y = np.diff(run.output[first:stop])
        if omega is not None:
            y += h * 0.5 * (omega[1:] + omega[:-1])
        if not self.estimates_scale_factor:
            y -= run.scale_factor * h * 0.5 * (run.f[first + 1 : stop, 0] + run.f[first : stop - 1, 0])
        y[h == 0.0] = 0.0
        return h, y

    def _fill_local(self, columns: Array, window: slice, h: Array, bows: Array | None) -> None:
        psi, force = self.phase_angle[window], self._force[:, window]
        if self.run.base_rate is not None:  # u/K: specific force less base rate over K [m/s^2]
            force = force - self.run.base_rate[window].T / self.scale_factor
        turned = columns
        if self.point:  # each sample is both ends of an interval of one second
            psi, force = psi.repeat(2), force.repeat(2, axis=1)
            h = np.tile((1.0, 0.0), h.size)[:-1]
            turned = np.empty((len(columns), h.size))
        x, y, z = np.ascontiguousarray(force)
        bend = -self.scale_factor / 8.0 * h * np.diff(x)
        straight, row = np.zeros((2, h.size)), 0
        if "p" in self.local_names:
            across = straight if bows is None else bows[1:3] - bows[4:6] / self.scale_factor
            coupling_columns(psi, y, z, across, h, bend, 1.0, turned[:2])
            row = 2
        for order in self._orders:
            one = np.ones(psi.size), np.zeros(psi.size)
            coupling_columns(psi, *one, straight, h, bend, float(order), turned[row : row + 2])
            row += 2
        if row < len(columns):
            held = np.empty((len(PHASELESS), h.size))
            servo_columns(psi, x, y, z, h, bend, held)
            turned[row:] = held[[PHASELESS.index(name) for name in self.local_names[row:]]]
        if self.point:
            columns[:] = turned[:, ::2]

    def _fill_shared(self, columns: Array, window: slice, h: Array, bows: Array | None) -> None:
        run = self.run
        samples = dict(zip("xyz", self._force[:, window], strict=True))
        samples["t"] = run.t[window] - self.time_reference
        if run.temperature is not None:
            samples["T"] = run.temperature[window] - self.request.temperature_reference
        if run.vibration is not None:
            samples["v"] = run.vibration[window]
        if self.point:
            for column, name in zip(columns, self.shared_names, strict=True):
                column[:] = product_at(PRODUCTS[name], samples)
            return
        middles = {name: 0.5 * (values[1:] + values[:-1]) for name, values in samples.items()}
        for name, bow in zip("xyz", () if bows is None else bows, strict=False):
            middles[name] += 1.5 * bow
        for column, name in zip(columns, self.shared_names, strict=True):
            product_column(PRODUCTS[name], samples, middles, h, column)

    def _check_bend(self) -> None:
        if not self.turning_names or self.point:
            return
        run, worst, at = self.run, 0.0, 0
        for rows in spans(run.size - 1):
            ends = slice(rows.start, rows.stop + 1)
            bend = np.abs(np.diff(run.f[ends, 0]) * np.diff(run.t[ends]))
            bend[run.begins[ends][1:]] = 0.0
            own = self.scale_factor / 8.0 * float(bend.max())
            if own > worst:
                worst, at = own, ends.start + 1 + int(bend.argmax())
        if worst > _MOST_BEND:
            rate = np.sqrt(worst / _MOST_BEND) / (run.t[at] - run.t[at - 1])
            raise DataError(
                f"row {run.row[at]}: between two samples the output angle bends by {worst:.2g} rad; its "
                "cross-coupling cannot be integrated",
                remedy=f"sample at {rate:.3g} Hz or more",
            )


class MeanDesign(Design):
    """The design of the means of ``every`` neighbouring samples of a record; its ``run`` is the record of the means."""

    def __init__(self, whole: Design, every: int) -> None:
        self.__dict__.update(whole.__dict__ | {"means": self, "_cache": {}})
        self.whole, self.every, run = whole, every, whole.run
        starts = np.union1d(np.flatnonzero(run.begins), [start for start, *_ in whole._ranges])
        lengths = np.diff(np.append(starts, run.size))
        counts = np.maximum(np.rint(lengths / every).astype(np.int64), 1)
        place = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        self.firsts = np.repeat(starts, counts) + (place * np.repeat(lengths / counts, counts)).astype(np.int64)
        self._ranges = [(*self.rows_of(np.array(ends)).tolist(), segment) for *ends, segment in whole._ranges]
        mean = self.means_of
        self.run = replace(
            run,
            t=mean(run.t),
            output=mean(run.output),
            f=mean(run.f),
            base_rate=None if run.base_rate is None else mean(run.base_rate),
            temperature=None if run.temperature is None else mean(run.temperature),
            vibration=None if run.vibration is None else mean(run.vibration),
            segment_index=run.segment_index[self.firsts],
            begins=np.logical_or.reduceat(run.begins, self.firsts),
            row=run.row[self.firsts],
            left_out=None,
        )
        self.phase_angle = mean(whole.phase_angle)

    def means_of(self, values: Array) -> Array:
        """Means of values (n,) or (n, 3) of the samples, one for each row."""
        sizes = np.diff(np.append(self.firsts, self.whole.run.size))
        each = sizes if values.ndim == 1 else sizes[:, None]
        return np.asarray(np.add.reduceat(values, self.firsts, axis=0) / each)

    def blocks(self, *, keep: bool = True) -> Iterator[Block]:
        """As for the record; the rows of the means are always kept."""
        after = np.zeros(len(self.names) + 2)
        whole = enumerate(self.whole.blocks(keep=keep) if not self._cache else ())
        for (index, block), rows in zip(whole, self._ranges, strict=False):
            self._cache[index] = self._mean_block(block, *rows[:2], after)
        yield from self._cache.values()

    def _mean_block(self, block: Block, first: int, stop: int, after: Array) -> Block:
        begin = int(block.start == 1 and not self.point)  # the first sample of a record has no row
        edges = np.clip(np.append(self.firsts[first:stop], block.stop) - block.start, 0, None)
        if self.point:
            count = np.add.reduceat((block.h > 0.0).astype(float), edges[:-1])
            sums = np.add.reduceat(block.columns, edges[:-1], axis=1) / np.sqrt(np.maximum(count, 1.0))
            return Block(first, stop, block.segment, np.where(count > 0.0, 1.0, -1.0), sums)
        out = np.empty((len(after), stop - first))
        mean_rows(block.columns, edges, after[:-1], out[:-1])
        mean_rows(np.maximum(block.h, 0.0)[None], edges, after[-1:], out[-1:])
        out[:, self.run.begins[first:stop]] = 0.0
        return Block(first + begin, stop, block.segment, out[-1, begin:], out[:-1, begin:])

    def rows_of(self, samples: NDArray[np.int64]) -> NDArray[np.int64]:
        """First mean from each sample on."""
        return np.searchsorted(self.firsts, samples)

    def noise_of_rows(self, white: float, walk: float) -> tuple[float, float]:
        """White noise falls by the number of samples. A walk within the means acts like white noise of the other sign."""
        if self.point:
            return white, walk * self.every
        return white / self.every - walk * self.every * self.whole.run.median_step / 6.0, walk


def _ranges(run: Run) -> list[tuple[int, int, int]]:
    """Row ranges of the blocks: within one segment, about ``_CHUNK`` rows; (start, stop, segment).

    No block ends at a sample that is left out, because its interval belongs to the next sample.
    """
    edges = run.segment_edges()
    ranges: list[tuple[int, int, int]] = []
    for left, right in pairwise(edges):
        segment, end = int(run.segment_index[left]), int(right)
        start = int(left)
        while start < end:
            stop = min(start + _CHUNK, end)
            while run.left_out is not None and stop < end and run.left_out[stop - 1]:
                stop += 1
            ranges.append((start, stop, segment))
            start = stop
    return ranges
