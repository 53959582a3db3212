"""Code that all pages share: the opened folder, templates, form data, files, errors."""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route

from piga._version import __version__
from piga.errors import ArgumentError, PigaError
from piga.workbench.folder import STATE_FOLDER, Folder, OutsideError
from piga.workbench.jobs import BusyError, Job, Jobs, Status
from piga.workbench.security import Door

MOST_FORM = 2 << 20
"""Largest form [bytes]."""
MOST_FIELDS = 2000
ASSETS = {
    "workbench.css": "text/css",
    "uplot.min.css": "text/css",
    "workbench.js": "text/javascript",
    "signals.js": "text/javascript",
    "htmx.min.js": "text/javascript",
    "uplot.min.js": "text/javascript",
}
"""Files that pages load, and their types."""
MENU = (
    ("/", "Records"),
    ("/instrument", "Instruments"),
    ("/plan", "Plan"),
    ("/explore", "Explore"),
    ("/twin", "Twin"),
    ("/platform", "Platform"),
    ("/jobs", "Jobs"),
)
"""Pages that need no record."""

MARK = re.compile(r"(?:signals/[0-9a-f]{12}-|check/|terms/)[0-9a-f]{24}")
"""Jobs with such a result write no files for the user."""
TRIAL = re.compile(rf"{re.escape(STATE_FOLDER)}/trials/[0-9a-f]{{12}}")
"""Results of a calibration that is not kept yet."""


class TooLargeError(ArgumentError):
    """More was sent than is taken."""


STATUSES: dict[type[Exception], int] = {OutsideError: 404, BusyError: 429, TooLargeError: 413}
"""Status of the answer by kind of error; that of all other errors of a user is 422."""


@dataclass(frozen=True)
class Workbench:
    """What the pages work on."""

    folder: Folder
    jobs: Jobs
    door: Door

    def new_trial(self) -> str:
        """Name of a new folder for results that are not kept yet."""
        return self.folder.name(self.folder.state_room("trials") / secrets.token_hex(6))

    def place_of(self, result: str) -> Path | None:
        """Where the results of a job lie, or will; None if it writes none.

        Raises
        ------
        OutsideError
            If this is outside of the folder.
        """
        if not result or MARK.fullmatch(result):
            return None
        if not TRIAL.fullmatch(result):
            return self.folder.path(result)
        place = self.folder.state_room("trials") / result.rpartition("/")[2]
        if place.is_symlink():
            raise OutsideError("the results of this job are a link", remedy="discard the job")
        return place

    def start(
        self,
        command: Sequence[str],
        title: str,
        subject: str,
        result: str,
        reads: Sequence[Path] | None = None,
    ) -> Job:
        """Start a job (:meth:`piga.workbench.jobs.Jobs.start`) whose results are written in the folder."""
        self.place_of(result)
        return self.jobs.start(command, title, subject, result, reads)

    def listed(self, wanted: Callable[[Job], bool] = lambda _job: True) -> list[tuple[Job, Status]]:
        """The wanted jobs, the newest first, and what became of them."""
        return [(job, self.jobs.status(job)) for job in self.jobs.all() if wanted(job)]


def bench_of(request: Request) -> Workbench:
    """The workbench that serves the request."""
    bench: Workbench = request.app.state.bench
    return bench


@lru_cache(maxsize=1)
def _environment() -> Any:
    import jinja2

    def text(name: str) -> str:
        return resources.files("piga.workbench").joinpath("templates", name).read_text(encoding="utf-8")

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(text), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    environment.filters["bytes"] = in_bytes
    environment.filters["moment"] = moment
    return environment


def render(request: Request, template: str, code: int = 200, **values: Any) -> Response:
    """A page from its template. Every value is escaped."""
    bench = bench_of(request)
    text = (
        _environment()
        .get_template(template)
        .render(
            menu=MENU,
            at=request.url.path,
            folder=bench.folder.root.name,
            version=__version__,
            **values,
        )
    )
    return HTMLResponse(text, status_code=code)


