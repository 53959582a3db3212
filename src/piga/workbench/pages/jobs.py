"""Jobs: what runs and what ran, how far it is, what it printed; stop one. Answers of commands on a record as it is now."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from piga.errors import ArgumentError
from piga.records.text_files import files_named_in
from piga.workbench.folder import OutsideError
from piga.workbench.jobs import Job, Status
from piga.workbench.pages.common import Workbench, bench_of, redirect, render
from piga.workbench.security import REPORT_POLICY
from piga.workbench.signals import cache_key


def job_of(request: Request) -> tuple[Workbench, Job]:
    """The job that the address names."""
    bench = bench_of(request)
    job = bench.jobs.get(request.path_params["key"])
    if job is None:
        raise OutsideError("there is no such job", remedy="choose one of the list")
    return bench, job


def command_line(job: Job) -> str:
    """The command that does the same in a terminal."""
    return f"piga {shlex.join(job.command)}"


def show_all(request: Request) -> Response:
    """The list of jobs."""
    bench = bench_of(request)
    return render(request, "jobs/jobs.html.jinja", jobs=bench.listed())


def show(request: Request) -> Response:
    """One job: its state, and what it printed. The page asks for it again while the job runs."""
    bench, job = job_of(request)
    status = bench.jobs.status(job)
    values: dict[str, Any] = {
        "job": job,
        "status": status,
        "line": command_line(job),
        "out": bench.jobs.text(job, "out"),
        "err": bench.jobs.text(job, "err"),
        "files": result_files(bench, job) if status.state == "done" else [],
    }
    part = "jobs/job-part.html.jinja" if request.headers.get("hx-request") else "jobs/job.html.jinja"
    response = render(request, part, **values)
    if request.headers.get("hx-request") and status.state != "running":
        response.headers["hx-refresh"] = "true"
    return response


def stop(request: Request) -> Response:
    """End a job."""
    bench, job = job_of(request)
    bench.jobs.stop(job)
    return redirect(request, f"/jobs/{job.key}")


def file(request: Request) -> Response:
    """A result file of a job: a page in a frame without any rights, everything else to save."""
    bench, job = job_of(request)
    name = request.path_params["file"]
    path = next((item for item in result_files(bench, job) if item.name == name), None)
    if path is None:
        raise OutsideError(f"{name}: is not a result of this job", remedy="choose a listed file")
    if path.suffix == ".html":
        return FileResponse(path, headers={"content-security-policy": REPORT_POLICY}, media_type="text/html")
    return FileResponse(path, filename=name, media_type="application/octet-stream")


def result_files(bench: Workbench, job: Job) -> list[Path]:
    """The files that a job wrote: those of its folder, or its file and the page beside it."""
    try:
        place = bench.place_of(job.result)
    except OutsideError:
        return []
    if place is None:
        return []
    if place.is_dir():
        files = sorted(path for path in place.iterdir() if not path.name.startswith("."))
    else:
        files = [place, place.with_suffix(".html")]
    return [path for path in files if path.is_file() and not path.is_symlink()]


# --- answers --------------------------------------------------------------------------------------

LARGEST = 200_000_000
"""Size of a record [bytes] up to which it is asked without being told to. Larger ones take long."""


@dataclass(frozen=True)
class LogQuestion:
    """A ``piga check`` that prints JSON about a run file: the mark of its jobs, their title and the options."""

    mark: str
    title: str
    options: tuple[str, ...]


CHECK = LogQuestion("check", "Check", ("--json",))
TERMS = LogQuestion("terms", "Ask for each term", ("--terms", "--json"))


@dataclass(frozen=True)
class Answer:
    """What became of a question: its job and state, the document if it is done, the message if it failed."""

    job: Job
    status: Status
    document: dict[str, Any]
    message: str


def ask(bench: Workbench, name: str, question: LogQuestion, *, always: bool = False) -> Answer | None:
    """The answer for a run file and its log as they are now; it is asked if it was not.

    Parameters
    ----------
    bench, name:
        The workbench, and the run file.
    question:
        What to ask.
    always:
        Ask also for a large record.

    Returns
    -------
    Answer or None
        None if nothing was asked: the record is large, or too many jobs run.
    """
    files = files_named_in(bench.folder.toml(name))
    mark = f"{question.mark}/{cache_key(files)}"
    job = bench.jobs.latest(name, mark)
    if job is None:
        size = sum(path.stat().st_size for path in files if path.is_file())
        if size > LARGEST and not always:
            return None
        try:
            job = bench.jobs.start(("check", name, *question.options), question.title, name, mark)
        except ArgumentError:
            return None
    status, document, message = bench.jobs.status(job), {}, ""
    if status.state == "done":
        try:
            document = bench.jobs.document(job)
        except (OSError, ValueError):
            message = "its answer cannot be read; ask again"
    elif status.state != "running":
        message = bench.jobs.text(job, "err") or "It was stopped."
    return Answer(job, status, document, message)


ROUTES = [
    Route("/jobs", show_all),
    Route("/jobs/{key}", show),
    Route("/jobs/{key}/stop", stop, methods=["POST"]),
    Route("/jobs/{key}/file/{file}", file),
]
