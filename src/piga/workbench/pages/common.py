"""What all pages use: the opened folder, templates, form data, fields with units, files, errors."""

from __future__ import annotations

import re
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from piga._version import __version__
from piga.errors import ArgumentError, PigaError, UnitError
from piga.reports.render.numbers import count, pretty_unit, rounded, significant
from piga.units import to_si
from piga.workbench.folder import Folder, OutsideError
from piga.workbench.history import ChangedError, History
from piga.workbench.jobs import BusyError, Jobs
from piga.workbench.security import REPORT_POLICY, Door

_MOST_FORM = 2 << 20
"""Largest form [bytes]."""
_MOST_FIELDS = 2000
_ASSETS = {
    "bench.css": "text/css",
    "uplot.min.css": "text/css",
    "bench.js": "text/javascript",
    "picture.js": "text/javascript",
    "htmx.min.js": "text/javascript",
    "uplot.min.js": "text/javascript",
}
"""Files that pages load, and their types."""
NUMBER = re.compile(r"\s*[-+\u2212]?(\d+([.,]\d*)?|[.,]\d+)(e[-+]?\d+)?\s*", re.IGNORECASE)


class TooLargeError(ArgumentError):
    """More was sent than is taken."""


_STATUSES: dict[type[Exception], int] = {OutsideError: 404, BusyError: 429, TooLargeError: 413}
"""Status of the answer by kind of error; that of all other errors of a user is 422."""


@dataclass(frozen=True)
class Bench:
    """What the pages work on. ``answers``: the last answers of each record, the newest first."""

    folder: Folder
    jobs: Jobs
    history: History
    door: Door
    answers: dict[str, list[str]] = field(default_factory=dict)


def bench_of(request: Request) -> Bench:
    """The bench that serves the request."""
    bench: Bench = request.app.state.bench
    return bench


def _in_bytes(size: float) -> str:
    """A size in words."""
    for unit in ("bytes", "kB", "MB"):
        if size < 1000.0:
            return f"{size:.3g} {unit}"
        size /= 1000.0
    return f"{size:.3g} GB"


def _number(value: float, digits: int = 4) -> str:
    """A number in a template."""
    return significant(value, digits)


