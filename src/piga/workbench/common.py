"""What all pages use: the opened folder, jobs and their pages, templates, forms, fields with units, files, errors."""

from __future__ import annotations

import json
import os
import re
import secrets
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, Literal, TypeVar, cast
from urllib.parse import parse_qsl, quote

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from piga._version import __version__
from piga.errors import ArgumentError, PigaError, UnitError
from piga.reports.render.figure import css_variables
from piga.reports.render.numbers import count, pretty_unit, rounded, shown_output, significant
from piga.reports.render.page import resource
from piga.units import to_si
from piga.workbench.folder import TRIALS, Folder, History, OutsideError

REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""Policy of a report from the folder. Its scripts run in an origin of their own and reach no part of the bench."""
_MOST_FORM, _MOST_FIELDS = 2 << 20, 2000
"""Largest form [bytes], and most of its fields."""
FIT = "Fit"
"""Title of the fits of a record."""
LAPSE, _PATIENCE = 3.0, 1.0
"""Time [s] after which a fit that no page asks for is ended, while a page waits for another fit of the record; and time
that a stopped job has to end by itself."""
Made = TypeVar("Made")
Sent = dict[str, str]
"""The fields of a sent form; none when its page is opened."""


@dataclass(eq=False)
class Job:
    """A job: its process with standard input, and the folder of what it prints.

    ``command`` are the arguments of ``piga``, ``title`` and ``subject`` what it does and the record it is for, ``result`` the
    folder or file of the results below the opened folder. ``started`` and ``asked`` are times [s since 1970]: of the start,
    and of the last question of a page.
    """

    child: subprocess.Popen[bytes]
    input: IO[bytes]
    place: Path
    command: tuple[str, ...] = ()
    title: str = ""
    subject: str = ""
    result: str = ""
    started: float = 0.0
    asked: float = 0.0
    was_stopped: bool = False

    @property
    def state(self) -> Literal["running", "done", "failed", "stopped"]:
        """What became of it."""
        code = self.child.poll()
        if code is None:
            return "running"
        self.input.close()
        return "done" if code == 0 else "stopped" if self.was_stopped else "failed"

    @property
    def progress(self) -> dict[str, Any]:
        """What it does now (``what``), and which ``share`` of it is done, if known."""
        with suppress(OSError, ValueError):
            return dict(json.loads((self.place / "progress").read_text(encoding="utf-8")))
        return {"what": "", "share": None}

    @property
    def fault(self) -> str:
        """Why there is no result; "" while it runs, and when it is done."""
        is_over = self.state in ("failed", "stopped")
        return (self.text("err").removeprefix("piga: ") or "It was stopped.") if is_over else ""

    def text(self, name: Literal["out", "err"]) -> str:
        """What it printed on standard output or standard error."""
        return (self.place / name).read_text("utf-8", "replace")


class Jobs:
    """The jobs of one folder: commands of piga that run beside the server, each in a process of its own.

    A job is a command line, written to a process that waits for it. Its results are identical to those of the command, and
    the page shows how to repeat it in a terminal. What it prints is kept in a private temporary folder. Jobs are known to this
    server alone. A job whose server is gone ends as after Ctrl-C: it reads the end of its standard input then.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._folder = Path(tempfile.mkdtemp(prefix="piga-ui-"))
        self.by_key: dict[str, Job] = {}
        self._lock = threading.Lock()
        self._spare = self._waiting()

    def _waiting(self) -> Job:
        """A process that has loaded what a command needs and waits for it: a command then starts at once."""
        place = self._folder / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
        place.mkdir()
        environment = os.environ | {"PYTHONUTF8": "1", "PYTHONSAFEPATH": "1", "NO_COLOR": "1"}
        with (place / "out").open("wb") as out, (place / "err").open("wb") as err:
            child = subprocess.Popen(  # noqa: S603  piga itself
                [sys.executable, "-P", "-m", "piga.cli.job", str(place)],
                cwd=self._root, stdin=subprocess.PIPE, stdout=out, stderr=err, env=environment,
                start_new_session=True,
            )  # fmt: skip
        return Job(child, cast("IO[bytes]", child.stdin), place)

    def start(self, command: Sequence[str], title: str, subject: str, result: str = "") -> Job:
        """Start ``piga`` with these arguments in the opened folder.

        If the same command makes this result already, that job is returned.
        """
        with self._lock:  # many requests may ask at the same time
            running = (job for job in self.all() if result and job.result == result and job.state == "running")
            same = next(running, None)
            if same is not None and same.command == tuple(command):
                return same
            if same is not None:
                words = f"{result} is just being made with other options"
                raise ArgumentError(words, remedy="wait until that job has ended, or stop it")
            job = self._spare if self._spare.child.poll() is None else self._waiting()
            self._spare = self._waiting()
            job.command, job.title, job.subject, job.result = tuple(command), title, subject, result
            job.started = job.asked = time.time()
            job.input.write(json.dumps(command).encode() + b"\n")
            job.input.flush()
            self.by_key[job.place.name] = job
            return job

    def all(self) -> list[Job]:
        """All jobs, the newest first."""
        return list(reversed(list(self.by_key.values())))

    def made(
        self, read: Callable[[], Made | None], command: Sequence[str], title: str, subject: str, result: str
    ) -> tuple[Made | None, Job | None]:
        """A result, as ``read`` gives it; or the newest job for the record that makes it, or that failed."""
        job = next((one for one in self.all() if (one.subject, one.result) == (subject, result)), None)
        is_open = job is not None and job.state != "done"
        made = read()  # after the state: the job may end meanwhile
        if made is not None:
            return made, None
        return None, job if is_open else self.start(command, title, subject, result)

    def attend(self, job: Job) -> None:
        """A page waits for this job. Fits of the same record that no page waits for any more are ended and forgotten."""
        job.asked = now = time.time()
        for other in self.all():
            is_fit = (other.title, other.subject) == (FIT, job.subject) and other.state == "running"
            if is_fit and now - other.asked > LAPSE:
                self.stop(other)
                self.forget(other)

    def stop(self, *jobs: Job) -> None:
        """End running jobs. Their results are then absent, as after Ctrl-C in a terminal."""
        for job in jobs:
            job.was_stopped |= job.child.poll() is None
            job.input.close()
        limit = time.monotonic() + _PATIENCE
        for job in jobs:
            with suppress(subprocess.TimeoutExpired):
                job.child.wait(max(limit - time.monotonic(), 0.0))
            if job.child.poll() is None:
                with suppress(OSError):
                    os.killpg(job.child.pid, signal.SIGKILL) if hasattr(os, "killpg") else job.child.kill()
                job.child.wait()

    def stop_all(self) -> None:
        """End all running jobs and remove what they printed (when the server ends)."""
        self.stop(self._spare, *self.all())
        shutil.rmtree(self._folder, ignore_errors=True)

    def forget(self, job: Job) -> None:
        """Remove a job that has ended."""
        if job.state != "running":
            self.by_key.pop(job.place.name, None)
            shutil.rmtree(job.place, ignore_errors=True)


