"""The specific force of a log: from its columns, or from the columns of the stand; and the terms that it can tell."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.describe.columns import ColumnGuess, Values
from piga.describe.draft import RunFileDraft, quantity_text
from piga.describe.log import LogDescription
from piga.describe.output import from_input_axis
from piga.stand.scenario import head_positions
from piga.units import G0, parse_unit

Array = NDArray[np.float64]

EARTH = (
    "CHECK: no rate of the base is logged. The rotation of the Earth stays in the coefficients (up to 82 ppm of the "
    "scale factor, 82 ug of k0): give [data] base_rate, or a [stand] table with the latitude in place of the reference"
)
LEAST_SWING = 0.01
"""Transverse specific force [g] from which on ``tan_beta`` is asked for."""
SHORT_HOLD = 0.05
"""A value of the stand that is held for a smaller share of the longest hold belongs to a move."""


def put_reference(
    draft: RunFileDraft, log: LogDescription, output: ColumnGuess | None, settings: Mapping[str, Any]
) -> None:
    """The specific force: from its columns, or from the columns of the stand."""
    group = one_of_each_axis(log.of("force"))
    if [column.axis for column in group] == [0, 1, 2] and len({column.unit for column in group}) == 1:
        names = [column.name for column in group]
        others = [f"  or: {other}" for other in group[0].alternatives]
        if output is not None and output.name in log.numbers:
            names, why = from_input_axis(draft, log, output, names)
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


def one_of_each_axis(columns: list[ColumnGuess]) -> list[ColumnGuess]:
    """The first column of each axis."""
    first: dict[int | None, ColumnGuess] = {}
    for column in columns:
        first.setdefault(column.axis, column)
    return list(first.values())


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
        draft.put("stand.radius", quantity_text(radius.value, "m"), radius.reason)


def _site(draft: RunFileDraft, log: LogDescription) -> None:
    for key, unit in (("stand.latitude", "deg"), ("stand.gravity", "m/s^2")):
        known = log.facts.get(key)
        if known is not None:
            draft.put(key, quantity_text(known.value, unit), known.reason)


def put_terms(draft: RunFileDraft, log: LogDescription) -> None:
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
    positions = stand.get("positions")
    if stand.get("kind") == "dividing-head" and isinstance(positions, list | str | Mapping):
        x = np.array(head_positions(list(positions.values()) if isinstance(positions, Mapping) else positions))
        return np.column_stack([np.cos(x), -np.sin(x), np.zeros(x.size)])
    return None
