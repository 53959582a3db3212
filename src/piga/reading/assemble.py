"""Read a run file and its data file into a run in SI. Every fault met is counted.

NumPy works on whole columns here. Those of a long record lie in files (:mod:`piga.records.arrays`).
"""

from __future__ import annotations

import hashlib
import math
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.errors import RunFileError, Where
from piga.formats.columns import RecordStream
from piga.output import check_results
from piga.reading.checks import (
    OutputScale,
    find_positions,
    leave_out_ranges,
    leave_out_repeats,
    leave_out_settling,
    note_doubtful,
    note_norm,
    note_sequence,
    note_stuck,
    unwrapped,
)
from piga.reading.columns import RawColumns, collect, file_digest, read_columns, stand_files, steady
from piga.records.arrays import empty, largest_size, norms, scaled, stored
from piga.records.calibration.diagnostics import Quality
from piga.records.run import Run, TimeBase, examine_time
from piga.records.run_file import Columns, ColumnTable, DataTable, PositionColumn, RunFile, read_run_file
from piga.records.terms import integral_unit, scale_factor_in
from piga.results import Array
from piga.text_files import toml_bytes
from piga.units import conversion_factor, offset_to_si, parse_unit, to_si
from piga.upper import doors

_LOST_ANGLE, _LOST_SHARE = 0.1, 0.01
"""Angle [rad] and share of the turn in a gap by which the output may differ from the rates on both sides (coupling, noise)."""
_LEAST_TURN = 0.5
"""Angle [rad] by which the output turns beside a short gap, so that its rate there is known (own choice)."""
_WHOLE = 1e-9
"""Tolerance [rev] of the test for whole turns. A range in units such as mrad is never exactly whole."""


def read_record(path: Path, *, need_reference: bool = True, content: bytes | None = None) -> Run:
    """Read a recorded test: :func:`piga.read_run`."""
    check_results(path.parent)
    content = toml_bytes(path) if content is None else content
    run_file = read_run_file(path, content)
    if need_reference:
        _check_reference(path, run_file)
    raw = read_columns(path.parent, run_file.data)
    inputs = {path.name: hashlib.sha256(content).hexdigest()} | raw.inputs
    with ExitStack() as stack:
        for name in stand_files(run_file.stand):
            stack.enter_context(steady(path.parent / name, "[stand] file is relative to the run file"))
            inputs[name] = file_digest(path.parent / name)
        run = assemble(path, run_file, raw)
    run.input_sha256.update(inputs)
    return run


def read_stream(path: Path, run_file: RunFile, stream: RecordStream) -> Run:
    """A run from a stream of rows in memory. ``path`` names the stream in messages, and is the source of the run."""
    _check_reference(path, run_file)
    return assemble(path, run_file, collect(path, run_file.data, stream))


def _check_reference(path: Path, run_file: RunFile) -> None:
    if run_file.data.reference is None and run_file.stand is None:
        raise RunFileError(
            f"{path}: [data] reference is missing: the specific force that the instrument felt",
            remedy="add reference = { columns = ['fx', 'fy', 'fz'], unit = 'g' }, or a [stand] table",
            where=Where(path),
        )


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def assemble(path: Path, run_file: RunFile, raw: RawColumns) -> Run:
    """Make a run of the columns of a data file: leave rows out, find gaps, convert, check. ``path`` is the run file."""
    data, instrument, rows_read = run_file.data, run_file.instrument, raw.count
    if isinstance(data.segment, PositionColumn):
        find_positions(raw, data.segment.holds_of)
    if data.output.kind == "pulses":
        pulses = raw.numbers[data.output.column]  # a row without a number stays one; its pulses are lost
        count = np.cumsum(np.nan_to_num(pulses))
        raw.numbers[data.output.column] = np.where(np.isfinite(pulses), count, np.nan)
    t = _used_rows(raw, data)
    base = examine_time(t, raw.segment, raw.rows)
    raw.events += base.events
    _check_enough(path, raw, data, base, rows_read)
    if data.sequence is not None:
        note_sequence(raw, raw.numbers[data.sequence.column], data.sequence.wraps_at, base.begins)
    f, base_rate = _reference(path, run_file, raw, t)
    scale = _output_scale(run_file, raw)
    scale_factor = scale_factor_in(instrument.scale_factor, run_file.unit)
    gyro = instrument.kind == "gyro"
    output, lost = _output(data, raw, base, scale, 1.2 * scale_factor * largest_size(f[:, 0]) * base.nominal)
    if gyro and data.output.kind != "rate":
        fold = math.inf if scale.span is None else abs(scale.span * scale.factor)
        unfolded = data.output.counted and instrument.counter_bits is None
        fastest = 1.5 * scale_factor * float(norms(f).max()) if unfolded else math.inf
        _mark_lost(raw, t, output, base, lost, fastest, fold)
    if data.reference is not None:
        note_norm(raw, f)
    note_doubtful(raw, data.output.kind == "rate", t, output, f, base, scale_factor, scale)
    segment, labels, groups = _split_lost(raw, lost)
    return Run(
        serial=instrument.serial,
        scale_factor=scale_factor,
        kind="rate" if data.output.kind == "rate" else "angle",
        t=t,
        output=output,
        f=f,
        base_rate=base_rate if gyro else None,
        temperature=_logged(raw, data.temperature),
        vibration=_logged(raw, data.vibration),
        segment_index=segment,
        labels=labels,
        begins=base.begins,
        phase_group=groups,
        row=raw.rows,
        resolution=scale.factor if scale.counts else 0.0,
        quality=Quality(rows_read, raw.count, rows_read - raw.count, tuple(raw.events)),
        model=run_file.model,
        estimation=run_file.estimation,
        uncertainty=run_file.uncertainty,
        stand=run_file.stand,
        computed_reference=data.reference is None and run_file.stand is not None,
        servo=() if instrument.servo is None else instrument.servo.parameters(),
        source=str(path),
        unit=run_file.unit,
    )


