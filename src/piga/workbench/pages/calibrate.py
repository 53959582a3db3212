"""Calibrate: choose terms, run, look at the result, keep it or discard it. Compensate: before and after."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.errors import ArgumentError, CalibrationError
from piga.output import CALIBRATION_RESULTS, results
from piga.records.run_file import METHOD_WORDS, METHODS, PHASE_SOURCES, PHASES, RunFile, read_run_file
from piga.records.terms import UNITS, check_terms, meaning_of
from piga.records.text_files import files_named_in
from piga.workbench.folder import OutsideError, results_of
from piga.workbench.jobs import Job
from piga.workbench.pages.common import TRIAL, Workbench, bench_of, only, redirect, render, sent_form, start_job
from piga.workbench.pages.jobs import TERMS, ask, command_line, job_of
from piga.workbench.pages.records import calibrations

SILENT = {
    "scale_factor": "not beside k1",
    "k1": "not beside scale_factor",
    "k0_T": "the record has no temperature that changes",
    "k1_T": "the record has no temperature that changes",
}
"""Why the record is not asked about a term."""
_SEPARATORS = re.compile(r"[,;\s]+")


def show(request: Request) -> Response:
    """The form of a record, and its calibrations so far."""
    bench, name = bench_of(request), request.path_params["name"]
    path = bench.folder.toml(name)
    run_file = read_run_file(path)
    known = _shown_terms()
    chosen = list(run_file.model.terms)
    tried = [
        (job, status, " ".join(_kept_options(job)))
        for job, status in bench.listed(lambda job: job.subject == name and job.command[0] == "calibrate")
    ]
    adopted = results_of(path)
    return render(
        request,
        "calibrate/calibrate.html.jinja",
        name=name,
        run_file=run_file,
        terms=[(term, UNITS[term], meaning_of(term), term in chosen) for term in known],
        harmonics=" ".join(term for term in chosen if term not in UNITS),
        methods=[(method, what) for method, (what, _) in METHOD_WORDS.items()],
        phases=PHASES,
        sources=PHASE_SOURCES,
        tried=tried,
        adopted=bench.folder.name(adopted) if (adopted / "calibration.json").is_file() else "",
    )


def prospects(request: Request) -> Response:
    """What the record says of each term, before a calibration; the page puts each verdict beside its term."""
    bench, name = bench_of(request), request.path_params["name"]
    answer = ask(bench, name, TERMS, always="again" in request.query_params)
    told = {row["term"] for row in answer.document.get("terms", ())} if answer is not None else set()
    silent = [(term, SILENT[term]) for term in _shown_terms() if term in SILENT and term not in told]
    return render(request, "calibrate/prospects.html.jinja", name=name, check=answer, silent=silent)


def _shown_terms() -> list[str]:
    """The terms that have a box of their own."""
    return [term for term in UNITS if term != "phi"]


async def start(request: Request) -> Response:
    """Start a calibration as the form asks for it."""
    bench, name = bench_of(request), request.path_params["name"]
    fields = await sent_form(request)
    path = bench.folder.toml(name)
    run_file = read_run_file(path)
    terms = (*fields.get("term", []), *_words(only(fields, "harmonics")))
    check_terms(terms)
    options = _options(run_file, terms, fields)
    trial = bench.new_trial()
    command = ("calibrate", name, *options, "--out", trial)
    return await start_job(request, command, "Calibrate", name, trial, files_named_in(path), page="result")


def _words(text: str) -> tuple[str, ...]:
    """The names of terms in a field."""
    return tuple(word for word in _SEPARATORS.split(text) if word)


def _options(run_file: RunFile, terms: tuple[str, ...], fields: dict[str, list[str]]) -> list[str]:
    """Options of the command, where the form differs from the run file."""
    options = [] if terms == run_file.model.terms else ["--terms", ",".join(terms)]
    asked = {
        "--method": (only(fields, "method"), run_file.estimation.method, METHODS),
        "--phases": (only(fields, "phases"), run_file.model.phases, PHASES),
        "--phase-source": (only(fields, "phase_source"), run_file.model.phase_source, PHASE_SOURCES),
    }
    for option, (value, written, allowed) in asked.items():
        if value and value not in allowed:
            raise ArgumentError(f"{option}: {value!r} is not known", remedy=f"one of {', '.join(allowed)}")
        options += [option, value] if value and value != written else []
    sets = [_words(part) for part in only(fields, "compare").split(";") if part.strip()]
    for number, names in enumerate(sets, start=1):
        check_terms(names, where=f"set {number} to compare")
    return options + ([f"--compare={'; '.join(map(','.join, sets))}"] if sets else [])


def _trial(bench: Workbench, job: Job) -> Path:
    """Folder of a calibration's results."""
    place = (
        bench.place_of(job.result) if job.command[0] == "calibrate" and TRIAL.fullmatch(job.result) else None
    )
    if place is None:
        raise OutsideError("this job is not a calibration", remedy="choose a calibration")
    return place


