"""``piga init``, ``check``, ``convert``, ``noise``: logs and run files; ``terms``, ``examples``: their words."""

from __future__ import annotations

import difflib
import re
import shlex
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import piga
from piga.cli.common import (
    Ending,
    RunFileArgument,
    argument,
    counted,
    deliver,
    deliver_file,
    flag,
    option,
    progress,
    say,
    tell,
    write_text,
)
from piga.data import example_files
from piga.errors import ArgumentError, PigaError

if TYPE_CHECKING:
    from piga.describe import LogDescription, RunFileDraft
    from piga.keys import KeyPlace

_SET = "A value of the run file, e.g. data.time.unit=ms."
_COLUMN = "What a column holds: time, counts, 'angle [deg]', 'force x [g]', ..."
_AGAIN = "May be repeated."


def init(
    log: Annotated[Path, argument("LOG", "Log of a test, written by any program.")],
    out: Annotated[Path | None, option("RUN.toml", "The run file [default: LOG.toml].")] = None,
    settings: Annotated[list[str] | None, option("KEY=VALUE", f"{_SET} {_AGAIN}", "--set")] = None,
    columns: Annotated[list[str] | None, option("NAME=KIND", f"{_COLUMN} {_AGAIN}", "--column")] = None,
) -> None:
    """Draft a run file for a log.

    Guesses encoding, header, units, separator, decimal mark, time stamps, and the content of each column. Every guess is in
    the run file with its reason and its alternatives. What the log does not say is an open line in the run file.
    """
    from piga.describe import describe_log, draft_run_file, setting
    from piga.records.run_file import read_run_file

    chosen = out or log.parent / f"{log.name.split('.')[0] or 'run'}.toml"
    if chosen.suffix != ".toml":
        raise ArgumentError(f"--out {chosen}: the name must end in .toml", remedy="e.g. run.toml")
    Ending.options = ()  # a draft that nobody changed is replaced by that of other words
    with deliver_file(chosen, "init", [log]) as to:
        target = (to.folder or chosen.parent) / chosen.name
        given = dict(setting(text) for text in settings or [])
        kinds = {}
        for text in columns or []:
            name, _, kind = text.rpartition("=")
            if not name:
                remedy = "e.g. --column 'CH3=angle [deg]'"
                raise ArgumentError(f"--column {text}: is not name=kind", remedy=remedy)
            kinds[name] = kind
        with progress(f"reading {log.name}"):
            described = describe_log(log, kinds)
        draft = draft_run_file(described, given, folder=target.parent)
        read_run_file(target, draft.completed().text().encode())
        lines = list(_column_lines(described))
        if draft.open:
            end = list(_open_lines(described, draft, target, settings or [], columns or []))
        else:
            target.parent.mkdir(exist_ok=True)  # the log is named from there
            with progress("trying it"):
                end = list(_outcome_lines(target, draft))
        lines += [line for notes in draft.comments.values() for line in notes if line.startswith("CHECK")]
        write_text(to / target.name, draft.text())
        to.tell(lambda: _document(described, draft, target), lambda: "\n".join([*lines, *end]))


def _column_lines(described: LogDescription) -> Iterator[str]:
    layout = described.layout
    if layout is not None:
        yield f"{described.path}: {layout.form.encoding} text; names in row {layout.options.header}"
    names = [column.name if len(column.name) < 60 else f"{column.name[:57]}..." for column in described.columns]
    width = max(map(len, names), default=0)
    for name, column in zip(names, described.columns, strict=True):
        yield f"  {name:<{width}}  {column.words}"


def _open_lines(
    described: LogDescription, draft: RunFileDraft, target: Path, settings: list[str], columns: list[str]
) -> Iterator[str]:
    """What the log does not say, and the two ways to answer."""
    questions = (*draft.open, *draft.optional)
    yield f"{counted(len(questions), 'question')} open, since the log does not say it:"
    for one in questions:
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
    answers = " ".join([*given, *(f"--set {one.key}='{one.example}'" for one in questions)])
    yield f"  piga init {_typed(described.path)} --out {_typed(target)} --force {answers}"


