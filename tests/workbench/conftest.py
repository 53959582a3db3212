"""A real server on a folder with the shipped record, and a client that behaves as the browser does."""

from __future__ import annotations

import contextlib
import ctypes
import gzip
import http.client
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest

import piga
from tests.memory import kilobytes

os.environ["PYTHONPATH"] = str(Path(piga.__file__).resolve().parent.parent)
"""Servers and jobs have other working folders. They run the piga that is tested."""
Headers = dict[str, str]
Answer = tuple[int, Headers, bytes]
READY = re.compile(r"piga ui: (\S+:(\d+))/\?token=(\S+)\n")


class Client:
    """Requests as a browser sends them, with the session's cookie."""

    def __init__(self, port: int, token: str) -> None:
        self.port, self.token, self.cookie = port, token, ""
        self.home = f"http://127.0.0.1:{port}"

    def ask(
        self,
        path: str,
        method: str = "GET",
        body: bytes | None = None,
        headers: Headers | None = None,
        host: str = "",
    ) -> Answer:
        """Status, headers and body of the answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        sent = {"Host": host or self.home.partition("//")[2]}
        sent |= {"Cookie": self.cookie} if self.cookie else {}
        sent |= headers or {}
        with contextlib.closing(connection):
            connection.request(method, path, body=body, headers=sent)
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()

    def enter(self) -> None:
        """Exchange the token for the cookie."""
        status, headers, _ = self.ask(f"/?token={self.token}")
        assert status == 303
        self.cookie, *flags = headers["set-cookie"].split("; ")
        assert {"HttpOnly", "SameSite=strict", "Path=/", "Max-Age=43200"} == set(flags)

    def page(self, path: str, status: int = 200) -> str:
        """A page as text."""
        got, _, body = self.ask(path)
        assert got == status, body.decode()
        return body.decode()

    def post(self, path: str, fields: dict[str, object] | None = None) -> Answer:
        """Send a form."""
        body = urlencode(fields or {}, doseq=True).encode()
        headers = {"Origin": self.home, "Content-Type": "application/x-www-form-urlencoded"}
        return self.ask(path, "POST", body, headers)

    def until(self, path: str, done: Callable[[str], bool], seconds: float = 240.0) -> str:
        """The page once ``done`` holds of it."""
        limit = time.monotonic() + seconds
        while True:
            text = self.page(path)
            if done(text):
                return text
            assert time.monotonic() < limit, text
            time.sleep(0.2)


def wait_until(holds: Callable[[], object], seconds: float = 120.0) -> None:
    """Wait until something is so."""
    limit = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < limit
        time.sleep(0.05)


def memory(pid: int) -> float:
    """Memory of a process without mapped files [MB]; 0 if it has ended."""
    try:
        return kilobytes("RssAnon", pid) / 1000.0
    except (OSError, KeyError):
        return 0.0


def ends_with_parent() -> None:
    """Linux kills this process when its parent has ended, however that came."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


class Server:
    """``piga ui`` in a process of its own. ``program`` starts it otherwise: options of Python and their values."""

    def __init__(self, folder: Path, *options: str, program: Sequence[str] = ("-m", "piga")) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, *program, "ui", str(folder), "--no-browser", *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
            preexec_fn=ends_with_parent if sys.platform == "linux" else None,  # noqa: PLW1509  no lock is held
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        match = READY.search(line)
        if match is None:
            self.process.kill()
            assert match is not None, line + (self.process.stderr.read() if self.process.stderr else "")
        self.client = Client(int(match[2]), match[3])

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str]:
        """Exit code and messages."""
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=120)
        return self.process.returncode, errors


def entered(folder: Path) -> Server:
    """A server on a folder, whose client has its session."""
    server = Server(folder)
    server.client.enter()
    return server


