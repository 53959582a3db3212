"""Records: run files and logs of the folder with their state. The user can drop a file and open one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from piga.output import put_in_place
from piga.workbench.pages.common import TooLargeError, bench_of, render

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

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
    import tempfile

    from starlette.concurrency import run_in_threadpool
    from starlette.responses import JSONResponse

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
            part.chmod(0o644)
            await run_in_threadpool(put_in_place, part, target, replace=False)
        finally:
            part.unlink(missing_ok=True)
    return JSONResponse({"name": folder.name(target)})


def _too_large(target: Path) -> TooLargeError:
    return TooLargeError(
        f"{target.name}: is larger than {MOST_UPLOAD >> 30} GiB", remedy="copy it into the folder"
    )


def routes() -> list[Any]:
    """Routes of this page."""
    from starlette.routing import Route

    return [Route("/", show), Route("/upload", take, methods=["POST"])]
