"""A run file that is not complete yet, and what the signals of a log say for it.

The output: how the counter folds, which force it follows, scale factor and counts per revolution. The specific force: from its
columns, or from the columns of the stand; and the terms that it can tell.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from piga.describe.columns import TOLD, ColumnGuess
from piga.describe.log import Guess, LogDescription
from piga.errors import ArgumentError, UnitError
from piga.keys import check_setting
from piga.reading.columns import positions
from piga.results import Array
from piga.stand.scenario import head_positions
from piga.text_files import toml_text, toml_value
from piga.units import G0, parse_unit, to_si

COUNTED = ("counts", "pulses")
"""Kinds of an output that needs the counts per revolution."""
HEIGHT = (
    "CHECK: how high is the laboratory? Without [stand] height (or gravity) 500 m are assumed as its uncertainty: "
    "155 ppm of the scale factor"
)
"""Comment of a draft that has neither height nor local gravity."""


@dataclass(frozen=True)
class Question:
    """A value that the log does not hold: the key of the run file, the question, an example."""

    key: str
    words: str
    example: str


_FORCE = '{ columns = ["fx", "fy", "fz"], unit = "g" }'
QUESTIONS = {one.key: one for one in (
    Question("instrument.scale_factor", "nominal scale factor (pendulosity over angular momentum)", "0.8884 rad/s/g"),
    Question("instrument.counts_per_revolution", "counts of the output per revolution of the outer gimbal", "72000"),
    Question("data.output", "column of the output", '{ column = "n", kind = "counts" }'),
    Question("data.sample_rate", "rate of the samples, since no column holds the time", "20 Hz"),
    Question("data.reference", "columns of the specific force along X0, Y0 and Z0", _FORCE),
    Question("stand.latitude", "latitude of the laboratory", "40 deg"),
    Question("stand.height", "height of the laboratory above sea level (if you know it)", "320 m"),
    Question("stand.radius", "radius of the centrifuge at the instrument", "1 m"),
)}  # fmt: skip
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
    optional:
        Questions without which a result is worse.
    """

    document: dict[str, dict[str, Any]]
    comments: dict[str, list[str]] = field(default_factory=dict)
    open: list[Question] = field(default_factory=list)
    optional: list[Question] = field(default_factory=list)

    def put(self, key: str, value: Any, *reasons: str) -> None:
        """Set ``table.key`` and the comment on it."""
        table, _, name = key.partition(".")
        self.document.setdefault(table, {})[name] = value
        if reasons:
            self.comments[key] = list(reasons)

    def put_guess(self, key: str, guess: Guess) -> None:
        """Set ``table.key`` to a guess; the comment names the reason and the alternatives."""
        name = key.rpartition(".")[2]
        others = [f"  or: {name} = {toml_value(other)}" for other in guess.alternatives]
        self.put(key, guess.value, guess.reason, *others)

    def put_fact(self, facts: Mapping[str, Guess], key: str, unit: str) -> bool:
        """Set ``table.key`` to the quantity that the preamble of the log states. False if it states none."""
        if key in facts:
            self.put(key, quantity_text(facts[key].value, unit), facts[key].reason)
        return key in facts

    def text(self) -> str:
        """The run file."""
        order: list[str] = [name for name in ("instrument", "data", "stand", "model") if name in self.document]
        order += [name for name in self.document if name not in order]
        comments = dict(self.comments)
        for one in (*self.open, *self.optional):
            table, _, key = one.key.partition(".")
            comments[f"{table}."] = [
                *comments.get(f"{table}.", []),
                f"OPEN: {one.words}. Correct the next line and remove its #.",
                f"{key} = {toml_value(setting(f'{one.key}={one.example}')[1])}",
            ]
        return toml_text({name: self.document[name] for name in order}, comments)

    def completed(self) -> RunFileDraft:
        """A draft in which every open question has its example as the answer: to check all that is not open."""
        whole = RunFileDraft({table: dict(part) for table, part in self.document.items()})
        for one in self.open:
            whole.put(one.key, setting(f"{one.key}={one.example}")[1])
        output = whole.document["data"].get("output")
        if isinstance(output, Mapping) and output.get("kind") in COUNTED:
            whole.document["instrument"].setdefault("counts_per_revolution", 72000)
        return whole

    def give(self, key: str, value: Any) -> None:
        """Set a value that the user gave, also inside an inline table."""
        parts = key.split(".")
        at: dict[str, Any] = self.document.setdefault(parts[0], {})
        for part in parts[1:-1]:
            inner = at.get(part)
            at[part] = dict(inner) if isinstance(inner, Mapping) else {}
            at = at[part]
        at[parts[-1]] = value
        if parts[:2] in (["data", "time"], ["data", "sample_rate"]):
            self.document["data"].pop("sample_rate" if parts[1] == "time" else "time", None)
        if parts[-1] == "stamp":
            at.pop("unit", None)
        self.comments[".".join(parts[:2])] = ["as given"]

    def ask(self) -> None:
        """Ask all questions that are still open."""
        own, data, stand = self.document["instrument"], self.document["data"], self.document.get("stand")
        output = data.get("output")
        counted = isinstance(output, Mapping) and output.get("kind") in COUNTED and "scale_factor" in own
        asked = QUESTIONS
        if own.get("kind") == "direct" and isinstance(output, Mapping):
            words, example = "nominal scale factor: its output for 1 g", f"1.3 {output.get('unit', 'V')}/g"
            asked = asked | {"instrument.scale_factor": Question("instrument.scale_factor", words, example)}
        at = {} if stand is None else stand
        missing = {
            "data.output": "output" not in data,
            "data.sample_rate": not {"time", "sample_rate"} & {*data},
            "instrument.scale_factor": "scale_factor" not in own,
            "instrument.counts_per_revolution": counted and "counts_per_revolution" not in own,
            "stand.latitude": stand is not None and "latitude" not in at,
            "stand.radius": at.get("kind") == "centrifuge" and "radius" not in at,
            "data.reference": stand is None and "reference" not in data,
        }
        self.open = [asked[key] for key, is_open in missing.items() if is_open]
        if stand is not None and not {"height", "gravity"} & {*stand}:
            self.optional = [asked["stand.height"]]
            self.comments.setdefault("stand.kind", []).append(HEIGHT)


