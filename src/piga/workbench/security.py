"""Access control: who may use the workbench.

Every request passes :class:`Guard` first. It checks, in this order:

1. the name of the host that the browser asked for (a foreign name that resolves to this machine is refused);
2. where the request comes from (``Origin`` and ``Sec-Fetch-Site``; every request that changes something names its
   origin);
3. the session. The address that ``piga ui`` prints holds a token that is good for one use. It gives a cookie that
   scripts cannot read and that no other site can send.

The guard is plain ASGI, so it covers WebSockets and event streams, too.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import time
from collections.abc import Awaitable, Callable, MutableMapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from piga.errors import PigaError
from piga.records.limits import read_whole

Scope = MutableMapping[str, Any]
_Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, _Receive, Send], Awaitable[None]]

SESSION_AGE = 12 * 3600.0
"""Age [s] at which a session ends. A new one starts with the address of a new ``piga ui``."""
_MOST_SESSIONS = 64
"""Most sessions of a server. One more ends the oldest."""
_MOST_STORE = 1 << 16
"""Largest file of sessions [bytes]."""
_SAFE_METHODS = frozenset({"GET", "HEAD"})
LOOPBACK = "127.0.0.1"
"""Address of this machine that no other one can reach."""
_PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; style-src-attr 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; "
    "frame-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
"""Policy of the workbench's own pages: no inline script, nothing from outside. Figures are drawn in the page (SVG), and
their colours are attributes."""
REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""Policy of a report from the folder. Its scripts run in an origin of their own and reach no part of the workbench."""
_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), geolocation=(), microphone=()"),
)
"""Headers of every answer."""


@dataclass
class Door:
    """The one-time token and the sessions of one server.

    Attributes
    ----------
    port, folder:
        The port that the server listens on, and the opened folder.
    token:
        Token of the printed address; empty once it was used.
    """

    port: int
    folder: str = ""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    clock: Callable[[], float] = time.time
    _sessions: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with suppress(PigaError, OSError, ValueError, TypeError, AttributeError):
            raw = read_whole(self._store(), _MOST_STORE, "another port")
            self._sessions = {str(mark): float(began) for mark, began in json.loads(raw).items()}

    def _store(self) -> Path:
        """The file of the sessions of this port and folder, in the user's cache.

        A server that is started again at the same address knows its browser again. The file holds digests, not sessions.
        """
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "piga"
        return cache / f"ui-{self.port}-{_mark(self.folder)[:16]}.json"

    def _keep(self) -> None:
        """Write the sessions. Without a cache folder a browser needs a new address after the next start."""
        with suppress(OSError):
            path = self._store()
            path.parent.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as stream:
                json.dump(self._sessions, stream)

    @property
    def cookie(self) -> str:
        """Name of the session cookie. Browsers share cookies between ports, so the port is in the name."""
        return f"piga-{self.port}"

    @property
    def address(self) -> str:
        """The address to open, with the token."""
        return f"http://{LOOPBACK}:{self.port}/?token={self.token}"

    def knows_host(self, host: str) -> bool:
        """True if ``host`` (of the request) is a loopback name with this server's port."""
        names = {LOOPBACK, "localhost", "[::1]"}
        return host.lower() in {f"{name}:{self.port}" for name in names} | (names if self.port == 80 else set())

    def knows_origin(self, origin: str) -> bool:
        """True if ``origin`` is a page of this server."""
        return origin.startswith("http://") and self.knows_host(origin.removeprefix("http://"))

    def open_session(self, token: str) -> str | None:
        """Exchange the token for a session. None if the token is wrong or was used before."""
        if not self.token or not secrets.compare_digest(token.encode(), self.token.encode()):
            return None
        self.token = ""
        if len(self._sessions) >= _MOST_SESSIONS:
            del self._sessions[next(iter(self._sessions))]
        session = secrets.token_urlsafe(24)
        self._sessions[_mark(session)] = self.clock()
        self._keep()
        return session

    def set_cookie(self, session: str) -> str:
        """The header that gives a session to the browser."""
        return f"{self.cookie}={session}; Path=/; HttpOnly; SameSite=Strict; Max-Age={SESSION_AGE:.0f}"

    def has_session(self, session: str) -> bool:
        """True if the session is open and not too old."""
        started = self._sessions.get(_mark(session))
        return started is not None and 0.0 <= self.clock() - started < SESSION_AGE


