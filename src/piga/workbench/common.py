"""What all pages use: the opened folder, templates, form data, fields with units, files, errors."""

from __future__ import annotations

import re
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any
from urllib.parse import parse_qsl, quote

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from piga._version import __version__
from piga.errors import ArgumentError, PigaError, UnitError
from piga.reports.render.numbers import count, pretty_unit, rounded, shown_output, significant
from piga.units import to_si
from piga.workbench.folder import TRIALS, Folder, History
from piga.workbench.jobs import Jobs
from piga.workbench.security import REPORT_POLICY

_MOST_FORM, _MOST_FIELDS = 2 << 20, 2000
"""Largest form [bytes], and most of its fields."""


class Bench:
    """What the pages work on. ``answers``: the last answers of each record, the newest first."""

    def __init__(self, folder: Folder) -> None:
        self.folder, self.jobs, self.history = folder, Jobs(folder.root), History(folder)
        self.answers: dict[str, list[str]] = {}


def bench_of(request: Request) -> Bench:
    """The bench that serves the request."""
    bench: Bench = request.app.state.bench
    return bench


def _moment(seconds: float) -> str:
    """A time in the zone of this machine."""
    with suppress(OSError, OverflowError, ValueError):
        return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))
    return ""


def sentence(words: str) -> str:
    """Words with a capital at their begin."""
    return words[:1].upper() + words[1:]


@lru_cache(maxsize=1)
def _environment() -> Any:
    """The templates. Every value is escaped."""
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.PackageLoader("piga.workbench"), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    made.filters |= {"unit": pretty_unit, "count": count, "moment": _moment, "sentence": sentence}
    made.filters |= {"number": lambda value, digits=4: significant(value, digits), "path": quote}
    made.globals |= {"rounded": rounded, "version": __version__, "output_unit": shown_output}
    return made


def render(request: Request, template: str, code: int = 200, **values: Any) -> Response:
    """A page from its template."""
    bench = bench_of(request)
    shared = {"folder": bench.folder.root.name, "undo": bench.history.last, "at": request.url.path}
    return HTMLResponse(_environment().get_template(template).render(shared | values), status_code=code)


def redirect(to: str) -> Response:
    """Go to another page."""
    return RedirectResponse(to, status_code=303)


def start(request: Request, command: Sequence[str], title: str, subject: str, result: str = "") -> Response:
    """Start a job and go to its page."""
    bench = bench_of(request)
    if result and not result.startswith(TRIALS):
        bench.folder.path(result)  # nothing is written through a link
    return redirect(f"/jobs/{bench.jobs.start(command, title, subject, result).key}")


def _file(request: Request) -> Response:
    """A file of the folder, or of an answer that is not kept: a page in a frame without any rights, all else to save."""
    folder, name = bench_of(request).folder, request.path_params["name"]
    path = folder.root / name if name.startswith(TRIALS) else folder.file(name)
    raw = folder.read(path)
    if path.suffix == ".html":
        return HTMLResponse(raw, headers={"content-security-policy": REPORT_POLICY})
    headers = {"content-disposition": f"attachment; filename*=utf-8''{quote(path.name)}"}
    return Response(raw, media_type="application/octet-stream", headers=headers)


def error_page(request: Request, error: Exception) -> Response:
    """The page of an error: what is wrong, and the remedy. What a page typed is in the browser's Back."""
    status = getattr(error, "status_code", 422)
    text, _, remedy = str(error).partition("\n  remedy: ")
    if isinstance(error, HTTPException):
        text = {404: "There is no such page.", 405: "This page does not take that."}.get(status, error.detail)
    elif isinstance(error, OSError):
        text = f"{error.filename or 'a file'}: {error.strerror or error}"
    elif not isinstance(error, PigaError):
        status, text = 500, "This is an error of the bench. The terminal of piga ui shows more."
    values = {"text": text, "remedy": remedy, "changed": getattr(error, "lines", [])}
    page = render(request, "error.html.jinja", status, again=request.headers.get("referer", "/"), **values)
    page.headers.update(
        {"hx-retarget": "#main", "hx-reselect": "#main", "hx-reswap": "outerHTML"}
    )  # of a part, too
    return page