def result(request: Request) -> Response:
    """The result of a calibration, or how far it is."""
    bench, job = job_of(request)
    trial = _trial(bench, job)
    status = bench.jobs.status(job)
    values: dict[str, Any] = {"job": job, "status": status, "line": _shown_line(job), "name": job.subject}
    if status.state == "running":
        return render(
            request,
            "jobs/job-part.html.jinja" if _is_part(request) else "calibrate/result-wait.html.jinja",
            **values,
        )
    if _is_part(request):
        return redirect(request, request.url.path)
    if status.state != "done" or not (trial / "calibration.json").is_file():
        text = bench.jobs.text(job, "err")
        return render(request, "calibrate/result-failed.html.jinja", text=text, **values)
    return render(request, "calibrate/result.html.jinja", **values)


def _is_part(request: Request) -> bool:
    return request.headers.get("hx-request") is not None


def _shown_line(job: Job) -> str:
    """The command in a terminal. Its results go to the usual place."""
    command = (*job.command[:2], *_kept_options(job))
    return command_line(Job(job.key, command, job.title, job.subject))


def _kept_options(job: Job) -> tuple[str, ...]:
    """The options of a calibration but the place of its results."""
    end = job.command.index("--out") if "--out" in job.command else len(job.command)
    return job.command[2:end]


def adopt(request: Request) -> Response:
    """Keep the result: its files go where the command would have written them."""
    bench, job = job_of(request)
    trial = _trial(bench, job)
    if bench.jobs.status(job).state != "done" or not (trial / "calibration.json").is_file():
        raise CalibrationError("this calibration has no result", remedy="calibrate again")
    run = bench.folder.toml(job.subject)
    target = bench.folder.path(bench.folder.name(results_of(run)))
    with results(target, "calibrate", CALIBRATION_RESULTS, files_named_in(run), force=True) as stage:
        for pattern in CALIBRATION_RESULTS:
            for path in trial.glob(pattern):
                shutil.copyfile(path, stage / path.name)
    return redirect(request, f"/calibrate/{quote(job.subject)}")


def discard(request: Request) -> Response:
    """Discard the result."""
    bench, job = job_of(request)
    bench.jobs.stop(job)
    shutil.rmtree(_trial(bench, job), ignore_errors=True)
    bench.jobs.forget(job)
    return redirect(request, f"/calibrate/{quote(job.subject)}")


# --- compensation ---------------------------------------------------------------------------------

FORMATS = ("parquet", "csv")


def show_compensation(request: Request) -> Response:
    """The form of a record, and its compensations so far."""
    bench, name = bench_of(request), request.path_params["name"]
    run_file = read_run_file(bench.folder.toml(name))
    serial = run_file.instrument.serial
    items = sorted(calibrations(bench.folder), key=lambda item: item[1] != serial)
    tried = bench.listed(lambda job: job.subject == name and job.command[0] == "compensate")
    return render(
        request, "compensate.html.jinja", name=name, serial=serial, calibrations=items, formats=FORMATS, tried=tried
    )  # fmt: skip


async def compensate(request: Request) -> Response:
    """Start a compensation as the form asks for it."""
    bench, name = bench_of(request), request.path_params["name"]
    fields = await sent_form(request)
    run = bench.folder.toml(name)
    calibration = bench.folder.file(only(fields, "calibration"))
    form = only(fields, "format", FORMATS[0])
    if form not in FORMATS:
        raise ArgumentError(f"format {form!r}: is not known", remedy=f"one of {', '.join(FORMATS)}")
    out = run.with_name(f"{run.stem}-compensated.{form}")
    command = [
        "compensate",
        name,
        "--calibration",
        bench.folder.name(calibration),
        "--out",
        bench.folder.name(out),
    ]
    command += ["--report", bench.folder.name(out.with_suffix(".html")), "--force"]
    for option in ("phase", "identify-phase", "rate"):
        value = only(fields, option).strip()
        command += [f"--{option}={value}"] if value else []
    command += ["--other-serial"] if only(fields, "other-serial") else []
    reads = [*files_named_in(run), calibration]
    return await start_job(request, command, "Compensate", name, bench.folder.name(out), reads)


ROUTES = [
    Route("/calibrate/{name:path}", show, methods=["GET"]),
    Route("/calibrate/{name:path}", start, methods=["POST"]),
    Route("/term-prospects/{name:path}", prospects),
    Route("/result/{key}", result),
    Route("/result/{key}/adopt", adopt, methods=["POST"]),
    Route("/result/{key}/discard", discard, methods=["POST"]),
    Route("/compensate/{name:path}", show_compensation, methods=["GET"]),
    Route("/compensate/{name:path}", compensate, methods=["POST"]),
]