def _mark(text: str) -> str:
    """Digest of a session or folder."""
    return hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()


class Guard:
    """ASGI middleware that lets only the right browser through. See the module's docstring."""

    def __init__(self, app: App, door: Door) -> None:
        self._app, self._door = app, door

    async def __call__(self, scope: Scope, receive: _Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await _answer(send, *refusal)

    def _refusal(self, scope: Scope) -> tuple[int, str, tuple[tuple[bytes, bytes], ...]] | None:
        """Status, text and headers of the refusal; None if the request may pass."""
        headers = _headers(scope)
        door = self._door
        if headers is None or not door.knows_host(headers.get("host", "")):
            return 421, "This server answers only as 127.0.0.1 or localhost.", ()
        if not self._comes_from_us(scope, headers):
            return 403, "This request comes from another site.", ()
        path, method = scope["path"], scope.get("method")
        if path == "/healthz" and method in _SAFE_METHODS:
            return None
        has_session = door.has_session(_cookie_value(headers.get("cookie", ""), door.cookie))
        query = parse_qs(scope["query_string"].decode("latin-1"))
        if path == "/" and "token" in query and method == "GET":
            session = door.open_session(query["token"][0])
            if session is not None:
                return 303, "", ((b"location", b"/"), (b"set-cookie", door.set_cookie(session).encode()))
            if has_session:
                return 303, "", ((b"location", b"/"),)
        if has_session:
            return None
        return (
            403,
            "Open the address that piga ui printed. It is good for one browser. Start piga ui again for a new one.",
            (),
        )

    def _comes_from_us(self, scope: Scope, headers: dict[str, str]) -> bool:
        origin = headers.get("origin")
        if origin is not None:
            return self._door.knows_origin(origin)
        changes = scope["type"] == "websocket" or scope["method"] not in _SAFE_METHODS
        site = headers.get("sec-fetch-site", "none")
        navigation = headers.get("sec-fetch-mode") == "navigate" and scope["path"] == "/"
        return not changes and (site in ("none", "same-origin") or navigation)


def _headers(scope: Scope) -> dict[str, str] | None:
    """The request's headers by name; None if the host, the origin or the cookie is named twice."""
    result: dict[str, str] = {}
    for raw_name, raw_value in scope["headers"]:
        name = raw_name.decode("latin-1").lower()
        if name in result and name in ("host", "origin", "cookie"):
            return None
        result[name] = raw_value.decode("latin-1")
    return result


def _cookie_value(text: str, name: str) -> str:
    """Value of one cookie. Other cookies of this machine may have any form and are skipped."""
    for part in text.split(";"):
        key, _, value = part.strip().partition("=")
        if key == name:
            return value
    return ""


def _with_headers(send: Send) -> Send:
    """A ``send`` that adds :data:`_HEADERS`, and the policy of pages where the answer has none."""

    async def sent(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            headers = list(message.get("headers", ()))
            names = {name.lower() for name, _ in headers}
            headers += [item for item in _HEADERS if item[0] not in names]
            if b"content-security-policy" not in names:
                headers.append((b"content-security-policy", _PAGE_POLICY.encode()))
            if b"cache-control" not in names:
                headers.append((b"cache-control", b"no-store"))
            message = {**message, "headers": headers}
        await send(message)

    return sent


async def _answer(send: Send, status: int, text: str, more: tuple[tuple[bytes, bytes], ...]) -> None:
    body = text.encode()
    headers = [
        (b"content-type", b"text/plain; charset=utf-8"),
        (b"content-length", str(len(body)).encode()),
        *more,
    ]
    guarded = _with_headers(send)
    await guarded({"type": "http.response.start", "status": status, "headers": headers})
    await guarded({"type": "http.response.body", "body": body})