def _used_rows(raw: RawColumns, data: DataTable) -> Array:
    """Leave out the rows that cannot be used. Returns the time [s] of the others."""
    for values in raw.numbers.values():
        raw.usable &= np.isfinite(values)
    if not any(event.kind in ("missing-value", "no-segment", "moving") for event in raw.events):
        raw.note("not-finite", ~raw.usable, "the row is not used")
    limits = data.range or {}
    stand = data.segment.holds_of if isinstance(data.segment, PositionColumn) else None
    for name in raw.numbers:
        if name != stand:  # that of the stand is meant to stay where it is
            note_stuck(raw, name, limits.get(name, (-np.inf, np.inf)))
    for name, (low, high) in limits.items():
        out = (raw.numbers[name] <= low) | (raw.numbers[name] >= high)
        detail = f"column '{name}' at or beyond {low:g} to {high:g}: the row is not used"
        raw.leave_out("saturated", out, detail)
    leave_out_ranges(raw, data.leave_out)
    t = raw.time(data)
    if data.settle is not None:
        leave_out_settling(raw, t, to_si(data.settle, "s"))
    if not raw.usable.any():
        raise raw.refusal("no row has all needed values", "check the columns in [data]")
    leave_out_repeats(raw, t)
    return raw.keep_usable(t)


def _check_enough(path: Path, raw: RawColumns, data: DataTable, base: TimeBase, rows_read: int) -> None:
    if raw.count >= 2 and base.nominal > 0.0:
        return
    repeated = sum(event.count for event in raw.events if event.kind == "conflicting-row")
    if data.time is not None and 2 * repeated > rows_read:
        name, where = data.time.column, "in place of time; otherwise name the column of the time"
        words = f"column '{name}' repeats itself in most rows: its times are rounded, or it is not the time"
        raise raw.refusal(words, f"if they are rounded, give [data] sample_rate = '... Hz' {where}", name)
    raise raw.refusal("fewer than two usable rows with increasing time", f"check {path}")


def _reference(path: Path, run_file: RunFile, raw: RawColumns, t: Array) -> tuple[Array, Array | None]:
    data, stand = run_file.data, run_file.stand
    f, base_rate = _axes(raw, data.reference, "m/s^2"), _axes(raw, data.base_rate, "rad/s")
    if f is None and stand is not None:
        perfect = doors().run_reference()
        f, stand_rate = perfect.stand_reference(stand, path.parent, t, raw.segment, raw.labels)
        base_rate = stand_rate if base_rate is None else base_rate
    return np.full((t.size, 3), np.nan) if f is None else f, base_rate


def _axes(raw: RawColumns, group: Columns | None, unit: str) -> Array | None:
    """Three columns as an array (n, 3); each column is contiguous."""
    if group is None:
        return None
    factor, rows = conversion_factor(group.unit, unit), empty((3, raw.count))
    for axis, name in enumerate(group.columns):
        raw.unit(name, group.unit)
        np.multiply(raw.numbers[name], factor, out=rows[axis])
    return rows.T


def _logged(raw: RawColumns, column: ColumnTable | None) -> Array | None:
    if column is None:
        return None
    unit = raw.unit(column.column, column.unit)
    return raw.si(column.column, parse_unit(unit).factor, offset_to_si(unit))


