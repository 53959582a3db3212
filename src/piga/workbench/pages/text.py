"""Show as text: any TOML file of the folder, or an example to begin with, and the commands that run it."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.data import example_files
from piga.errors import ArgumentError, PigaError
from piga.records.text_files import files_named_in, toml_document
from piga.workbench.folder import OutsideError
from piga.workbench.history import ChangedError
from piga.workbench.pages.common import Sent, bench_of, only, posted, redirect, render
from piga.workbench.pages.later import start
from piga.workbench.pages.record import left

_COMMANDS: dict[str, dict[str, str]] = {
    "run file": {"check": "Check", "calibrate": "Calibrate"},
    "plan": {"plan": "Plan the test"},
    "platform": {
        "platform navigate": "Navigate", "platform compare": "Compare models", "platform simulate": "Simulate",
        "platform identify": "Identify", "platform align": "Align",
    },
    "scenario": {"simulate": "Simulate the test"},
    "other file": {},
}  # fmt: skip
"""Commands by kind of file."""


def _kind_of(document: dict[str, Any]) -> str:
    """Kind of a file by its tables."""
    for table, kind in (("data", "run file"), ("plan", "plan"), ("case_rotation", "platform")):
        if table in document:
            return kind
    return "scenario" if {"stand", "electronics"} <= document.keys() else "other file"


def _show(request: Request) -> Response:
    """A file, or an example to begin with."""
    folder, query = bench_of(request).folder, request.query_params
    name, example = query.get("file", ""), query.get("example", "")
    if name:
        return _page(request, name, folder.text(name))
    if example and example not in _examples():
        raise OutsideError(f"{example[:80]!r}: is no example", remedy="choose one of the list")
    return _page(request, "", _examples()[example].decode("utf-8") if example else "", example=example)


def _examples() -> dict[str, bytes]:
    return {name: raw for name, raw in sorted(example_files().items()) if name.endswith(".toml")}


def _page(
    request: Request, name: str, text: str, message: str = "", code: int = 200, example: str = ""
) -> Response:
    bench, kind = bench_of(request), "other file"
    with contextlib.suppress(PigaError):
        kind = _kind_of(toml_document(Path(name or "the text"), text.encode()))
    seen = bench.history.seen(bench.folder.text(name)) if name and bench.folder.path(name).is_file() else ""
    return render(
        request, "text.html.jinja", code, **left(bench, name), file=name, text=text, message=message, seen=seen,
        commands=_COMMANDS[kind].items(), names=bench.folder.listed(".toml")[:500], example=example, examples=_examples(),
    )  # fmt: skip


def _save(request: Request, sent: Sent) -> Response:
    """Save the file; run a command on it."""
    bench, word = bench_of(request), only(sent, "do")
    name, text = only(sent, "file"), only(sent, "text").replace("\r\n", "\n")
    name = name if name.endswith(".toml") else f"{name}.toml"
    path = bench.folder.path(name)
    try:
        kind = _kind_of(toml_document(path, text.encode()))
        seen = only(sent, "seen") if name == only(sent, "was") else ""
        bench.history.write(name, seen, text, f"save {name}", "run" if kind == "run file" else kind)
    except ChangedError:
        raise
    except PigaError as error:
        return _page(request, name, text, str(error), 422)
    if word == "save":
        return redirect(request, f"/text?file={name}")
    if word not in _COMMANDS[kind]:
        raise ArgumentError(f"{word[:40]!r}: is not a command for this file", remedy="use the buttons")
    words = word.split()
    out = "" if word == "check" else bench.folder.name(path.with_name(f"{path.stem}-{words[-1]}"))
    command = [*words, name, *(["--out", out, "--force"] if out else [])]
    return start(request, command, word.capitalize(), name, out, files_named_in(path))


ROUTES = [Route("/text", _show, methods=["GET"]), Route("/text", posted(_save), methods=["POST"])]
