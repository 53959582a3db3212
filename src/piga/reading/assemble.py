"""Read a run file and its data file into a run in SI. Every fault met is counted.

NumPy works on whole columns here. Those of a long record lie in files (:mod:`piga.records.arrays`).
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from piga.errors import DataError, RunFileError, Where
from piga.formats.columns import RecordStream
from piga.output import check_results
from piga.reading.columns import (
    RawColumns,
    collect,
    file_digest,
    find_positions,
    read_columns,
    stand_files,
)
from piga.records.arrays import changes, empty, largest_size, norms, scaled, stored
from piga.records.calibration.diagnostics import Event, Quality
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
    inputs |= {name: file_digest(path.parent / name) for name in stand_files(run_file.stand)}
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
        _note_sequence(raw, raw.numbers[data.sequence.column], data.sequence.wraps_at, base.begins)
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
    for name, (low, high) in (data.range or {}).items():
        out = (raw.numbers[name] <= low) | (raw.numbers[name] >= high)
        detail = f"column '{name}' at or beyond {low:g} to {high:g}: the row is not used"
        raw.leave_out("saturated", out, detail)
    for entry in data.leave_out:
        first, last = entry.rows
        inside = (raw.rows >= first) & (raw.rows <= last)
        if not inside.any():
            remedy = f"give the first and the last row to leave out, from {raw.rows[0]} to {raw.rows[-1]}"
            words = f"{raw.path}: [data] leave_out: the file has no rows {first} to {last}"
            raise DataError(words, remedy=remedy, where=Where(raw.path, first))
        raw.leave_out("left-out", inside, f"rows {first} to {last} are not used: {entry.reason}")
    t = raw.time(data)
    if data.settle is not None:
        begins, seconds = np.diff(raw.segment, prepend=raw.segment[0] - 1) != 0, to_si(data.settle, "s")
        early = (t - t[begins][np.cumsum(begins) - 1] < seconds) & (raw.segment >= 0)
        raw.leave_out("settling", early, f"the first {seconds:g} s of each position are not used")
    if not raw.usable.any():
        left_out = (f"; {event.kind}: {event.count} rows, {event.detail}" for event in raw.events)
        remedy = (
            "shorten [data] settle" if data.settle is not None else "check the columns and limits in [data]"
        )
        raise raw.refusal(f"no row is left to use{''.join(left_out)}", remedy)
    _leave_out_repeats(raw, t)
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


def _output_scale(run_file: RunFile, raw: RawColumns) -> _OutputScale:
    instrument, output = run_file.instrument, run_file.data.output
    direct, counts, unit = instrument.kind == "direct", output.counted, str(output.unit)
    if not counts:
        raw.unit(output.column, run_file.unit if direct else unit)
    span = None if instrument.counter_bits is None or not counts else 2.0**instrument.counter_bits
    if direct:  # counts and the declared unit are kept: the phase of a count is of no matter
        return _OutputScale(1.0, span, counts=counts, unit=integral_unit(run_file.unit))
    if output.kind == "rate":
        return _OutputScale(conversion_factor(unit, "rad/s"))
    if counts:
        factor = 2.0 * np.pi / float(instrument.counts_per_revolution or 0.0)
    else:
        factor = conversion_factor(unit, "rad")
        span = None if output.fold is None else output.fold / factor
    turns = 0.0 if span is None else span * factor / (2.0 * np.pi)
    return _OutputScale(factor, span, abs(turns - round(turns)) <= _WHOLE, counts)


def _output(
    data: DataTable, raw: RawColumns, base: TimeBase, scale: _OutputScale, largest: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Output in SI, and the samples at which the number of turns was lost. ``largest``: step that the reference allows [rad]."""
    name = data.output.column
    if data.output.kind == "rate":
        return raw.si(name, scale.factor * data.output.direction), np.zeros(raw.count, np.bool_)
    output, lost = _unwrapped(raw, name, base, scale, largest)
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


# -- checks -------------------------------------------------------------------------------------------------


def _leave_out_repeats(raw: RawColumns, t: Array) -> None:
    """Do not use rows with a repeated time (n,): the second of two identical rows, both of two conflicting rows."""
    index = np.flatnonzero(raw.usable)
    same = (np.diff(t[index]) == 0.0) & (np.diff(raw.segment[index]) == 0)
    first, second = index[:-1][same], index[1:][same]
    identical = np.all([column[first] == column[second] for column in raw.numbers.values()], axis=0)
    raw.usable[second] = False
    raw.usable[first[~identical]] = False
    raw.note("repeated-row", second[identical], "the copy is not used")
    raw.note("conflicting-row", second[~identical], "same time, other values: neither is used")


def _note_sequence(raw: RawColumns, number: Array, wraps_at: int | None, begins: NDArray[np.bool_]) -> None:
    """Begin a stretch where a sequence number does not follow the one before. Lost and disordered numbers are counted."""
    step = changes(number)
    step[0] = 1.0
    if wraps_at is not None:
        np.mod(step, wraps_at, out=step)
    begins |= step != 1.0
    gaps, backs = np.flatnonzero(step > 1.0), np.flatnonzero(step <= 0.0)
    missing = int(min(step[gaps].sum() - gaps.size, 1e18))
    none = "no increment is formed across it"
    raw.note("sequence-gap", gaps, f"{missing} samples missing; {none}")
    raw.note("sequence-back", backs, none)


