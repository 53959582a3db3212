"""Read a run: run file and data file to a :class:`~piga.records.run.Run`, everything found counted."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, RunFileError
from piga.records.calibration import Event, Quality
from piga.records.counter import unwrap
from piga.records.run import Run
from piga.records.run_file import RunFile, read_run_file
from piga.records.signal_checks import (
    beyond_limits,
    mistaken_rate,
    mistaken_unit,
    resets_inside,
    sequence_breaks,
    stopped_output,
    stuck_extremes,
)
from piga.records.stream import open_stream
from piga.records.table import RawTable
from piga.records.time_base import TimeBase, examine_time
from piga.units import conversion_factor, offset_to_si, parse_unit, to_si

Array = NDArray[np.float64]

MAX_SEGMENTS = 100_000


StandReference = Callable[
    [dict[str, Any], Path, Array, NDArray[np.int32], tuple[str, ...]], tuple[Array, Array]
]
"""Specific force and base rate of a ``[stand]`` table: (table, folder, t, segment, labels) to (n, 3) each."""


def read_record(path: str | Path, stand_reference: StandReference, *, need_reference: bool = True) -> Run:
    """Read a recorded test; :func:`piga.read_run` is this with the stands of piga.

    Parameters
    ----------
    path:
        Run file (TOML), see ``interface.md``; its data file is looked for beside it.
    stand_reference:
        Gives the reference when ``[data]`` has none and a ``[stand]`` table describes it.
    need_reference:
        False: a record without any reference is read too (its ``f`` is nan); a set of instruments needs none.

    Raises
    ------
    RunFileError
        If the run file is not valid.
    DataError
        If the data file does not hold what the run file says; with file, row, column and remedy.
    """
    path = Path(path)
    run_file = read_run_file(path)
    if need_reference and run_file.data.reference is None and run_file.stand is None:
        raise RunFileError(
            f"{path}: [data] reference is missing: the specific force that the instrument felt",
            remedy="add reference = { columns = ['fx', 'fy', 'fz'], unit = 'g' }, or a [stand] table",
        )
    data_path = path.parent / run_file.data.file
    digest = _sha256(data_path)
    _check_sidecar(data_path, digest)
    table = _read_table(data_path, run_file)
    run = _Assembly(run_file, table, stand_reference).run(path)
    if _sha256(data_path) != digest:
        raise DataError(
            f"{data_path}: the file changed while it was read", remedy="stop the logger, then try again"
        )
    run.input_sha256.update({path.name: _sha256(path), data_path.name: digest})
    return run


def _sha256(path: Path) -> str:
    if path.exists() and not path.is_file():
        raise DataError(f"{path}: is no regular file", remedy="name the data file in [data] file")
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise DataError(
            f"{path}: cannot be read ({error.strerror})", remedy="[data] file is relative to the run file"
        ) from None


def _check_sidecar(path: Path, digest: str) -> None:
    """Compare with ``FILE.sha256`` where the logger wrote one."""
    sidecar = path.with_name(path.name + ".sha256")
    if not sidecar.is_file():
        return
    words = sidecar.read_bytes()[:4096].decode("ascii", errors="replace").split()
    if not words or words[0].lower() != digest:
        raise DataError(
            f"{path}: its SHA-256 is not the one in {sidecar.name}",
            remedy="the file was damaged or changed: copy it again",
        )


def _read_table(path: Path, run_file: RunFile) -> RawTable:
    stream = open_stream(path.parent, run_file.data)
    chunks = list(stream.chunks())
    numbers = {name: np.concatenate([chunk.numbers[name] for chunk in chunks]) for name in chunks[0].numbers}
    rows = np.concatenate([chunk.rows for chunk in chunks])
    labels = {}
    if run_file.data.segment is not None:
        codes = np.concatenate([chunk.codes for chunk in chunks if chunk.codes is not None])
        labels[run_file.data.segment] = (codes, tuple(stream.label_names))
    return RawTable(path, numbers, labels, rows.size, 1, stream.units, tuple(stream.events()), rows)


@dataclass
class _Assembly:
    """From a raw table to a run in SI, step by step."""

    run_file: RunFile
    table: RawTable
    stand_reference: StandReference

    def run(self, path: Path) -> Run:
        data, table = self.run_file.data, self.table
        events = list(table.events)
        rows = table.file_rows()
        segment, labels = self._segments(events)
        columns = {name: table.numbers[name] for name in table.numbers}
        usable = np.isfinite(np.column_stack([columns[name] for name in columns])).all(axis=1) & (segment >= 0)
        self._check_masked(usable, events, rows)
        events += stuck_extremes(columns, rows)
        saturated, found = beyond_limits(columns, data.range or {}, rows)
        events += found
        usable &= ~saturated
        self._check_masked(usable, events, rows)
        t = self._time(rows)
        others = [np.asarray(column, dtype=float) for column in columns.values()]
        base = examine_time(t, segment, usable, others, rows)
        events += base.events
        base = self._with_sequence(base, rows, events)
        keep = base.keep
        self._check_enough(base, path)
        f, base_rate = self._reference(path, t[keep], segment[keep], labels, keep)
        output, lost, resolution = self._output(keep, base, f[:, 0], rows[keep], events)
        lost = lost | self._reset_between(t[keep], output, base, f, segment[keep], rows[keep], events)
        self._check_plausible(t[keep], output, f, base, resolution, rows[keep], events)
        segment, labels, groups = _split_lost(segment[keep], labels, lost, events, rows[keep])
        return Run(
            serial=self.run_file.instrument.serial,
            scale_factor=to_si(self.run_file.instrument.scale_factor, "rad/s/g"),
            kind="rate" if data.output.kind == "rate" else "angle",
            t=t[keep],
            output=output,
            f=f,
            base_rate=base_rate,
            temperature=self._temperature(keep),
            segment=segment,
            labels=labels,
            begins=base.begins,
            phase_group=groups,
            row=rows[keep],
            resolution=resolution,
            quality=Quality(table.rows, int(keep.sum()), int(table.rows - keep.sum()), tuple(events)),
            model=self.run_file.model,
            estimation=self.run_file.estimation,
            uncertainty=self.run_file.uncertainty,
            stand=self.run_file.stand,
            source=str(path),
        )

    def _reference(
        self, path: Path, t: Array, segment: NDArray[np.int32], labels: tuple[str, ...], keep: NDArray[np.bool_]
    ) -> tuple[Array, Array | None]:
        """Specific force and base rate from the columns, or from the stand where there are none."""
        data = self.run_file.data
        f, base_rate = self._group(data.reference, "m/s^2", keep), self._group(data.base_rate, "rad/s", keep)
        if f is None and self.run_file.stand is not None:
            f, stand_rate = self.stand_reference(self.run_file.stand, path.parent, t, segment, labels)
            base_rate = stand_rate if base_rate is None else base_rate
        return np.full((t.size, 3), np.nan) if f is None else f, base_rate

    def _segments(self, events: list[Event]) -> tuple[NDArray[np.int32], tuple[str, ...]]:
        name = self.run_file.data.segment
        if name is None:
            return np.zeros(self.table.rows, np.int32), ("all",)
        codes, labels = self.table.labels[name]
        if len(labels) > MAX_SEGMENTS:
            raise DataError(
                f"{self.table.path}: column '{name}' has {len(labels)} different segments",
                remedy="name the column that numbers the positions",
            )
        return _renumber_visits(codes, labels, events, self.table.file_rows())

    def _check_masked(self, usable: NDArray[np.bool_], events: list[Event], rows: NDArray[np.int64]) -> None:
        if not usable.any():
            raise DataError(
                f"{self.table.path}: no row has all needed values", remedy="check the columns in [data]"
            )
        listed = sum(event.count for event in events if event.kind == "missing-value")
        listed += sum(
            event.count for event in events if event.kind in ("saturated", "no-segment", "not-finite")
        )
        bad = int((~usable).sum())
        if bad and not listed:
            events.append(Event("not-finite", bad, int(rows[np.argmin(usable)]), "the row is not used"))

    def _with_sequence(self, base: TimeBase, rows: NDArray[np.int64], events: list[Event]) -> TimeBase:
        """The time base with a new stretch wherever the sample number does not follow."""
        column = self.run_file.data.sequence
        if column is None:
            return base
        number = self.table.numbers[column.column][base.keep]
        breaks, found = sequence_breaks(number, column.wraps_at, rows[base.keep])
        events += found
        return replace(base, begins=base.begins | breaks)

    def _time(self, rows: NDArray[np.int64]) -> Array:
        data = self.run_file.data
        if data.time is None:
            assert data.sample_rate is not None  # noqa: S101 - read_run_file wants one of the two
            return np.arange(rows.size) / to_si(data.sample_rate, "Hz")
        unit = self._unit(data.time.column, data.time.unit)
        return np.asarray(self.table.numbers[data.time.column], dtype=float) * conversion_factor(unit, "s")

    def _check_enough(self, base: TimeBase, path: Path) -> None:
        if base.keep.sum() < 2 or base.nominal <= 0.0:
            raise DataError(
                f"{self.table.path}: fewer than two usable rows with increasing time", remedy=f"check {path}"
            )

    def _unit(self, column: str, declared: str) -> str:
        """The declared unit, checked against the one in the data file where it has one."""
        found = self.table.units.get(column)
        if found is not None:
            known, wanted = parse_unit(found), parse_unit(declared)
            if known.dimension != wanted.dimension or known.factor != wanted.factor:
                raise DataError(
                    f"{self.table.path}: column '{column}' is in '{found}' there, but in '{declared}' in the run file",
                    remedy="correct the one that is wrong",
                )
        return declared

    def _group(self, group: Any, unit: str, keep: NDArray[np.bool_]) -> Array | None:
        if group is None:
            return None
        result = np.empty((int(keep.sum()), 3))
        for axis, name in enumerate(group.columns):
            factor = conversion_factor(self._unit(name, group.unit), unit)
            result[:, axis] = self.table.numbers[name][keep]
            result[:, axis] *= factor
        return result

    def _temperature(self, keep: NDArray[np.bool_]) -> Array | None:
        column = self.run_file.data.temperature
        if column is None:
            return None
        unit = self._unit(column.column, column.unit)
        values = np.asarray(self.table.numbers[column.column][keep], dtype=float)
        return values * parse_unit(unit).factor + offset_to_si(unit)

    def _output(
        self, keep: NDArray[np.bool_], base: TimeBase, a_x: Array, rows: NDArray[np.int64], events: list[Event]
    ) -> tuple[Array, NDArray[np.bool_], float]:
        """Output in SI, samples where the whole turns were lost, and the angle of one count [rad]."""
        instrument, output = self.run_file.instrument, self.run_file.data.output
        reading = np.asarray(self.table.numbers[output.column][keep], dtype=float)
        nothing = np.zeros(reading.size, dtype=bool)
        if output.kind == "rate":
            return (
                reading * conversion_factor(self._unit(output.column, str(output.unit)), "rad/s"),
                nothing,
                0.0,
            )
        if output.kind == "angle":
            factor = conversion_factor(self._unit(output.column, str(output.unit)), "rad")
            span = None if output.wraps_at is None else to_si(output.wraps_at, "rad") / factor
            revolution = 2.0 * np.pi / factor
        else:
            self._check_counts(reading, rows)
            revolution = float(instrument.counts_per_revolution or 0.0)
            factor = 2.0 * np.pi / revolution
            span = None if instrument.counter_bits is None else 2.0**instrument.counter_bits
        resolution = factor if output.kind == "counts" else 0.0
        if span is None:
            self._check_unwrapped(reading * factor, base, a_x, rows)
            self._check_resets(reading, span, factor, base, a_x, rows)
            return reading * factor, nothing, resolution
        self._check_span(reading, span, factor, base, a_x, rows)
        found = unwrap(reading, span, base.begins)
        if found.wraps:
            events.append(Event("counter-roll-over", found.wraps, None, "unwrapped"))
        self._check_resets(reading, span, factor, base, a_x, rows)
        self._check_unwrapped(found.value * factor, base, a_x, rows)
        keeps_phase = span % revolution == 0.0
        return found.value * factor, nothing if keeps_phase else found.lost, resolution

    def _check_counts(self, reading: Array, rows: NDArray[np.int64]) -> None:
        bad = (reading != np.round(reading)) | (np.abs(reading) >= 2.0**53)
        if bad.any():
            at = int(np.argmax(bad))
            raise DataError(
                f"{self.table.path}: row {rows[at]}, column '{self.run_file.data.output.column}': {reading[at]!r} "
                "is no whole count",
                remedy="set kind to 'angle' or 'rate' with its unit",
            )

    def _largest_step(self, base: TimeBase, a_x: Array) -> float:
        """Largest output step [rad] between samples that the reference allows; nan without one."""
        return (
            1.2
            * to_si(self.run_file.instrument.scale_factor, "rad/s/g")
            * float(np.abs(a_x).max())
            * base.nominal
        )

    def _check_resets(
        self,
        reading: Array,
        span: float | None,
        factor: float,
        base: TimeBase,
        a_x: Array,
        rows: NDArray[np.int64],
    ) -> None:
        """Refuse a counter that went back to zero inside a stretch: that is neither roll-over nor motion."""
        if self.run_file.data.output.kind != "counts":
            return
        step = np.diff(reading, prepend=reading[0])
        step = step if span is None else step - span * np.round(step / span)
        step[base.begins] = 0.0
        found = resets_inside(step, reading, self._largest_step(base, a_x) / factor)
        if found.size:
            name = self.run_file.data.output.column
            listed = "; ".join(
                f"row {rows[k]}, column '{name}': the counter goes to {reading[k]:.17g}, by {step[k]:+.0f} counts"
                for k in found[:100]
            )
            raise DataError(
                f"{self.table.path}: {listed}: it was reset there",
                remedy="start a new segment there (a segment column) and use phase = 'per-segment'",
            )

    def _reset_between(
        self, t: Array, psi: Array, base: TimeBase, f: Array, segment: NDArray[np.int32], rows: NDArray[np.int64],
        events: list[Event],
    ) -> NDArray[np.bool_]:  # fmt: skip
        """Stretches that begin with a counter that cannot have come from the reading before: phase lost.

        Between segments the case may have been turned once about the input axis as well.
        """
        lost = np.zeros(psi.size, dtype=bool)
        output, bits = self.run_file.data.output, self.run_file.instrument.counter_bits
        at = np.flatnonzero(base.begins)[1:]
        if output.kind != "counts" or bits is not None or at.size == 0:
            return lost
        step, interval = psi[at] - psi[at - 1], t[at] - t[at - 1]
        scale = to_si(self.run_file.instrument.scale_factor, "rad/s/g")
        force = float(np.sqrt(np.einsum("ij,ij->i", f, f).max()))
        slack = np.where(segment[at] == segment[at - 1], 0.2, 7.0)
        allowed = (1.5 * scale * force + 1e-3) * interval + slack
        lost[at] = (interval > 0.0) & (np.abs(step) > allowed)
        if lost.any():
            first = int(rows[int(np.argmax(lost))])
            events.append(
                Event("counter-reset", int(lost.sum()), first, "between two stretches; the phase is new")
            )
        return lost

    def _check_plausible(
        self, t: Array, output: Array, f: Array, base: TimeBase, resolution: float, rows: NDArray[np.int64],
        events: list[Event],
    ) -> None:  # fmt: skip
        """Units that are probably mistaken, and an output that does not turn: reported, nothing is changed."""
        step = np.diff(t, prepend=t[0])
        step[base.begins] = 0.0
        scale = to_si(self.run_file.instrument.scale_factor, "rad/s/g")
        first = int(rows[0])
        if self.run_file.data.reference is not None:
            events += mistaken_unit(f, first)
        if self.run_file.data.output.kind == "rate":
            events += mistaken_rate(f, output, scale, first)
            return
        inside = step > 0.0
        rate = np.diff(output, prepend=output[0])[inside] / step[inside]
        events += mistaken_rate(f[inside], rate, scale, first)
        events += stopped_output(output, step, f[:, 0], scale / (resolution or 1e-3), rows)

    def _check_span(
        self, reading: Array, span: float, factor: float, base: TimeBase, a_x: Array, rows: NDArray[np.int64]
    ) -> None:
        name = self.run_file.data.output.column
        width = float(reading.max() - reading.min())
        if width > span:
            at = int(np.argmax(reading))
            raise DataError(
                f"{self.table.path}: row {rows[at]}, column '{name}': {reading[at]:.17g} lies outside the range of "
                f"{span:.17g}",
                remedy="correct [instrument] counter_bits (or wraps_at)",
            )
        largest = self._largest_step(base, a_x)
        if np.isnan(largest):
            steps = np.diff(reading)[~base.begins[1:]]
            largest = 1.2 * factor * float(np.abs(steps - span * np.round(steps / span)).max())
        if largest >= 0.5 * span * factor:
            rate = largest / base.nominal / (0.5 * span * factor)
            raise DataError(
                f"{self.table.path}: column '{name}': between samples the output may move by {largest:.3g} rad, more "
                f"than half of the counter's range ({span * factor:.3g} rad): a roll-over cannot be told",
                remedy=f"sample at {1.2 * rate:.3g} Hz or more, or use a wider counter",
            )

    def _check_unwrapped(self, psi: Array, base: TimeBase, a_x: Array, rows: NDArray[np.int64]) -> None:
        """Refuse an output that jumps as only a folded counter or a reset can."""
        step = np.abs(np.diff(psi))
        step[base.begins[1:]] = 0.0
        limit = 10.0 * self._largest_step(base, a_x) + 2.0
        if step.size and step.max() > limit:
            at = int(np.argmax(step)) + 1
            raise DataError(
                f"{self.table.path}: row {rows[at]}, column '{self.run_file.data.output.column}': the output jumps by "
                f"{step[at - 1]:.4g} rad in one sample, the reference allows {self._largest_step(base, a_x):.3g} rad",
                remedy="if the counter wraps, give [instrument] counter_bits (for an angle: wraps_at); "
                "if it was reset, start a new segment there; otherwise check scale_factor and the units",
            )


def _renumber_visits(
    codes: NDArray[np.int32], labels: tuple[str, ...], events: list[Event], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int32], tuple[str, ...]]:
    """One segment per visit: a label that comes back later is a new segment ``label#2``."""
    change = np.flatnonzero(np.diff(codes) != 0) + 1
    starts = np.concatenate(([0], change))
    if np.unique(codes[starts]).size == starts.size and codes.min() >= 0:
        return codes, labels
    seen: dict[int, int] = {}
    names: list[str] = []
    segment = np.full(codes.size, -1, dtype=np.int32)
    for start, stop in zip(starts, np.append(change, codes.size), strict=True):
        code = int(codes[start])
        if code < 0:
            events.append(
                Event("no-segment", int(stop - start), int(rows[start]), "rows without a segment are not used")
            )
            continue
        seen[code] = seen.get(code, 0) + 1
        segment[start:stop] = len(names)
        names.append(labels[code] if seen[code] == 1 else f"{labels[code]}#{seen[code]}")
    return segment, tuple(names)