def setting(text: str) -> tuple[str, Any]:
    """Key and value of ``instrument.scale_factor="0.8884 rad/s/g"``. A value that is not TOML is text."""
    key, equals, written = text.partition("=")
    key = key.strip()
    if not equals or "." not in key or not all(key.split(".")):
        raise ArgumentError(
            f"--set {text}: is not table.key=value",
            remedy="e.g. --set instrument.scale_factor='0.8884 rad/s/g'",
        )
    value: Any = written.strip()
    with suppress(tomllib.TOMLDecodeError):
        value = tomllib.loads(f"value = {value}")["value"]
    check_setting(key, value)
    return key, value


def number_in(text: Any) -> float:
    """The number at the beginning of a text, with a decimal comma or point; 0 if there is none."""
    try:
        return float(str(text).split()[0].replace(",", "."))
    except (ValueError, IndexError):
        return 0.0


def quantity_text(text: Any, unit: str) -> str:
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


# -- signals ---------------------------------------------------------------------------------------------

_WIDTHS = (8, 12, 16, 20, 24, 32)
"""Usual widths of counters [bits]."""
_ROUND_COUNTS = 0.02
"""Counts per revolution are rounded to a usual number within this relative distance."""
_USUAL_COUNTS = tuple(
    sorted(
        {m * 10**k for m in (1, 1.44, 1.8, 2, 2.5, 3.6, 4, 5, 7.2, 8) for k in range(2, 7)}
        | {2**k for k in range(8, 25)}
    )
)
MOVING = 0.02
"""Largest share of the rows in which a stand moves while a column numbers a position."""
_SAME_PLACE = 0.003
"""Largest distance from the middle of a position, relative to the largest value of the stand."""
_LEAST_RELATED = 0.9
"""Least correlation of the output rate with the specific force along an axis that is taken for the input axis."""


