"""The server of the workbench: one Starlette application, on the loopback address or behind TLS and a password.

A connection ends if its browser keeps it waiting for a request, and when the server ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from uvicorn.protocols.http.h11_impl import H11Protocol

from piga.workbench.folder import Folder
from piga.workbench.jobs import Jobs
from piga.workbench.live import Live
from piga.workbench.pages import (
    calibrate,
    certificate,
    common,
    describe,
    explore,
    jobs,
    login,
    records,
    scenario,
    signals,
)
from piga.workbench.pages.common import Workbench, error_page, gone_page
from piga.workbench.remote import WAITING, Entrance, listening
from piga.workbench.security import Door, Guard

LONGEST_HEAD = 20.0
"""Time [s] that a connection may take for the head of its next request. uvicorn itself sets no limit."""
LAST = 1.0
"""Time [s] that answers have to reach their readers when the server ends."""


class Connection(H11Protocol):
    """A connection that nobody can hold without a request."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first head."""
        super().connection_made(transport)
        self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Part of a request. More parts of the same head get no more time."""
        super().data_received(data)
        if not self._is_idle():
            self._stop_waiting()

    def on_response_complete(self) -> None:
        """Wait for the next head; it may have come already."""
        super().on_response_complete()
        if self._is_idle():
            self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Nothing is waited for."""
        self._stop_waiting()
        super().connection_lost(exc)

    def shutdown(self) -> None:
        """End at once if no request is in progress, and soon if one is.

        A TLS connection would otherwise stay open until the browser agrees to its end.
        """
        if self._is_idle() and not self.transport.get_write_buffer_size():
            self.transport.abort()
            return
        super().shutdown()
        self.loop.call_later(LAST, self.transport.abort)

    def _is_idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _wait_for_head(self) -> None:
        self._stop_waiting()
        self._late = self.loop.call_later(LONGEST_HEAD, self.transport.abort)

    def _stop_waiting(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None


ROUTES = [
    route
    for page in (common, records, describe, signals, calibrate, certificate, scenario, explore, jobs, login)
    for route in page.ROUTES
]
"""The routes of all pages, and of the files that they load."""
MOST_CONNECTIONS = 300
"""Connections at a time; a request beyond is answered with 503. Each may hold a socket and a file, and a process usually
may have 1024 of them."""
GRACE = 2
"""Time [s] that open requests have when the server ends."""


def application(folder: Folder, door: Door, ready: Callable[[], None], live: Live | None) -> Any:
    """The ASGI application for a folder.

    Parameters
    ----------
    folder:
        The opened folder.
    door:
        Who may come in.
    ready:
        Called once when the application has started.
    live:
        The stream of the page Live, or None.
    """
    from piga.errors import PigaError

    folder.settle()
    bench = Workbench(folder, Jobs(folder.state_room("jobs"), folder.root), live, door)

    for part in folder.state_room(records.PARTS).iterdir():
        part.unlink(missing_ok=True)

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


def serve(
    folder: Path, port: int, *, ready: Callable[[Door], None], live: Live | None, entrance: Entrance
) -> None:
    """Serve the workbench of a folder until SIGINT or SIGTERM. Running jobs are then ended.

    Parameters
    ----------
    folder:
        The folder to open.
    port:
        Port to listen on; 0 takes a free one.
    ready:
        Called with the door once the server answers.
    live:
        The stream of the page Live, or None.
    entrance:
        Where to listen, and what to ask for.

    Raises
    ------
    ArgumentError
        If ``folder`` is not a folder, or the name or port cannot be used.
    """
    opened = Folder(folder)
    sockets = listening(entrance, port)
    door = Door(sockets[0].getsockname()[1], entrance.host, entrance.login)
    tls = entrance.tls
    config = uvicorn.Config(
        application(opened, door, lambda: ready(door), live),
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=GRACE,
        backlog=WAITING,  # so many are accepted before the first of them is answered
        limit_concurrency=MOST_CONNECTIONS,
        http=Connection,
        lifespan="on",
        loop="asyncio",  # others do not ask the listener
        ssl_context_factory=None if tls is None else lambda _config, _default: tls,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _ended)  # uvicorn raises the signal again when it has ended
    with contextlib.ExitStack() as stack:
        for one in sockets:
            stack.enter_context(one)
        uvicorn.Server(config).run(sockets=sockets)


def _ended(_number: int, _frame: Any) -> None:
    """The server has ended by itself."""


def open_browser(address: str) -> bool:
    """Open the address in the user's browser. False if there is none."""
    import webbrowser

    try:
        return webbrowser.open(address)
    except webbrowser.Error:
        return False