def _output_scale(run_file: RunFile, raw: RawColumns) -> OutputScale:
    instrument, output = run_file.instrument, run_file.data.output
    direct, counts, unit = instrument.kind == "direct", output.counted, str(output.unit)
    if not counts:
        raw.unit(output.column, run_file.unit if direct else unit)
    span = None if instrument.counter_bits is None or not counts else 2.0**instrument.counter_bits
    if direct:  # counts and the declared unit are kept: the phase of a count is of no matter
        return OutputScale(1.0, span, counts=counts, unit=integral_unit(run_file.unit))
    if output.kind == "rate":
        return OutputScale(conversion_factor(unit, "rad/s"))
    if counts:
        factor = 2.0 * np.pi / float(instrument.counts_per_revolution or 0.0)
    else:
        factor = conversion_factor(unit, "rad")
        span = None if output.fold is None else output.fold / factor
    turns = 0.0 if span is None else span * factor / (2.0 * np.pi)
    return OutputScale(factor, span, abs(turns - round(turns)) <= _WHOLE, counts)


def _output(
    data: DataTable, raw: RawColumns, base: TimeBase, scale: OutputScale, largest: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Output in SI, and the samples at which the number of turns was lost. ``largest``: step that the reference allows [rad]."""
    name = data.output.column
    if data.output.kind == "rate":
        return raw.si(name, scale.factor * data.output.direction), np.zeros(raw.count, np.bool_)
    output, lost = unwrapped(raw, name, base, scale, largest)
    if data.output.kind == "pulses" and scale.unit == "rad":
        at = np.flatnonzero(base.begins)[1:]
        rows = raw.rows[at] - raw.rows[at - 1]
        at = at[base.step[at] > (rows + 0.5) * base.nominal]  # rows of the log are missing before
        lost[at] = True
        raw.note("pulses-lost", at, "the pulses of missing rows are not known; the phase is new")
    return scaled(output, -1.0) if data.output.direction < 0 else output, lost


def _mark_lost(
    raw: RawColumns, t: Array, psi: Array, base: TimeBase, lost: NDArray[np.bool_], fastest: float, fold: float
) -> None:
    """Mark stretches whose phase is lost: where a counter was reset, or lost counts.

    It was reset if its first count cannot follow from the reading before at the rate ``fastest`` [rad/s]. Between segments the
    case may also have been turned once about the input axis. It lost counts in a gap inside a position over which the output
    did not turn as it does on both sides. The rates on both sides are those of the stretches before and after. Each must have
    turned once, or by half a radian in a time no shorter than the gap. ``fold`` [rad]: range after which the reading folds
    back; whole ranges are not seen.
    """
    bounds = np.append(np.flatnonzero(base.begins), t.size)
    before, at, after = bounds[:-2], bounds[1:-1], bounds[2:]
    gap, moved, inside = t[at] - t[at - 1], psi[at] - psi[at - 1], raw.segment[at] == raw.segment[at - 1]
    reset = (gap > 0.0) & (np.abs(moved) > (fastest + 1e-3) * gap + np.where(inside, 0.2, 7.0))
    raw.note("counter-reset", at[reset], "between two stretches; the phase is new")
    times = np.array([t[at - 1] - t[before], t[after - 1] - t[at]])
    turns = np.array([psi[at - 1] - psi[before], psi[after - 1] - psi[at]])
    shortest, turned = times.min(axis=0), np.abs(turns).min(axis=0)
    comparable = inside & ~lost[at] & ~reset & (gap > 0.0) & (shortest > 0.0)
    comparable &= (turned >= 2.0 * np.pi) | ((turned >= _LEAST_TURN) & (shortest >= gap))
    first, second = np.divide(turns, times, out=np.zeros_like(turns), where=comparable)
    allowed = _LOST_ANGLE + (np.abs(first - second) + _LOST_SHARE * np.abs(first)) * gap
    missed = moved - 0.5 * (first + second) * gap
    missed -= np.round(missed / fold) * fold if math.isfinite(fold) else 0.0
    missing = comparable & (np.abs(missed) > allowed)
    raw.note("counts-lost", at[missing], "the counter lost counts in the gap; the phase is new")
    lost[at[reset | missing]] = True


def _split_lost(
    raw: RawColumns, lost: NDArray[np.bool_]
) -> tuple[NDArray[np.int32], tuple[str, ...], tuple[int, ...]]:
    """Give every part after a lost phase its own segment and phase group.

    Returns the segment of each row, the labels, and the phase group of each segment.
    """
    begins = np.zeros(lost.size, np.bool_)
    begins[1:] = lost[1:] | (raw.segment[1:] != raw.segment[:-1])
    names, groups, parts = [raw.labels[int(raw.segment[0])]], [0], {int(raw.segment[0]): 1}
    starts = np.flatnonzero(begins)
    for row in starts.tolist():
        old = int(raw.segment[row])
        parts[old] = parts.get(old, 0) + 1
        names.append(raw.labels[old] + ("" if parts[old] == 1 else f"/{parts[old]}"))
        groups.append(groups[-1] + int(lost[row]))
    detail = (
        "the counter may have rolled over unseen; a segment begins there with a new zero of the output angle"
    )
    raw.note("phase-lost", starts[lost[starts]], detail)
    return stored(np.cumsum(begins, dtype=np.int32)), tuple(names), tuple(groups)
