"""The server of the bench: one Starlette application on the loopback address, and who may use it.

Every request passes :class:`Guard` first. It checks, in this order:

1. the name of the host that the browser asked for (a foreign name that resolves to this machine is refused);
2. where the request comes from (``Origin`` and ``Sec-Fetch-Site``; every request that changes something names its
   origin);
3. the session. The address that ``piga ui`` prints holds a token that is good for one use. It gives a cookie that
   scripts cannot read and that no other site can send.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
import signal
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from piga.errors import ArgumentError, PigaError
from piga.text_files import read_whole
from piga.workbench import common, later, record
from piga.workbench.common import Bench, error_page
from piga.workbench.folder import Folder

_MOST_CONNECTIONS = 300
"""Connections at a time; a request beyond is answered with 503. Each may hold a socket and a file, and a process usually
may have 1024 of them."""
_GRACE, _LAST = 1, 1.5
"""Time [s] that open requests have when the server ends, and then a page that still reads a file."""
SESSION_AGE = 12 * 3600
"""Age [s] at which a session ends. A new one starts with the address of a new ``piga ui``."""
LOOPBACK = "127.0.0.1"
"""Address of this machine that no other one can reach."""
_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; style-src-attr 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; frame-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "cache-control": "no-store",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
}
"""Headers of an answer that does not set them itself: no inline script, nothing from outside."""


class Door:
    """The one-time token and the session of one server.

    The session is kept in the user's cache, by port and folder: a server that is started again at the same address knows
    its browser again. ``token`` is that of the printed address; it is empty once it was used.
    """

    def __init__(self, port: int, folder: str = "") -> None:
        self.port, self.token = port, secrets.token_urlsafe(24)
        self.cookie = f"piga-{port}"  # browsers share cookies between ports
        self._session, self._began = "", 0.0
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "piga"
        self._store = cache / f"ui-{port}-{hashlib.sha256(folder.encode()).hexdigest()[:16]}"
        with suppress(PigaError, OSError, UnicodeDecodeError):
            self._began = self._store.stat().st_mtime
            self._session = read_whole(self._store, 100, "another port").decode("ascii")

    @property
    def address(self) -> str:
        """The address to open, with the token."""
        return f"http://{LOOPBACK}:{self.port}/?token={self.token}"

    def knows_host(self, host: str) -> bool:
        """True if ``host`` (of the request) is a loopback name with this server's port."""
        ports = (f":{self.port}", "") if self.port == 80 else (f":{self.port}",)  # browsers leave port 80 out
        return host.lower() in {f"{name}{port}" for name in (LOOPBACK, "localhost", "[::1]") for port in ports}

    def knows_origin(self, origin: str) -> bool:
        """True if ``origin`` is a page of this server."""
        return origin.startswith("http://") and self.knows_host(origin.removeprefix("http://"))

    def open_session(self, token: str) -> str | None:
        """Exchange the token for a session. None if the token is wrong or was used before."""
        if not self.token or not secrets.compare_digest(token.encode(), self.token.encode()):
            return None
        self.token = ""
        if not self.has_session(self._session):
            self._session, self._began = secrets.token_urlsafe(24), time.time()
            with suppress(OSError):  # without a cache folder a browser needs a new address after the next start
                self._store.parent.mkdir(parents=True, exist_ok=True)
                _write_private(self._store, self._session)
        return self._session

    def has_session(self, session: str) -> bool:
        """True if the session is open and not too old."""
        same = bool(session) and secrets.compare_digest(session.encode(), self._session.encode())
        return same and 0.0 <= time.time() - self._began < SESSION_AGE


def _write_private(path: Path, text: str) -> None:
    """Write a file that no other user of this machine can read."""
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as stream:
        stream.write(text.encode())


class Guard:
    """ASGI middleware that lets only the right browser through, over HTTP alone. See the module's docstring."""

    def __init__(self, app: ASGIApp, door: Door) -> None:
        self._app, self._door = app, door

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if scope["path"].startswith("/assets/"):
                    headers.setdefault("cache-control", "max-age=3600")
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(HTTPConnection(scope)) if scope["type"] == "http" else None
        await (refusal or self._app)(scope, receive, sent)  # a websocket is closed there: no page has one

    def _refusal(self, asked: HTTPConnection) -> Response | None:
        door, headers = self._door, asked.headers
        path, method = asked.scope["path"], asked.scope["method"]
        is_safe = method in ("GET", "HEAD")
        is_twofold = any(len(headers.getlist(name)) > 1 for name in ("host", "origin", "cookie"))
        if is_twofold or not door.knows_host(headers.get("host", "")):
            return PlainTextResponse("This server answers only as 127.0.0.1 or localhost.", 421)
        if "origin" in headers:
            is_ours = door.knows_origin(headers["origin"])
        else:
            enters = path == "/" and headers.get("sec-fetch-mode") == "navigate"
            is_ours = is_safe and (headers.get("sec-fetch-site", "none") in ("none", "same-origin") or enters)
        if not is_ours:
            return PlainTextResponse("This request comes from another site.", 403)
        has_session = door.has_session(asked.cookies.get(door.cookie, ""))
        token = asked.query_params.get("token")
        if path == "/" and token is not None and method == "GET":
            session = door.open_session(token)
            if session is not None or has_session:
                answer = RedirectResponse("/", 303)
                if session is not None:
                    answer.set_cookie(door.cookie, session, SESSION_AGE, httponly=True, samesite="strict")
                return answer
        if has_session or (path == "/healthz" and is_safe):
            return None
        words = "Open the address that piga ui printed. It is good for one browser. Start piga ui again for a new one."
        return PlainTextResponse(words, 403)


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
    for room in ("parts", "trials", "signals"):  # of a server that was killed, or of a stranger
        shutil.rmtree(opened.state_room(room), ignore_errors=True)
    bench = Bench(opened)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        ready(door, opened.state_room())
        yield
        bench.jobs.stop_all()

    kinds = (PigaError, HTTPException, OSError, ClientDisconnect, Exception)
    handlers: dict[Any, Any] = dict.fromkeys(kinds, error_page)
    routes = [*common.ROUTES, *record.ROUTES, *later.ROUTES]
    app = Starlette(routes=routes, lifespan=lifespan, exception_handlers=handlers)
    app.state.bench = bench
    config = uvicorn.Config(
        Guard(app, door), log_level="error", access_log=False, server_header=False, proxy_headers=False, http="h11",
        loop="asyncio", timeout_graceful_shutdown=_GRACE, limit_concurrency=_MOST_CONNECTIONS, lifespan="on",
    )  # fmt: skip
    server = uvicorn.Server(config)

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


def open_browser(door: Door, place: Path) -> None:
    """Open the user's browser, if there is one, on a file that leads to the address.

    Other users of this machine see the arguments of a browser, but not the file, which only its owner can read.
    """
    import webbrowser

    page = f'<!DOCTYPE html><title>piga</title><meta http-equiv="refresh" content="0;url={door.address}">'
    _write_private(place / "open.html", page)
    with suppress(webbrowser.Error):
        webbrowser.open((place / "open.html").as_uri())