Sent = dict[str, str]
"""The fields of a sent form."""


def posted(work: Callable[[Request, Sent], Response]) -> Callable[[Request], Awaitable[Response]]:
    """A page that takes a form: ``work`` gets its fields, in a thread of its own."""

    async def handler(request: Request) -> Response:
        body = bytearray()
        async for part in request.stream():
            body += part
            if len(body) > _MOST_FORM:
                raise ArgumentError("the form is too large", remedy=f"send at most {_MOST_FORM} bytes")
        try:
            fields = parse_qsl(
                body.decode("utf-8"), keep_blank_values=True, strict_parsing=bool(body), max_num_fields=_MOST_FIELDS,
                errors="strict",
            )  # fmt: skip
        except ValueError:
            raise ArgumentError("the form cannot be read", remedy="reload the page") from None
        return await run_in_threadpool(work, request, dict(fields))

    return handler


def form(address: str, work: Callable[[Request, Sent], Response]) -> list[Route]:
    """Routes of a page with a form: ``work`` gets no fields when the page is opened."""
    opened = Route(address, lambda request: work(request, {}), methods=["GET"])
    return [opened, Route(address, posted(work), methods=["POST"])]


def in_line(error: PigaError) -> str:
    """An error and its remedy beside a field."""
    return ". ".join(sentence(words) for words in (error.message, error.remedy) if words) + "."


@dataclass(frozen=True)
class Field:
    """A question of a form: its key, what it asks for, an example and a note.

    ``typed``, ``unit`` and ``refusal`` are what was typed, the chosen unit, and why the entry is refused. ``like`` is a unit of
    the kind that a quantity has ("": a text), ``units`` are those of its menu. ``choices`` are values and words of a menu,
    ``rows`` the lines of a longer text.
    """

    key: str
    words: str = ""
    example: str = ""
    note: str = ""
    typed: str = ""
    unit: str = ""
    refusal: str = ""
    like: str = ""
    units: tuple[str, ...] = ()
    choices: tuple[tuple[str, str], ...] = ()
    rows: int = 0
    needed: bool = False

    def with_sent(self, sent: Sent, prefix: str = "") -> Field:
        """The field with what was typed, and why it is refused."""
        typed = sent.get(prefix + self.key, self.typed).strip()
        made = replace(self, typed=typed, unit=sent.get(f"u:{self.key}", ""))
        try:
            if not typed and self.needed:
                raise ArgumentError("this is needed", remedy=f"e.g. {self.example}")
            _ = made.value
        except PigaError as error:
            return replace(made, refusal=in_line(error))
        return made

    @property
    def value(self) -> str:
        """What was typed; a quantity with its unit."""
        return quantity(self.typed, self.unit, self.like, self.key) if self.typed and self.like else self.typed


def quantity(written: str, unit: str, like: str, what: str) -> str:
    """A typed number with the unit of its menu, as a run file has it. A decimal comma is accepted."""
    text = written.strip().replace("\u2212", "-")
    text = text if "." in text else text.replace(",", ".", 1)
    if re.fullmatch(r"[-+.,\deE]+", text):
        if not unit and like != "1":
            raise UnitError(
                "the unit is missing", remedy="choose it in the menu, or write it behind the number"
            )
        text = f"{text} {unit}".strip()
    elif not text.endswith(unit):
        raise UnitError(f"{text[:40]!r}, but the menu says {unit!r}", remedy="choose one")
    to_si(text, like, what=what)
    return text


def _health(_request: Request) -> Response:
    return PlainTextResponse("ok\n")


ROUTES = [
    Route("/healthz", _health),
    Route("/file/{name:path}", _file),
    Mount("/assets", StaticFiles(packages=[("piga.workbench", "assets")])),
]
