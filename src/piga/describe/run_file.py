"""Draft a run file from the description of a log, and find the lines that repair a run file.

Every guessed line has its reason and its alternatives. Every line of a repair is tried before it is given.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from piga.describe.columns import ColumnGuess, Values
from piga.describe.draft import (
    RunFileDraft,
    number_in,
    put_instrument,
    put_output,
    put_reference,
    put_terms,
    triad,
)
from piga.describe.log import LogDescription, describe_log
from piga.errors import DataError, PigaError
from piga.records.run import Run
from piga.results import Array
from piga.stand.run_reference import read_run
from piga.text_files import toml_document, toml_key, toml_text, toml_value
from piga.units import parse_unit

_MOST_DAMAGED = 0.01
"""Largest share of damaged rows that a draft leaves out by itself."""


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
    """
    settings = dict(settings or {})
    draft = RunFileDraft({"instrument": {}, "data": {}})
    draft.comments[""] = [
        f"A run file for {log.path.name}, drafted by 'piga init'. Each guess says why, and what else it may be.",
        "Read it, correct it, then: piga check, piga calibrate.",
        "",
        *(f"  {column.name}: {column.words}" for column in log.columns),
    ]
    file = os.path.relpath(log.path, folder or log.path.parent)
    draft.put("data.file", Path(file).as_posix())
    guesses = log.layout.guesses if log.layout else {}
    sheet = {"sheet": log.facts["data.sheet"]} if "data.sheet" in log.facts else {}
    for key, guess in (sheet | guesses).items():
        draft.put_guess(f"data.{key}", guess)
    _time(draft, log)
    output = put_output(draft, log)
    _optional(draft, log)
    put_reference(draft, log, output, settings)
    used = json.dumps(draft.document["data"])
    fills = {name: value for name, value in log.fills.items() if json.dumps(name) in used}
    if fills:
        marks = ", ".join(f"{value:g} in {name}" for name, value in fills.items())
        words = list(dict.fromkeys(f"{value:g}" for value in fills.values()))
        draft.put("data.missing", words, f"the log writes {marks} for a missing value: such rows are left out")
    for key, value in settings.items():
        draft.give(key, value)
    put_instrument(draft, log, output)
    put_terms(draft, log)
    for key, value in settings.items():
        draft.give(key, value)
    draft.ask()
    return draft


def try_run_file(draft: RunFileDraft, path: Path) -> Run:
    """Read the log with a draft. ``path``: where the run file will be written.

    If the counter may have folded in a gap, the draft gets one phase for each segment, and the log is read again.
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


def _without_damage(draft: RunFileDraft, path: Path, error: DataError) -> Run:
    """Read the log without a few damaged rows: words that mark missing values, or a footer. The draft says so."""
    why = f"{' '.join(error.message.split(': ', 1)[-1].split())[:200]}: left out and counted"
    for fix in error.fixes:
        if fix.key in ("missing", "damaged_rows"):
            trial = RunFileDraft(draft.document | {"data": draft.document["data"] | {fix.key: fix.value}})
            with suppress(PigaError), np.errstate(divide="ignore", invalid="ignore"):
                run = read_run(path, content=trial.text().encode())
                if run.quality.rows - run.size <= max(_MOST_DAMAGED * run.quality.rows, 2):
                    draft.put(f"data.{fix.key}", fix.value, why)
                    return run
    raise error


def _time(draft: RunFileDraft, log: LogDescription) -> None:
    times = sorted(log.of("time"), key=lambda column: bool(column.stamp))
    if not times:
        step = log.facts.get("step")
        stated = draft.put_fact(log.facts, "data.sample_rate", "Hz")
        if not stated and step is not None and number_in(step.value) > 0.0:
            rate = f"{1.0 / number_in(step.value):.9g} Hz"
            draft.put("data.sample_rate", rate, f"{step.reason}: the time between samples")
        return
    column = times[0]
    value = {"column": column.name, **({"stamp": column.stamp} if column.stamp else {"unit": column.unit})}
    rounded = _rate_of_rounded(log.numbers.get(column.name, np.empty(0)), column)
    if rounded is not None:
        why = f"the times of {column.name} are rounded: each stands in {rounded[1]:g} rows"
        draft.put("data.sample_rate", f"{rounded[0]:.9g} Hz", why)
        return
    draft.put("data.time", value, column.reason)


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


def _optional(draft: RunFileDraft, log: LogDescription) -> None:
    group = triad(log.of("base-rate"))
    if group and draft.document["instrument"].get("kind") != "direct":
        value = {"columns": [column.name for column in group], "unit": group[0].unit}
        draft.put("data.base_rate", value, group[0].reason)
    warm = log.of("temperature")
    if warm:
        draft.put("data.temperature", {"column": warm[0].name, "unit": warm[0].unit}, warm[0].reason)
    parts = log.of("segment")
    if parts:
        draft.put("data.segment", parts[0].name, parts[0].reason)
    numbers = [c for c in log.of("sequence") if c.name in log.numbers and Values.of(log.numbers[c.name]).even]
    if numbers:
        draft.put("data.sequence", {"column": numbers[0].name}, numbers[0].reason)


# -- repairs ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Suggestion:
    """A line for a table of the run file, and the reason. It replaces a line with the same key."""

    table: str
    line: str
    reason: str


def suggestions(path: Path, content: bytes | None = None) -> list[Suggestion]:
    """Lines with which a refused log can be read: those of a new draft that are needed.

    They were put into the file, and the log was read again: with all of them, and without each. The list is empty if they do
    not let the log be read. ``content`` is the text of a file that is not on disk.
    """
    try:
        document = toml_document(path, content)
        log = path.parent / document["data"]["file"]
        if _reads(path, document):
            return []
        tables = {table: document.get(table, {}) for table in ("instrument", "stand")}
        given = {f"{table}.{key}": value for table, part in tables.items() for key, value in part.items()}
        draft = draft_run_file(describe_log(log), given, folder=path.parent)
        with suppress(PigaError):
            try_run_file(draft, path)
    except (PigaError, KeyError, TypeError, AttributeError):
        return []
    fresh = ((table, *entry) for table in ("instrument", "data") for entry in draft.document[table].items())
    changes = [one for one in fresh if document.get(one[0], {}).get(one[1]) != one[2]]
    if not _reads(path, document, changes):
        return []
    for change in tuple(changes):
        fewer = [one for one in changes if one is not change]
        changes = fewer if _reads(path, document, fewer) else changes
    lines = []
    for table, key, value in changes:
        reason = f"as a new run file has it: {draft.comments.get(f'{table}.{key}', [''])[0]}"
        lines.append(Suggestion(table, f"{toml_key(key)} = {toml_value(value)}", reason))
    return lines


def _reads(path: Path, document: dict[str, Any], changes: Iterable[tuple[str, str, Any]] = ()) -> bool:
    """True if the log can be read with these changes of the run file: table, key and value."""
    for table, key, value in changes:
        document = {**document, table: {**document.get(table, {}), key: value}}
    try:
        with np.errstate(divide="ignore", invalid="ignore"):
            read_run(path, content=toml_text(document).encode())
    except PigaError:
        return False
    return True