def moment(seconds: float) -> str:
    """A time in the zone of this machine."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


@lru_cache(maxsize=1)
def environment() -> Any:
    """The templates. Every value is escaped."""
    import jinja2

    def text(name: str) -> str:
        return resources.files("piga.workbench").joinpath("templates", name).read_text(encoding="utf-8")

    made = jinja2.Environment(
        loader=jinja2.FunctionLoader(text), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    filters = {"bytes": _in_bytes, "unit": pretty_unit, "count": count, "number": _number, "moment": moment}
    made.filters |= filters | {"path": lambda name: quote(name, safe="/")}
    made.globals |= {"rounded": rounded, "version": __version__}
    return made


def render(request: Request, template: str, code: int = 200, **values: Any) -> Response:
    """A page from its template."""
    bench = bench_of(request)
    shared = {
        "folder": bench.folder.root.name,
        "undo": bench.history.last,
        "at": request.url.path,
        "live": True,
    }
    return HTMLResponse(environment().get_template(template).render(shared | values), status_code=code)


async def sent_form(request: Request) -> dict[str, list[str]]:
    """The fields of a sent form, each with its values."""
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > _MOST_FORM:
            raise ArgumentError("the form is too large", remedy=f"send at most {_in_bytes(_MOST_FORM)}")
    try:
        pairs = parse_qsl(
            body.decode("utf-8"), keep_blank_values=True, strict_parsing=bool(body), max_num_fields=_MOST_FIELDS,
            errors="strict",
        )  # fmt: skip
    except ValueError:
        raise ArgumentError("the form cannot be read", remedy="reload the page") from None
    fields: dict[str, list[str]] = {}
    for name, value in pairs:
        fields.setdefault(name, []).append(value)
    return fields


def posted(
    work: Callable[[Request, dict[str, list[str]]], Response],
) -> Callable[[Request], Awaitable[Response]]:
    """A page that takes a form: ``work`` gets its fields, in a thread of its own."""

    async def handler(request: Request) -> Response:
        return await run_in_threadpool(work, request, await sent_form(request))

    return handler


def only(fields: Mapping[str, list[str]], name: str, default: str = "") -> str:
    """The value of a field that is sent once."""
    return fields.get(name, [default])[-1]


def quantity(written: str, unit: str, like: str, what: str) -> str:
    """A typed number with the unit of its menu, as a run file has it. A decimal comma is accepted."""
    text = written.strip().replace("\u2212", "-")
    number = re.match(r"[-+\d.,]+(?:[eE][-+]?\d+)?", text)
    if number is None:
        raise UnitError(f"{text[:40]!r} does not begin with a number", remedy=f"e.g. 1 {like}")
    head, rest = number[0], text[number.end() :].strip()
    if not NUMBER.fullmatch(head):
        raise UnitError(f"{head[:40]!r} is not one number", remedy="write no separators between thousands")
    if not rest and not unit and like != "1":
        raise UnitError("the unit is missing", remedy="choose it in the menu beside the number")
    if rest and unit and rest != unit:
        raise UnitError(f"the number has the unit {rest[:20]!r}, the menu says {unit!r}", remedy="choose one")
    value = f"{head.replace(',', '.')} {rest or unit}".strip()
    to_si(value, like, what=what)
    return value


def error_page(request: Request, error: Exception) -> Response:
    """The page of an error: what is wrong, and the remedy."""
    status = next((code for kind, code in _STATUSES.items() if isinstance(error, kind)), 422)
    text, remedy = str(error), ""
    if isinstance(error, HTTPException):
        status = error.status_code
        text = {404: "There is no such page.", 405: "This page does not take that."}.get(status, error.detail)
    elif isinstance(error, PigaError):
        text, _, remedy = str(error).partition("\n  remedy: ")
    elif isinstance(error, OSError):
        status, text = 422, f"{error.filename or 'a file'}: {error.strerror or error}"
    else:
        status, text = 500, "This is an error of the bench. The terminal of piga ui shows more."
    part = "message.html.jinja" if request.headers.get("hx-request") else "error.html.jinja"
    return render(request, part, status, text=text, remedy=remedy)


def changed_page(request: Request, error: Exception) -> Response:
    """A file was changed meanwhile: what changed. The page is reloaded; what was typed is in the browser's Back."""
    assert isinstance(error, ChangedError)  # noqa: S101  its handler
    return render(request, "changed.html.jinja", 409, error=error, again=request.headers.get("referer", "/"))


def gone_page(_request: Request, _error: Exception) -> Response:
    """The answer to a request that ended before it was whole; nobody reads it."""
    return Response(status_code=400)


def redirect(request: Request, to: str) -> Response:
    """Go to another page, with or without scripts in the browser."""
    if request.headers.get("hx-request"):
        return Response(status_code=200, headers={"hx-redirect": to})
    return RedirectResponse(to, status_code=303)


def result_file(bench: Bench, path: Path, *, draft: bool = False) -> Response:
    """A result file: a page in a frame without any rights, everything else to save."""
    raw = bench.folder.read(path)
    if path.suffix == ".html":
        unmarked = draft and b'class="draft"' not in raw  # the command marks a laboratory of the example itself
        mark = environment().get_template("draft.html.jinja").render().encode() if unmarked else b""
        return Response(raw + mark, media_type="text/html", headers={"content-security-policy": REPORT_POLICY})
    headers = {"content-disposition": f"attachment; filename*=utf-8''{quote(path.name)}"}
    return Response(raw, media_type="application/octet-stream", headers=headers)


def _asset(request: Request) -> Response:
    """A script or style sheet of the bench."""
    name = request.path_params["name"]
    if name not in _ASSETS:
        raise HTTPException(404)
    text = resources.files("piga.workbench").joinpath("assets", name).read_text(encoding="utf-8")
    return Response(text, media_type=_ASSETS[name], headers={"cache-control": "max-age=3600"})


def health(_request: Request) -> Response:
    """The server answers."""
    return PlainTextResponse("ok\n")


ROUTES = [Route("/healthz", health), Route("/assets/{name}", _asset)]
