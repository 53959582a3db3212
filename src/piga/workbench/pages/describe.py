"""Describe: what a log holds and which unit it has; the run file as a form and as text."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.describe import LogDescription, RunFileDraft, describe_log, draft_run_file, setting
from piga.describe.columns import WORDS
from piga.describe.draft import FILES
from piga.errors import ArgumentError, PigaError
from piga.records.run_file import read_run_file
from piga.records.text_files import toml_document, toml_value
from piga.workbench.folder import Folder
from piga.workbench.forms import digest, form_of_text, form_values, sent_text, text_with, typed_text
from piga.workbench.pages.common import bench_of, only, redirect, render, sent_form
from piga.workbench.pages.jobs import CHECK, ask

ROWS = 8
"""Rows of the preview."""
TAKEN_OVER = ("instrument", "stand", "uncertainty")
"""Tables that an earlier run file can give."""


def show(request: Request) -> Response:
    """A log with the draft of its run file, or a run file to correct."""
    folder, name = bench_of(request).folder, request.path_params["name"]
    if name.endswith(".toml"):
        path = folder.file(name)
        return _run_file_page(request, name, path.read_text(encoding="utf-8", errors="replace"))
    return _written_page(request, name) or _draft_page(request, name, {})


def _run_file_page(request: Request, name: str, text: str, message: str = "", code: int = 200) -> Response:
    bench = bench_of(request)
    form = form_of_text(text, "run", message)
    check, faulty = None, ""
    if not form.message:
        try:
            read_run_file(bench.folder.toml(name))
            check = ask(bench, name, CHECK, always="again" in request.query_params)
        except (PigaError, OSError) as error:
            faulty = str(error)
    page = "check-part" if request.headers.get("hx-request") else "describe-run"
    return render(
        request, f"describe/{page}.html.jinja", code, name=name, form=form, check=check, faulty=faulty,
        back=f"/describe/{quote(name)}",
    )  # fmt: skip


def _written_page(request: Request, name: str) -> Response | None:
    """The page of a run file that is being written, or None if none is."""
    bench = bench_of(request)
    job = bench.jobs.get(request.query_params.get("job", ""))
    if job is None or job.command[:2] != ("init", name):
        return None
    status = bench.jobs.status(job)
    if status.state == "done":
        return redirect(request, f"/describe/{quote(job.result)}")
    if status.state == "running":
        return render(request, "describe/describe-wait.html.jinja", name=name, job=job, status=status)
    given = dict(word.removeprefix("--set=").split("=", 1) for word in job.command if word.startswith("--set="))
    message = bench.jobs.text(job, "err") or "It was stopped. Nothing was written."
    return _draft_page(request, name, given, message)


def _draft_page(
    request: Request, name: str, given: dict[str, str], message: str = "", code: int = 200
) -> Response:
    """The page of a log: its columns, the questions that are open, and the run file so far."""
    folder = bench_of(request).folder
    log = folder.file(name)
    described = describe_log(log)
    draft, message = _draft(described, given, message)
    target = log.with_name(f"{log.name.split('.')[0]}.toml")
    others = [entry.name for entry in folder.entries() if entry.state in ("ready", "calibrated")]
    return render(
        request, "describe/describe-log.html.jinja", code, name=name, described=described, preview=_preview(described),
        draft=draft, given=given, message=message, target=folder.name(target), taken=target.exists(),
        form=form_of_text(draft.text(), "run"), others=others, words=WORDS,
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


async def sync(request: Request) -> Response:
    """Form and text after one of them was changed: the other one follows."""
    fields = await sent_form(request)
    text, file = typed_text(fields), only(fields, "file")
    if file not in FILES:
        raise ArgumentError(f"{file!r}: is no kind of file", remedy="reload the page")
    message = ""
    if only(fields, "side") == "form":
        try:
            text = text_with(text, form_values(fields), file)
        except PigaError as error:
            message = str(error)
    return render(request, "describe/both.html.jinja", form=form_of_text(text, file, message))


async def change(request: Request) -> Response:
    """Draft anew with the answers, or write the run file."""
    name = request.path_params["name"]
    fields = await sent_form(request)
    word = only(fields, "do")
    if word not in ("draft", "take", "check", "phase"):
        raise ArgumentError(f"{word!r}: is not a command of this page", remedy="use its buttons")
    answer = _change_run_file if name.endswith(".toml") else _change_draft
    return await run_in_threadpool(answer, request, name, word, fields)


def _change_run_file(request: Request, name: str, word: str, fields: dict[str, list[str]]) -> Response:
    folder = bench_of(request).folder
    text = typed_text(fields)
    try:
        text = sent_text(fields, "run")
        if word == "phase":
            text = text_with(folder.file(name).read_text(encoding="utf-8"), {"model.phases": '"per-segment"'})
        _save(folder, name, text, new=False)
    except PigaError as error:
        return _run_file_page(request, name, text, str(error), 422)
    return redirect(request, f"/describe/{quote(name)}")


def _change_draft(request: Request, name: str, word: str, fields: dict[str, list[str]]) -> Response:
    bench = bench_of(request)
    given = {
        key.removeprefix("set:"): values[-1].strip()
        for key, values in fields.items()
        if key.startswith("set:") and values[-1].strip()
    }
    extra = only(fields, "correction").strip()
    if extra:
        key, _, value = extra.partition("=")
        given[key.strip()] = value.strip()
    if word == "take":
        given |= _taken_over(bench.folder, bench.folder.file(name), only(fields, "from"))
    if word != "check":
        return _draft_page(request, name, given)
    target = only(fields, "target")
    try:
        _check_target(bench.folder, target)
        text = sent_text(fields, "run")
        if digest(text) != only(fields, "drafted"):
            answers = {key: value for key, value in given.items() if key in only(fields, "asked").split()}
            _save(bench.folder, target, text_with(text, answers), new=True)
            return redirect(request, f"/describe/{quote(target)}")
        draft, message = _draft(describe_log(bench.folder.file(name)), given, "")
        if message or draft.open:
            still = "; ".join(question.words for question in draft.open)
            return _draft_page(request, name, given, message or f"The log does not say: {still}.", 422)
    except PigaError as error:
        return _draft_page(request, name, given, str(error), 422)
    settings = [f"--set={key}={value}" for key, value in given.items()]
    job = bench.jobs.start(("init", name, *settings, "--yes", "--out", target), "Describe", name, target)
    return redirect(request, f"/describe/{quote(name)}?job={job.key}")


def _taken_over(folder: Folder, log: Path, name: str) -> dict[str, str]:
    """Instrument and uncertainties of another run file, as settings of a draft; the stand, if the log has no reference."""
    document = toml_document(folder.toml(name))
    draft = draft_run_file(describe_log(log), {}, folder=log.parent)
    tables = ("instrument", "uncertainty") if "reference" in draft.document["data"] else TAKEN_OVER
    return {
        f"{table}.{key}": toml_value(value)
        for table in tables
        for key, value in document.get(table, {}).items()
    }


def _check_target(folder: Folder, name: str) -> Path:
    """The path of a new run file.

    Raises
    ------
    ArgumentError
        If the name is not one, or is taken.
    """
    path = folder.path(name)
    if path.suffix != ".toml":
        raise ArgumentError(f"{name}: the name must end in .toml", remedy="e.g. run.toml")
    if path.exists():
        raise ArgumentError(f"{name}: exists already", remedy="choose another name")
    return path


def _save(folder: Folder, name: str, text: str, *, new: bool) -> None:
    """Write a run file, if it is one.

    Raises
    ------
    PigaError
        If the text is not a valid run file, or would replace one. Nothing is written then.
    """
    path = _check_target(folder, name) if new else folder.path(name)
    folder.write_toml(path, text, read_run_file, new=new)


ROUTES = [
    Route("/form", sync, methods=["POST"]),
    Route("/describe/{name:path}", show, methods=["GET"]),
    Route("/describe/{name:path}", change, methods=["POST"]),
]
