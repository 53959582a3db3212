"""Draft a run file from the description of a log. Every guessed line has its reason and its alternatives."""

from __future__ import annotations

import json
import math
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.describe.columns import WORDS, ColumnGuess, Values
from piga.describe.layout import Guess
from piga.describe.log import LogDescription
from piga.describe.toml_writer import toml_text, toml_value
from piga.errors import ArgumentError, DataError, UnitError
from piga.records.run import Run
from piga.stand.run_reference import read_run
from piga.units import G0, parse_unit, to_si

Array = NDArray[np.float64]

WIDTHS = (8, 12, 16, 20, 24, 32)
"""Usual widths of counters [bits]."""
ROUND_COUNTS = 0.02
"""Counts per revolution are rounded to a usual number within this relative distance."""
USUAL_COUNTS = tuple(
    sorted(
        {m * 10**k for m in (1, 1.8, 2, 2.5, 3.6, 4, 5, 7.2, 8) for k in range(2, 7)}
        | {2**k for k in range(8, 25)}
    )
)
EARTH = (
    "CHECK: no rate of the base is logged. The rotation of the Earth stays in the coefficients (up to 82 ppm of the "
    "scale factor, 82 ug of k0): give [data] base_rate, or a [stand] table with the latitude in place of the reference"
)
LEAST_SWING = 0.01
"""Transverse specific force [g] from which on ``tan_beta`` is asked for."""


@dataclass(frozen=True)
class Question:
    """A value that the log does not hold: the key of the run file, the question, an example."""

    key: str
    words: str
    example: str

    @property
    def toml(self) -> bool:
        """True if the example is written in TOML, not a text."""
        return self.example[:1] in "{[" or self.example.isdigit()


QUESTIONS = {
    "instrument.scale_factor": Question(
        "instrument.scale_factor", "nominal scale factor (pendulosity over angular momentum)", "0.8884 rad/s/g"
    ),
    "instrument.counts_per_revolution": Question(
        "instrument.counts_per_revolution", "counts of the output per revolution of the outer gimbal", "72000"
    ),
    "data.output": Question("data.output", "column of the output", '{ column = "n", kind = "counts" }'),
    "data.sample_rate": Question(
        "data.sample_rate", "rate of the samples, since no column holds the time", "20 Hz"
    ),
    "data.reference": Question(
        "data.reference",
        "columns of the specific force along X0, Y0 and Z0",
        '{ columns = ["fx", "fy", "fz"], unit = "g" }',
    ),
    "stand.latitude": Question("stand.latitude", "latitude of the laboratory", "40 deg"),
    "stand.radius": Question("stand.radius", "radius of the centrifuge at the instrument", "1 m"),
}
"""Values that no log need hold, by key of the run file."""


@dataclass
class RunFileDraft:
    """A run file that is not complete yet.

    Attributes
    ----------
    document:
        Its tables.
    comments:
        Lines before a table or key: the reason of each guess, and the alternatives.
    open:
        Questions that the log does not answer. The run file is complete when there are none.
    """

    document: dict[str, dict[str, Any]]
    comments: dict[str, list[str]] = field(default_factory=dict)
    open: list[Question] = field(default_factory=list)

    def put(self, key: str, value: Any, *reasons: str) -> None:
        """Set ``table.key`` and the comment on it."""
        table, _, name = key.partition(".")
        self.document.setdefault(table, {})[name] = value
        if reasons:
            self.comments[key] = list(reasons)

    def text(self) -> str:
        """The run file."""
        order: list[str] = [name for name in ("instrument", "data", "stand", "model") if name in self.document]
        order += [name for name in self.document if name not in order]
        comments = dict(self.comments)
        for one in self.open:
            table, _, key = one.key.partition(".")
            comments[f"{table}."] = [
                *comments.get(f"{table}.", []),
                f"OPEN: {one.words}. Correct the next line and remove its #.",
                f"{key} = {one.example if one.toml else toml_value(one.example)}",
            ]
        return toml_text({name: self.document[name] for name in order}, comments)

    def completed(self) -> RunFileDraft:
        """A draft in which every open question has its example as the answer: to check all that is not open."""
        whole = RunFileDraft({table: dict(part) for table, part in self.document.items()})
        for one in self.open:
            whole.put(one.key, setting(f"{one.key}={one.example}")[1])
        output = whole.document["data"].get("output")
        if isinstance(output, Mapping) and output.get("kind") == "counts":
            whole.document["instrument"].setdefault("counts_per_revolution", 72000)
        return whole