def shipped_record(folder: Path) -> Path:
    """The shipped record in a folder; its run file."""
    data = files("piga.data")
    (folder / "tumble-a.csv").write_bytes(gzip.decompress(data.joinpath("tumble-a.csv.gz").read_bytes()))
    run = folder / "tumble-a.toml"
    run.write_bytes(data.joinpath("tumble-a.toml").read_bytes())
    return run


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    shipped_record(folder)
    return folder


@pytest.fixture(scope="module")
def server(lab: Path) -> Iterator[Server]:
    running = entered(lab)
    yield running
    if running.process.poll() is None:
        running.end()


@pytest.fixture
def client(server: Server) -> Client:
    return server.client


@pytest.fixture(scope="session")
def chromium() -> str:
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("no Chromium on this machine")
    return path


class Browser:
    """A page of a browser that notes every fault."""

    def __init__(self, context: Any, server: Server) -> None:
        self.page = context.new_page()
        self.server = server
        self.faults: list[str] = []
        self.page.on("console", lambda entry: self._note(entry.type, entry.text))
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.on("request", lambda request: self._from(request.url))
        self.page.set_default_timeout(120_000)

    def _note(self, kind: str, text: str) -> None:
        # the browser notes a refused form by itself
        refused = any(f"status of {status}" in text for status in (422, 409))
        if kind in ("error", "warning") and not refused:
            self.faults.append(text)

    def _from(self, url: str) -> None:
        if not url.startswith((f"{self.server.client.home}/", "data:", "blob:", "about:")):
            self.faults.append(f"a request to {url}")

    def open(self, path: str) -> None:
        self.page.goto(f"{self.server.client.home}{path}")

    def until(self, expression: str) -> None:
        """Wait until an expression is true. The page's policy forbids the browser's own way of waiting."""
        limit = time.monotonic() + 120.0
        from playwright.sync_api import Error

        while True:
            try:
                if self.page.evaluate(expression):
                    return
            except Error:  # the page is just being replaced
                pass
            assert time.monotonic() < limit, expression
            time.sleep(0.05)

    def is_accessible(self) -> None:
        """No violation by axe, and nothing wider than the window."""
        from axe_playwright_python.sync_playwright import Axe

        result = Axe().run(
            self.page, options={"runOnly": ["wcag2a", "wcag2aa", "best-practice"], "iframes": False}
        )
        problems = [(item["id"], item["nodes"][0]["html"][:120]) for item in result.response["violations"]]
        assert not problems, (self.page.url, problems)
        root = "document.documentElement"
        assert self.page.evaluate(f"{root}.scrollWidth <= {root}.clientWidth"), self.page.url


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    shipped_record(folder)
    for name in ("plan-dividing-head.toml", "platform-published.toml", "twin.toml", "certificate.toml"):
        shutil.copy(Path("examples") / name, folder)
    return folder


@pytest.fixture(scope="module")
def running(place: Path) -> Iterator[Server]:
    server = entered(place)
    yield server
    code, errors = server.end()
    assert code == 0
    assert not errors, errors[-3000:]


@pytest.fixture(scope="module")
def program(chromium: str) -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()


def window(program: Any, server: Server, width: int = 1300, scheme: str = "light") -> Any:
    """A window of the browser that has the session of a server."""
    context = program.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
    name, _, value = server.client.cookie.partition("=")
    context.add_cookies([{"name": name, "value": value, "url": server.client.home}])
    return context


WIDE, NARROW = (1300, "light"), (400, "dark")
narrow = pytest.mark.parametrize("browser", [NARROW], indirect=True, ids=["narrow-dark"])
both = pytest.mark.parametrize("browser", [WIDE, NARROW], indirect=True, ids=["wide-light", "narrow-dark"])
"""Windows of a test. Each page is seen in both; what a person does in it is done in one."""


@pytest.fixture
def browser(request: pytest.FixtureRequest, program: Any, running: Server) -> Iterator[Browser]:
    context = window(program, running, *getattr(request, "param", WIDE))
    opened = Browser(context, running)
    yield opened
    context.close()
    assert not opened.faults, opened.faults