def _split_lost(
    segment: NDArray[np.int32],
    labels: tuple[str, ...],
    lost: NDArray[np.bool_],
    events: list[Event],
    rows: NDArray[np.int64],
) -> tuple[NDArray[np.int32], tuple[str, ...], tuple[int, ...]]:
    """Give every part behind a lost phase its own segment and phase group."""
    order = np.concatenate(([0], np.cumsum((np.diff(segment) != 0) | lost[1:])))
    starts = np.concatenate(([0], np.flatnonzero(np.diff(order)) + 1))
    groups = np.cumsum(lost[starts])
    old = segment[starts]
    parts: dict[int, int] = {}
    names = []
    for index in old:
        parts[int(index)] = parts.get(int(index), 0) + 1
        suffix = "" if parts[int(index)] == 1 else f"/{parts[int(index)]}"
        names.append(labels[int(index)] + suffix)
    inside = int(np.count_nonzero(np.diff(segment)[lost[1:]] == 0)) if lost.any() else 0
    if lost.any():
        detail = "the counter may have rolled over unseen; the zero of the output angle is new there"
        events.append(Event("phase-lost", int(lost.sum()), int(rows[int(np.argmax(lost))]), detail))
    if inside:
        events.append(Event("segment-split", inside, None, "a gap inside a segment, phase lost"))
    return order.astype(np.int32), tuple(names), tuple(int(g) for g in groups)