class Bench:
    """What the pages work on. ``answers``: the last answers of each record, the newest first."""

    def __init__(self, folder: Folder) -> None:
        self.folder, self.jobs, self.history = folder, Jobs(folder.root), History(folder)
        self.answers: dict[str, list[str]] = {}


def bench_of(request: Request) -> Bench:
    """The bench that serves the request."""
    bench: Bench = request.app.state.bench
    return bench


def sentence(words: str) -> str:
    """Words with a capital at their begin."""
    return words[:1].upper() + words[1:]


def _moment(seconds: float) -> str:
    with suppress(OSError, OverflowError, ValueError):
        return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))
    return ""


@lru_cache(maxsize=1)
def _templates() -> Any:
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.PackageLoader("piga.workbench"), autoescape=True, trim_blocks=True, lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )  # fmt: skip
    made.filters |= {"unit": pretty_unit, "count": count, "moment": _moment, "sentence": sentence}
    made.filters |= {"path": quote, "number": lambda value, digits=4: significant(value, digits)}
    made.globals |= {"rounded": rounded, "version": __version__, "output_unit": shown_output}
    return made


def render(request: Request, page: str, title: str, code: int = 200, **values: Any) -> Response:
    """A page: its template in the frame of all pages."""
    bench = bench_of(request)
    shared = {"folder": bench.folder.root.name, "undo": bench.history.last, "at": request.url.path}
    shared |= {"page": f"{page}.html.jinja", "title": title}
    return HTMLResponse(_templates().get_template("frame.html.jinja").render(shared | values), status_code=code)


def start(request: Request, command: Sequence[str], title: str, subject: str, result: str = "") -> Response:
    """Start a job and go to its page."""
    bench = bench_of(request)
    if result and not result.startswith(TRIALS):
        bench.folder.path(result)  # nothing is written through a link
    return RedirectResponse(f"/jobs/{bench.jobs.start(command, title, subject, result).place.name}", 303)


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
    status, changed = getattr(error, "status_code", 422), getattr(error, "lines", [])
    text, _, remedy = str(error).partition("\n  remedy: ")
    if isinstance(error, HTTPException):
        text = {404: "There is no such page.", 405: "This page does not take that."}.get(status, error.detail)
    elif isinstance(error, OSError):
        text = f"{error.filename or 'a file'}: {error.strerror or error}"
    elif not isinstance(error, PigaError):
        status, text = 500, "This is an error of the bench. The terminal of piga ui shows more."
    title = "Changed meanwhile" if changed else "This cannot be done"
    values = {"text": text, "remedy": remedy, "changed": changed, "again": request.headers.get("referer", "/")}
    page = render(request, "error", title, status, **values)
    page.headers.update({"hx-retarget": "#main", "hx-reselect": "#main", "hx-reswap": "outerHTML"})
    return page


