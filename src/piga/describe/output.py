"""What the output column says: how the counter folds, which force it follows, scale factor and counts per revolution."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.describe.columns import WORDS, ColumnGuess
from piga.describe.draft import RunFileDraft, number_in, quantity_text
from piga.describe.log import LogDescription
from piga.errors import ArgumentError, UnitError
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
LEAST_RELATED = 0.9
"""Least correlation of the output rate with the specific force along an axis that is taken for the input axis."""


def put_output(draft: RunFileDraft, log: LogDescription) -> ColumnGuess | None:
    """Describe the output of the log, and return its column; None if no column holds a running output."""
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


def from_input_axis(
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


def put_instrument(draft: RunFileDraft, log: LogDescription, output: ColumnGuess | None) -> None:
    """Serial number, scale factor and counts per revolution: from the preamble, else from the slope of the output."""
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
        draft.put("instrument.scale_factor", quantity_text(scale.value, "rad/s/g"), scale.reason)
    counts = log.facts.get("instrument.counts_per_revolution")
    if counts is not None and "counts_per_revolution" not in own and number_in(counts.value) > 0.0:
        draft.put("instrument.counts_per_revolution", number_in(counts.value), counts.reason)
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
    elif draft.document.get("stand", {}).get("kind") == "dividing-head" and log.of("stand-angle"):
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