@dataclass(frozen=True)
class _OutputScale:
    """Conversion from a reading to the output.

    ``factor``: SI per unit of the reading. ``span``: range after which the reading folds back, in its own unit
    (None: never). ``keeps_phase``: the span is a whole number of revolutions. ``counts``: the reading is a count. ``unit`` is
    that of the output: rad, or count for a direct instrument, which has no phase.
    """

    factor: float
    span: float | None = None
    keeps_phase: bool = True
    counts: bool = False
    unit: str = "rad"


def _unwrapped(
    raw: RawColumns, name: str, base: TimeBase, scale: _OutputScale, largest: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Unwrapped output angle [rad] of a column, and the samples at which the number of turns was lost.

    A folded reading is _unwrapped to the nearest turn inside stretches. Between samples it must move by less
    than half its range. The check uses ``largest``: the largest output step [rad] between samples that the reference
    allows; nan without a reference. A jump that only a folded counter or a reset can make is refused.
    """
    values, begins, span, unit = raw.numbers[name], base.begins, scale.span, scale.unit
    lost = np.zeros(values.size, np.bool_)

    def refusal(words: str, remedy: str, at: int | None = None, key: str = "") -> DataError:
        return raw.refusal(f"column '{name}': {words}", remedy, name, at=at, key=key)

    whole = (values == np.rint(values)) & (np.abs(values) < 2.0**53) if scale.counts else np.ones(1, np.bool_)
    if not whole.all():
        at = int(np.argmin(whole))
        remedy = "set kind to 'angle' or 'rate' with its unit, or name the column of the counts"
        raise refusal(f"{values[at]:.15g} is not a whole count", remedy, at)
    step = changes(values) if scale.counts or span is not None else values
    if span is None:
        psi = scaled(values, scale.factor)
    else:
        top = int(np.argmax(values))
        if values[top] - values.min() > span:
            words = f"{values[top]:.17g} lies outside the range of {span:.17g}"
            raise refusal(words, "correct [instrument] counter_bits (or wraps_at)", top, "counter_bits")
        folds = np.round(step / span)
        wraps = int(np.count_nonzero(folds[~begins]))
        step -= np.multiply(folds, span, out=folds)
        if wraps:
            raw.events.append(Event("counter-roll-over", wraps, None, "unwrapped"))
        fastest, half = largest, 0.5 * span * scale.factor
        if np.isnan(largest):
            fastest = 1.2 * scale.factor * float(np.abs(step[~begins]).max(initial=0.0))
        if fastest >= half:
            words = (
                f"between samples the output may move by {fastest:.3g} {unit}, more than half of the counter's range "
                f"({2.0 * half:.3g} {unit}): a roll-over cannot be recognised"
            )
            rate = 1.2 * fastest / base.nominal / half
            raise refusal(words, f"sample at {rate:.3g} Hz or more, or use a wider counter")
        psi = stored(np.cumsum(step))
        psi += values[0]
        psi *= scale.factor
        lost[1:] = begins[1:] & (not scale.keeps_phase)
    size = np.abs(changes(psi))
    size[begins] = 0.0
    at = int(np.argmax(size))
    if size[at] > 10.0 * largest + 2.0:
        words = f"the output jumps by {size[at]:.4g} {unit} in one sample, the reference allows {largest:.3g} {unit}"
        remedy = (
            "if the counter wraps, give [instrument] counter_bits (for an angle: wraps_at); "
            "if it was reset, start a new segment there; otherwise check scale_factor and the units"
        )
        raise refusal(words, remedy, at, "counter_bits")
    if resets := _resets(values, step, begins, largest / scale.factor) if scale.counts else []:
        more = ", ".join(str(raw.rows[at]) for at in resets[1:100])
        also = f", and in rows {more}" if more else ""
        phases = " and use phases = 'per-segment'" if unit == "rad" else ""
        at = resets[0]
        words = f"the counter goes to {values[at]:.17g}, by {step[at]:+.0f} counts{also}: it was reset there"
        remedy = f"start a new segment there (a segment column){phases}; if it wrapped instead, give [instrument] counter_bits"
        raise refusal(words, remedy, at, "counter_bits")
    return psi, stored(lost)


def _resets(values: Array, step: Array, begins: NDArray[np.bool_], largest: float) -> list[int]:
    """Where a counter jumped to about zero inside a stretch, by more than it can have moved, and went on from there.

    No other step within three samples is a third as large.
    """
    resets = []
    sudden = np.flatnonzero((np.abs(step) > 1.5 * largest + 10.0) & ~begins & (np.abs(values) <= largest + 2.0))
    for at in sudden.tolist():
        window = slice(max(at - 3, 0), at + 4)
        size = np.sort(np.abs(step[window]) * ~begins[window])
        if size.size > 1 and size[-2] < abs(step[at]) / 3.0:
            resets.append(at)
    return resets
