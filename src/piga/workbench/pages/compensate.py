"""Compensate: a record and a calibration; the specific force without the cross-coupling, before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from piga.errors import ArgumentError
from piga.records.run_file import read_run_file
from piga.records.text_files import files_named_in
from piga.workbench.folder import Folder
from piga.workbench.pages.common import bench_of, only, redirect, render, sent_form

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

FORMATS = ("parquet", "csv")


def calibrations(folder: Folder) -> list[tuple[str, str]]:
    """The kept calibrations of the folder: name and serial number."""
    import msgspec

    items = []
    for path in sorted(folder.root.glob("**/calibration.json"))[:500]:
        name = folder.name(path)
        if name.startswith(".") or "/." in name or not path.resolve().is_relative_to(folder.root):
            continue
        try:
            document = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
        except (OSError, msgspec.DecodeError):
            continue
        instrument = document.get("instrument")
        serial = instrument.get("serial", "") if isinstance(instrument, dict) else ""
        items.append((name, str(serial)))
    return items


def show(request: Request) -> Response:
    """The form of a record, and its compensations so far."""
    bench, name = bench_of(request), request.path_params["name"]
    run_file = read_run_file(bench.folder.toml(name))
    serial = run_file.instrument.serial
    items = sorted(calibrations(bench.folder), key=lambda item: item[1] != serial)
    tried = [
        (job, bench.jobs.status(job))
        for job in bench.jobs.all()
        if job.subject == name and job.command[0] == "compensate"
    ]
    return render(
        request, "compensate.html.jinja", name=name, serial=serial, calibrations=items, formats=FORMATS, tried=tried
    )  # fmt: skip


async def start(request: Request) -> Response:
    """Start a compensation as the form asks for it."""
    from starlette.concurrency import run_in_threadpool

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
    job = await run_in_threadpool(bench.jobs.start, command, "Compensate", name, bench.folder.name(out), reads)
    return redirect(request, f"/jobs/{job.key}")


def routes() -> list[Any]:
    """Routes of this page."""
    from starlette.routing import Route

    return [
        Route("/compensate/{name:path}", show, methods=["GET"]),
        Route("/compensate/{name:path}", start, methods=["POST"]),
    ]