def put_output(draft: RunFileDraft, log: LogDescription) -> ColumnGuess | None:
    """Describe the output of the log, and return its column; None if no column holds a running output."""
    outputs = [column for kind in ("counts", "pulses", "angle", "rate", "direct") for column in log.of(kind)]
    outputs.sort(key=lambda column: not column.reason.startswith(TOLD))
    if not outputs:
        return None
    column = outputs[0]
    value: dict[str, Any] = {"column": column.name, "kind": column.kind}
    reasons = [column.reason]
    x = log.numbers.get(column.name, np.empty(0))
    if column.kind == "counts" and _of_each_sample(log, x):
        column = replace(column, kind="pulses")
        value["kind"] = "pulses"
        reasons.append("it follows the specific force itself: the pulses of each sample, which are summed")
    elif column.kind == "counts":
        bits = _counter_bits(x)
        if bits is not None:
            draft.put("instrument.counter_bits", *bits, "  or: leave it out, if the counter was reset there")
    elif column.kind == "direct":
        value |= {"kind": "rate", "unit": column.unit}
        draft.put("instrument.kind", "direct", f"{column.name} is in {column.unit}: no gimbal")
    elif column.kind != "pulses":
        value["unit"] = column.unit
        fold = _fold(x, column.unit) if column.kind == "angle" else None
        if fold is not None:
            value["wraps_at"] = fold[0]
            reasons.append(fold[1])
    draft.put("data.output", value, *reasons)
    return column


def _of_each_sample(log: LogDescription, x: Array) -> bool:
    """True if counts, not their steps, follow the specific force: they are the pulses of each sample."""
    forces = [log.numbers[one.name] for one in log.of("force") if one.name in log.numbers]
    angles = [one for one in log.of("stand-angle") if one.name in log.numbers]
    forces += [np.cos(log.numbers[one.name] * parse_unit(one.unit).factor) for one in angles]
    forces += [log.numbers[one.name] ** 2 for one in log.of("stand-speed") if one.name in log.numbers]
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
    """Width of a counter that folds: the narrowest one that holds its values, if it falls by more than half of it.

    Its steps, each the shortest way round, are then below half of it in nearly every row.
    """
    x = x[np.isfinite(x)]
    if x.size < 3:
        return None
    d = np.diff(x)
    low, high, at = float(x.min()), float(x.max()), int(np.argmax(np.abs(d)))
    signed = low < 0.0
    bits = next((n for n in _WIDTHS if -low <= 2.0 ** (n - signed) > high), None)
    if bits is None:
        return None
    span = 2.0**bits
    usual = float(np.quantile(np.abs(np.remainder(d + 0.5 * span, span) - 0.5 * span), 0.9))
    if abs(d[at]) <= 0.5 * span or usual >= 0.4 * span:
        return None
    inside = f"between -2^{bits - 1} and 2^{bits - 1}" if signed else f"below 2^{bits}"
    return bits, f"goes from {x[at]:.0f} to {x[at + 1]:.0f} in one row, and stays {inside}"


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


def _from_input_axis(rate: Array, log: LogDescription, names: list[str]) -> tuple[list[str], list[str]]:
    """The columns of the specific force from the input axis on, and why. The output turns with the force along X0."""
    related = [_correlation(rate, _beside(rate, log.numbers[name])) for name in names]
    first = int(np.argmax(np.abs(related)))
    if abs(related[first]) < _LEAST_RELATED:
        follows_none = all(np.isfinite(related)) and max(map(abs, related)) > 0.0
        why = f"CHECK: the output does not follow {names[0]} (correlation {abs(related[0]):.2f})"
        return names, [why] if follows_none else []
    if first == 0 or abs(related[0]) >= _LEAST_RELATED:
        return names, []
    why = (
        f"CHECK: the output turns with {names[first]}, so this is X0; Y0 and Z0 follow in the sense of rotation"
    )
    return [*names[first:], *names[:first]], [why]


