"""Describe: what a log holds and which unit it has; the run file as a form and as text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from piga.describe import LogDescription, RunFileDraft, describe_log, draft_run_file, setting
from piga.describe.keys import places_in
from piga.describe.toml_writer import toml_value
from piga.errors import ArgumentError, PigaError
from piga.records.run_file import RunFile, read_run_file
from piga.records.text_files import toml_document
from piga.workbench.folder import Folder
from piga.workbench.pages.common import bench_of, form_of, only, redirect, render

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

ROWS = 8
"""Rows of the preview."""


def show(request: Request) -> Response:
    """A log with the draft of its run file, or a run file to correct."""
    folder, name = bench_of(request).folder, request.path_params["name"]
    if name.endswith(".toml"):
        path = folder.file(name)
        return _run_file_page(request, name, path.read_text(encoding="utf-8", errors="replace"))
    return _draft_page(request, name, {})


def _run_file_page(request: Request, name: str, text: str, message: str = "", code: int = 200) -> Response:
    bench = bench_of(request)
    job = bench.jobs.latest(name)
    checked = job if job is not None and job.command[0] == "check" else None
    try:
        tables = form_fields(text)
    except PigaError as error:
        tables, message = {}, message or str(error)
    values: dict[str, Any] = {"check": None, "tables": tables}
    if checked is not None:
        status = bench.jobs.status(checked)
        values["check"] = (checked, status, bench.jobs.text(checked, "out"), bench.jobs.text(checked, "err"))
    return render(
        request, "describe/describe-run.html.jinja", code, name=name, text=text, message=message, **values
    )


def _draft_page(request: Request, name: str, given: dict[str, str], message: str = "") -> Response:
    """The page of a log: its columns, the questions that are open, and the run file so far."""
    folder = bench_of(request).folder
    log = folder.file(name)
    described = describe_log(log)
    draft, message = _draft(described, given, message)
    target = log.with_name(f"{log.name.split('.')[0]}.toml")
    return render(
        request, "describe/describe-log.html.jinja", name=name, described=described, preview=_preview(described),
        draft=draft, given=given, message=message, target=folder.name(target), taken=target.exists(),
    )  # fmt: skip


def _draft(described: LogDescription, given: dict[str, str], message: str) -> tuple[RunFileDraft, str]:
    """The draft with what was given; what cannot be used is left out and said."""
    settings: dict[str, Any] = {}
    for key, value in given.items():
        try:
            settings |= dict([setting(f"{key}={value}")])
            draft_run_file(described, settings, folder=described.path.parent)
        except PigaError as error:
            settings.pop(key, None)
            message = message or str(error)
    return draft_run_file(described, settings, folder=described.path.parent), message


def _preview(described: LogDescription) -> list[list[str]]:
    """The first values of each number column, as they were read."""
    columns = [described.numbers.get(column.name) for column in described.columns]
    return [
        ["" if values is None or len(values) <= row else f"{values[row]:.9g}" for values in columns]
        for row in range(ROWS)
    ]


@dataclass(frozen=True)
class Field:
    """A key of the run file in the form: its path, what it means, and its value as TOML."""

    path: str
    sentence: str
    unit: str
    example: str
    value: str


def form_fields(text: str) -> dict[str, list[Field]]:
    """The keys of a run file by table, with their values in ``text``.

    Raises
    ------
    RunFileError
        If the text is not TOML.
    """
    document = toml_document(Path("run.toml"), text.encode("utf-8"))
    tables: dict[str, list[Field]] = {}
    for place in places_in("run", RunFile):
        table, _, key = place.path.partition(".")
        if not key or "." in key:
            continue
        held = document.get(table)
        value = toml_value(held[key]) if isinstance(held, dict) and key in held else ""
        words = place.words
        tables.setdefault(table, []).append(Field(place.path, words.sentence, words.unit, words.example, value))
    return tables


def text_with(text: str, values: Mapping[str, str]) -> str:
    """The text of a run file with other values; comments and all other keys stay as they are.

    Parameters
    ----------
    text:
        The run file.
    values:
        TOML values by ``table.key``. An empty one removes the key. A value that is not TOML is taken as text.

    Raises
    ------
    RunFileError
        If the text is not TOML, or a value cannot stand in a run file.
    """
    import tomlkit

    toml_document(Path("run.toml"), text.encode("utf-8"))
    document: Any = tomlkit.parse(text)
    known = {field.path: field.value for fields in form_fields(text).values() for field in fields}
    for path, value in values.items():
        table, _, key = path.partition(".")
        if path not in known or value.strip() == known[path]:
            continue
        if not value.strip():
            document[table].pop(key, None)
            continue
        if table not in document:
            document[table] = tomlkit.table()
        document[table][key] = _toml(value.strip())
    changed = str(tomlkit.dumps(document))
    toml_document(Path("run.toml"), changed.encode("utf-8"))
    return changed


def _toml(value: str) -> Any:
    """A value as TOML; words that are none are text."""
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    try:
        return tomlkit.value(value)
    except (TOMLKitError, ValueError):
        return value


async def sync(request: Request) -> Response:
    """Form and text after one of them was changed: the other one follows."""
    fields = await form_of(request)
    text, message = only(fields, "text").replace("\r\n", "\n"), ""
    try:
        if only(fields, "side") == "form":
            values = {
                key.removeprefix("key:"): held[-1] for key, held in fields.items() if key.startswith("key:")
            }
            text = text_with(text, values)
        tables = form_fields(text)
    except PigaError as error:
        message, tables = str(error), {}
    return render(request, "describe/describe-both.html.jinja", text=text, tables=tables, message=message)


async def change(request: Request) -> Response:
    """Draft anew with the answers, or write the run file and check it."""
    from starlette.concurrency import run_in_threadpool

    bench, name = bench_of(request), request.path_params["name"]
    fields = await form_of(request)
    word, text = only(fields, "do"), only(fields, "text").replace("\r\n", "\n")
    if word == "draft":
        given = {
            key.removeprefix("set:"): values[-1].strip()
            for key, values in fields.items()
            if key.startswith("set:") and values[-1].strip()
        }
        extra = only(fields, "correction").strip()
        message = ""
        if extra:
            key, _, value = extra.partition("=")
            given[key.strip()] = value.strip()
        return await run_in_threadpool(_draft_page, request, name, given, message)
    if word != "check":
        raise ArgumentError(f"{word!r}: is no command of this page", remedy="use its buttons")
    target = only(fields, "target") if not name.endswith(".toml") else name
    try:
        await run_in_threadpool(_save, bench.folder, target, text, new=target != name)
    except PigaError as error:
        if name.endswith(".toml"):
            return await run_in_threadpool(_run_file_page, request, name, text, str(error), 422)
        raise
    await run_in_threadpool(bench.jobs.start, ("check", target), "Check", target)
    return redirect(request, f"/describe/{target}")


def _save(folder: Folder, name: str, text: str, *, new: bool) -> None:
    """Write a run file, if it is one.

    Raises
    ------
    PigaError
        If the text is not a valid run file, or would replace one. Nothing is written then.
    """
    path = folder.path(name)
    if path.suffix != ".toml":
        raise ArgumentError(f"{name}: the name must end in .toml", remedy="e.g. run.toml")
    if new and path.exists():
        raise ArgumentError(f"{name}: exists already", remedy="choose another name")
    folder.write_toml(path, text, read_run_file, new=new)


def routes() -> list[Any]:
    """Routes of this page."""
    from starlette.routing import Route

    return [
        Route("/describe-sync", sync, methods=["POST"]),
        Route("/describe/{name:path}", show, methods=["GET"]),
        Route("/describe/{name:path}", change, methods=["POST"]),
    ]
