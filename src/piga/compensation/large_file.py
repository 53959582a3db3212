"""Data files of any length, read in chunks: the columns that compensation needs, in SI.

Repairs are those that need no look ahead, and are counted: rows with a missing value are left out, a repeated
time is left out, time that jumps back or leaves a gap begins a new stretch. The nominal interval is the median
of the first chunk. Where the log has no reference, the stand of the run file gives it. What needs the whole file
(conflicting rows, checks against the reference) is done by :func:`piga.read_run`, which reads smaller files.
"""

from __future__ import annotations

import math
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
from piga.records.raw_columns import read_labels
from piga.records.run_file import RunFile
from piga.records.stream import Chunk as RawChunk
from piga.records.stream import open_stream
from piga.records.visits import Visits
from piga.stand.run_reference import FollowedStand, follow_stand
from piga.units import conversion_factor, offset_to_si, parse_unit, to_si

Array = NDArray[np.float64]

STAND_ROWS = 1 << 13
"""Rows that a stand is asked for at a time: it holds some ten columns of them on the way."""


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
        self._last_t, self._first_reading, self._last_reading, self._turned = -np.inf, 0.0, 0.0, 0.0
        self._segment: int | None = None
        self._number: float | None = None
        self._stand: FollowedStand | None = None

    @property
    def kind(self) -> str:
        """``"rate"`` or ``"angle"``."""
        return "rate" if self._kind == "rate" else "angle"

    def pieces(self) -> Iterator[Piece]:
        """The samples in order."""
        stream = open_stream(self.path.parent, self.run_file.data, small=True)
        visits = Visits(stream.label_names)
        self._stand = self._follow_stand()
        for chunk in stream.chunks():
            yield from self._convert(chunk, stream.units, visits)
        for event in stream.events():
            if event.kind != "missing-value":
                self.found[event.kind] += event.count

    def _follow_stand(self) -> FollowedStand | None:
        """The stand that the reference comes from; None where the log has one."""
        data, table = self.run_file.data, self.run_file.stand
        if data.reference is not None or table is None:
            return None
        return follow_stand(self.path, table, lambda: read_labels(self.path.parent, data))

    def _columns(self, raw: RawChunk, units: dict[str, str]) -> dict[str, Array]:
        """The samples in SI, the reading of the output in its own unit; what is not there is empty."""
        data = self.run_file.data
        count = raw.rows.size

        def column(name: str, unit: str, like: str) -> Array:
            _check_unit(self._data_path, name, unit, units.get(name))
            values = _inside(raw.numbers[name], (data.range or {}).get(name))
            factor, offset = conversion_factor(unit, like), offset_to_si(unit) if like == "K" else 0.0
            scaled = values if factor == 1.0 else values * factor
            return scaled if offset == 0.0 else scaled + offset

        found = {"y": np.zeros(count), "z": np.zeros(count), "omega": NO_RATES, "warm": NONE, "number": NONE}
        if data.time is None:
            found["t"] = np.arange(self.rows, self.rows + count) / to_si(data.sample_rate or 1.0, "Hz")
        else:
            found["t"] = column(data.time.column, data.time.unit, "s")
        found["reading"] = _inside(raw.numbers[data.output.column], (data.range or {}).get(data.output.column))
        if data.reference is not None:
            unit, names = data.reference.unit, data.reference.columns
            found["y"], found["z"] = column(names[1], unit, "m/s^2"), column(names[2], unit, "m/s^2")
        if data.base_rate is not None:
            unit = data.base_rate.unit
            found["omega"] = np.column_stack([column(name, unit, "rad/s") for name in data.base_rate.columns])
        if data.temperature is not None:
            found["warm"] = column(data.temperature.column, data.temperature.unit, "K")
        if data.sequence is not None:
            found["number"] = raw.numbers[data.sequence.column]
        self.rows += count
        return found

    def _kept(
        self, found: dict[str, Array], segment: NDArray[np.int32] | None
    ) -> tuple[dict[str, Array], NDArray[np.int32] | None]:
        """Without rows that lack a value or a segment, or repeat a time."""
        keep = np.isfinite(found["t"] + found["reading"] + found["y"] + found["z"])
        keep &= np.isfinite(found["omega"]).all(axis=1) if found["omega"].size else True
        keep &= np.isfinite(found["warm"]) if found["warm"].size else True
        repeated = keep & (np.diff(found["t"], prepend=self._last_t) == 0.0)
        self.found["missing-value"] += int(np.count_nonzero(~keep))
        self.found["repeated-time"] += int(np.count_nonzero(repeated))
        keep &= ~repeated
        keep &= True if segment is None else segment >= 0
        if keep.all():
            return found, segment
        kept = {name: values[keep] if values.size else values for name, values in found.items()}
        return kept, None if segment is None else segment[keep]

    def _is_sound(self, found: dict[str, Array], segment: NDArray[np.int32] | None) -> bool:
        """True when nothing is missing, and time goes on without a gap: then no row needs to be looked at."""
        t = found["t"]
        if t.size < 2 or not 0.0 < t[0] - self._last_t <= GAP * self.nominal:
            return False
        steps = t[1:] - t[:-1]
        goes_on = steps.min() > 0.0 and steps.max() <= GAP * self.nominal
        whole = math.isfinite(sum(float(values.sum()) for name, values in found.items() if name != "number"))
        return bool(goes_on and whole and (segment is None or segment.min() >= 0))

    def _find_begins(self, t: Array) -> NDArray[np.bool_]:
        """Where time jumps back or leaves a gap, against the nominal interval."""
        steps = np.diff(t, prepend=self._last_t)
        if self.nominal == 0.0:
            forward = steps[np.isfinite(steps) & (steps > 0.0)]
            self.nominal = float(np.median(forward)) if forward.size else 0.0
        return np.asarray((steps <= 0.0) | (steps > GAP * self.nominal))

    def _convert(self, raw: RawChunk, units: dict[str, str], visits: Visits) -> Iterator[Piece]:
        segment = None if raw.codes is None else visits.segment(raw.codes, raw.rows)
        found = self._columns(raw, units)
        sound = self._is_sound(found, segment)
        if not sound:
            found, segment = self._kept(found, segment)
        t, y, z, omega, warm = (found[name] for name in ("t", "y", "z", "omega", "warm"))
        if t.size == 0:
            return
        if self._stand is not None:
            y, z, omega = self._felt(self._stand, t, segment, omega)
        begins = np.zeros(t.size, dtype=np.bool_) if sound else self._find_begins(t)
        first = not np.isfinite(self._last_t)
        edges, new = self._segments(segment, t.size)
        begins[edges[:-1][new]] = True
        begins |= self._breaks(found["number"])
        self.found["stretch"] += int(np.count_nonzero(begins))
        output = self._unwrapped(found["reading"])
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

    def _felt(
        self, stand: FollowedStand, t: Array, segment: NDArray[np.int32] | None, logged: Array
    ) -> tuple[Array, Array, Array]:
        """Transverse force and base rate on the stand; a base rate that is logged goes before."""
        segment = np.zeros(t.size, dtype=np.int32) if segment is None else segment
        y, z, omega = np.empty(t.size), np.empty(t.size), np.empty((t.size, 3))
        for start in range(0, t.size, STAND_ROWS):
            part = slice(start, start + STAND_ROWS)
            force, omega[part] = stand.motion(t[part], segment[part])
            y[part], z[part] = force[:, 1], force[:, 2]
        return y, z, omega if self.run_file.data.base_rate is None else logged

    def _breaks(self, number: Array) -> NDArray[np.bool_]:
        """Where the sequence number does not follow the one before."""
        sequence = self.run_file.data.sequence
        if sequence is None:
            return np.zeros(1, dtype=np.bool_)
        steps = np.diff(number, prepend=number[0] - 1.0 if self._number is None else self._number)
        self._number = float(number[-1])
        return np.asarray((steps if sequence.wraps_at is None else np.mod(steps, sequence.wraps_at)) != 1.0)

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
            return reading if self._factor == 1.0 else reading * self._factor
        if not np.isfinite(self._last_t):
            self._first_reading = self._last_reading = float(reading[0])
        steps = np.diff(reading, prepend=self._last_reading)
        folded = steps - self._span * np.round(steps / self._span)
        folded[0] += self._turned
        turned = np.cumsum(folded)
        self._last_reading, self._turned = float(reading[-1]), float(turned[-1])
        return (self._first_reading + turned) * self._factor


def _inside(values: Array, limits: tuple[float, float] | None) -> Array:
    """Values at the limits of their range, or beyond, are missing: the column may be saturated there."""
    if limits is None:
        return values
    return np.where((values > limits[0]) & (values < limits[1]), values, np.nan)


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