def route(address: str, work: Callable[[Request, Sent], Response], *methods: str) -> Route:
    """Route of a page with a form. ``work`` gets the fields that were posted, in a thread of its own."""

    async def handler(request: Request) -> Response:
        sent = await _sent(request) if request.method == "POST" else {}
        return await run_in_threadpool(work, request, sent)

    return Route(address, handler, methods=methods or ("GET", "POST"))


async def _sent(request: Request) -> Sent:
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > _MOST_FORM:
            raise ArgumentError("the form is too large", remedy=f"send at most {_MOST_FORM} bytes")
    try:
        fields = parse_qsl(
            body.decode(), keep_blank_values=True, strict_parsing=bool(body), max_num_fields=_MOST_FIELDS, errors="strict"
        )  # fmt: skip
    except ValueError:
        raise ArgumentError("the form cannot be read", remedy="reload the page") from None
    return dict(fields)


def in_line(error: PigaError) -> str:
    """An error and its remedy beside a field."""
    return ". ".join(sentence(words) for words in (error.message, error.remedy) if words) + "."


@dataclass(frozen=True)
class Field:
    """A question of a form: its key, what it asks for, an example and a note.

    ``typed``, ``unit`` and ``refusal`` are what was typed, the chosen unit, and why the entry is refused. ``like`` is a unit of
    the kind that a quantity has ("": a text), ``units`` are those of its menu. ``choices`` are values and words of a menu,
    ``rows`` the lines of a longer text, ``css`` its class on the page.
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
    css: str = ""

    def with_sent(self, sent: Sent) -> Field:
        """The field with what was typed, and why it is refused."""
        typed = sent.get(self.key, self.typed).strip()
        made = replace(self, typed=typed, unit=sent.get(f"u:{self.key}", ""))
        try:
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
            raise UnitError("the unit is missing", remedy="choose it in the menu, or write it with the number")
        text = f"{text} {unit}".strip()
    elif not text.endswith(unit):
        raise UnitError(f"{text[:40]!r}, but the menu says {unit!r}", remedy="choose one")
    to_si(text, like, what=what)
    return text


def _show_jobs(request: Request) -> Response:
    return render(request, "jobs", "Jobs", jobs=bench_of(request).jobs.all())


def _show_job(request: Request) -> Response:
    bench = bench_of(request)
    job = bench.jobs.by_key.get(request.path_params["key"])
    if job is None:
        raise OutsideError("there is no such job; jobs end with the server", remedy="start it again")
    state, line = job.state, "" if job.command[0] == "envelopes" else f"piga {shlex.join(job.command)}"
    files = _result_files(bench, job) if state == "done" else []
    return render(request, "job", f"{job.title} {job.subject}", job=job, state=state, line=line, files=files)


def _progress(request: Request) -> Response:
    """How far a job is; pages ask every 0.4 s. When it has ended, the part that waits for it asks for itself again."""
    bench = bench_of(request)
    job = bench.jobs.by_key.get(request.path_params["key"])
    if job is None or job.state != "running":
        return Response(headers={"hx-trigger": "ended"})
    bench.jobs.attend(job)
    return HTMLResponse(_templates().get_template("progress.html.jinja").render(job=job))


def _stop_job(request: Request) -> Response:
    """Stop a job; one that has ended is forgotten, so that its page asks for it again."""
    jobs = bench_of(request).jobs
    job = jobs.by_key.get(request.path_params["key"])
    if job is not None:
        jobs.stop(job) if job.state == "running" else jobs.forget(job)
    return RedirectResponse(request.headers.get("referer") or "/jobs", 303)


def _result_files(bench: Bench, job: Job) -> list[str]:
    """The files that a job wrote: those of its folder, or its file and the page beside it."""
    if not job.result:
        return []
    place = bench.folder.root / job.result
    files = sorted(place.iterdir()) if place.is_dir() else [place, place.with_suffix(".html")]
    return [bench.folder.name(path) for path in files if path.is_file() and not path.name.startswith(".")]


def _page_css(_request: Request) -> Response:
    """The style of the reports: the colours, light and dark, and text, tables, notices."""
    light, dark = (f":root {{ {css_variables(dark=dark)} }}\n" for dark in (False, True))
    sheet = f"{light}@media screen and (prefers-color-scheme: dark) {{ {dark} }}\n{resource('templates', 'page.css')}"
    return Response(sheet, media_type="text/css")


ROUTES = [
    Route("/healthz", lambda _request: PlainTextResponse("ok\n")),
    Route("/file/{name:path}", _file),
    Route("/jobs", _show_jobs),
    Route("/jobs/{key}", _show_job),
    Route("/jobs/{key}/progress", _progress),
    Route("/jobs/{key}/stop", _stop_job, methods=["POST"]),
    Route("/assets/page.css", _page_css),
    Mount("/assets", StaticFiles(packages=[("piga.workbench", "assets")])),
]
