"""Instruments: years of one instrument: its calibrations and their trend, and the ledger that keeps them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from piga.errors import ArgumentError
from piga.workbench.pages.certificate import plain
from piga.workbench.pages.common import Workbench, bench_of, only, redirect, render, sent_form
from piga.workbench.pages.compensate import calibrations

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

STORES = (".sqlite", ".db")
"""Endings of ledgers."""
LEDGER = {"list": "List the ledger", "verify": "Verify the ledger", "export": "Export the ledger"}
"""Commands on a ledger, and their titles."""
TITLES = ("Trend", "Keep", *LEDGER.values())


def _by_serial(bench: Workbench) -> dict[str, list[str]]:
    instruments: dict[str, list[str]] = {}
    for path, serial in calibrations(bench.folder):
        instruments.setdefault(serial, []).append(path)
    return instruments


def show(request: Request) -> Response:
    """All instruments of the folder."""
    bench = bench_of(request)
    jobs = [(job, bench.jobs.status(job)) for job in bench.jobs.all() if job.title in TITLES]
    return render(
        request, "instrument.html.jinja", instruments=_by_serial(bench), jobs=jobs,
        stores=_stores(bench), runs=_runs(bench),
    )  # fmt: skip


def _stores(bench: Workbench) -> list[str]:
    """The ledgers of the folder."""
    return [
        path.name
        for ending in STORES
        for path in sorted(bench.folder.root.glob(f"*{ending}"))
        if path.is_file() and not path.is_symlink() and not path.name.startswith(".")
    ]


def _runs(bench: Workbench) -> list[str]:
    """Run files whose results are kept."""
    return [entry.name for entry in bench.folder.entries() if entry.state == "calibrated"]


async def trend(request: Request) -> Response:
    """Show how the coefficients of one instrument drift."""
    from starlette.concurrency import run_in_threadpool

    bench = bench_of(request)
    fields = await sent_form(request)
    serial = only(fields, "serial")
    paths = _by_serial(bench).get(serial)
    if not paths:
        raise ArgumentError(f"there is no calibration of {serial!r}", remedy="calibrate a record first")
    out = f"trend-{plain(serial)}"
    command = ["records", "trend", *paths, "--out", out, "--force"]
    at = only(fields, "at").strip()
    command += [f"--at={at}"] if at else []
    job = await run_in_threadpool(bench.jobs.start, command, "Trend", serial, out)
    return redirect(request, f"/jobs/{job.key}")


async def keep(request: Request) -> Response:
    """Keep a run, its results and its report in a ledger; it is made if there is none."""
    from starlette.concurrency import run_in_threadpool

    bench = bench_of(request)
    fields = await sent_form(request)
    run = bench.folder.name(bench.folder.toml(only(fields, "run")))
    store = _store(bench, only(fields, "store"))
    results = bench.folder.path(run.removesuffix(".toml") + "-calibration")
    command = ["records", "add", run, "--store", store, "--results", bench.folder.name(results)]
    for option in ("operator", "reason"):
        value = " ".join(only(fields, option).split())
        if not value:
            raise ArgumentError(f"{option}: is missing", remedy="say who keeps the record, and why")
        command.append(f"--{option}={value}")
    job = await run_in_threadpool(bench.jobs.start, command, "Keep", run)
    return redirect(request, f"/jobs/{job.key}")


async def ledger(request: Request) -> Response:
    """List or verify a ledger, or write its records into one file."""
    from starlette.concurrency import run_in_threadpool

    bench = bench_of(request)
    fields = await sent_form(request)
    store, word = _store(bench, only(fields, "store"), there=True), only(fields, "do")
    if word not in LEDGER:
        raise ArgumentError(f"{word!r}: is not a command of this page", remedy="use its buttons")
    out = f"{store.partition('.')[0]}-{time.strftime('%Y%m%d-%H%M%S')}.zip" if word == "export" else ""
    command = ["records", word, *([out] if out else []), "--store", store]
    job = await run_in_threadpool(bench.jobs.start, command, LEDGER[word], store, out)
    return redirect(request, f"/jobs/{job.key}")


def _store(bench: Workbench, name: str, *, there: bool = False) -> str:
    """The name of a ledger in the folder, never an address."""
    path = bench.folder.file(name) if there else bench.folder.path(name)
    if path.parent != bench.folder.root or path.suffix not in STORES:
        raise ArgumentError(f"{name!r}: cannot be the name of a ledger", remedy="e.g. lab.sqlite")
    return path.name


def routes() -> list[Any]:
    """Routes of this page."""
    from starlette.routing import Route

    return [
        Route("/instrument", show),
        Route("/instrument/keep", keep, methods=["POST"]),
        Route("/instrument/ledger", ledger, methods=["POST"]),
        Route("/instrument/trend", trend, methods=["POST"]),
    ]