def setting(text: str) -> tuple[str, Any]:
    """Key and value of ``instrument.scale_factor="0.8884 rad/s/g"``. A value that is not TOML is text.

    Raises
    ------
    ArgumentError
        If there is no ``table.key=``.
    """
    key, equals, written = text.partition("=")
    key = key.strip()
    if not equals or "." not in key or not all(key.split(".")):
        raise ArgumentError(
            f"--set {text}: is not table.key=value",
            remedy="e.g. --set instrument.scale_factor='0.8884 rad/s/g'",
        )
    try:
        return key, tomllib.loads(f"value = {written.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return key, written.strip()


def draft_run_file(
    log: LogDescription, settings: Mapping[str, Any] | None = None, *, folder: Path | None = None
) -> RunFileDraft:
    """Draft a run file for a log.

    Parameters
    ----------
    log:
        The log, from :func:`describe_log`.
    settings:
        Values by ``table.key`` (also ``data.time.unit``). They replace the guesses.
    folder:
        Folder of the run file; that of the log if None.

    Raises
    ------
    ArgumentError, UnitError
        If a setting cannot be used.
    """
    settings = dict(settings or {})
    draft = RunFileDraft({"instrument": {}, "data": {}})
    draft.comments[""] = [
        f"A run file for {log.path.name}, drafted by 'piga init'. Each guess says why, and what else it may be.",
        "Read it, correct it, then: piga check, piga calibrate.",
        "",
        *(f"{_column_words(column)}" for column in log.columns),
    ]
    file = os.path.relpath(log.path, folder or log.path.parent)
    draft.put("data.file", Path(file).as_posix())
    _layout(draft, log)
    _time(draft, log)
    output = _output(draft, log)
    _optional(draft, log)
    _reference(draft, log, output, settings)
    _fills(draft, log)
    for key, value in settings.items():
        _apply(draft, key, value)
    _instrument(draft, log, output)
    _model(draft, log)
    for key, value in settings.items():
        _apply(draft, key, value)
    _open(draft)
    return draft


def try_run_file(draft: RunFileDraft, path: Path) -> Run:
    """Read the log with a draft. ``path``: where the run file will be written.

    If the counter may have folded in a gap, the draft gets one phase for each segment, and the log is read again.

    Raises
    ------
    PigaError
        If the log cannot be read with it.
    """
    try:
        run = read_run(path, content=draft.text().encode())
    except DataError as error:
        run = _without_damage(draft, path, error)
    if len(set(run.phase_group)) > 1 and "phases" not in draft.document.get("model", {}):
        draft.put(
            "model.phases",
            "per-segment",
            "the counter may have folded unseen in a gap, so the zero of the output angle is new after it",
        )
        return read_run(path, content=draft.text().encode())
    return run


MOST_DAMAGED = 0.01
"""Largest share of damaged rows that a draft leaves out by itself."""


def _without_damage(draft: RunFileDraft, path: Path, error: DataError) -> Run:
    """Read the log without a few damaged rows: words that mark missing values, or a footer. The draft says so."""
    remedy = error.remedy or ""
    if "damaged_rows = 'mask'" not in remedy:
        raise error
    words = re.findall(r"missing = \['([^']*)'\]", remedy)
    for key, value in (*(("data.missing", [word]) for word in words), ("data.damaged_rows", "mask")):
        before = draft.document["data"].get(key.partition(".")[2])
        draft.put(
            key, value, f"{' '.join(error.message.split(': ', 1)[-1].split())[:200]}: left out and counted"
        )
        try:
            run = read_run(path, content=draft.text().encode())
        except DataError:
            run = None
        if run is not None and run.quality.rows - run.size <= max(MOST_DAMAGED * run.quality.rows, 2):
            return run
        draft.comments.pop(key)
        if before is None:
            draft.document["data"].pop(key.partition(".")[2])
        else:
            draft.document["data"][key.partition(".")[2]] = before
    raise error


def _column_words(column: ColumnGuess) -> str:
    axis = "" if column.axis is None else f" {'XYZ'[column.axis]}0"
    unit = f" [{column.unit}]" if column.unit else f" ({column.stamp})" if column.stamp else ""
    others = f"; or {', '.join(column.alternatives)}" if column.alternatives else ""
    return f"  {column.name}: {WORDS[column.kind]}{axis}{unit}: {column.reason}{others}"


def _layout(draft: RunFileDraft, log: LogDescription) -> None:
    layout = log.layout
    if "data.sheet" in log.facts:
        sheet = log.facts["data.sheet"]
        others = [f"  or: sheet = {toml_value(other)}" for other in sheet.alternatives]
        draft.put("data.sheet", sheet.value, sheet.reason, *others)
    if layout is None:
        return
    guesses = {"delimiter": layout.separator, "decimal": layout.decimal}
    if layout.encoding.value not in ("utf-8", "ascii"):
        guesses["encoding"] = layout.encoding
    if layout.header_row.value is False or layout.header_row.value > 1 or layout.marked:
        guesses["header_row"] = layout.header_row
    if layout.skip_rows:
        guesses["skip_rows"] = Guess(layout.skip_rows, "lines before the numbers")
    if layout.units_row.value is not False:
        guesses["units_row"] = layout.units_row
    for key, guess in guesses.items():
        others = [f"  or: {key} = {toml_value(other)}" for other in guess.alternatives]
        draft.put(f"data.{key}", guess.value, guess.reason, *others)


def _time(draft: RunFileDraft, log: LogDescription) -> None:
    times = log.of("time")
    stamped = [column for column in times if column.stamp]
    named = [column for column in times if not column.stamp]
    chosen = (named or stamped)[:1]
    if not chosen:
        rate = log.facts.get("data.sample_rate")
        step = log.facts.get("step")
        if rate is not None:
            draft.put("data.sample_rate", _quantity(rate.value, "Hz"), rate.reason)
        elif step is not None and _number(step.value) > 0.0:
            draft.put(
                "data.sample_rate",
                f"{1.0 / _number(step.value):.9g} Hz",
                f"{step.reason}: the time between samples",
            )
        return
    column = chosen[0]
    others = [f"  or: column {other.name}" for other in times if other is not column]
    others += [
        f"  or: {'stamp' if column.stamp else 'unit'} = {toml_value(other.removeprefix('unit '))}"
        for other in column.alternatives
        if other not in WORDS.values()
    ]
    value = {"column": column.name, **({"stamp": column.stamp} if column.stamp else {"unit": column.unit})}
    rounded = _rate_of_rounded(log.numbers.get(column.name, np.empty(0)), column)
    if rounded is not None:
        why = f"the times of {column.name} are rounded: each stands in {rounded[1]:g} rows"
        draft.put("data.sample_rate", f"{rounded[0]:.9g} Hz", why, f"  or: time = {toml_value(value)}", *others)
        return
    draft.put("data.time", value, column.reason, *others)


def _rate_of_rounded(t: Array, column: ColumnGuess) -> tuple[float, float] | None:
    """Sample rate [Hz] and rows per value of a time that is rounded so far that it repeats. None if it does not."""
    t = t[np.isfinite(t)]
    if t.size < 8 or np.median(np.diff(t)) > 0.0:
        return None
    at = np.flatnonzero(np.diff(t) > 0.0)
    if at.size < 3:
        return None
    rows, step = float(np.median(np.diff(at))), float(np.median(t[at + 1] - t[at]))
    seconds = 1.0 if column.stamp else parse_unit(column.unit).factor
    return (rows / (step * seconds), rows) if rows >= 2.0 else None


def _output(draft: RunFileDraft, log: LogDescription) -> ColumnGuess | None:
    outputs = [column for kind in ("counts", "angle", "rate") for column in log.of(kind)]
    if not outputs:
        return None
    column = outputs[0]
    others = [f"  or: column {other.name} ({WORDS[other.kind]})" for other in outputs[1:]]
    value: dict[str, Any] = {"column": column.name, "kind": column.kind}
    reasons = [column.reason]
    x = log.numbers.get(column.name, np.empty(0))
    if column.kind == "counts" and _of_each_sample(log, x):
        draft.comments["data."] = [
            f"{column.name} holds the pulses of each sample, not a running count: it follows the specific force itself.",
            f"piga reads a running count. Add a column with the running sum of {column.name} to the log.",
        ]
        return None
    if column.kind == "counts":
        bits = _counter_bits(x)
        if bits is not None:
            draft.put(
                "instrument.counter_bits",
                bits[0],
                bits[1],
                "  or: leave it out, if the counter was reset there",
            )
    else:
        value["unit"] = column.unit
        fold = _fold(x, column.unit) if column.kind == "angle" else None
        if fold is not None:
            value["wraps_at"] = fold[0]
            reasons.append(fold[1])
    draft.put("data.output", value, *reasons, *others)
    return column


def _of_each_sample(log: LogDescription, x: Array) -> bool:
    """True if counts, not their steps, follow the specific force: they are the pulses of each sample."""
    forces = [log.numbers[one.name] for one in log.of("force") if one.name in log.numbers]
    themselves = max((abs(_correlation(x, level)) for level in forces), default=0.0)
    steps = max((abs(_correlation(np.diff(x), level[1:])) for level in forces), default=0.0)
    return themselves > 0.99 and steps < 0.5


def _correlation(y: Array, x: Array) -> float:
    """Correlation of two columns, without gaps and jumps of y; 0 where one of them is the same everywhere."""
    good = np.isfinite(x) & np.isfinite(y)
    good &= np.abs(y) <= 3.0 * np.quantile(np.abs(y[good]), 0.9) if good.any() else False
    x, y = x[good], y[good]
    if x.size < 10 or np.std(y) == 0.0 or np.std(x) <= 0.02 * np.abs(x).max():
        return 0.0
    return float(np.corrcoef(x, y)[0, 1])


def _counter_bits(x: Array) -> tuple[int, str] | None:
    """Width of a counter that folds: the narrowest one that holds its values, if it falls by more than half of it."""
    x = x[np.isfinite(x)]
    if x.size < 3:
        return None
    d = np.diff(x)
    size, low, high = float(np.abs(d).max()), float(x.min()), float(x.max())
    usual = float(np.quantile(np.abs(d), 0.9))
    for bits in WIDTHS:
        span = 2.0**bits
        signed = low < 0.0
        if -0.5 * span * signed <= low and high < span * (0.5 if signed else 1.0):
            if size > 0.5 * span and usual < 0.25 * span:
                at = int(np.argmax(np.abs(d)))
                inside = f"between -2^{bits - 1} and 2^{bits - 1}" if signed else f"below 2^{bits}"
                return bits, f"goes from {x[at]:.0f} to {x[at + 1]:.0f} in one row, and stays {inside}"
            return None
    return None


def _fold(x: Array, unit: str) -> tuple[str, str] | None:
    """The value at which an angle folds back, if it does so at a whole turn."""
    x = x[np.isfinite(x)]
    if x.size < 3:
        return None
    turn = 2.0 * math.pi / parse_unit(unit).factor
    size = float(np.abs(np.diff(x)).max())
    if x.max() - x.min() <= 1.001 * turn and size > 0.5 * turn:
        return f"{turn:.12g} {unit}", f"folds back at {turn:.6g} {unit}: a step of {size:.6g}"
    return None


def _one_of_each_axis(columns: list[ColumnGuess]) -> list[ColumnGuess]:
    """The first column of each axis."""
    first: dict[int | None, ColumnGuess] = {}
    for column in columns:
        first.setdefault(column.axis, column)
    return list(first.values())


def _optional(draft: RunFileDraft, log: LogDescription) -> None:
    for kind, key in (("base-rate", "base_rate"),):
        group = _one_of_each_axis(log.of(kind))
        if [column.axis for column in group] == [0, 1, 2] and len({column.unit for column in group}) == 1:
            value = {"columns": [column.name for column in group], "unit": group[0].unit}
            draft.put(f"data.{key}", value, group[0].reason)
    warm = log.of("temperature")
    if warm:
        draft.put("data.temperature", {"column": warm[0].name, "unit": warm[0].unit}, warm[0].reason)
    parts = log.of("segment")
    if parts:
        draft.put("data.segment", parts[0].name, parts[0].reason)
    numbers = [c for c in log.of("sequence") if c.name in log.numbers and Values.of(log.numbers[c.name]).even]
    if numbers:
        draft.put("data.sequence", {"column": numbers[0].name}, numbers[0].reason)


LEAST_RELATED = 0.9
"""Least correlation of the output rate with the specific force along an axis that is taken for the input axis."""


def _from_input_axis(
    draft: RunFileDraft, log: LogDescription, output: ColumnGuess, names: list[str]
) -> tuple[list[str], list[str]]:
    """The columns of the specific force from the input axis on, and why. The output turns with the force along X0."""
    related = [_related(draft, log, output, name) for name in names]
    first = int(np.argmax(np.abs(related)))
    if abs(related[first]) < LEAST_RELATED:
        if all(np.isfinite(related)) and max(map(abs, related)) > 0.0:
            size = abs(related[0])
            return names, [f"CHECK: the output does not follow {names[0]} (correlation {size:.2f})"]
        return names, []
    words = []
    if first and abs(related[0]) < LEAST_RELATED:
        words.append(
            f"CHECK: the output turns with {names[first]}, so this is X0; Y0 and Z0 follow in the sense of rotation"
        )
        names = [*names[first:], *names[:first]]
    if related[first] < 0.0 and abs(related[first]) >= LEAST_RELATED:
        words.append(
            f"CHECK: the output falls where {names[0]} is positive. piga wants it to rise: change the sign of the output, "
            "or of X0 and one other axis, in the log"
        )
    return names, words


def _related(draft: RunFileDraft, log: LogDescription, output: ColumnGuess, name: str) -> float:
    """Correlation of the output rate with a column of force; 0 where the force is the same everywhere."""
    read = _rate_and_level(draft, log, output, log.numbers.get(name))
    if read is None:
        return 0.0
    return _correlation(*read)


def _seconds(draft: RunFileDraft, log: LogDescription, count: int) -> Array | None:
    """Time of the rows [s]."""
    time, rate = draft.document["data"].get("time"), draft.document["data"].get("sample_rate")
    if isinstance(time, Mapping):
        t = log.numbers.get(str(time.get("column")))
        return None if t is None else t * parse_unit(str(time.get("unit", "s"))).factor
    if rate is None:
        return None
    try:
        return np.arange(count) / to_si(rate, "Hz")
    except (UnitError, ZeroDivisionError):
        return None


def _rate_and_level(
    draft: RunFileDraft, log: LogDescription, output: ColumnGuess, force: Array | None
) -> tuple[Array, Array] | None:
    """Rate of the output, in its unit per second, and the force at the same times in the unit of its column."""
    x = log.numbers.get(output.name)
    if x is None or force is None:
        return None
    if output.kind == "rate":
        return x, force
    seconds = _seconds(draft, log, x.size)
    if seconds is None:
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = np.diff(x) / np.diff(seconds)
    return np.where(np.isfinite(rate), rate, np.nan), 0.5 * (force[1:] + force[:-1])


def _reference(
    draft: RunFileDraft, log: LogDescription, output: ColumnGuess | None, settings: Mapping[str, Any]
) -> None:
    """The specific force: from its columns, or from the columns of the stand."""
    group = _one_of_each_axis(log.of("force"))
    if [column.axis for column in group] == [0, 1, 2] and len({column.unit for column in group}) == 1:
        names = [column.name for column in group]
        others = [f"  or: {other}" for other in group[0].alternatives]
        if output is not None and output.name in log.numbers:
            names, why = _from_input_axis(draft, log, output, names)
            others = [*why, *others]
        more = [one.name for one in log.of("force") if one not in group]
        others += [f"  or: column {name}" for name in more]
        draft.put("data.reference", {"columns": names, "unit": group[0].unit}, group[0].reason, *others)
        if "base_rate" not in draft.document["data"]:
            draft.comments["data.reference"].append(EARTH)
        return
    if any(key == "data.reference" or key.startswith("stand.kind") for key in settings):
        return
    angle, speed = log.of("stand-angle")[:1], log.of("stand-speed")[:1]
    for columns, stand in ((angle, _head), (speed, _centrifuge)):
        held = _holds(draft, log, columns[0]) if columns and columns[0].name in log.numbers else None
        if held is not None:
            stand(draft, log, columns[0], held)
            _site(draft, log)
            return


def _fills(draft: RunFileDraft, log: LogDescription) -> None:
    """Limits that leave out numbers which mark missing values."""
    used = json.dumps(draft.document["data"])
    limits = {
        name: [value, 1e30] if value < 0.0 else [-1e30, value]
        for name, value in log.fills.items()
        if json.dumps(name) in used
    }
    spikes = [
        {"rows": list(rows), "reason": f"{log.spikes[name][0]:g} in {name} marks a missing value"}
        for name in log.spikes
        if json.dumps(name) in used
        for rows in log.spikes[name][1]
    ]
    if spikes:
        before = draft.document["data"].get("leave_out", [])
        draft.put("data.leave_out", before + spikes, "single rows hold a number that marks a missing value")
    if limits:
        marks = ", ".join(f"{value:g} in {name}" for name, value in log.fills.items() if name in limits)
        draft.put("data.range", limits, f"the log writes {marks} for a missing value: such rows are left out")


def _holds(draft: RunFileDraft, log: LogDescription, column: ColumnGuess) -> list[tuple[str, float]] | None:
    """Label and mean value of the stand in each segment, in order. None if it does not hold still."""
    x = log.numbers[column.name]
    if log.labels is not None and log.labels.size == x.size:
        change = np.flatnonzero(np.diff(log.labels) != 0) + 1
        names = [log.label_names[code] if code >= 0 else "" for code in log.labels[np.r_[0, change]]]
    elif Values.of(x).stepped:
        change = np.flatnonzero(np.diff(x) != 0) + 1
        names = _still(draft, log, x, change)
        draft.put(
            "data.segment",
            column.name,
            f"no column numbers the positions; {column.name} holds its value in each",
        )
    else:
        return None
    parts = np.split(x, change)
    return [(name, float(np.nanmean(part))) for name, part in zip(names, parts, strict=True) if name]


SHORT_HOLD = 0.05
"""A value of the stand that is held for a smaller share of the longest hold belongs to a move."""


def _still(draft: RunFileDraft, log: LogDescription, x: Array, change: NDArray[np.int64]) -> list[str]:
    """Name of each hold. The rows in which the stand moves are left out; they have no name."""
    starts = np.r_[0, change]
    lengths = np.diff(np.r_[starts, x.size])
    moving = lengths < max(SHORT_HOLD * lengths.max(), 2)
    if log.rows is not None and moving.any():
        edges = np.flatnonzero(np.diff(np.r_[False, moving, False]))
        ends = starts + lengths - 1
        moves = [
            {"rows": [int(log.rows[starts[a]]), int(log.rows[ends[b - 1]])], "reason": "the stand moves"}
            for a, b in zip(edges[::2], edges[1::2], strict=True)
        ]
        draft.put("data.leave_out", moves, f"{len(moves)} moves of the stand between the positions")
        return ["" if part else f"{value:.12g}" for part, value in zip(moving, x[starts], strict=True)]
    return [f"{value:.12g}" for value in x[starts]]


def _head(
    draft: RunFileDraft, _log: LogDescription, column: ColumnGuess, held: list[tuple[str, float]]
) -> None:
    draft.put(
        "stand.kind",
        "dividing-head",
        f"{column.name} is the angle of the stand: {column.reason}",
        '  or: kind = "rate-table"',
    )
    angles = [f"{value:.9g} {column.unit}" for _, value in held]
    draft.put(
        "stand.positions",
        angles,
        f"mean of {column.name} in each of {len(held)} segments, in order",
        "0 deg has X0 up; change the signs if the head turns the other way",
    )


def _centrifuge(
    draft: RunFileDraft, log: LogDescription, column: ColumnGuess, held: list[tuple[str, float]]
) -> None:
    draft.put(
        "stand.kind",
        "centrifuge",
        f"{column.name} is the speed of the stand: {column.reason}",
        '  or: kind = "rate-table"',
    )
    draft.put(
        "stand.rates",
        [f"{value:.9g} {column.unit}" for _, value in held],
        f"mean of {column.name} in each of {len(held)} segments, in order",
    )
    draft.put("stand.down", False, "the list holds the levels up and down as they were run")
    radius = log.facts.get("stand.radius")
    if radius is not None:
        draft.put("stand.radius", _quantity(radius.value, "m"), radius.reason)


def _site(draft: RunFileDraft, log: LogDescription) -> None:
    for key, unit in (("stand.latitude", "deg"), ("stand.gravity", "m/s^2")):
        known = log.facts.get(key)
        if known is not None:
            draft.put(key, _quantity(known.value, unit), known.reason)


def _instrument(draft: RunFileDraft, log: LogDescription, output: ColumnGuess | None) -> None:
    own = draft.document["instrument"]
    serial = log.facts.get("instrument.serial")
    name = "".join(c if c.isprintable() else "_" for c in log.path.name.split(".")[0])
    if "serial" not in own:
        if serial is not None:
            draft.put("instrument.serial", str(serial.value), serial.reason)
        else:
            draft.put("instrument.serial", name, "the name of the file; no serial number stands in the log")
    scale = log.facts.get("instrument.scale_factor")
    if scale is not None and "scale_factor" not in own:
        draft.put("instrument.scale_factor", _quantity(scale.value, "rad/s/g"), scale.reason)
    counts = log.facts.get("instrument.counts_per_revolution")
    if counts is not None and "counts_per_revolution" not in own and _number(counts.value) > 0.0:
        draft.put("instrument.counts_per_revolution", _number(counts.value), counts.reason)
    if output is None:
        return
    slope = _slope(draft, log, output)
    if slope is None:
        return
    if output.kind != "counts":
        if "scale_factor" not in own:
            factor = parse_unit(output.unit).factor
            draft.put(
                "instrument.scale_factor",
                f"{slope * factor * G0:.4g} rad/s/g",
                "from the log: output rate over specific force along X0",
            )
    elif "scale_factor" in own and "counts_per_revolution" not in own:
        _counts_of(draft, slope)
    elif "counts_per_revolution" in own and "scale_factor" not in own:
        per_count = 2.0 * math.pi / float(own["counts_per_revolution"])
        draft.put(
            "instrument.scale_factor",
            f"{slope * per_count * G0:.4g} rad/s/g",
            "from the log: output rate over specific force along X0",
        )


def _counts_of(draft: RunFileDraft, slope: float) -> None:
    """Counts per revolution from the slope of the counts and the nominal scale factor."""
    try:
        scale = to_si(draft.document["instrument"]["scale_factor"], "rad/s/g", what="instrument.scale_factor")
    except UnitError as error:
        raise ArgumentError(
            error.message, remedy="e.g. --set instrument.scale_factor='0.8884 rad/s/g'"
        ) from None
    if scale <= 0.0:
        raise ArgumentError(
            "instrument.scale_factor: must be positive",
            remedy="use a positive value; where the output falls with the force, change its sign in the log",
        )
    value = 2.0 * math.pi * slope / scale
    near = min(USUAL_COUNTS, key=lambda usual: abs(math.log(usual / value)))
    if abs(near / value - 1.0) <= ROUND_COUNTS:
        draft.put(
            "instrument.counts_per_revolution",
            int(near),
            f"from the log: {value:.5g} with the nominal scale factor; the nearest usual number",
        )
    else:
        draft.put(
            "instrument.counts_per_revolution",
            round(value, 3),
            "from the log, with the nominal scale factor; not a usual number: check it",
        )


def _slope(draft: RunFileDraft, log: LogDescription, output: ColumnGuess) -> float | None:
    """Rate of the output over specific force along X0 [units/s per m/s^2], from the force columns of the log."""
    reference = draft.document["data"].get("reference")
    if isinstance(reference, Mapping):
        force = log.numbers.get(str(next(iter(reference.get("columns", ("",))))))
        factor = parse_unit(str(reference["unit"])).factor
    elif draft.document.get("stand", {}).get("kind") == "dividing-head":
        column = log.of("stand-angle")[0]
        force, factor = np.cos(log.numbers[column.name] * parse_unit(column.unit).factor), G0
    else:
        return None
    read = _rate_and_level(draft, log, output, force)
    if read is None:
        return None
    rate, level = read[0], read[1] * factor
    good = (
        np.isfinite(rate) & np.isfinite(level) & (np.abs(level) > 0.3 * np.nanmax(np.abs(level), initial=0.0))
    )
    if good.sum() < 10:
        return None
    slope = float(np.median(rate[good] / level[good]))
    good &= np.abs(rate - slope * level) < 0.2 * np.abs(slope * level)  # no folds, no moves
    mean = float(np.sum(rate[good] * level[good]) / np.sum(level[good] ** 2)) if good.any() else 0.0
    return abs(mean) if mean else None


def _model(draft: RunFileDraft, log: LogDescription) -> None:
    """Terms that the positions of the test can determine."""
    force = _levels(draft, log)
    if force is None:
        draft.put("model.terms", ["scale_factor", "tan_beta", "k0"], "the terms of every instrument")
        return
    a_x, a_y, a_z = force.T
    terms = ["scale_factor"]
    if np.hypot(a_y, a_z).max() > LEAST_SWING:
        terms.append("tan_beta")
    columns = [a_x]
    for name, column in (("k0", np.ones_like(a_x)), ("m_Y", a_y), ("m_Z", a_z)):
        trial = np.column_stack([*columns, column])
        size = np.linalg.norm(trial, axis=0)
        if (size > LEAST_SWING * math.sqrt(a_x.size)).all() and np.linalg.svd(trial / size, compute_uv=False)[
            -1
        ] > LEAST_SWING:
            terms.append(name)
            columns.append(column)
    draft.put("model.terms", terms, f"terms that the {a_x.size} levels of this log can tell; more: piga terms")


def _levels(draft: RunFileDraft, log: LogDescription) -> Array | None:
    """Specific force [g] at some rows (n, 3)."""
    reference, stand = draft.document["data"].get("reference"), draft.document.get("stand", {})
    if isinstance(reference, Mapping):
        columns = [log.numbers.get(str(name)) for name in reference.get("columns", ())]
        if len(columns) != 3 or any(column is None for column in columns):
            return None
        f = (
            np.column_stack([column for column in columns if column is not None])
            * parse_unit(str(reference["unit"])).factor
            / G0
        )
        f = f[np.isfinite(f).all(axis=1)][:: max(f.shape[0] // 2000, 1)]
        return np.unique(f.round(4), axis=0) if f.size else None
    if stand.get("kind") == "dividing-head" and isinstance(stand.get("positions"), list):
        x = np.array([to_si(value, "rad", what="[stand] positions") for value in stand["positions"]])
        return np.column_stack([np.cos(x), -np.sin(x), np.zeros(x.size)])
    return None


def _apply(draft: RunFileDraft, key: str, value: Any) -> None:
    """Set a value that the user gave, also inside an inline table."""
    parts = key.split(".")
    at: dict[str, Any] = draft.document.setdefault(parts[0], {})
    for part in parts[1:-1]:
        inner = at.get(part)
        at[part] = dict(inner) if isinstance(inner, Mapping) else {}
        at = at[part]
    at[parts[-1]] = value
    if parts[0] == "data" and parts[1] in ("time", "sample_rate"):
        at_data = draft.document["data"]
        at_data.pop("sample_rate" if parts[1] == "time" else "time", None)
    if parts[-1] == "stamp":
        at.pop("unit", None)
    draft.comments[".".join(parts[:2])] = ["as given"]


def _open(draft: RunFileDraft) -> None:
    """The questions that are still open."""
    document = draft.document
    own, data, stand = document["instrument"], document["data"], document.get("stand")
    missing = []
    if "output" not in data:
        missing.append("data.output")
    if "time" not in data and "sample_rate" not in data:
        missing.append("data.sample_rate")
    if "scale_factor" not in own:
        missing.append("instrument.scale_factor")
    counted = isinstance(data.get("output"), Mapping) and data["output"].get("kind") == "counts"
    if counted and "counts_per_revolution" not in own and "instrument.scale_factor" not in missing:
        missing.append("instrument.counts_per_revolution")
    if stand is not None:
        missing += ["stand.latitude"] if "latitude" not in stand else []
        missing += ["stand.radius"] if stand.get("kind") == "centrifuge" and "radius" not in stand else []
    elif "reference" not in data:
        missing.append("data.reference")
    draft.open = [QUESTIONS[key] for key in missing]


def _number(text: Any) -> float:
    try:
        return float(str(text).split()[0].replace(",", "."))
    except (ValueError, IndexError):
        return 0.0


def _quantity(text: Any, unit: str) -> str:
    """A quantity as a preamble writes it: a decimal comma becomes a point; a plain number gets the usual unit."""
    number, _, rest = str(text).strip().partition(" ")
    number = number.replace(",", ".")
    rest = rest.strip().removesuffix("N").strip()
    for written in (f"{number} {rest or unit}", number):
        try:
            to_si(written, unit)
        except UnitError:
            continue
        return written
    return str(text)
