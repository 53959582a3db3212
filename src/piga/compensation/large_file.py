"""Data files of any length, read in chunks: the columns that compensation needs, in SI.

Repairs are those that need no look ahead, and are counted: rows with a missing value are left out, a repeated
time is left out, time that jumps back or leaves a gap begins a new stretch. The nominal interval is the median
of the first chunk. What needs the whole file (conflicting rows, checks against the reference) is done by
:func:`piga.read_run`, which reads smaller files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.compensation.compensator import GAP
from piga.compensation.step import NO_RATES, NONE, Chunk
from piga.errors import DataError
from piga.records.run_file import RunFile
from piga.records.stream import Chunk as RawChunk
from piga.records.stream import open_stream
from piga.records.visits import Visits
from piga.units import conversion_factor, offset_to_si, parse_unit, to_si

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Piece:
    """Samples of one segment that follow each other in the file; ``lost``: the phase was lost before them."""

    label: str
    chunk: Chunk
    lost: bool


@dataclass
class LargeFile:
    """A data file as described by its run file, read piece by piece; ``found`` counts repairs by kind."""

    path: Path
    run_file: RunFile
    found: Counter[str] = field(default_factory=Counter)
    rows: int = 0
    nominal: float = 0.0

    def __post_init__(self) -> None:
        data, instrument = self.run_file.data, self.run_file.instrument
        self._data_path = self.path.parent / data.file
        self._kind = data.output.kind
        self._span, self._factor, self._keeps_phase = None, 1.0, True
        if self._kind == "counts":
            revolution = float(instrument.counts_per_revolution or 1.0)
            self._factor = 2.0 * np.pi / revolution
            if instrument.counter_bits is not None:
                self._span = 2.0**instrument.counter_bits
                self._keeps_phase = self._span % revolution == 0.0
        else:
            like = "rad" if self._kind == "angle" else "rad/s"
            self._factor = conversion_factor(data.output.unit or "", like)
            if data.output.wraps_at is not None:
                self._span = to_si(data.output.wraps_at, "rad") / self._factor
                turns = self._span * self._factor / (2.0 * np.pi)
                self._keeps_phase = abs(turns - np.rint(turns)) < 1e-12
        self._last_t, self._last_reading, self._value = -np.inf, 0.0, 0.0
        self._segment: int | None = None

    @property
    def kind(self) -> str:
        """``"rate"`` or ``"angle"``."""
        return "rate" if self._kind == "rate" else "angle"

    def pieces(self) -> Iterator[Piece]:
        """The samples in order."""
        stream = open_stream(self.path.parent, self.run_file.data)
        visits = Visits(stream.label_names)
        for chunk in stream.chunks():
            yield from self._convert(chunk, stream.units, visits)
        for event in stream.events():
            if event.kind != "missing-value":
                self.found[event.kind] += event.count

    def _convert(self, raw: RawChunk, units: dict[str, str], visits: Visits) -> Iterator[Piece]:
        data = self.run_file.data
        count = raw.rows.size

        def column(name: str, unit: str, like: str) -> Array:
            _check_unit(self._data_path, name, unit, units.get(name))
            values = _inside(raw.numbers[name], (data.range or {}).get(name))
            return np.asarray(
                values * conversion_factor(unit, like) + (offset_to_si(unit) if like == "K" else 0.0)
            )

        if data.time is None:
            t = np.arange(self.rows, self.rows + count) / to_si(data.sample_rate or 1.0, "Hz")
        else:
            t = column(data.time.column, data.time.unit, "s")
        reading = _inside(raw.numbers[data.output.column], (data.range or {}).get(data.output.column))
        names = data.reference.columns[1:] if data.reference else ()
        force = [column(name, data.reference.unit, "m/s^2") for name in names if data.reference]
        y, z = force if force else (np.zeros(count), np.zeros(count))
        omega, warm = NO_RATES, NONE
        if data.base_rate is not None:
            unit = data.base_rate.unit
            omega = np.column_stack([column(name, unit, "rad/s") for name in data.base_rate.columns])
        if data.temperature is not None:
            warm = column(data.temperature.column, data.temperature.unit, "K")
        self.rows += count
        keep = np.isfinite(t + reading + y + z)
        keep &= np.isfinite(omega).all(axis=1) if omega.size else True
        keep &= np.isfinite(warm) if warm.size else True
        steps = np.diff(t, prepend=self._last_t)
        repeated = keep & (steps == 0.0)
        segment = None if raw.codes is None else visits.segment(raw.codes, raw.rows)
        keep &= True if segment is None else segment >= 0
        if repeated.any() or not keep.all():
            self.found["missing-value"] += int(np.count_nonzero(~keep))
            self.found["repeated-time"] += int(np.count_nonzero(repeated))
            keep &= ~repeated
            t, reading, y, z = t[keep], reading[keep], y[keep], z[keep]
            omega, warm = omega[keep] if omega.size else omega, warm[keep] if warm.size else warm
            segment = None if segment is None else segment[keep]
            steps = np.diff(t, prepend=self._last_t)
        if t.size == 0:
            return
        if self.nominal == 0.0:
            forward = steps[1:][steps[1:] > 0.0]
            self.nominal = float(np.median(forward)) if forward.size else 0.0
        begins = (steps <= 0.0) | (steps > GAP * self.nominal)
        first = not np.isfinite(self._last_t)
        edges, new = self._segments(segment, t.size)
        begins[edges[:-1][new]] = True
        self.found["stretch"] += int(np.count_nonzero(begins))
        output = self._unwrapped(reading)
        self._last_t = float(t[-1])
        lost = (
            np.flatnonzero(begins)
            if self._span is not None and not self._keeps_phase
            else np.zeros(0, np.int64)
        )
        lost = lost[lost > 0] if first else lost
        for start, stop in pairwise(edges):
            rows = slice(int(start), int(stop))
            chunk = Chunk(
                t[rows], output[rows], y[rows], z[rows], begins[rows], omega[rows], warm[rows], NONE
            )  # fmt: skip
            label = "all" if segment is None else visits.names[int(segment[start])]
            yield Piece(label, chunk, bool(np.any((lost >= start) & (lost < stop))))

    def _segments(
        self, segment: NDArray[np.int32] | None, count: int
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Edges of the parts in one segment, and whether each part begins one."""
        if segment is None:
            first, self._segment = self._segment is None, 0
            return np.array([0, count]), np.array([first])
        starts = np.concatenate(([0], np.flatnonzero(np.diff(segment)) + 1))
        new = np.ones(starts.size, dtype=np.bool_)
        new[0] = self._segment != int(segment[0])
        self._segment = int(segment[-1])
        return np.append(starts, count), new

    def _unwrapped(self, reading: Array) -> Array:
        """Output in SI; a folded reading is unwrapped by the nearest turn, counted in its own unit."""
        if self._span is None:
            return reading * self._factor
        if not np.isfinite(self._last_t):
            self._last_reading = self._value = float(reading[0])
        steps = np.diff(reading, prepend=self._last_reading)
        folded = steps - self._span * np.round(steps / self._span)
        values = self._value + np.cumsum(folded)
        self._last_reading, self._value = float(reading[-1]), float(values[-1])
        return values * self._factor


def _inside(values: Array, limits: tuple[float, float] | None) -> Array:
    """Values outside of their range are missing."""
    if limits is None:
        return values
    return np.where((values >= limits[0]) & (values <= limits[1]), values, np.nan)


def _check_unit(path: Path, column: str, declared: str, found: str | None) -> None:
    """Compare the declared unit with the one in the data file where it has one."""
    if found is None:
        return
    known, wanted = parse_unit(found), parse_unit(declared)
    if known.dimension != wanted.dimension or known.factor != wanted.factor:
        raise DataError(
            f"{path}: column '{column}' is in '{found}' there, but in '{declared}' in the run file",
            remedy="correct the one that is wrong",
        )
