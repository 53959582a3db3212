"""``piga init``: a run file for a log of any program."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from piga.cli.common import (
    ForceOption,
    JsonOption,
    argument,
    counted,
    no_folder,
    note,
    option,
    progress,
    say,
    tell,
    write_text,
)
from piga.errors import ArgumentError, PigaError
from piga.output import check_outputs, write_whole

if TYPE_CHECKING:
    from piga.describe import LogDescription, RunFileDraft
    from piga.records import Run


def init(
    log: Annotated[Path, argument("LOG", "Log of a test, written by any program.")],
    out: Annotated[Path | None, option("RUN.toml", "The run file [default: LOG.toml].")] = None,
    settings: Annotated[
        list[str] | None,
        option(
            "KEY=VALUE",
            "A value of the run file, e.g. instrument.scale_factor='0.8884 rad/s/g'. May be repeated.",
            "--set",
        ),
    ] = None,
    columns: Annotated[
        list[str] | None,
        option(
            "NAME=KIND",
            "What a column holds: time, counts, angle, 'force x [g]', stand-speed, ... May be repeated.",
            "--column",
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Take all guesses; do not ask.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draft a run file for a log.

    Guesses encoding, header, units, separator, decimal mark, time stamps, and the content of each column. Every guess is in
    the run file with its reason and its alternatives. At a terminal the command asks for what the log does not say.
    Elsewhere this is an open line in the run file.
    """
    from piga.describe import describe_log, draft_run_file, setting
    from piga.records.run_file import read_run_file

    target = out or no_folder(log).parent / f"{log.name.split('.')[0] or 'run'}.toml"
    if target.suffix != ".toml":
        raise ArgumentError(f"--out {target}: the name must end in .toml", remedy="e.g. run.toml")
    check_outputs([target], [log], force=force)
    given = dict(setting(text) for text in settings or [])
    kinds = {name: kind for name, _, kind in (text.rpartition("=") for text in columns or [])}
    with progress(f"reading {log.name}"):
        described = describe_log(log, kinds)
    draft = draft_run_file(described, given, folder=target.parent)
    asking = not (yes or as_json) and sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
    if asking:
        draft = _ask(described, given, target)
    read_run_file(target, draft.completed().text().encode())
    tried: Run | PigaError | None = None
    if not draft.open:
        with progress("trying it"):
            tried = _tried(draft, target)
    text = draft.text()
    write_whole(target, lambda path: write_text(path, text), remedy="choose another --out")
    columns_shown = () if asking else _column_lines(described)
    checks = (line for notes in draft.comments.values() for line in notes if line.startswith("CHECK"))
    end = (
        _open_lines(described, draft, target, settings or [], columns or [])
        if tried is None
        else _outcome_lines(target, tried)
    )
    lines = chain(columns_shown, [f"wrote {target}"], checks, end)
    tell(as_json, _document(described, draft, target), lines)


def _ask(described: LogDescription, given: dict[str, Any], target: Path) -> RunFileDraft:
    """Show the guesses, ask for what is missing and for corrections, until the user is content."""
    from piga.describe import draft_run_file, setting

    for line in _column_lines(described):
        say(line)
    left: set[str] = set()
    while True:
        draft = draft_run_file(described, given, folder=target.parent)
        question = next((one for one in (*draft.open, *draft.optional) if one.key not in left), None)
        if question is not None:
            words = f"{question.words} [{question.key}], e.g. {question.example}, or Enter to leave it open: "
            answer = _answer(words)
            if not answer:
                left.add(question.key)
                continue
            try:
                given |= dict([setting(f"{question.key}={answer}")])
                draft_run_file(described, given, folder=target.parent)
            except PigaError as error:
                given.pop(question.key, None)
                note(f"  {error}")
            continue
        note("")
        note(draft.text())
        answer = _answer("A correction as table.key=value, or Enter to write the file: ")
        if not answer:
            return draft
        try:
            trial = given | dict([setting(answer)])
            draft_run_file(described, trial, folder=target.parent)
            given.clear()
            given |= trial
        except PigaError as error:
            note(f"  {error}")


