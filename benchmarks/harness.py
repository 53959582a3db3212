"""What all timings share: works run in turn, their medians, and the figures that a table keeps."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from benchmarks import measured


def rounds(
    works: Mapping[str, Callable[[], object]], count: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, np.ndarray]:
    """Seconds of each work in each round by ``clock``, (count,) each. The first round is not counted.

    The works of one round follow each other, so the ratios of a round share the state of the machine.
    """
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(count + 1):
        for name, work in works.items():
            start = clock()
            work()
            times[name].append(clock() - start)
    return {name: np.array(values[1:]) for name, values in times.items()}


def seconds(
    work: Callable[[], object], count: int = 7, clock: Callable[[], float] = time.perf_counter
) -> np.ndarray:
    """Seconds of each of ``count`` calls after one for warm-up."""
    return rounds({"": work}, count, clock)[""]


def put_down(table: str, values: Mapping[str, Any], **shared: Any) -> None:
    """Print the values; with ``--record`` put those that the table has into docs/measured, to three digits."""
    for name, value in values.items():
        print(f"{name:72s} {value['value'] if isinstance(value, dict) else value:.4g}")
    if "--record" in sys.argv:
        names = {figure["name"] for figure in measured.load(table)[1]}
        rounded = {
            name: {**value, **{k: measured.rounded(value[k]) for k in ("value", "least") if k in value}}
            if isinstance(value, dict)
            else measured.rounded(value)
            for name, value in values.items()
            if name in names
        }
        measured.record(table, rounded, **shared)


def put_table(
    table: str,
    corner: str,
    rows: Mapping[str, Mapping[str, measured.Value | measured.Figure]],
    units: Mapping[str, str] | None = None,
    *,
    record: bool,
    **shared: Any,
) -> None:
    """Print the rows of a table; if asked, write the whole table into docs/measured with what its figures share."""
    for row, cells in rows.items():
        print(
            row, {column: v["value"] if isinstance(v, dict) else v for column, v in cells.items()}, flush=True
        )
    if record:
        measured.write(table, corner, rows, units, **shared)
