"""The server of the bench: one Starlette application on the loopback address."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import threading
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from piga.errors import ArgumentError, PigaError
from piga.workbench import common, describe, later, record
from piga.workbench.common import Bench, error_page
from piga.workbench.folder import Folder
from piga.workbench.security import LOOPBACK, Door, Guard, write_private

ROUTES = [route for page in (common, describe, record, later) for route in page.ROUTES]
_MOST_CONNECTIONS = 300
"""Connections at a time; a request beyond is answered with 503. Each may hold a socket and a file, and a process usually
may have 1024 of them."""
_GRACE, _LAST = 1, 1.5
"""Time [s] that open requests have when the server ends, and then a page that still reads a file."""


def application(folder: Folder, door: Door, ready: Callable[[], None]) -> Any:
    """The ASGI application for a folder. ``ready`` is called once when it has started."""
    for room in ("parts", "trials"):  # of a server that was killed
        shutil.rmtree(folder.state_room(room), ignore_errors=True)
    bench = Bench(folder)

    @contextlib.asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        ready()
        yield
        bench.jobs.stop_all()

    kinds = (PigaError, HTTPException, OSError, ClientDisconnect, Exception)
    handlers: dict[Any, Any] = dict.fromkeys(kinds, error_page)
    app = Starlette(routes=ROUTES, lifespan=lifespan, exception_handlers=handlers)
    app.state.bench = bench
    return Guard(app, door)


def serve(folder: Path, port: int, *, ready: Callable[[Door, Path], None]) -> None:
    """Serve the bench of a folder on the loopback address until SIGINT or SIGTERM. Running jobs are then ended.

    ``port`` 0 takes a free one. ``ready`` is called with the door and the hidden folder once the server answers.
    """
    opened = Folder(folder)
    try:
        listener = socket.create_server((LOOPBACK, port))
    except (OSError, OverflowError) as error:
        words = f"port {port} cannot be used ({getattr(error, 'strerror', error)})"
        raise ArgumentError(words, remedy="choose another, or leave --port out") from None
    door = Door(listener.getsockname()[1], str(opened.root))
    app = application(opened, door, lambda: ready(door, opened.state_room()))
    server = uvicorn.Server(
        uvicorn.Config(
            app, log_level="error", access_log=False, server_header=False, proxy_headers=False, http="h11", loop="asyncio",
            timeout_graceful_shutdown=_GRACE, limit_concurrency=_MOST_CONNECTIONS, lifespan="on",
        )
    )  # fmt: skip

    def end(_number: int, _frame: Any) -> None:
        server.should_exit = True  # before it began; uvicorn raises the signal again when it has ended

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    with listener:
        server.run(sockets=[listener])
    if any(thread.name.startswith("AnyIO") for thread in threading.enumerate()):
        timer = threading.Timer(_LAST, os._exit, (0,))
        timer.daemon = True
        timer.start()


def open_browser(door: Door, place: Path) -> bool:
    """Open the user's browser on a file that leads to the address. False if there is no browser.

    Other users of this machine see the arguments of a browser, but not the file, which only its owner can read.
    """
    import webbrowser

    page = f'<!DOCTYPE html><title>piga</title><meta http-equiv="refresh" content="0;url={door.address}">'
    write_private(place / "open.html", page.encode())
    try:
        return webbrowser.open((place / "open.html").as_uri())
    except webbrowser.Error:
        return False
