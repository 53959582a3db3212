"""The server of the workbench: one Starlette application, on the loopback address or behind TLS and a password."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from piga.workbench.folder import Folder
from piga.workbench.jobs import Jobs
from piga.workbench.live import Live
from piga.workbench.pages import all_routes
from piga.workbench.pages.common import Workbench, error_page, gone_page
from piga.workbench.pages.records import PARTS
from piga.workbench.remote import WAITING, Entrance, listening
from piga.workbench.security import Door, Guard

MOST_CONNECTIONS = 300
"""Connections at a time; a request beyond is answered with 503. Each may hold a socket and a file, and a process usually
may have 1024 of them."""
GRACE = 2
"""Time [s] that open requests have when the server ends."""


def application(
    folder: Folder, door: Door, ready: Callable[[], None] = lambda: None, live: Live | None = None
) -> Any:
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
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.requests import ClientDisconnect

    from piga.errors import PigaError

    folder.settle()
    bench = Workbench(folder, Jobs(folder.state_room("jobs"), folder.root), live, door)

    for part in folder.state_room(PARTS).iterdir():
        part.unlink(missing_ok=True)

    @contextlib.asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        ready()
        yield
        bench.jobs.stop_all()

    app = Starlette(
        routes=all_routes(),
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
    folder: Path,
    port: int = 0,
    *,
    ready: Callable[[Door], None],
    live: Live | None = None,
    entrance: Entrance | None = None,
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
        Where to listen, and what to ask for. None: 127.0.0.1 and the token.

    Raises
    ------
    ArgumentError
        If ``folder`` is not a folder, or the name or port cannot be used.
    """
    import uvicorn

    from piga.workbench.connection import Connection

    entrance = entrance or Entrance()
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