def _typed(path: Path) -> str:
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def _outcome_lines(target: Path, draft: RunFileDraft) -> Iterator[str]:
    """What is read with the new run file, or why nothing is."""
    from piga.describe import try_run_file

    try:
        tried = try_run_file(draft, target)
    except PigaError as error:
        yield f"The log cannot be read with it yet: {error.message}"
        yield f"  remedy: {error.remedy}"
        yield from suggested_lines(target, draft.text().encode())
        return
    counts = Counter[str]()
    for event in tried.quality.events:
        counts[event.kind] += event.count
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


def check(
    run: Annotated[Path | None, argument("RUN.toml", "Run file of the recorded test.")] = None,
    out: Annotated[Path | None, option("DIR", "Write check.html with a picture of the record.")] = None,
    fix_suggestions: Annotated[bool, flag("--fix-suggestions", "Print lines that settle a refusal.")] = False,
    terms: Annotated[bool, flag("--terms", "Also say which terms the record determines (slow).")] = False,
    explain: Annotated[str | None, option("KEY", "Say what a key of any TOML file means.")] = None,
) -> None:
    """Show the content of a recorded test. Nothing is calibrated."""
    if explain is not None:
        explain_key(explain)
        return
    if run is None:
        raise ArgumentError("no run file is named", remedy="piga check RUN.toml, or piga check --explain KEY")
    try:
        with progress("reading"):
            record = piga.read_run(run)
            for _ in piga.stand.stand_changes(record):  # refuses what calibrate would refuse in [uncertainty]
                pass
    except PigaError:
        if fix_suggestions:
            say("\n".join(suggested_lines(run)))
        raise
    from piga.reports.check import brief, check_document, page

    with progress("asking for each term") if terms else nullcontext():
        prospects = piga.calibration.term_prospects(record) if terms else ()
    with deliver(out, "check", ("check.html",), [run]) as to:
        if out is not None:
            piga.reports.write_page(page(record, prospects), to / "check.html")
        to.tell(
            lambda: check_document(record, prospects), lambda: piga.reports.page_text(brief(record, prospects))
        )


def convert(
    run: RunFileArgument,
    out: Annotated[Path, option("FILE.parquet", "File for the clean record.")],
) -> None:
    """Write a recorded test as clean Parquet in SI.

    The file holds the units and all findings.
    """
    from piga.formats.columns import data_table, write_run_parquet

    if out.suffix != ".parquet":
        raise PigaError(f"--out {out}: the name must end in .parquet", remedy="e.g. clean.parquet")
    with deliver_file(out, "convert", [run]) as to:
        with progress("reading"):
            record = piga.read_run(run)
        with progress("writing"):
            write_run_parquet(record, to / out.name)
        to.tell(dict, lambda: f"{record.size} of {record.quality.rows} rows")
    say(f"a run file reads it with\n\n{data_table(record, out.name)}")


def suggested_lines(run: Path, content: bytes | None = None) -> list[str]:
    """The lines that were tried, in run-file syntax, with the reason as a comment."""
    from piga.describe.run_file import suggestions

    with progress("trying run-file lines"):
        tried = suggestions(run, content)
    lines = [] if tried else ["# no run-file line lets the log be read"]
    for item in tried:
        lines += [f"# {' '.join(item.reason.split())}", f"{item.line}    # in [{item.table}]"]
    return lines


def noise(
    log: Annotated[Path, argument("LOG", "Run file, or a log written by any program.")],
    column: Annotated[str | None, option("NAME", "Column of the output, for a log.")] = None,
    kind: Annotated[
        Literal["rate", "angle"],
        typer.Option("--kind", help="rate: a voltage, a rate. angle: what is summed up, as counts, a phase."),
    ] = "rate",
    unit: Annotated[str | None, option("UNIT", "Unit of the column [default: as in the log].")] = None,
    sample_rate: Annotated[str | None, option("RATE", "If no column holds the time, e.g. '20 Hz'.")] = None,
    out: Annotated[Path | None, option("DIR", "Write noise.json and noise.html.")] = None,
) -> None:
    """Show the noise of a static log.

    Allan, modified and Hadamard deviation, and the levels of quantisation, random walk, bias instability, rate random walk
    and drift, each with its interval.
    """
    from piga.noise import read_static_log
    from piga.reports.noise import brief, noise_document, page

    with progress("reading"):
        result = read_static_log(log, column=column, kind=kind, unit=unit, sample_rate=sample_rate)
    names = ("noise.json", "noise.html")
    with deliver(out, "noise", names, [log]) as to:
        to.show(noise_document(result), page(result), brief(result), *names)


