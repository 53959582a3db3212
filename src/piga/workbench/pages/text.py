"""Show as text: any TOML file of the folder, or an example to begin with, and the commands that run it."""

from __future__ import annotations

from typing import Any

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.data import example_files
from piga.errors import ArgumentError, PigaError
from piga.records.text_files import files_named_in, toml_document
from piga.workbench.folder import OutsideError
from piga.workbench.pages.common import bench_of, only, posted, redirect, render
from piga.workbench.pages.later import start
from piga.workbench.pages.record import left

COMMANDS: dict[str, tuple[tuple[str, str], ...]] = {
    "run file": (("check", "Check"), ("calibrate", "Calibrate")),
    "plan": (("plan", "Plan the test"),),
    "platform": (
        ("platform navigate", "Navigate"), ("platform compare", "Compare models"), ("platform simulate", "Simulate"),
        ("platform identify", "Identify"), ("platform align", "Align"),
    ),
    "scenario": (("simulate", "Simulate the test"),),
    "other file": (),
}  # fmt: skip
"""Commands by kind of file."""


def _kind_of(document: dict[str, Any]) -> str:
    """Kind of a file by its tables."""
    if "data" in document:
        return "run file"
    if "plan" in document:
        return "plan"
    if "case_rotation" in document:
        return "platform"
    return "scenario" if "stand" in document and "electronics" in document else "other file"


def show(request: Request) -> Response:
    """A file, or an example to begin with."""
    folder, query = bench_of(request).folder, request.query_params
    name, example = query.get("file", ""), query.get("example", "")
    if name:
        return _page(request, name, folder.text(name))
    examples = {key: raw for key, raw in example_files().items() if key.endswith(".toml")}
    if example and example not in examples:
        raise OutsideError(f"{example[:80]!r}: is no example", remedy="choose one of the list")
    return _page(request, "", examples[example].decode("utf-8") if example else "", example=example)


def _page(
    request: Request, name: str, text: str, message: str = "", code: int = 200, example: str = ""
) -> Response:
    from pathlib import Path

    bench = bench_of(request)
    try:
        kind = _kind_of(toml_document(Path(name or "the text"), text.encode()))
    except PigaError:
        kind = "other file"
    seen = bench.history.seen(bench.folder.text(name)) if name and bench.folder.path(name).is_file() else ""
    return render(
        request, "text.html.jinja", code, **left(bench, name), file=name, text=text, message=message, kind=kind, seen=seen,
        commands=COMMANDS[kind], names=bench.folder.listed(".toml")[:500], example=example,
        examples=sorted(one for one in example_files() if one.endswith(".toml")),
    )  # fmt: skip


def save(request: Request, fields: dict[str, list[str]]) -> Response:
    """Save the file; run a command on it."""
    bench, word = bench_of(request), only(fields, "do")
    name, text = only(fields, "file"), only(fields, "text").replace("\r\n", "\n")
    name = name if name.endswith(".toml") else f"{name}.toml"
    path = bench.folder.path(name)
    try:
        kind = _kind_of(toml_document(path, text.encode()))
        check = "run" if kind == "run file" else kind
        seen = only(fields, "seen") if name == only(fields, "was") else ""
        bench.history.write(name, seen, text, f"save {name}", check)
    except PigaError as error:
        if not isinstance(error, ArgumentError) or not hasattr(error, "lines"):
            return _page(request, name, text, str(error), 422)
        raise
    if word == "save":
        return redirect(request, f"/text?file={name}")
    if word not in [one for one, _ in COMMANDS[kind]]:
        raise ArgumentError(f"{word[:40]!r}: is not a command for this file", remedy="use the buttons")
    words = word.split()
    out = "" if word == "check" else bench.folder.name(path.with_name(f"{path.stem}-{words[-1]}"))
    command = [*words, name, *(["--out", out, "--force"] if out else [])]
    return start(request, command, word.capitalize(), name, out, files_named_in(path))


ROUTES = [Route("/text", show, methods=["GET"]), Route("/text", posted(save), methods=["POST"])]
