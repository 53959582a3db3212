"""The server of the workbench: one Starlette application, on the loopback address."""

from __future__ import annotations

import contextlib
import shutil
import signal
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from piga.errors import ArgumentError, PigaError
from piga.workbench.folder import Folder
from piga.workbench.jobs import Jobs
from piga.workbench.pages import (
    calibrate,
    certificate,
    common,
    describe,
    explore,
    jobs,
    records,
    scenario,
    signals,
)
from piga.workbench.pages.common import Workbench, error_page, gone_page
from piga.workbench.security import LOOPBACK, Door, Guard

ROUTES = [
    route
    for page in (common, records, describe, signals, calibrate, certificate, scenario, explore, jobs)
    for route in page.ROUTES
]
"""The routes of all pages, and of the files that they load."""
MOST_CONNECTIONS = 300
"""Connections at a time; a request beyond is answered with 503. Each may hold a socket and a file, and a process usually
may have 1024 of them."""
MOST_PORT = 65535
GRACE = 2
"""Time [s] that open requests have when the server ends."""


def application(folder: Folder, door: Door, ready: Callable[[], None]) -> Any:
    """The ASGI application for a folder.

    Parameters
    ----------
    folder:
        The opened folder.
    door:
        Who may come in.
    ready:
        Called once when the application has started.
    """
    bench = Workbench(folder, Jobs(folder.root), door)

    for part in folder.state_room(records.PARTS).iterdir():
        part.unlink(missing_ok=True)
    for trial in folder.state_room("trials").iterdir():  # no job makes or shows it any more
        shutil.rmtree(trial, ignore_errors=True)

    @contextlib.asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        ready()
        yield
        bench.jobs.stop_all()

    app = Starlette(
        routes=ROUTES,
        lifespan=lifespan,
        exception_handlers={
            PigaError: error_page,
            HTTPException: error_page,
            OSError: error_page,
            ClientDisconnect: gone_page,
            Exception: error_page,
        },
    )
    app.state.bench = bench
    return Guard(app, door)


def serve(folder: Path, port: int, *, ready: Callable[[Door], None]) -> None:
    """Serve the workbench of a folder on the loopback address until SIGINT or SIGTERM. Running jobs are then ended.

    Parameters
    ----------
    folder:
        The folder to open.
    port:
        Port to listen on; 0 takes a free one.
    ready:
        Called with the door once the server answers.

    Raises
    ------
    ArgumentError
        If ``folder`` is not a folder, or the port cannot be used.
    """
    opened = Folder(folder)
    listener = _listening(port)
    door = Door(listener.getsockname()[1])
    config = uvicorn.Config(
        application(opened, door, lambda: ready(door)),
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=GRACE,
        limit_concurrency=MOST_CONNECTIONS,
        http="h11",
        lifespan="on",
        loop="asyncio",
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _ended)  # uvicorn raises the signal again when it has ended
    with listener:
        uvicorn.Server(config).run(sockets=[listener])


def _listening(port: int) -> socket.socket:
    """A socket on the loopback address."""
    if not 0 <= port <= MOST_PORT:
        raise ArgumentError(f"port {port}: is not between 0 and {MOST_PORT}", remedy="choose another, or 0")
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        raise ArgumentError(
            f"port {port} cannot be used ({error.strerror})", remedy="choose another, or leave --port out"
        ) from None


def _ended(_number: int, _frame: Any) -> None:
    """The server has ended by itself."""


def open_browser(address: str) -> bool:
    """Open the address in the user's browser. False if there is none."""
    import webbrowser

    try:
        return webbrowser.open(address)
    except webbrowser.Error:
        return False
