"""Read a run file and its data file into a run in SI. Every fault met is counted.

The record is processed in blocks, so a record on disk needs no more memory than one in memory.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, RunFileError
from piga.formats.columns import RecordStream
from piga.output import settle
from piga.reading.raw_columns import RawColumns, collect, read_columns, split_lost
from piga.reading.signal_checks import (
    Extremes,
    OutputScale,
    Reading,
    beyond_limits,
    largest_size,
    left_out_rows,
    mistaken_rate,
    mistaken_unit,
    sampled,
    sequence_breaks,
    stopped_output,
    stuck_extremes,
)
from piga.records.calibration import Event, Quality, Tally
from piga.records.run import Run, TimeBase, drop_repeats, examine_time
from piga.records.run_file import RunFile, read_run_file
from piga.records.spool import gathered, scaled, scaled_rows, spans
from piga.records.text_files import toml_bytes
from piga.results import Array
from piga.units import conversion_factor, offset_to_si, parse_unit, to_si

StandReference = Callable[
    [dict[str, Any], Path, Array, NDArray[np.int32], tuple[str, ...]], tuple[Array, Array]
]
"""Specific force and base rate of a ``[stand]`` table: (table, folder, t, segment, labels) to (n, 3) each."""


WHOLE = 1e-9
"""Tolerance [rev] of the test for whole turns. A range in units such as mrad is never exactly whole."""


def _whole_turns(span: float, revolution: float) -> bool:
    """True if ``span`` is a whole number of turns. A reading that rolls over there keeps its phase."""
    turns = span / revolution
    return abs(turns - round(turns)) <= WHOLE


@dataclass
class Assembly:
    """Assembles a run from the columns of one data file. ``rows_read`` counts its rows, ``events`` the faults so far."""

    run_file: RunFile
    raw: RawColumns
    stand_reference: StandReference

    def __post_init__(self) -> None:
        self.rows_read = self.raw.count
        self.events = self.raw.events

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")
    def run(self, path: Path) -> Run:
        """Assemble the run. ``path`` is the run file."""
        t = self._used_rows()
        raw, arrays = self.raw, self.raw.arrays
        base = examine_time(t, raw.segment, raw.rows, arrays)
        self.events += base.events
        self._check_enough(base, path)
        sequence = self.run_file.data.sequence
        if sequence is not None:
            number = raw.numbers[sequence.column]
            self.events += sequence_breaks(number, sequence.wraps_at, base.begins, raw.rows)
        f, base_rate = self._reference(path, t)
        a_x = f[:, 0]
        largest = 1.2 * self._scale_factor * largest_size(a_x) * base.nominal
        scale = self._scale()
        output, lost = self._output(base, scale, largest)
        self._reset_between(t, output, base, f, lost)
        resolution = scale.factor if scale.counts else 0.0
        self._check_plausible(t, output, f, base, resolution)
        segment, labels, groups, events = split_lost(raw.segment, raw.labels, lost, raw.rows, arrays)
        self.events += events
        used = raw.count
        return Run(
            serial=self.run_file.instrument.serial,
            scale_factor=self._scale_factor,
            kind="rate" if self.run_file.data.output.kind == "rate" else "angle",
            t=t,
            output=output,
            f=f,
            base_rate=base_rate,
            temperature=self._temperature(),
            segment_index=segment,
            labels=labels,
            begins=base.begins,
            phase_group=groups,
            row=raw.rows,
            resolution=resolution,
            quality=Quality(self.rows_read, used, self.rows_read - used, tuple(self.events)),
            model=self.run_file.model,
            estimation=self.run_file.estimation,
            uncertainty=self.run_file.uncertainty,
            stand=self.run_file.stand,
            servo=() if self.run_file.instrument.servo is None else self.run_file.instrument.servo.parameters(),
            source=str(path),
        )

    @property
    def _scale_factor(self) -> float:
        return to_si(self.run_file.instrument.scale_factor, "rad/s/g")

    def _used_rows(self) -> Array:
        """Leave out the rows that cannot be used. Returns the time [s] of the others."""
        raw = self.raw
        usable = raw.arrays.empty(raw.count, np.bool_)
        for part in spans(raw.count):
            usable[part] = raw.segment[part] >= 0
        limits = self.run_file.data.range or {}
        with ThreadPoolExecutor(2) as pool:
            extremes = list(pool.map(Extremes.of, raw.numbers.values()))
            for extreme in extremes:
                extreme.mask(usable)
            self._check_masked(usable)
            declared = [limits.get(name, (-np.inf, np.inf)) for name in raw.numbers]
            stuck = pool.map(
                stuck_extremes,
                raw.numbers,
                raw.numbers.values(),
                extremes,
                repeat(raw.rows),
                repeat(raw.segment),
                declared,
            )
            self.events += chain.from_iterable(stuck)
        if limits:
            self.events += beyond_limits(raw.numbers, limits, usable, raw.rows)
            self._check_masked(usable)
        if self.run_file.data.leave_out:
            self.events += left_out_rows(self.run_file.data.leave_out, usable, raw.rows, raw.path)
            self._check_masked(usable)
        t = self._time()
        self.events += drop_repeats(t, raw.segment, usable, list(raw.numbers.values()), raw.rows)
        if usable.all():
            return t
        raw.numbers = {name: self._kept(values, usable) for name, values in raw.numbers.items()}
        raw.rows, raw.segment = self._kept(raw.rows, usable), self._kept(raw.segment, usable)
        return self._kept(t, usable)

    def _kept(self, values: NDArray[Any], usable: NDArray[np.bool_]) -> NDArray[Any]:
        kept = self.raw.arrays.growing(values.dtype)
        for part in spans(values.size):
            kept.append(values[part][usable[part]])
        return kept.finish()

    def _check_masked(self, usable: NDArray[np.bool_]) -> None:
        bad = usable.size - int(np.count_nonzero(usable))
        if bad == usable.size:
            raise DataError(
                f"{self.raw.path}: no row has all needed values", remedy="check the columns in [data]"
            )
        reasons = ("missing-value", "saturated", "no-segment", "not-finite", "left-out")
        if bad and not any(event.kind in reasons for event in self.events):
            row = int(self.raw.rows[int(np.argmin(usable))])
            self.events.append(Event("not-finite", bad, row, "the row is not used"))

    def _time(self) -> Array:
        data, raw = self.run_file.data, self.raw
        if data.time is not None and data.time.unit is None:
            return raw.numbers[data.time.column]  # time stamps are in seconds already
        if data.time is not None and data.time.unit is not None:
            return self._scaled(
                data.time.column, conversion_factor(self._unit(data.time.column, data.time.unit), "s")
            )
        assert data.sample_rate is not None  # noqa: S101 - read_run_file wants one of the two
        rate = to_si(data.sample_rate, "Hz")
        t: Array = raw.arrays.empty(raw.count)
        for part in spans(raw.count):
            t[part] = np.arange(part.start, part.stop) / rate
        return t

    def _scaled(self, name: str, factor: float, offset: float = 0.0) -> Array:
        """A column times a factor, plus an offset."""
        values = self.raw.numbers[name]
        return values if (factor, offset) == (1.0, 0.0) else scaled(values, factor, offset, self.raw.arrays)

    def _check_enough(self, base: TimeBase, path: Path) -> None:
        time = self.run_file.data.time
        repeated = sum(event.count for event in self.events if event.kind == "conflicting-row")
        few = self.raw.count < 2 or base.nominal <= 0.0
        if few and time is not None and 2 * repeated > self.rows_read:
            raise DataError(
                f"{self.raw.path}: column '{time.column}' repeats itself in most rows: its times are rounded, or it is "
                "not the time",
                remedy="if they are rounded, give [data] sample_rate = '... Hz' in place of time; otherwise name the "
                "column of the time",
            )
        if few:
            raise DataError(
                f"{self.raw.path}: fewer than two usable rows with increasing time", remedy=f"check {path}"
            )

    def _unit(self, column: str, declared: str) -> str:
        """The declared unit, checked against the unit in the data file, if that has one."""
        logged = self.raw.units.get(column)
        if logged is not None:
            known, wanted = parse_unit(logged), parse_unit(declared)
            if known.dimension != wanted.dimension or known.factor != wanted.factor:
                raise DataError(
                    f"{self.raw.path}: column '{column}' has the unit '{logged}' in the file, but '{declared}' in "
                    "the run file",
                    remedy="correct the one that is wrong",
                )
        return declared

    def _reference(self, path: Path, t: Array) -> tuple[Array, Array | None]:
        """Specific force and base rate from the columns; without such columns from the stand."""
        data, stand = self.run_file.data, self.run_file.stand
        f, base_rate = self._group(data.reference, "m/s^2"), self._group(data.base_rate, "rad/s")
        if f is None and stand is not None:
            f, stand_rate = self.stand_reference(stand, path.parent, t, self.raw.segment, self.raw.labels)
            base_rate = stand_rate if base_rate is None else base_rate
        return np.full((t.size, 3), np.nan) if f is None else f, base_rate

    def _group(self, group: Any, unit: str) -> Array | None:
        """Three columns as an array (n, 3); each column is contiguous."""
        if group is None:
            return None
        for name in group.columns:
            self._unit(name, group.unit)
        factor = conversion_factor(group.unit, unit)
        return scaled_rows([self.raw.numbers[name] for name in group.columns], factor).T

    def _temperature(self) -> Array | None:
        column = self.run_file.data.temperature
        if column is None:
            return None
        unit = self._unit(column.column, column.unit)
        return self._scaled(column.column, parse_unit(unit).factor, offset_to_si(unit))

    def _scale(self) -> OutputScale:
        """Conversion of the logged output to SI."""
        instrument, output = self.run_file.instrument, self.run_file.data.output
        if output.kind == "rate":
            return OutputScale(conversion_factor(self._unit(output.column, str(output.unit)), "rad/s"))
        if output.kind == "angle":
            factor = conversion_factor(self._unit(output.column, str(output.unit)), "rad")
            span = None if output.wraps_at is None else to_si(output.wraps_at, "rad") / factor
            return OutputScale(factor, span, span is None or _whole_turns(span, 2.0 * np.pi / factor))
        revolution = float(instrument.counts_per_revolution or 0.0)
        span = None if instrument.counter_bits is None else 2.0**instrument.counter_bits
        return OutputScale(
            2.0 * np.pi / revolution, span, span is None or _whole_turns(span, revolution), counts=True
        )

    def _output(self, base: TimeBase, scale: OutputScale, largest: float) -> tuple[Array, NDArray[np.bool_]]:
        """Output in SI, and the samples at which the number of turns was lost."""
        name, raw = self.run_file.data.output.column, self.raw
        if self.run_file.data.output.kind == "rate":
            return self._scaled(name, scale.factor), raw.arrays.zeros(raw.count, np.bool_)
        reading = Reading(
            raw.path, name, raw.numbers[name], raw.rows, base.begins, largest, base.nominal, scale
        )
        output, lost, events = reading.output(raw.arrays)
        self.events += events
        return output, lost

    def _reset_between(self, t: Array, psi: Array, base: TimeBase, f: Array, lost: NDArray[np.bool_]) -> None:
        """Stretches whose first count cannot follow from the reading before. Their phase is lost.

        Between segments the case may also have been turned once about the input axis.
        """
        segment, bits = self.raw.segment, self.run_file.instrument.counter_bits
        if self.run_file.data.output.kind != "counts" or bits is not None or np.count_nonzero(base.begins) < 2:
            return
        force = np.sqrt(max(float(np.einsum("ij,ij->i", f[part], f[part]).max()) for part in spans(t.size)))
        reset = Tally()
        for part in spans(t.size):
            at = part.start + np.flatnonzero(base.begins[part])
            at = at[at > 0]
            interval = t[at] - t[at - 1]
            slack = np.where(segment[at] == segment[at - 1], 0.2, 7.0)
            allowed = (1.5 * self._scale_factor * force + 1e-3) * interval + slack
            gone = at[(interval > 0.0) & (np.abs(psi[at] - psi[at - 1]) > allowed)]
            reset.see(gone)
            lost[gone] = True
        self.events += reset.events("counter-reset", self.raw.rows, "between two stretches; the phase is new")

    def _check_plausible(self, t: Array, output: Array, f: Array, base: TimeBase, resolution: float) -> None:
        """Report units that are probably wrong and an output that does not turn. Nothing is changed."""
        first, some = int(self.raw.rows[0]), sampled(t.size)
        if self.run_file.data.reference is not None:
            self.events += mistaken_unit(gathered(f, some), t.size, first)
        if self.run_file.data.output.kind == "rate":
            wanted, logged_rate = gathered(f[:, 0], some), gathered(output, some)
            self.events += mistaken_rate(wanted, logged_rate, self._scale_factor, t.size, first)
            return
        at = some[~base.begins[some]]
        turned, passed = (gathered(values, at) - gathered(values, at - 1) for values in (output, t))
        rate = turned / passed
        inside = t.size - int(np.count_nonzero(base.begins))
        self.events += mistaken_rate(gathered(f[:, 0], at), rate, self._scale_factor, inside, first)
        per_step = self._scale_factor / (resolution or 1e-3)
        self.events += stopped_output(output, t, base.begins, f[:, 0], per_step, self.raw.rows)


def read_record(
    path: str | Path,
    stand_reference: StandReference,
    *,
    need_reference: bool = True,
    held: int | None = None,
    content: bytes | None = None,
) -> Run:
    """Read a recorded test: :func:`piga.read_run`, which calls this with the stands of piga.

    ``stand_reference`` computes the reference if ``[data]`` has none and a ``[stand]`` table describes it. The arrays of a
    record with more than ``held`` rows lie in unnamed files beside it, mapped into memory. The resident memory is bounded
    for any length of the record.
    """
    path = Path(path)
    settle(path.parent)
    content = toml_bytes(path) if content is None else content
    run_file = read_run_file(path, content)
    if need_reference:
        _check_reference(path, run_file)
    raw = read_columns(path.parent, run_file.data, held)
    run = Assembly(run_file, raw, stand_reference).run(path)
    run.input_sha256.update({path.name: hashlib.sha256(content).hexdigest()} | raw.inputs)
    return run


def read_stream(path: Path, run_file: RunFile, stream: RecordStream, stand_reference: StandReference) -> Run:
    """A run from a stream of rows in memory. ``path`` names the stream in messages, and is the source of the run.

    Raises
    ------
    RunFileError, DataError
        As :func:`read_record`.
    """
    _check_reference(path, run_file)
    raw = collect(path, run_file.data, stream, stream.expected_rows + 1)
    return Assembly(run_file, raw, stand_reference).run(path)


def _check_reference(path: Path, run_file: RunFile) -> None:
    if run_file.data.reference is None and run_file.stand is None:
        raise RunFileError(
            f"{path}: [data] reference is missing: the specific force that the instrument felt",
            remedy="add reference = { columns = ['fx', 'fy', 'fz'], unit = 'g' }, or a [stand] table",
        )
