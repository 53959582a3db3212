"""Plan, Twin and Platform: a scenario as text, and the commands that run it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.data import example_files
from piga.errors import ArgumentError, PigaError
from piga.records.text_files import files_named_in, toml_document
from piga.workbench.folder import MOST_TOML, Folder
from piga.workbench.forms import form_of_text, sent_text
from piga.workbench.pages.common import bench_of, only, redirect, render, sent_form, start_job


@dataclass(frozen=True)
class Kind:
    """A kind of scenario.

    It has a page, a kind of file, an example to begin with, tables that tell it, and commands by the words of their
    buttons.
    """

    key: str
    file: str
    example: str
    title: str
    purpose: str
    tables: tuple[str, ...]
    commands: tuple[tuple[str, tuple[str, ...]], ...]


KINDS = {
    kind.key: kind
    for kind in (
        Kind(
            "plan", "plan", "plan-dividing-head.toml", "Plan",
            "Which positions, how long in each, and which uncertainty that gives.",
            ("plan",), (("Plan the test", ("plan",)),),
        ),
        Kind(
            "twin", "scenario", "twin.toml", "Twin",
            "A test with a known truth: stand, instrument, electronics and noise.",
            ("electronics", "stand"), (("Simulate the test", ("simulate",)),),
        ),
        Kind(
            "platform", "platform", "platform-published.toml", "Platform",
            "A platform with turning gyro cases: gimbal and navigation errors over days.",
            ("site", "case_rotation"),
            (
                ("Navigate", ("platform", "navigate")), ("Compare models", ("platform", "compare")),
                ("Simulate", ("platform", "simulate")), ("Identify", ("platform", "identify")),
                ("Align", ("platform", "align")),
            ),
        ),
    )
}  # fmt: skip


def _files(folder: Folder, kind: Kind) -> list[str]:
    """The scenarios of a kind that lie in the folder."""
    names = []
    for name in folder.listed("**/*.toml")[:500]:
        path = folder.root / name
        if path.stat().st_size > MOST_TOML:
            continue
        try:
            document = toml_document(path)
        except PigaError:
            continue
        fits = all(table in document for table in kind.tables)
        if fits and "data" not in document and (kind.key == "plan" or "plan" not in document):
            names.append(name)
    return names


def _page(kind: Kind) -> Callable[[Request], Response]:
    def show(request: Request) -> Response:
        bench = bench_of(request)
        names = _files(bench.folder, kind)
        name = request.query_params.get("file", names[0] if names else "")
        if name:
            text = bench.folder.file(name).read_text(encoding="utf-8", errors="replace")
        else:
            text = example_files()[kind.example].decode("utf-8")
        form = form_of_text(text, kind.file)
        jobs = bench.listed(lambda job: any(job.command[: len(words)] == words for _, words in kind.commands))
        return render(
            request, "scenario.html.jinja", kind=kind, names=names, name=name, form=form, jobs=jobs[:20]
        )

    return show


def _runner(kind: Kind) -> Callable[[Request], Any]:
    async def run(request: Request) -> Response:

        bench = bench_of(request)
        fields = await sent_form(request)
        path = _saved(bench.folder, only(fields, "name"), sent_text(fields, kind.file))
        name = bench.folder.name(path)
        word = only(fields, "do")
        if word == "save":
            return redirect(request, f"/{kind.key}?file={quote(name)}")
        words = next((words for words in (item[1] for item in kind.commands) if " ".join(words) == word), None)
        if words is None:
            raise ArgumentError(f"{word!r}: is not a command of this page", remedy="use its buttons")
        out = bench.folder.name(path.with_name(f"{path.stem}-{words[-1]}"))
        command = [*words, name, "--out", out, "--force"]
        return await start_job(request, command, " ".join(words).capitalize(), name, out, files_named_in(path))

    return run


def _saved(folder: Folder, name: str, text: str) -> Path:
    """Write the text of a scenario, if it is valid TOML.

    Raises
    ------
    RunFileError
        If the text is not TOML; the message names the line. The file is then as before.
    """
    name = name if name.endswith(".toml") else f"{name}.toml"
    path = folder.path(name)
    folder.write_toml(path, text, toml_document)
    return path


ROUTES = [
    *(Route(f"/{kind.key}", _page(kind), methods=["GET"]) for kind in KINDS.values()),
    *(Route(f"/{kind.key}", _runner(kind), methods=["POST"]) for kind in KINDS.values()),
]
