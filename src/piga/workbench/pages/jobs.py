"""Jobs: what runs and what ran, how far it is, what it printed and wrote; stop one."""

from __future__ import annotations

import shlex
from pathlib import Path

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.workbench.folder import STATE_FOLDER, OutsideError
from piga.workbench.jobs import Job
from piga.workbench.pages.common import Bench, bench_of, is_part, redirect, render, result_file


def _job_of(request: Request) -> tuple[Bench, Job]:
    """The job that the address names."""
    bench = bench_of(request)
    job = bench.jobs.get(request.path_params["key"])
    if job is None:
        raise OutsideError("there is no such job; jobs end with the server", remedy="start it again")
    return bench, job


def _show_all(request: Request) -> Response:
    jobs = bench_of(request).jobs
    return render(request, "jobs.html.jinja", jobs=[(job, jobs.status(job)) for job in jobs.all()])


def _show(request: Request) -> Response:
    """One job: its state, what it printed, its files. The page asks for it again while the job runs."""
    bench, job = _job_of(request)
    status = bench.jobs.status(job)
    response = render(
        request, "job-part.html.jinja" if is_part(request) else "job.html.jinja", job=job, status=status,
        line=f"piga {shlex.join(job.command)}", out=bench.jobs.text(job, "out"), err=bench.jobs.text(job, "err"),
        files=[path.name for path in _result_files(bench, job)] if status.state == "done" else [],
    )  # fmt: skip
    if is_part(request) and status.state != "running":
        response.headers["hx-refresh"] = "true"
    return response


def _stop(request: Request) -> Response:
    bench, job = _job_of(request)
    bench.jobs.stop(job)
    return redirect(request, request.headers.get("referer") or f"/jobs/{job.key}")


def _file(request: Request) -> Response:
    """A result file of a job."""
    bench, job = _job_of(request)
    name = request.path_params["file"]
    path = next((item for item in _result_files(bench, job) if item.name == name), None)
    if path is None:
        raise OutsideError(f"{name}: is not a result of this job", remedy="choose a listed file")
    return result_file(bench, path, draft=job.title.startswith("DRAFT"))


def _result_files(bench: Bench, job: Job) -> list[Path]:
    """The files that a job wrote: those of its folder, or its file and the page beside it."""
    if not job.result or job.result.startswith(("signals/", "check/")):
        return []
    is_trial = job.result.startswith(f"{STATE_FOLDER}/trials/")
    place = bench.folder.root / job.result if is_trial else bench.folder.path(job.result)
    files = [place, place.with_suffix(".html")]
    if place.is_dir() and not place.is_symlink():
        files = sorted(path for path in place.iterdir() if not path.name.startswith("."))
    return [path for path in files if path.is_file() and not path.is_symlink()]


ROUTES = [
    Route("/jobs", _show_all),
    Route("/jobs/{key}", _show),
    Route("/jobs/{key}/stop", _stop, methods=["POST"]),
    Route("/jobs/{key}/file/{file}", _file),
]
