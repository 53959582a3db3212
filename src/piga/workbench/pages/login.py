"""Log in with the password, and log out. Only a server with a password has these pages."""

from __future__ import annotations

import asyncio
import math

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import RedirectResponse, Response
from starlette.routing import Route

from piga.errors import ArgumentError
from piga.workbench.pages.common import bench_of, only, render, sent_form
from piga.workbench.remote import Login
from piga.workbench.security import LOGIN, Door, cookie_value

MOST_LOGIN = 8 << 10
"""Largest login form [bytes]."""
SLOWEST = 10.0
"""Time [s] in which the form must arrive."""


def shown(request: Request) -> Response:
    """The login page."""
    _door_and_login(request)
    return _page(request, 200)


async def sent(request: Request) -> Response:
    """Check the password. The right one gives a new session."""
    door, login = _door_and_login(request)
    try:
        async with asyncio.timeout(SLOWEST):
            fields = await sent_form(request, MOST_LOGIN)
    except ArgumentError as error:
        return _page(request, 422, f"{error.message[0].upper()}{error.message[1:]}.")
    except TimeoutError:
        return _page(request, 408, "The form took too long.")
    address = request.client.host if request.client else ""
    if pause := login.pause(address):
        return _page(request, 429, f"Wait {math.ceil(pause)} s before the next try.", pause)
    if not await login.opens(address, only(fields, "password")):
        pause = login.pause(address)
        return _page(
            request, 403, f"The password is wrong. Wait {math.ceil(pause)} s before the next try.", pause
        )
    return _to("/", door.set_cookie(door.new_session()))


def left(request: Request) -> Response:
    """End the session."""
    door, _ = _door_and_login(request)
    door.end_session(cookie_value(request.headers.get("cookie", ""), door.cookie))
    return _to(LOGIN, door.set_cookie(""))


def _door_and_login(request: Request) -> tuple[Door, Login]:
    """The door and its password. Without a password there are no such pages."""
    door = bench_of(request).door
    if door.login is None:
        raise HTTPException(404)
    return door, door.login


def _to(path: str, cookie: str) -> Response:
    return RedirectResponse(path, status_code=303, headers={"set-cookie": cookie})


def _page(request: Request, code: int, message: str = "", pause: float = 0.0) -> Response:
    page = render(request, "login.html.jinja", code, message=message)
    if pause:
        page.headers["retry-after"] = str(math.ceil(pause))
    return page


ROUTES = [
    Route(LOGIN, shown),
    Route(LOGIN, sent, methods=["POST"]),
    Route("/logout", left, methods=["POST"]),
]