# -- words of files and terms --------------------------------------------------------------------------


def explain(key: str) -> list[KeyPlace]:
    """The places of a key in all files: ``terms``, ``data.time.stamp`` or ``[data] time``."""
    from piga.keys import FILES, places_of

    wanted = ".".join(re.sub(r"[\[\]]", " ", key.replace(".", " ")).split())
    every = [place for file in FILES for place in places_of(file)]
    hits = [place for place in every if place.path == wanted]
    hits = hits or [place for place in every if place.path.endswith(f".{wanted}")]
    if not hits:
        known = {place.path for place in every} | {place.path.rpartition(".")[2] for place in every}
        near = difflib.get_close_matches(wanted, sorted(known), n=4)
        raise ArgumentError(
            f"no file has the key '{key[:60]}'",
            remedy=f"did you mean {', '.join(near)}?" if near else "write e.g. data.time.stamp, or terms",
        )
    return hits


def explain_key(key: str) -> None:
    """Say what a key means; places with the same meaning are named together."""
    from piga.keys import FILES

    rows: list[dict[str, str]] = []
    meanings: dict[str, dict[str, None]] = {}
    shown = "  {meaning}\n  value    {value}{in_unit}\n  default  {default}\n  example  {name} = {example}"
    for place in explain(key):
        words, file = place.words, FILES[place.file][0]
        row = {
            "file": file,
            "key": place.path,
            "meaning": words.sentence,
            "unit": words.unit,
            "value": place.kind,
        }
        rows.append(row | {"default": place.default, "example": words.example})
        plain = words.unit in ("", "1", "own", "as the value", "row", "rows")
        more = {"in_unit": "" if plain else f", e.g. in {words.unit}", "name": place.path.rpartition(".")[2]}
        meanings.setdefault(shown.format(**rows[-1], **more), {})[f"{place.path} ({file})"] = None
    tell(rows, (f"{'; '.join(places)}\n{meaning}" for meaning, places in meanings.items()))


def terms(name: Annotated[str | None, argument("TERM", "One term; all if left out.")] = None) -> None:
    """List the terms of the error model.

    For each: what it multiplies, its unit, its meaning, the test that shows it, and a size from the literature where there is one.
    """
    from piga.records.terms import TERM_WORDS, known_terms, term_words, unit_of

    names = list(TERM_WORDS) if name is None else [name]
    try:
        chosen = {one: term_words(one) for one in names}
    except KeyError:
        raise ArgumentError(f"'{name}' is not a term", remedy=known_terms(str(name))) from None
    units = {one: "g" if one in ("sn", "cn") else unit_of(one) for one in chosen}
    keys = ("formula", "meaning", "shown_by", "known")
    rows = [
        {"name": one, "unit": units[one]} | {key: getattr(w, key) for key in keys} for one, w in chosen.items()
    ]
    shown = "{name}  [{unit}]  {meaning}\n  adds     {formula}\n  shown by {shown_by}"
    tell(rows, ((shown + ("\n  e.g.     {known}" if row["known"] else "")).format(**row) for row in rows))


def examples(out: Annotated[Path, option("DIR", "Folder for the files.")] = Path("examples")) -> None:
    """Write all example files, as the how-tos use them.

    Run the commands of the how-tos in the folder that holds DIR.
    """
    texts = example_files()
    with deliver(out, "examples", tuple(texts), ()) as to:
        for name, content in texts.items():
            path = to / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        first = f"{to.folder}/dividing-head.toml"
        to.tell(dict, lambda: f"Try: piga simulate {first} --out head; piga calibrate head/run.toml")
