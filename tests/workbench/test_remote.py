"""Access from other computers: what is asked for at the start, and what a stranger in the network meets."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import os
import secrets
import select
import socket
import ssl
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from piga.errors import ArgumentError
from piga.workbench.remote import (
    FORGOTTEN,
    LOOPBACK,
    MOST_ADDRESSES,
    MOST_OPEN,
    Entrance,
    Login,
    entrance,
    listening,
    read_password,
    tls_context,
)
from piga.workbench.security import MOST_SESSIONS, SESSION_AGE, Door
from tests.certificate.certificate_data import key_pair
from tests.cli.runner import exit_code
from tests.workbench.conftest import Browser, Client, Server, shipped_record

PASSWORD = "größer als zwölf"
PLAIN = {"Content-Type": "application/x-www-form-urlencoded"}


class RemoteClient(Client):
    """A browser on another computer. Each has its own address."""

    def __init__(self, server: Server, authority: Path, address: str = LOOPBACK) -> None:
        super().__init__(server.client.port, "", server.client.home)
        self.address = address
        self.context = ssl.create_default_context(cafile=str(authority))

    def connection(self) -> http.client.HTTPConnection:
        return http.client.HTTPSConnection(
            "localhost", self.port, timeout=60, context=self.context, source_address=(self.address, 0)
        )

    def log_in(self, password: str = PASSWORD) -> tuple[int, dict[str, str], bytes]:
        """Send the password. The right one gives the cookie."""
        status, headers, body = self.post("/login", {"password": password})
        if status == 303:
            self.cookie = headers["set-cookie"].partition(";")[0]
        return status, headers, body


@pytest.fixture(scope="module")
def tls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a certificate for localhost, its key, that key encrypted, and another key."""
    from cryptography.hazmat.primitives.serialization import (
        BestAvailableEncryption,
        Encoding,
        PrivateFormat,
        load_pem_private_key,
    )

    folder = tmp_path_factory.mktemp("tls")
    for path in key_pair(folder, "bench", start=-1, days=3, hosts=["localhost", LOOPBACK]):
        path.rename(folder / path.name.removeprefix("bench-"))
    key_pair(folder, "other")[0].rename(folder / "other.pem")
    key = load_pem_private_key((folder / "key.pem").read_bytes(), None)
    encrypted = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret"))
    (folder / "encrypted.pem").write_bytes(encrypted)
    return folder


def secret(folder: Path, content: bytes = PASSWORD.encode() + b"\n", mode: int = 0o600) -> Path:
    path = folder / "password"
    path.write_bytes(content)
    path.chmod(mode)
    return path