def _rate_of(draft: RunFileDraft, log: LogDescription, output: ColumnGuess) -> Array | None:
    """Rate of the output in its unit per second: in each row, or from row to row. None without values or times."""
    x, data = log.numbers.get(output.name), draft.document["data"]
    if x is None or output.kind in ("rate", "direct"):
        return x
    time, step = data.get("time"), np.array(math.nan)
    if isinstance(time, Mapping):
        t = log.numbers.get(str(time.get("column")), np.empty(0))
        step = np.diff(t) * parse_unit(str(time.get("unit", "s"))).factor
    elif "sample_rate" in data:
        with suppress(UnitError, ZeroDivisionError):  # the reader of the run file says it
            step = np.array(1.0 / to_si(data["sample_rate"], "Hz"))
    if step.size == 0 or np.isnan(step).all():
        return None
    steps = x[1:] if output.kind == "pulses" else np.diff(x)
    if bits := draft.document["instrument"].get("counter_bits"):
        steps = np.remainder(steps + 2.0 ** (bits - 1), 2.0**bits) - 2.0 ** (bits - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = steps / step
    return np.where(np.isfinite(rate), rate, np.nan)


def _beside(rate: Array, force: Array) -> Array:
    """The force at the times of a rate."""
    return force if force.size == rate.size else 0.5 * (force[1:] + force[:-1])


def put_instrument(draft: RunFileDraft, log: LogDescription, output: ColumnGuess | None) -> None:
    """Serial number, scale factor and counts per revolution: from the preamble, else from the slope of the output."""
    own = draft.document["instrument"]
    if "serial" not in own:
        name = "".join(c if c.isprintable() else "_" for c in log.path.name.split(".")[0])
        unknown = Guess(name, "the name of the file; no serial number stands in the log")
        draft.put_guess("instrument.serial", log.facts.get("instrument.serial", unknown))
    if "scale_factor" not in own:
        draft.put_fact(log.facts, "instrument.scale_factor", "rad/s/g")
    counts = log.facts.get("instrument.counts_per_revolution")
    if counts is not None and "counts_per_revolution" not in own and number_in(counts.value) > 0.0:
        draft.put("instrument.counts_per_revolution", number_in(counts.value), counts.reason)
    slope = None if output is None else _slope(draft, log, output)
    if output is None or slope is None:
        return
    if "scale_factor" in own:
        if output.kind in COUNTED and "counts_per_revolution" not in own:
            _counts_of(draft, slope)
        return
    unit = "rad/s"
    if output.kind == "direct":
        factor, unit = 1.0, output.unit
    elif output.kind not in COUNTED:
        factor = parse_unit(output.unit).factor
    elif "counts_per_revolution" in own:
        factor = 2.0 * math.pi / float(own["counts_per_revolution"])
    else:
        return
    draft.put(
        "instrument.scale_factor",
        f"{slope * factor * G0:.4g} {unit}/g",
        "from the log: output rate over specific force along X0; write the nominal value, or K is tested against itself",
    )


def _counts_of(draft: RunFileDraft, slope: float) -> None:
    """Counts per revolution from the slope of the counts and the nominal scale factor."""
    scale = to_si(draft.document["instrument"]["scale_factor"], "rad/s/g", what="instrument.scale_factor")
    if scale <= 0.0:
        return  # the reader of the run file says it
    value = 2.0 * math.pi * slope / scale
    near = min(_USUAL_COUNTS, key=lambda usual: abs(math.log(usual / value)))
    if abs(near / value - 1.0) <= _ROUND_COUNTS:
        draft.put(
            "instrument.counts_per_revolution",
            int(near),
            f"from the log: {value:.5g} with the nominal scale factor; the nearest usual number",
        )
    else:
        why = f"with the nominal scale factor the log gives about {value:.5g} counts per revolution; not a usual number"
        draft.comments.setdefault("instrument.", []).append(why)


def _force(draft: RunFileDraft, log: LogDescription) -> tuple[Array | None, float, str]:
    """Specific force along X0 by row, its unit [m/s^2], and where it is large. The unit is nan for an arm of unknown radius."""
    reference, kind = draft.document["data"].get("reference"), draft.document.get("stand", {}).get("kind")
    angle, speed = log.of("stand-angle")[:1], log.of("stand-speed")[:1]
    if isinstance(reference, Mapping):
        name = str(next(iter(reference.get("columns", ("",)))))
        return log.numbers.get(name), parse_unit(str(reference["unit"])).factor, f"{name} is positive"
    if kind == "dividing-head" and angle:
        column = np.cos(log.numbers[angle[0].name] * parse_unit(angle[0].unit).factor)
        return column, G0, "the input axis points up"
    return (
        log.numbers[speed[0].name] ** 2 if kind == "centrifuge" and speed else None,
        math.nan,
        "the arm is fast",
    )


def _slope(draft: RunFileDraft, log: LogDescription, output: ColumnGuess) -> float | None:
    """Rate of the output over specific force along X0 [units/s per m/s^2]. A falling output is turned round."""
    rate, (force, unit, where) = _rate_of(draft, log, output), _force(draft, log)
    if rate is None or force is None:
        return None
    level = _beside(rate, force)
    large = np.abs(level) > 0.3 * np.nanmax(np.abs(level), initial=0.0)
    good = np.isfinite(rate) & np.isfinite(level) & large
    if good.sum() < 10:
        return None
    slope = float(np.median(rate[good] / level[good]))
    good &= np.abs(rate - slope * level) < 0.2 * np.abs(slope * level)  # no folds, no moves
    mean = float(np.sum(rate[good] * level[good]) / np.sum(level[good] ** 2)) if good.any() else 0.0
    turned = draft.document["data"]["output"]
    if mean < 0.0 and "direction" not in turned:
        turned["direction"] = -1
        draft.comments.setdefault("data.output", []).append(f"direction = -1: the output falls where {where}")
    return abs(mean) / unit if mean and math.isfinite(unit) else None


EARTH = (
    "CHECK: no rate of the base is logged. The rotation of the Earth stays in the coefficients (up to 82 ppm of the "
    "scale factor, 82 ug of k0): give [data] base_rate, or a [stand] table with the latitude in place of the reference"
)
_LEAST_SWING = 0.01
"""Transverse specific force [g] from which on ``tan_beta`` is asked for."""


def put_reference(
    draft: RunFileDraft, log: LogDescription, output: ColumnGuess | None, settings: Mapping[str, Any]
) -> None:
    """The specific force: from its columns, or from the columns of the stand."""
    group = triad(log.of("force"))
    if group:
        names = [column.name for column in group]
        checks: list[str] = []
        rate = None if output is None else _rate_of(draft, log, output)
        if rate is not None:
            names, checks = _from_input_axis(rate, log, names)
        draft.put("data.reference", {"columns": names, "unit": group[0].unit}, group[0].reason, *checks)
        if "base_rate" not in draft.document["data"] and not _direct(draft):
            draft.comments["data.reference"].append(EARTH)
        return
    if "data.reference" in settings:
        return
    for column in (*log.of("stand-angle")[:1], *log.of("stand-speed")[:1]):
        if settings.get("stand.kind", _STANDS[column.kind]) != _STANDS[column.kind]:
            continue
        held = _holds(draft, log, column) if column.name in log.numbers else None
        if held is not None:
            values = [f"{value:.9g} {column.unit}" for _, value in held]
            mean = f"mean of {column.name} in each of {len(values)} segments, in order"
            head = column.kind == "stand-angle"
            why = f"{column.name} is the {'angle' if head else 'speed'} of the stand: {column.reason}"
            draft.put("stand.kind", _STANDS[column.kind], why, '  or: kind = "rate-table"')
            if head:
                signs = "0 deg has X0 up; change the signs if the head turns the other way"
                north = (
                    "the axis of the head points north; if not, add azimuth = '90 deg' (from north over east)"
                )
                draft.put("stand.positions", values, mean, signs, north)
            else:
                draft.put("stand.rates", values, mean)
                draft.put("stand.down", False, "the list holds the levels up and down as they were run")
                draft.put_fact(log.facts, "stand.radius", "m")
            for key, unit in (("latitude", "deg"), ("height", "m"), ("gravity", "m/s^2")):
                draft.put_fact(log.facts, f"stand.{key}", unit)
            return


def triad(columns: list[ColumnGuess]) -> list[ColumnGuess]:
    """The first column of each axis, X0 to Z0, if they have one unit; else none."""
    first: dict[int | None, ColumnGuess] = {}
    for column in columns:
        first.setdefault(column.axis, column)
    whole = list(first) == [0, 1, 2] and len({column.unit for column in first.values()}) == 1
    return list(first.values()) if whole else []


def _holds(draft: RunFileDraft, log: LogDescription, column: ColumnGuess) -> list[tuple[str, float]] | None:
    """Label and mean value of the stand in each segment, in order. None if it does not hold still."""
    x, labels = log.numbers[column.name], log.labels
    change, names = np.empty(0, np.int64), []
    if labels is not None and labels.size == x.size:
        change = np.flatnonzero(np.diff(labels) != 0) + 1
        names = [log.label_names[code] if code >= 0 else "" for code in labels[np.r_[0, change]]]
    known = [part for part in np.split(x, change) if np.isfinite(part).any()]
    limit = _SAME_PLACE * max((float(np.nanmax(np.abs(part))) for part in known), default=0.0)
    moving = sum(np.count_nonzero(np.abs(part - np.nanmedian(part)) > limit) for part in known)
    if not names or moving > MOVING * x.size:
        if spans := positions(x):
            share = sum(stop - start for start, stop in spans) / x.size
            none = "the numbers of the positions cover moves" if names else "no column numbers the positions"
            draft.put(
                "data.segment",
                {"holds_of": column.name},
                f"{none}; {column.name} stands still {len(spans)} times, in {100.0 * share:.0f} % of the rows. "
                "The rows between are not used",
            )
            return [(str(k + 1), float(np.nanmean(x[start:stop]))) for k, (start, stop) in enumerate(spans)]
        if not names:
            return None
    parts = np.split(x, change)
    return [(name, float(np.nanmean(part))) for name, part in zip(names, parts, strict=True) if name]


_STANDS = {"stand-angle": "dividing-head", "stand-speed": "centrifuge"}
"""Stand of a column of each kind."""


def _direct(draft: RunFileDraft) -> bool:
    return draft.document["instrument"].get("kind") == "direct"


def put_terms(draft: RunFileDraft, log: LogDescription) -> None:
    """Terms that the positions of the test can determine."""
    force, counted = _levels(draft, log)
    if force is None:
        terms = ["scale_factor", "k0"] if _direct(draft) else ["scale_factor", "tan_beta", "k0"]
        draft.put("model.terms", terms, "the terms of every instrument")
        return
    a_x, a_y, a_z = force.T
    terms = ["scale_factor"]
    if np.hypot(a_y, a_z).max() > _LEAST_SWING and not _direct(draft):
        terms.append("tan_beta")
    columns = [a_x]
    for name, column in (("k0", np.ones_like(a_x)), ("m_Y", a_y), ("m_Z", a_z)):
        trial = np.column_stack([*columns, column])
        size = np.linalg.norm(trial, axis=0)
        if size.min() <= _LEAST_SWING * math.sqrt(a_x.size):
            continue
        if np.linalg.svd(trial / size, compute_uv=False)[-1] > _LEAST_SWING:
            terms.append(name)
            columns.append(column)
    draft.put("model.terms", terms, f"terms that the {counted} of this log can tell; more: piga terms")


def _levels(draft: RunFileDraft, log: LogDescription) -> tuple[Array | None, str]:
    """Specific force [g] in the positions of the test (n, 3), or at some rows if it has none; and what these are."""
    reference, stand = draft.document["data"].get("reference"), draft.document.get("stand", {})
    if isinstance(reference, Mapping):
        columns = [log.numbers[name] for name in reference.get("columns", ()) if name in log.numbers]
        if len(columns) != 3:
            return None, ""
        f = np.column_stack(columns) * parse_unit(str(reference["unit"])).factor / G0
        f = f[np.isfinite(f).all(axis=1)]
        spans = positions(f[:, np.argmax(np.ptp(f, axis=0))]) if f.size else []
        if spans:
            f = np.array([f[start:stop].mean(axis=0) for start, stop in spans])
            return f, f"{len(spans)} positions"
        f = f[:: max(f.shape[0] // 2000, 1)]
        return (np.unique(f.round(4), axis=0), "directions") if f.size else (None, "")
    stated = stand.get("positions")
    if stand.get("kind") == "dividing-head" and isinstance(stated, list | str | Mapping):
        x = np.array(head_positions(list(stated.values()) if isinstance(stated, Mapping) else stated))
        return np.column_stack([np.cos(x), -np.sin(x), np.zeros(x.size)]), f"{x.size} positions"
    return None, ""
