"""Records: run files and logs of the folder with their state. Instruments: their calibrations, trend and ledgers."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from piga.errors import ArgumentError
from piga.output import allowed, put_in_place
from piga.workbench.folder import Folder, is_plain, results_of
from piga.workbench.pages.common import TooLargeError, Workbench, bench_of, only, render, sent_form, start_job

MOST_UPLOAD = 4 << 30
"""Largest file [bytes] that may be dropped in. Larger ones are copied into the folder."""

PARTS = "parts"
"""Room of the files that are being sent. What lies there when the server starts was never whole."""


def show(request: Request) -> Response:
    """The list of records."""
    bench = bench_of(request)
    entries = bench.folder.entries()
    running = {
        job.subject: job for job in reversed(bench.jobs.all()) if bench.jobs.status(job).state == "running"
    }
    return render(request, "records.html.jinja", entries=entries, running=running)


async def take(request: Request) -> Response:
    """A file that was dropped in. Its bytes are the body; its name is in the address."""
    folder = bench_of(request).folder
    target = folder.free_name(request.query_params.get("name", ""))
    with tempfile.NamedTemporaryFile(dir=folder.state_room(PARTS), delete=False) as stream:
        part = Path(stream.name)
        try:
            size = 0
            declared = request.headers.get("content-length", "0")
            if declared.isdigit() and len(declared) < 19 and int(declared) > MOST_UPLOAD:
                raise _too_large(target)
            async for piece in request.stream():
                size += len(piece)
                if size > MOST_UPLOAD:
                    raise _too_large(target)
                stream.write(piece)
            stream.flush()
            part.chmod(allowed(0o666))
            await run_in_threadpool(put_in_place, part, target, replace=False)
        finally:
            part.unlink(missing_ok=True)
    return JSONResponse({"name": folder.name(target)})


def _too_large(target: Path) -> TooLargeError:
    return TooLargeError(
        f"{target.name}: is larger than {MOST_UPLOAD >> 30} GiB", remedy="copy it into the folder"
    )


# --- instruments ----------------------------------------------------------------------------------

STORES = (".sqlite", ".db")
"""Endings of ledgers."""
LEDGER = {"list": "List the ledger", "verify": "Verify the ledger", "export": "Export the ledger"}
"""Commands on a ledger, and their titles."""
TITLES = ("Trend", "Keep", *LEDGER.values())


def calibrations(folder: Folder) -> list[tuple[str, str]]:
    """The kept calibrations of the folder: name and serial number."""
    items = []
    for path in sorted(folder.root.glob("**/calibration.json"))[:500]:
        name = folder.name(path)
        if not is_plain(name) or not path.resolve().is_relative_to(folder.root):
            continue
        try:
            document = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
        except (OSError, msgspec.DecodeError):
            continue
        instrument = document.get("instrument")
        serial = instrument.get("serial", "") if isinstance(instrument, dict) else ""
        items.append((name, str(serial)))
    return items


def _by_serial(bench: Workbench) -> dict[str, list[str]]:
    instruments: dict[str, list[str]] = {}
    for path, serial in calibrations(bench.folder):
        instruments.setdefault(serial, []).append(path)
    return instruments


def show_instruments(request: Request) -> Response:
    """All instruments of the folder."""
    bench = bench_of(request)
    jobs = bench.listed(lambda job: job.title in TITLES)
    kept = [entry.name for entry in bench.folder.entries() if entry.state == "calibrated"]
    stores = bench.folder.listed(*(f"*{ending}" for ending in STORES))
    return render(
        request, "instrument.html.jinja", instruments=_by_serial(bench), jobs=jobs, stores=stores, runs=kept
    )


def plain(name: str) -> str:
    """The letters and digits of a name, for a folder."""
    return "".join(letter if letter.isalnum() else "-" for letter in name).strip("-")[:60] or "instrument"


async def trend(request: Request) -> Response:
    """Show how the coefficients of one instrument drift."""
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
    return await start_job(request, command, "Trend", serial, out)


async def keep(request: Request) -> Response:
    """Keep a run, its results and its report in a ledger; it is made if there is none."""
    bench = bench_of(request)
    fields = await sent_form(request)
    path = bench.folder.toml(only(fields, "run"))
    run, results = bench.folder.name(path), bench.folder.name(results_of(path))
    store = _store(bench, only(fields, "store"))
    bench.folder.path(results)
    command = ["records", "add", run, "--store", store, "--results", results]
    for option in ("operator", "reason"):
        value = " ".join(only(fields, option).split())
        if not value:
            raise ArgumentError(f"{option}: is missing", remedy="say who keeps the record, and why")
        command.append(f"--{option}={value}")
    return await start_job(request, command, "Keep", run)


async def ledger(request: Request) -> Response:
    """List or verify a ledger, or write its records into one file."""
    bench = bench_of(request)
    fields = await sent_form(request)
    store, word = _store(bench, only(fields, "store"), there=True), only(fields, "do")
    if word not in LEDGER:
        raise ArgumentError(f"{word!r}: is not a command of this page", remedy="use its buttons")
    out = f"{store.partition('.')[0]}-{time.strftime('%Y%m%d-%H%M%S')}.zip" if word == "export" else ""
    command = ["records", word, *([out] if out else []), "--store", store]
    return await start_job(request, command, LEDGER[word], store, out)


def _store(bench: Workbench, name: str, *, there: bool = False) -> str:
    """The name of a ledger in the folder, never an address."""
    path = bench.folder.file(name) if there else bench.folder.path(name)
    if path.parent != bench.folder.root or path.suffix not in STORES:
        raise ArgumentError(f"{name!r}: cannot be the name of a ledger", remedy="e.g. lab.sqlite")
    return path.name


ROUTES = [
    Route("/", show),
    Route("/upload", take, methods=["POST"]),
    Route("/instrument", show_instruments),
    Route("/instrument/keep", keep, methods=["POST"]),
    Route("/instrument/ledger", ledger, methods=["POST"]),
    Route("/instrument/trend", trend, methods=["POST"]),
]