async def sent_form(request: Request, most: int = MOST_FORM) -> dict[str, list[str]]:
    """The fields of a sent form of at most ``most`` bytes, each with its values.

    Raises
    ------
    ArgumentError
        If the form is too large or is not one.
    """
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > most:
            raise ArgumentError("the form is too large", remedy=f"send at most {in_bytes(most)}")
    try:
        pairs = parse_qsl(
            body.decode("utf-8"), keep_blank_values=True, strict_parsing=bool(body), max_num_fields=MOST_FIELDS,
            errors="strict",
        )  # fmt: skip
    except ValueError:
        raise ArgumentError("the form cannot be read", remedy="reload the page") from None
    fields: dict[str, list[str]] = {}
    for name, value in pairs:
        fields.setdefault(name, []).append(value)
    return fields


def only(fields: Mapping[str, list[str]], name: str, default: str = "") -> str:
    """The value of a field that is sent once."""
    values = fields.get(name, [default])
    return values[-1]


def error_page(request: Request, error: Exception) -> Response:
    """The page of an error: what is wrong, and the remedy."""
    status = next((code for kind, code in STATUSES.items() if isinstance(error, kind)), 422)
    text, remedy = str(error), ""
    if isinstance(error, HTTPException):
        status = error.status_code
        text = {404: "There is no such page.", 405: "This page does not take that."}.get(status, error.detail)
    elif isinstance(error, PigaError):
        text, _, remedy = str(error).partition("\n  remedy: ")
    elif isinstance(error, OSError):
        status, text = 500, f"{error.filename or 'a file'}: {error.strerror or error}"
    else:
        status, text = 500, "This is an error of the workbench. The terminal of piga ui shows more."
    template = "message.html.jinja" if request.headers.get("hx-request") else "error.html.jinja"
    return render(request, template, status, text=text, remedy=remedy)


def gone_page(_request: Request, _error: Exception) -> Response:
    """The answer to a request that ended before it was whole; nobody reads it."""
    return Response(status_code=400)


def in_bytes(size: int) -> str:
    """A size in words."""
    value = float(size)
    for unit in ("bytes", "kB", "MB"):
        if value < 1000.0:
            return f"{value:.3g} {unit}"
        value /= 1000.0
    return f"{value:.3g} GB"


def moment(job: Job) -> str:
    """When a job began, in the time of this machine."""
    try:
        return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(job.started))
    except (OSError, OverflowError, ValueError):
        return job.key


async def start_job(
    request: Request,
    command: Sequence[str],
    title: str,
    subject: str,
    result: str = "",
    reads: Sequence[Path] | None = None,
    *,
    page: str = "jobs",
) -> Response:
    """Start a job (:meth:`Workbench.start`) and go to its page, below ``page``."""
    job = await run_in_threadpool(bench_of(request).start, command, title, subject, result, reads)
    return redirect(request, f"/{page}/{job.key}")


def redirect(request: Request, to: str) -> Response:
    """Go to another page, with or without scripts in the browser."""
    if request.headers.get("hx-request"):
        return Response(status_code=200, headers={"hx-redirect": to})
    return RedirectResponse(to, status_code=303)


def asset(request: Request) -> Response:
    """A script or style sheet of the workbench."""
    name = request.path_params["name"]
    if name not in ASSETS:
        raise HTTPException(404)
    text = _asset(name)
    headers = {"cache-control": "max-age=3600"}
    return Response(text, media_type=ASSETS[name], headers=headers)


@lru_cache(maxsize=len(ASSETS))
def _asset(name: str) -> str:
    text = resources.files("piga.workbench").joinpath("assets", name).read_text(encoding="utf-8")
    if name != "workbench.css":
        return text
    from piga.reports.render.figure import css_variables

    dark = f"@media (prefers-color-scheme: dark) {{ :root {{ {css_variables(dark=True)} }} }}"
    return f":root {{ {css_variables(dark=False)} }}\n{dark}\n{text}"


def health(_request: Request) -> Response:
    """The server answers."""
    return PlainTextResponse("ok\n")


ROUTES = [Route("/healthz", health), Route("/assets/{name}", asset)]
