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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.compensation.compensator import GAP
from piga.compensation.step import NO_RATES, NONE, Chunk
from piga.errors import DataError
from piga.records.run_file import RunFile
from piga.units import conversion_factor, offset_to_si, to_si

Array = NDArray[np.float64]

CHUNK_ROWS = 1 << 16
"""Rows of a chunk: about 5 MB while it is worked on."""
BLOCK_BYTES = 8 << 20


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
        self._label: str | None = None
        self._visits: Counter[str] = Counter()

    @property
    def kind(self) -> str:
        """``"rate"`` or ``"angle"``."""
        return "rate" if self._kind == "rate" else "angle"

    def columns(self) -> list[str]:
        """Names of the columns read."""
        data = self.run_file.data
        assert data.reference is not None  # noqa: S101 - read_run_file refuses a run file without reference
        names = [data.output.column, *data.reference.columns[1:]]
        names += [data.time.column] if data.time else []
        names += list(data.base_rate.columns) if data.base_rate else []
        names += [data.temperature.column] if data.temperature else []
        return names + ([data.segment] if data.segment else [])

    def pieces(self) -> Iterator[Piece]:
        """The samples in order."""
        for table in self._tables():
            yield from self._convert(table)

    def _tables(self) -> Iterator[Any]:
        suffixes = [suffix.lower() for suffix in self._data_path.suffixes]
        if suffixes[-1:] in ([".parquet"], [".pq"]):
            yield from self._parquet()
        else:
            yield from self._text(compressed=suffixes[-1:] == [".gz"])

    def _parquet(self) -> Iterator[Any]:
        import pyarrow as pa
        from pyarrow import parquet

        try:
            with parquet.ParquetFile(self._data_path, pre_buffer=False, buffer_size=1 << 20) as source:
                self._check_columns(source.schema_arrow.names)
                yield from source.iter_batches(CHUNK_ROWS, columns=self.columns(), use_threads=False)
        except FileNotFoundError:
            raise DataError(
                f"{self._data_path}: no such file", remedy="[data] file is relative to the run file"
            ) from None
        except (pa.ArrowException, OSError) as error:
            raise DataError(
                f"{self._data_path}: {str(error).splitlines()[0]}", remedy="export it again"
            ) from None

    def _text(self, *, compressed: bool) -> Iterator[Any]:
        import pyarrow as pa
        from pyarrow import csv

        from piga.records.text_format import INFINITE, MISSING, SNIFF_BYTES, find_encoding, find_format

        data = self.run_file.data
        with pa.input_stream(str(self._data_path), compression="gzip" if compressed else None) as source:
            raw = bytes(source.read(SNIFF_BYTES))
        encoding = find_encoding(raw, self._data_path, data.encoding)
        head = raw.decode(encoding, errors="ignore")
        head = head[: head.rfind("\n") + 1] if len(raw) == SNIFF_BYTES else head
        form = find_format(head, self._data_path, encoding, data.delimiter, data.decimal)
        self._check_columns(list(form.names))
        types = {name: pa.string() if name == data.segment else pa.float64() for name in self.columns()}
        with pa.input_stream(str(self._data_path), compression="gzip" if compressed else None) as source:
            try:
                yield from csv.open_csv(
                    source,
                    csv.ReadOptions(
                        column_names=list(form.names), skip_rows=form.skip, block_size=BLOCK_BYTES,
                        encoding=encoding,
                    ),
                    csv.ParseOptions(delimiter=form.separator),
                    csv.ConvertOptions(
                        include_columns=list(types), column_types=types, null_values=[*MISSING, *INFINITE],
                        decimal_point=form.decimal,
                    ),
                )  # fmt: skip
            except pa.ArrowInvalid as error:
                reason = str(error).splitlines()[0]
                raise DataError(
                    f"{self._data_path}: about row {self.rows}: {reason}", remedy="repair these rows"
                ) from None

    def _check_columns(self, names: list[str]) -> None:
        for name in self.columns():
            if name not in names:
                raise DataError(
                    f"{self._data_path}: no column '{name}'; the columns are: {', '.join(names)}",
                    remedy="correct the column name in [data]",
                )

    def _convert(self, table: Any) -> Iterator[Piece]:
        data = self.run_file.data
        assert data.reference is not None  # noqa: S101 - see columns
        count = table.num_rows
        t = self._times(table, count)
        reading = _numbers(table, data.output.column, 1.0)
        like = conversion_factor(data.reference.unit, "m/s^2")
        y, z = (_numbers(table, name, like) for name in data.reference.columns[1:])
        omega = NO_RATES
        if data.base_rate is not None:
            like = conversion_factor(data.base_rate.unit, "rad/s")
            omega = np.column_stack([_numbers(table, name, like) for name in data.base_rate.columns])
        warm = NONE
        if data.temperature is not None:
            unit = data.temperature.unit
            warm = _numbers(table, data.temperature.column, conversion_factor(unit, "K")) + offset_to_si(unit)
        self.rows += count
        keep = np.isfinite(t + reading + y + z)
        keep &= np.isfinite(omega).all(axis=1) if omega.size else True
        keep &= np.isfinite(warm) if warm.size else True
        steps = np.diff(t, prepend=self._last_t)
        repeated = keep & (steps == 0.0)
        labels = table.column(data.segment) if data.segment else None
        if repeated.any() or not keep.all():
            self.found["missing-value"] += int(np.count_nonzero(~keep))
            self.found["repeated-time"] += int(np.count_nonzero(repeated))
            keep &= ~repeated
            t, reading, y, z = t[keep], reading[keep], y[keep], z[keep]
            omega, warm = omega[keep] if omega.size else omega, warm[keep] if warm.size else warm
            labels = labels.filter(keep) if labels is not None else None
            steps = np.diff(t, prepend=self._last_t)
        if t.size == 0:
            return
        if self.nominal == 0.0:
            forward = steps[1:][steps[1:] > 0.0]
            self.nominal = float(np.median(forward)) if forward.size else 0.0
        begins = (steps <= 0.0) | (steps > GAP * self.nominal)
        first = not np.isfinite(self._last_t)
        edges, names = self._segments(labels, t.size)
        begins[edges[:-1][np.array([bool(name) for name in names])]] = True
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
            yield Piece(
                self._advance(names, edges, start), chunk, bool(np.any((lost >= start) & (lost < stop)))
            )

    def _times(self, table: Any, count: int) -> Array:
        data = self.run_file.data
        if data.time is None:
            rate = to_si(data.sample_rate or 1.0, "Hz")
            return np.arange(self.rows, self.rows + count) / rate
        return _numbers(table, data.time.column, conversion_factor(data.time.unit, "s"))

    def _segments(self, labels: Any, count: int) -> tuple[NDArray[np.int64], list[str | None]]:
        """Edges of the runs of one label, and the new label where one begins (None: it goes on)."""
        if labels is None:
            new = "all" if self._label is None else None
            self._label = "all"
            return np.array([0, count]), [new]
        encoded = labels.dictionary_encode()
        codes = encoded.indices.to_numpy(zero_copy_only=False)
        words = [str(word) for word in encoded.dictionary.to_pylist()]
        starts = np.concatenate(([0], np.flatnonzero(np.diff(codes)) + 1))
        names: list[str | None] = []
        for start in starts:
            word = words[int(codes[start])]
            names.append(None if word == self._label else word)
            self._label = word
        return np.append(starts, count), names

    def _advance(self, names: list[str | None], edges: NDArray[np.int64], start: int) -> str:
        """Name of the visit that a run belongs to: a label that comes back is ``label#2``."""
        new = names[int(np.searchsorted(edges, start))]
        if new is not None:
            self._visits[new] += 1
            self._current = new if self._visits[new] == 1 else f"{new}#{self._visits[new]}"
        return self._current

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


def _numbers(table: Any, name: str, factor: float) -> Array:
    column = table.column(name)
    values = np.asarray(column.to_numpy(zero_copy_only=False), dtype=float)
    return values if factor == 1.0 else values * factor