def _answer(words: str) -> str:
    sys.stderr.write(words)
    sys.stderr.flush()
    line = sys.stdin.readline()
    if not line:
        raise ArgumentError(
            "the input ended", remedy="nothing was written; run the command again, or with --yes"
        )
    return line.strip()


def _column_lines(described: LogDescription) -> Iterator[str]:
    layout = described.layout
    if layout is not None:
        yield f"{described.path}: {layout.encoding.value} text; names in row {layout.header_row.value}"
    names = [column.name if len(column.name) < 60 else f"{column.name[:57]}..." for column in described.columns]
    width = max(map(len, names), default=0)
    for name, column in zip(names, described.columns, strict=True):
        yield f"  {name:<{width}}  {column.words}"


def _tried(draft: RunFileDraft, target: Path) -> Run | PigaError:
    """The log as read with the new run file, or why it cannot be read."""
    from piga.describe import try_run_file

    try:
        return try_run_file(draft, target)
    except PigaError as error:
        return error


def _open_lines(
    described: LogDescription, draft: RunFileDraft, target: Path, settings: list[str], columns: list[str]
) -> Iterator[str]:
    """What the log does not say, and the two ways to answer."""
    yield f"{counted(len(draft.open), 'question')} open, since the log does not say it:"
    for one in (*draft.open, *draft.optional):
        yield f"  {one.key}: {one.words}"
    unused = [one.name for one in described.columns if one.kind == "other" and one.name in described.numbers]
    if unused and any(one.key in ("data.output", "data.reference") for one in draft.open):
        yield (
            f"  Not understood: {', '.join(unused)}. Say what one holds: --column {shlex.quote(unused[0] + '=angle')}"
        )
    for line in draft.comments.get("data.", []):
        yield f"  {line}"
    yield f"Answer in {target} (lines marked OPEN), or run the command again:"
    given = [f"--set {shlex.quote(text)}" for text in settings]
    given += [f"--column {shlex.quote(text)}" for text in columns]
    answers = " ".join(
        [*given, *(f"--set {one.key}='{one.example}'" for one in (*draft.open, *draft.optional))]
    )
    yield f"  piga init {_typed(described.path)} --out {_typed(target)} --force {answers}"


def _typed(path: Path) -> str:
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def _outcome_lines(target: Path, tried: Run | PigaError) -> Iterator[str]:
    from piga.cli.check import suggested_lines

    if isinstance(tried, PigaError):
        yield f"The log cannot be read with it yet: {tried.message}"
        yield f"  remedy: {tried.remedy}"
        yield from suggested_lines(target)
        return
    counts: dict[str, int] = {}
    for event in tried.quality.events:
        counts[event.kind] = counts.get(event.kind, 0) + event.count
    events = "".join(f"; {count} x {kind}" for kind, count in counts.items())
    yield (
        f"It reads {tried.size} of {tried.quality.rows} rows in {counted(len(tried.labels), 'segment')}{events}"
    )
    yield f"Next: piga check {_typed(target)}; piga calibrate {_typed(target)}"


def _document(described: LogDescription, draft: RunFileDraft, target: Path) -> dict[str, Any]:
    return {
        "run_file": str(target),
        "document": draft.document,
        "comments": draft.comments,
        "open": [{"key": one.key, "words": one.words, "example": one.example} for one in draft.open],
        "columns": [
            {
                "name": column.name,
                "kind": column.kind,
                "axis": None if column.axis is None else "XYZ"[column.axis] + "0",
                "unit": column.unit or None,
                "stamp": column.stamp or None,
                "reason": column.reason,
                "alternatives": list(column.alternatives),
            }
            for column in described.columns
        ],
    }