@pytest.fixture(scope="module")
def server(tls: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("k7Qz-bench")
    shipped_record(folder)
    files = (str(tls / "cert.pem"), str(tls / "key.pem"), "--password-file", str(secret(tls)))
    running = Server(folder, "--host", "localhost", "--tls", *files)
    yield running
    if running.process.poll() is None:
        assert running.end() == (0, "")


@pytest.fixture
def stranger(server: Server, tls: Path) -> RemoteClient:
    return RemoteClient(server, tls / "cert.pem")


# At the start


def test_other_names_need_tls_and_a_password(tls: Path, tmp_path: Path) -> None:
    pair = (tls / "cert.pem", tls / "key.pem")
    for options, missing in (
        ((None, None), "--tls and --password-file"),
        ((pair, None), "--password-file"),
        ((None, secret(tmp_path)), "--tls"),
    ):
        for host in ("labpc", "bench.example.org", "192.0.2.7", "2001:db8::7", "localhost.example.org"):
            with pytest.raises(ArgumentError, match=f"--host {host} needs {missing}: ") as refused:
                entrance(host, *options)
            assert refused.value.remedy.startswith("add " + missing.split(" and ")[0])
    for host in (None, "localhost", LOOPBACK, "127.0.0.2", "[::1]"):
        assert entrance(host).tls is None
    assert entrance("LabPC.Example.org", pair, secret(tmp_path)).host == "labpc.example.org"


def test_tls_and_password_are_for_a_host_and_belong_together(tls: Path, tmp_path: Path) -> None:
    pair, password = (tls / "cert.pem", tls / "key.pem"), secret(tmp_path)
    for options in ((pair, None), (None, password), (pair, password)):
        with pytest.raises(ArgumentError, match="only for --host"):
            entrance(None, *options)
    for options, wanted in (
        ((pair, None), "add --password-file FILE,"),
        ((None, password), "add --tls CERT KEY,"),
    ):
        with pytest.raises(ArgumentError, match="belong together") as refused:
            entrance("localhost", *options)
        assert refused.value.remedy.startswith(wanted)


@pytest.mark.parametrize(
    "host",
    ["0.0.0.0", "::", "[::]", "::ffff:0.0.0.0", "0", "0x0", "127.1", "010.0.0.1", "fe80::1%lo", "labpc:8443",
     "https://labpc", "labpc/", "a b", "", "-x", "x-", "a..b", "lab_pc", "*", "a" * 64, "bücher.example", "x\n"],
)  # fmt: skip
def test_what_is_not_the_name_of_one_computer(tls: Path, tmp_path: Path, host: str) -> None:
    with pytest.raises(ArgumentError, match=r"is not|browsers cannot") as refused:
        entrance(host, (tls / "cert.pem", tls / "key.pem"), secret(tmp_path))
    assert refused.value.remedy.startswith("give")


@pytest.mark.parametrize(
    ("content", "mode", "words"),
    [
        (b"twelve chars", 0o640, "other users"), (b"twelve chars", 0o604, "other users"),
        (b"twelve chars", 0o620, "other users"), (b"elevenchars\n", 0o600, "has 11 characters"),
        ("zwölf Zeic€\r\n".encode(), 0o600, "has 11 characters"), (b"", 0o600, "has 0 characters"),
        (b"twelve chars\nand more\n", 0o600, "several lines"), (b"  twelve chars \n", 0o600, "blanks"),
        (b"eight ch\0\0\0\0", 0o600, "nobody can type"),
        (b"\xff" * 12, 0o600, "UTF-8"), (b"a" * 1025, 0o600, "larger than 1024 bytes"),
    ],
)  # fmt: skip
def test_password_files_that_are_refused(tmp_path: Path, content: bytes, mode: int, words: str) -> None:
    path = secret(tmp_path, content, mode)
    with pytest.raises(ArgumentError, match=words) as refused:
        read_password(path)
    assert str(path) in str(refused.value)
    assert "twelve" not in str(refused.value)


def test_password_files_that_are_none(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name, words in (("pipe", "regular"), (".", "regular"), ("none", "cannot be read")):
        with pytest.raises(ArgumentError, match=words):
            read_password(tmp_path / name)
    for content in (b"twelve chars", b"twelve chars\n", b"\xef\xbb\xbftwelve chars\r\n"):
        assert read_password(secret(tmp_path, content)) == "twelve chars"


def test_certificates_and_keys_that_are_refused(tls: Path, tmp_path: Path) -> None:
    cert, key, damaged = tls / "cert.pem", tls / "key.pem", tmp_path / "damaged.pem"
    damaged.write_text("-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n", encoding="ascii")
    for pair, words in (
        ((cert, tls / "other.pem"), r"other\.pem: is not the key of .*cert\.pem"),
        ((key, cert), r"key\.pem: holds no certificate"),
        ((cert, cert), r"cert\.pem: holds no private key"),
        ((cert, tls / "encrypted.pem"), "the key is encrypted"),
        ((tmp_path / "none.pem", key), r"none\.pem: cannot be read"),
        ((cert, tmp_path), "is not a regular file"),
        ((damaged, key), r"damaged\.pem, .*key\.pem: cannot be used for TLS"),
    ):
        with pytest.raises(ArgumentError, match=words):
            tls_context(*pair)
    assert tls_context(cert, key).minimum_version == ssl.TLSVersion.TLSv1_2


def test_the_command_refuses_with_one_message(
    tls: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = ["--tls", tls / "cert.pem", tls / "other.pem", "--password-file", secret(tmp_path)]
    for options, words in (([], "needs --tls and --password-file"), (pair, "is not the key")):
        assert exit_code("ui", tmp_path, "--no-browser", "--host", "labpc", *options) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert words in said.err
        assert said.err.count("remedy:") == 1
        assert "Traceback" not in said.err


def test_a_name_must_mean_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    meant = {"labpc": "127.0.1.1", "localhost": "192.0.2.7", "zero": "0.0.0.0"}

    def looked_up(host: str, *_: object, **__: object) -> list[tuple[object, ...]]:
        if host not in meant:
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (meant[host], 0))]

    monkeypatch.setattr(socket, "getaddrinfo", looked_up)
    for host, words in (
        ("labpc", r"labpc: means 127\.0\.1\.1 on this machine, which is not an address in the network"),
        (
            "localhost",
            r"localhost: means 192\.0\.2\.7 on this machine, which is not an address of this machine alone",
        ),
        ("zero", r"zero: means 0\.0\.0\.0"),
        ("none", "none: no such name"),
    ):
        with pytest.raises(ArgumentError, match=words):
            listening(Entrance(host), 0)


def test_a_port_that_is_taken_or_none() -> None:
    with socket.create_server((LOOPBACK, 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ArgumentError, match=rf"--port {port}: cannot be used on 127\.0\.0\.1"):
            listening(Entrance(), port)
    for port in (99999, -1):
        with pytest.raises(ArgumentError, match=f"--port {port}: is not a port"):
            listening(Entrance(), port)
    with pytest.raises(ArgumentError, match=r"cannot be used on 192\.0\.2\.7"):
        listening(Entrance("192.0.2.7"), 0)


# The password


def test_wrong_passwords_are_slowed_for_their_address_alone() -> None:
    now = [1000.0]
    login = Login(PASSWORD, clock=lambda: now[0])

    def opens(address: str, password: str) -> bool:
        return asyncio.run(login.opens(address, password))

    pauses = []
    for _ in range(8):
        assert not opens("a", "wrong")
        pauses.append(login.pause("a"))
        now[0] += pauses[-1] - 0.01
        assert not opens("a", PASSWORD)  # too early: it is not looked at
        now[0] += 0.02
    assert pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    assert not opens("a", "wrong")
    assert login.pause("b") == 0.0
    assert opens("b", PASSWORD)
    now[0] += 60.0
    assert opens("a", PASSWORD)
    assert not opens("a", "wrong")
    assert login.pause("a") == 1.0
    now[0] += 1.0
    assert not opens("a", "wrong")
    now[0] += 2.0 + FORGOTTEN + 1.0
    assert not opens("a", "wrong")
    assert login.pause("a") == 1.0


def test_tries_at_the_same_time_are_one_try() -> None:
    login = Login(PASSWORD)
    checked = []
    hashed = login._hashed
    login._hashed = lambda text: checked.append(text) or hashed(text)  # type: ignore[method-assign]

    async def all_at_once() -> list[bool]:
        return list(await asyncio.gather(*(login.opens("a", f"wrong {k}") for k in range(50))))

    assert not any(asyncio.run(all_at_once()))
    assert checked == ["wrong 0"]


def test_thousands_of_addresses_take_bounded_memory_and_bounded_work(monkeypatch: pytest.MonkeyPatch) -> None:
    login = Login(PASSWORD)
    monkeypatch.setattr(login, "_hashed", lambda text: text.encode()[:64].ljust(64))

    async def storm() -> None:
        for k in range(MOST_ADDRESSES + 50):
            await login.opens(f"2001:db8::{k:x}", "wrong")

    asyncio.run(storm())
    assert len(login._tries) == MOST_ADDRESSES
    assert login.pause("2001:db8::0") == 0.0
    assert login.pause(f"2001:db8::{MOST_ADDRESSES + 49:x}") > 0.0
    checked = []
    monkeypatch.setattr(login, "_hashed", lambda text: checked.append(text) or b"")

    async def at_once() -> None:
        await asyncio.gather(*(login.opens(f"192.0.2.{k}", "wrong") for k in range(200)))

    asyncio.run(at_once())
    assert len(checked) == 16


def test_the_password_is_kept_as_a_salted_hash() -> None:
    one, two = Login(PASSWORD), Login(PASSWORD)
    kept = repr(vars(one)).encode() + b"".join(v for v in vars(one).values() if isinstance(v, bytes))
    assert PASSWORD.encode() not in kept
    assert PASSWORD not in kept.decode("latin-1")
    assert one._hash != two._hash
    decomposed = "gro\u0308ßer als zwo\u0308lf"
    assert decomposed != PASSWORD
    assert asyncio.run(one.opens("a", decomposed))
    for wrong in ("", PASSWORD.upper(), PASSWORD + " ", "\ud800"):
        assert not asyncio.run(Login(PASSWORD).opens("a", wrong)), wrong


# The door


def test_a_door_with_a_password_has_no_token_and_one_name() -> None:
    door = Door(8443, "labpc.example.org", Login(PASSWORD))
    assert door.address == "https://labpc.example.org:8443/"
    assert door.open_session(door.token) is None
    for host in ("labpc.example.org:8443", "LABPC.example.org:8443"):
        assert door.knows_host(host)
    for host in ("labpc.example.org", "labpc:8443", "localhost:8443", "127.0.0.1:8443", "labpc.example.org:443",
                 "labpc.example.org.:8443", "labpc.example.org:8443.evil.example", ""):  # fmt: skip
        assert not door.knows_host(host), host
    assert door.knows_origin("https://labpc.example.org:8443")
    for origin in (
        "http://labpc.example.org:8443",
        "https://labpc.example.org",
        "null",
        "https://evil.example",
    ):
        assert not door.knows_origin(origin), origin


def test_usual_ports_and_ipv6_are_written_as_browsers_do() -> None:
    door = Door(443, "2001:db8::7", Login(PASSWORD))
    assert door.address == "https://[2001:db8::7]:443/"
    assert door.knows_host("[2001:db8::7]")
    assert door.knows_host("[2001:db8::7]:443")
    assert door.knows_origin("https://[2001:db8::7]")
    assert not door.knows_host("[2001:db8::7]:80")
    assert Door(80).knows_origin("http://localhost")
    assert not Door(80).knows_origin("https://localhost")


def test_sessions_end_and_are_not_many() -> None:
    now = [0.0]
    door = Door(8443, "labpc", Login(PASSWORD), clock=lambda: now[0])
    first, second = door.new_session(), door.new_session()
    assert door.has_session(first)
    assert not Door(8443, "labpc", Login(PASSWORD)).has_session(first)  # another server
    door.end_session(first)
    assert not door.has_session(first)
    for _ in range(MOST_SESSIONS):
        last = door.new_session()
    assert not door.has_session(second)
    assert door.has_session(last)
    now[0] = SESSION_AGE + 1.0
    assert not door.has_session(last)


def test_one_address_has_only_so_many_connections() -> None:
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(listening(Entrance(login=Login(PASSWORD)), 0)[0])
        listener.setblocking(False)

        def connected(address: str) -> socket.socket:
            own = socket.create_connection(listener.getsockname(), timeout=10, source_address=(address, 0))
            return stack.enter_context(own)

        def accepted() -> socket.socket:
            return stack.enter_context(listener.accept()[0])

        held = [(connected("127.0.0.2"), accepted()) for _ in range(MOST_OPEN)]
        one_more = connected("127.0.0.2")
        with pytest.raises(BlockingIOError):
            accepted()
        assert one_more.recv(1) == b""
        connected("127.0.0.3")
        accepted()
        held[0][1].close()
        connected("127.0.0.2")
        accepted()


# A stranger at a running server


def test_the_printed_address_has_no_token_and_tls_is_real(server: Server, stranger: RemoteClient) -> None:
    assert server.client.home == f"https://localhost:{server.client.port}"
    assert server.client.token == ""
    assert stranger.ask("/healthz")[::2] == (200, b"ok\n")
    stranger.context = ssl.create_default_context()
    with pytest.raises(ssl.SSLCertVerificationError):
        stranger.ask("/healthz")


def test_a_stranger_sees_the_login_page_alone(server: Server, stranger: RemoteClient) -> None:
    status, headers, _ = stranger.ask("/", headers={"Accept": "text/html,*/*"})
    assert (status, headers["location"]) == (303, "/login")
    status, headers, _ = stranger.ask("/jobs", headers={"Accept": "text/html", "HX-Request": "true"})
    assert (status, headers["hx-redirect"]) == (403, "/login")
    for path in ("/", "/jobs", "/?token=", "/?token=x", "/assets/workbench.js", "/signal-data/tumble-a.toml", "/x",
                 "//login", "/login/", "/login/../jobs", "/Login", "/healthz/"):  # fmt: skip
        assert stranger.ask(path)[0] == 403, path
    for path in ("/jobs", "/healthz", "/assets/workbench.css", "/logout", "/upload?name=a.csv"):
        for method in ("POST", "PUT", "DELETE", "OPTIONS"):
            assert stranger.ask(path, method, b"", {"Origin": stranger.home})[0] == 403, (method, path)
    status, headers, body = stranger.ask("/login")
    assert status == 200
    assert server.folder.name.encode() not in body
    assert b"<script" not in body
    assert "default-src 'none'" in headers["content-security-policy"]
    assert headers["cache-control"] == "no-store"
    assert stranger.ask("/assets/workbench.css")[0] == 200


def test_foreign_hosts_and_origins(stranger: RemoteClient) -> None:
    port = stranger.port
    for host in ("evil.example", f"127.0.0.1:{port}", f"[::1]:{port}", "localhost", f"localhost:{port + 1}"):
        assert stranger.ask("/login", host=host)[0] == 421, host
    for origin in ({}, {"Origin": "null"}, {"Origin": f"http://localhost:{port}"}, {"Origin": "https://localhost"},
                   {"Origin": f"https://127.0.0.1:{port}"}, {"Origin": f"https://localhost:{port}.evil.example"}):  # fmt: skip
        status, headers, _ = stranger.ask("/login", "POST", b"password=x", PLAIN | origin)
        assert status == 403, origin
        assert "retry-after" not in headers  # the password was not looked at
    from_mail = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
    assert stranger.ask("/login", headers=from_mail)[0] == 200
    assert stranger.ask("/login", headers=from_mail | {"Sec-Fetch-Mode": "no-cors"})[0] == 403


def test_wrong_passwords_slow_one_address(server: Server, tls: Path) -> None:
    guesser, owner = (RemoteClient(server, tls / "cert.pem", address) for address in ("127.0.0.2", "127.0.0.3"))
    status, headers, body = guesser.log_in("wrong wrong wrong")
    assert (status, headers["retry-after"]) == (403, "1")
    assert b"The password is wrong. Wait 1 s" in body
    assert guesser.log_in()[0] == 429
    status, headers, _ = owner.log_in()
    assert (status, headers["location"]) == (303, "/")
    name, *flags = headers["set-cookie"].split("; ")
    assert name.startswith(f"__Host-piga-{server.client.port}=")
    assert set(flags) == {"Path=/", "HttpOnly", "SameSite=Strict", "Secure", f"Max-Age={SESSION_AGE:.0f}"}
    page = owner.page("/")
    assert "tumble-a.toml" in page
    assert "on this machine only" not in page


def test_a_cookie_that_was_there_before_is_worth_nothing(server: Server, tls: Path) -> None:
    client = RemoteClient(server, tls / "cert.pem", "127.0.0.4")
    planted = f"__Host-piga-{client.port}=planted"
    client.cookie = planted
    assert client.log_in()[0] == 303
    mine, client.cookie = client.cookie, planted
    assert mine != planted
    assert client.ask("/")[0] == 403
    client.cookie = mine
    status, headers, _ = client.post("/logout")
    assert (status, headers["location"]) == (303, "/login")
    assert f"{mine.partition('=')[0]}=; " in headers["set-cookie"]
    assert "Max-Age=0" in headers["set-cookie"]
    assert client.ask("/")[0] == 403


def test_login_forms_that_are_none(server: Server, tls: Path) -> None:
    client = RemoteClient(server, tls / "cert.pem", "127.0.0.5")
    for body in (b"%", b"\xff=1", b"x=1&" * 3000, b"password=" + b"x" * 9000, b"x" * (1 << 20)):
        status, _, page = client.ask("/login", "POST", body, {"Origin": client.home, **PLAIN})
        assert status == 422, body[:20]
        assert server.folder.name.encode() not in page
        assert b"Log in to piga" in page
    assert client.post("/login", {"word": PASSWORD})[0] == 403


def test_plain_http_gets_no_answer_and_harms_nobody(server: Server, stranger: RemoteClient) -> None:
    for sent in (
        f"GET /login HTTP/1.1\r\nHost: localhost:{stranger.port}\r\n\r\n".encode(),
        b"\x16\x03\x01",
        b"\0" * 400,
    ):
        with socket.create_connection((LOOPBACK, stranger.port), timeout=20) as raw:
            raw.sendall(sent)
            raw.shutdown(socket.SHUT_WR)
            try:
                answer = raw.recv(400)
            except ConnectionError:
                answer = b""
        assert b"HTTP/1" not in answer
    assert stranger.ask("/login")[0] == 200


# Connections without a request

HURRIED = "from piga.workbench import app; app.LONGEST_HEAD = 0.5; from piga.cli.main import main; main()"
"""A ``piga ui`` that waits half a second for a head."""


class Held:
    """Connections to a server, each having sent so much."""

    def __init__(self, stack: contextlib.ExitStack, tls: Path, kind: str, *program: str) -> None:
        folder = tls / f"folder-{secrets.token_hex(4)}"
        folder.mkdir()
        files = (str(tls / "cert.pem"), str(tls / "key.pem"), "--password-file", str(secret(tls)))
        options = ("--host", "localhost", "--tls", *files) if kind == "TLS" else ()
        self.server = Server(folder, *options, program=program or ("-m", "piga"))
        self.stack, self.context = stack, ssl.create_default_context(cafile=str(tls / "cert.pem"))
        self.context.maximum_version = ssl.TLSVersion.TLSv1_2  # nothing is sent after the handshake
        home, path = self.server.client.home, "/login"
        if kind == "plain":
            self.server.client.enter()
            path = "/upload?name=slow.csv"
        host = f"Host: {home.partition('//')[2]}\r\nOrigin: {home}\r\nCookie: {self.server.client.cookie}\r\n"
        self.get = f"GET /healthz HTTP/1.1\r\n{host}\r\n".encode()
        self.slow_post = f"POST {path} HTTP/1.1\r\n{host}Content-Length: 9\r\n\r\nslow".encode()

    def connection(self, sent: bytes) -> socket.socket:
        raw = socket.create_connection((LOOPBACK, self.server.client.port), timeout=10)
        if self.server.client.home.startswith("https"):
            raw = self.context.wrap_socket(raw, server_hostname="localhost")
        self.stack.enter_context(raw).sendall(sent)
        return raw

    def answered(self) -> socket.socket:
        raw = self.connection(self.get)
        answer = b""
        while not answer.endswith(b"ok\n"):
            answer += raw.recv(4096)
        return raw


def is_closed(raw: socket.socket) -> bool:
    try:
        return raw.recv(1) == b""
    except (ConnectionError, ssl.SSLEOFError):
        return True


@pytest.mark.only_compiled
@pytest.mark.parametrize("kind", ["plain", "TLS"])
def test_a_connection_without_a_request_ends(tls: Path, kind: str) -> None:
    """It sends nothing, part of a head, or a head without end. A request in progress may take its time."""
    with contextlib.ExitStack() as stack:
        held = Held(stack, tls, kind, "-c", HURRIED)
        slow, again = held.connection(held.slow_post), held.answered()
        again.sendall(held.get[:-2])
        waiting = [held.connection(b""), held.connection(held.get[:-2]), again]
        dripping = held.connection(held.get[:-2])
        begun = time.monotonic()
        with contextlib.suppress(ConnectionError, ssl.SSLError):
            while not select.select([dripping], [], [], 0.05)[0]:
                assert time.monotonic() - begun < 5.0
                dripping.sendall(b"a")
        assert all(is_closed(raw) for raw in (*waiting, dripping))
        assert not select.select([slow], [], [], 0.0)[0]
        assert held.server.end() == (0, "")


@pytest.mark.only_compiled
@pytest.mark.parametrize("kind", ["plain", "TLS"])
def test_the_end_of_the_server_waits_for_no_connection(tls: Path, kind: str) -> None:
    with contextlib.ExitStack() as stack:
        held = Held(stack, tls, kind)
        for sent in (b"", held.get[:-2], held.slow_post):
            held.connection(sent)
        held.answered()
        assert held.server.end() == (0, "")


@pytest.mark.only_compiled
@pytest.mark.parametrize(("width", "scheme"), [(1300, "light"), (400, "dark")])
def test_a_person_logs_in_works_and_logs_out(program: Any, server: Server, width: int, scheme: str) -> None:
    context = program.new_context(
        viewport={"width": width, "height": 900}, color_scheme=scheme, ignore_https_errors=True
    )
    browser = Browser(context, server)
    page = browser.page
    browser.open("/")
    assert page.url == f"{server.client.home}/login"
    browser.is_accessible()
    page.keyboard.type(PASSWORD)
    page.keyboard.press("Enter")
    page.get_by_role("link", name="Signals").first.click()
    browser.until("document.querySelectorAll('figure.signal[data-points]').length >= 3")
    browser.is_accessible()
    page.get_by_role("button", name="Log out").click()
    page.get_by_role("heading", name="Log in to piga").wait_for()
    browser.open("/jobs")
    assert page.url == f"{server.client.home}/login"
    context.close()
    assert not browser.faults
