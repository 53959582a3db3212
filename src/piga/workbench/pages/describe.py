"""Describe: what a log holds and which unit it has; the run file as a form and as text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from piga.describe import LogDescription, RunFileDraft, describe_log, draft_run_file, setting
from piga.errors import ArgumentError, PigaError
from piga.records.run_file import read_run_file
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
    values: dict[str, Any] = {"check": None}
    if checked is not None:
        status = bench.jobs.status(checked)
        values["check"] = (checked, status, bench.jobs.text(checked, "out"), bench.jobs.text(checked, "err"))
    return render(request, "describe-run.html.jinja", code, name=name, text=text, message=message, **values)


def _draft_page(request: Request, name: str, given: dict[str, str], message: str = "") -> Response:
    """The page of a log: its columns, the questions that are open, and the run file so far."""
    folder = bench_of(request).folder
    log = folder.file(name)
    described = describe_log(log)
    draft, message = _draft(described, given, message)
    target = log.with_name(f"{log.name.split('.')[0]}.toml")
    return render(
        request, "describe-log.html.jinja", name=name, described=described, preview=_preview(described),
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
        Route("/describe/{name:path}", show, methods=["GET"]),
        Route("/describe/{name:path}", change, methods=["POST"]),
    ]
