"""Signals: the record as it would be calibrated, to zoom and pan, with the findings marked."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from piga.errors import ArgumentError
from piga.records.run_file import read_run_file
from piga.records.text_files import files_named_in
from piga.workbench.jobs import Job
from piga.workbench.pages.common import Workbench, bench_of, only, redirect, render, sent_form
from piga.workbench.signals import SignalOutline, cache_key, picture, read_outline, rows_between

READ = "envelopes"
"""Name of the job that reads a record."""


def cache_of(bench: Workbench, name: str) -> Path:
    """Folder of the envelopes of a record, whether they exist or not."""
    run = bench.folder.toml(name)
    record = hashlib.sha256(name.encode()).hexdigest()[:12]
    return bench.folder.state_room("signals") / f"{record}-{cache_key(files_named_in(run))}"


def reading(bench: Workbench, name: str, *, again: bool = False) -> tuple[SignalOutline | None, Job | None]:
    """The outline of a record. If it is not read yet: the job that reads it, or that failed."""
    cache = cache_of(bench, name)
    outline = read_outline(cache)
    if outline is not None:
        return outline, None
    mark = f"signals/{cache.name}"
    last = bench.jobs.latest(name, mark)
    if last is not None and not again and bench.jobs.status(last).state in ("running", "failed", "stopped"):
        return None, last
    return None, bench.jobs.start((READ, name, str(cache)), "Read the record", name, mark)


def _read(bench: Workbench, name: str) -> SignalOutline:
    """The outline of a record that is read.

    Raises
    ------
    ArgumentError
        If it is not read yet.
    """
    outline, _ = reading(bench, name)
    if outline is None:
        raise ArgumentError(f"{name}: is not read yet", remedy="reload the page")
    return outline


def show(request: Request) -> Response:
    """The page of a record's signals."""
    bench, name = bench_of(request), request.path_params["name"]
    outline, job = reading(bench, name)
    if job is not None:
        status = bench.jobs.status(job)
        text = bench.jobs.text(job, "err") if status.state != "running" else ""
        return render(request, "signals/reading.html.jinja", name=name, job=job, status=status, text=text)
    assert outline is not None  # noqa: S101  a record is read, or a job reads it
    groups: dict[str, list[Any]] = {}
    for signal in outline.signals:
        groups.setdefault(signal.group, []).append(signal)
    return render(request, "signals/signals.html.jinja", name=name, outline=outline, groups=groups)


def read_again(request: Request) -> Response:
    """Read a record once more after a failure."""
    bench, name = bench_of(request), request.path_params["name"]
    reading(bench, name, again=True)
    return redirect(request, f"/signals/{quote(name)}")


def data(request: Request) -> Response:
    """Rows of time, then least and largest value of each asked signal, as 64-bit floats."""
    bench, name = bench_of(request), request.path_params["name"]
    outline = _read(bench, name)
    query = request.query_params
    try:
        first, last, width = float(query["from"]), float(query["to"]), int(query["width"])
    except (KeyError, ValueError):
        raise ArgumentError("the span of the picture is not valid", remedy="reload the page") from None
    signals = {signal.key: signal for signal in outline.signals}
    columns: list[Any] = []
    for key in query.get("keys", "").split(","):
        rows = picture(cache_of(bench, name), key, first, last, width)
        shown = rows[:, 1:] * signals[key].factor + signals[key].offset
        columns += [shown] if columns else [rows[:, :1], shown]
    table = np.ascontiguousarray(np.hstack(columns), dtype="<f8")
    headers = {"x-columns": str(table.shape[1])}
    return Response(table.tobytes(), media_type="application/octet-stream", headers=headers)


async def leave_out(request: Request) -> Response:
    """Leave a marked span out: its rows and the reason go into the run file."""
    bench, name = bench_of(request), request.path_params["name"]
    fields = await sent_form(request)
    try:
        first, last = float(only(fields, "from")), float(only(fields, "to"))
    except ValueError:
        raise ArgumentError("the marked span is not valid", remedy="mark it again") from None
    reason = " ".join(only(fields, "reason").split())
    if not reason:
        raise ArgumentError("a reason is needed", remedy="say why these rows are left out")
    await run_in_threadpool(_leave_out, bench, name, first, last, reason)
    return redirect(request, f"/signals/{quote(name)}")


def _leave_out(bench: Workbench, name: str, first: float, last: float, reason: str) -> None:
    """Add an entry to ``[data] leave_out``; everything else in the file, its comments too, stays as it is."""
    import tomlkit

    _read(bench, name)
    rows = rows_between(cache_of(bench, name), first, last)
    path = bench.folder.toml(name)
    document = tomlkit.parse(path.read_text(encoding="utf-8"))
    data: Any = document["data"]
    entry = tomlkit.inline_table()
    entry.update({"rows": list(rows), "reason": reason})
    if "leave_out" not in data:
        data["leave_out"] = tomlkit.array()
    data["leave_out"].append(entry)
    data["leave_out"].multiline(multiline=True)
    bench.folder.write_toml(path, tomlkit.dumps(document), read_run_file)


ROUTES = [
    Route("/signals/{name:path}", show, methods=["GET"]),
    Route("/signals/{name:path}", read_again, methods=["POST"]),
    Route("/signal-data/{name:path}", data),
    Route("/leave-out/{name:path}", leave_out, methods=["POST"]),
]
