"""Instruments: years of one instrument: its calibrations, trend and certificates."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from piga.errors import ArgumentError
from piga.workbench.pages.common import Workbench, bench_of, form_of, only, redirect, render
from piga.workbench.pages.compensate import calibrations

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response


def _by_serial(bench: Workbench) -> dict[str, list[str]]:
    instruments: dict[str, list[str]] = {}
    for path, serial in calibrations(bench.folder):
        instruments.setdefault(serial, []).append(path)
    return instruments


def show(request: Request) -> Response:
    """All instruments of the folder."""
    bench = bench_of(request)
    certificates = [
        bench.folder.name(path)
        for path in sorted(bench.folder.root.glob("*.toml"))
        if path.is_file() and "[laboratory]" in path.read_text(encoding="utf-8", errors="replace")
    ]
    jobs = [(job, bench.jobs.status(job)) for job in bench.jobs.all() if job.title in ("Trend", "Certificate")]
    return render(
        request, "instrument.html.jinja", instruments=_by_serial(bench), certificates=certificates, jobs=jobs
    )


async def trend(request: Request) -> Response:
    """Show how the coefficients of one instrument drift."""
    from starlette.concurrency import run_in_threadpool

    bench = bench_of(request)
    fields = await form_of(request)
    serial = only(fields, "serial")
    paths = _by_serial(bench).get(serial)
    if not paths:
        raise ArgumentError(f"there is no calibration of {serial!r}", remedy="calibrate a record first")
    out = f"trend-{_plain(serial)}"
    command = ["records", "trend", *paths, "--out", out, "--force"]
    at = only(fields, "at").strip()
    command += [f"--at={at}"] if at else []
    job = await run_in_threadpool(bench.jobs.start, command, "Trend", serial, out)
    return redirect(request, f"/jobs/{job.key}")


async def certificate(request: Request) -> Response:
    """Issue the certificate of a calibration."""
    from starlette.concurrency import run_in_threadpool

    bench = bench_of(request)
    fields = await form_of(request)
    calibration = bench.folder.file(only(fields, "calibration"))
    data = bench.folder.toml(only(fields, "data"))
    out = f"certificate-{_plain(calibration.parent.name)}"
    command = [
        "certificate", "issue", bench.folder.name(calibration), "--data", bench.folder.name(data),
        "--out", out, "--force",
    ]  # fmt: skip
    command += ["--dcc"] if only(fields, "dcc") else []
    job = await run_in_threadpool(bench.jobs.start, command, "Certificate", calibration.parent.name, out)
    return redirect(request, f"/jobs/{job.key}")


def _plain(name: str) -> str:
    """The letters and digits of a name, for a folder."""
    return "".join(letter if letter.isalnum() else "-" for letter in name).strip("-")[:60] or "instrument"


def routes() -> list[Any]:
    """Routes of this page."""
    from starlette.routing import Route

    return [
        Route("/instrument", show),
        Route("/instrument/trend", trend, methods=["POST"]),
        Route("/instrument/certificate", certificate, methods=["POST"]),
    ]
