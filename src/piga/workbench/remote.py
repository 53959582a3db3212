"""Access from other computers: which name the server has, its TLS certificate, and the password.

Without ``--host`` nothing here is asked for: the server listens on 127.0.0.1, and a one-time token opens it. Any other
name needs TLS and a password file. The password is kept as a salted hash only.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import ipaddress
import os
import re
import secrets
import shlex
import socket
import ssl
import time
import unicodedata
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from piga.errors import ArgumentError
from piga.records.limits import open_regular, read_whole

LOOPBACK = "127.0.0.1"
"""Address of this machine that no other one can reach."""
LEAST_LETTERS = 12
"""Fewest characters of a password."""
MOST_PASSWORD = 1024
"""Largest password file [bytes]."""
MOST_PEM = 1 << 20
"""Largest certificate or key file [bytes]."""
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 60.0
"""Pause [s] of an address after its first wrong password, and the longest. Each wrong password doubles it."""
FORGOTTEN = 3600.0
"""Time [s] after which the wrong passwords of an address no longer count."""
MOST_ADDRESSES = 4096
"""Most addresses whose wrong passwords are remembered. The one that has not tried for longest is forgotten first."""
MOST_CHECKS = 16
"""Most passwords that wait for their check. It takes about 50 ms, one after another."""
MOST_OPEN = 100
"""Most connections of one address at a time. Further ones are closed at once."""
MOST_PORT = 65535
WAITING = 128
"""Connections that may wait to be accepted."""

_NAME = re.compile(r"(?!-)[a-z0-9-]{1,63}(?<!-)(\.(?!-)[a-z0-9-]{1,63}(?<!-))*")
_NUMBER = re.compile(r"\d+|0x[0-9a-f]*")


class Login:
    """The password, and the pauses of the addresses that sent a wrong one.

    Parameters
    ----------
    password:
        The password. Only its hash is kept.
    clock:
        Monotonic time [s].
    """

    def __init__(self, password: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._salt = secrets.token_bytes(16)
        self._hash = self._hashed(password)
        self._tries: dict[str, tuple[int, float]] = {}  # wrong passwords, end of the pause; last tried is last
        self._checking: set[str] = set()
        self._checker = ThreadPoolExecutor(1, "password")

    def pause(self, address: str) -> float:
        """Time [s] that an address must wait before its next try; 0 if it need not wait."""
        _, until = self._tries.get(address, (0, 0.0))
        busy = address in self._checking or len(self._checking) >= MOST_CHECKS
        return max(until - self._clock(), FIRST_PAUSE if busy else 0.0)

    async def opens(self, address: str, password: str) -> bool:
        """True if the password is right. It is not looked at while the address must wait."""
        if self.pause(address):
            return False
        self._checking.add(address)
        try:
            tried = await asyncio.get_running_loop().run_in_executor(self._checker, self._hashed, password)
        finally:
            self._checking.discard(address)
        wrong, until = self._tries.pop(address, (0, 0.0))
        if hmac.compare_digest(tried, self._hash):
            return True
        now = self._clock()
        wrong = 1 if now - until > FORGOTTEN else wrong + 1
        self._tries[address] = wrong, now + min(FIRST_PAUSE * 2.0 ** (wrong - 1), LONGEST_PAUSE)
        if len(self._tries) > MOST_ADDRESSES:
            del self._tries[next(iter(self._tries))]
        return False

    def _hashed(self, password: str) -> bytes:
        text = unicodedata.normalize("NFC", password).encode("utf-8", "replace")
        return hashlib.scrypt(text, salt=self._salt, n=1 << 14, r=8, p=1)


@dataclass(frozen=True)
class Entrance:
    """Where the server listens, and what it asks for.

    Attributes
    ----------
    host:
        Name or address that browsers use.
    tls:
        Certificate and key. None: plain HTTP, on this machine only.
    login:
        The password. None: the one-time token of the printed address.
    """

    host: str = LOOPBACK
    tls: ssl.SSLContext | None = None
    login: Login | None = None


def entrance(
    host: str | None = None, tls: tuple[Path, Path] | None = None, password_file: Path | None = None
) -> Entrance:
    """The entrance for ``--host``, ``--tls`` and ``--password-file``.

    Parameters
    ----------
    host:
        Name or address that browsers use. None: 127.0.0.1.
    tls:
        Certificate (with its chain) and private key, as PEM files.
    password_file:
        File with the password; only its owner can read it.

    Raises
    ------
    ArgumentError
        If an option is missing or cannot be used.
    """
    given = {"--tls": tls is not None, "--password-file": password_file is not None}
    values = {"--tls": "--tls CERT KEY", "--password-file": "--password-file FILE"}
    missing = [option for option in given if not given[option]]
    add = "add " + " ".join(values[option] for option in missing)
    if host is None:
        if len(missing) < len(given):
            options = " and ".join(option for option in given if given[option])
            raise ArgumentError(
                f"{options}: only for --host", remedy="add --host NAME, the name that browsers will use"
            )
        return Entrance()
    name = _checked_name(host)
    if missing and not _is_loopback(name):
        raise ArgumentError(
            f"--host {name} needs {' and '.join(missing)}: other computers can reach this address",
            remedy=f"{add}, or leave --host out to stay on this machine",
        )
    if tls is None and password_file is None:
        return Entrance(name)
    if tls is None or password_file is None:
        raise ArgumentError("--tls and --password-file belong together", remedy=f"{add}, or give none")
    return Entrance(name, tls_context(*tls), Login(read_password(password_file)))


def _checked_name(host: str) -> str:
    """The name as browsers write it."""
    name = host.lower().removeprefix("[").removesuffix("]")
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        if len(name) > 253 or not _NAME.fullmatch(name) or _NUMBER.fullmatch(name.rpartition(".")[2]):
            raise ArgumentError(
                f"--host {host!r}: is not a host name",
                remedy="give the name or address alone, e.g. --host bench.example.org; the port is --port",
            ) from None
        return name
    if _is_every_address(name):
        raise ArgumentError(
            f"--host {host}: is not the name of one computer", remedy="give the name that browsers will use"
        )
    if isinstance(address, ipaddress.IPv6Address) and address.scope_id is not None:
        raise ArgumentError(f"--host {host}: browsers cannot open an address with %", remedy="give a name")
    return str(address)


def _inner(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """An address, or the IPv4 address in an IPv6 one."""
    outer = ipaddress.ip_address(address)
    return getattr(outer, "ipv4_mapped", None) or outer


def _is_loopback(host: str) -> bool:
    """True for names and addresses that no other computer can reach."""
    try:
        return _inner(host).is_loopback
    except ValueError:
        return host == "localhost"


def _is_every_address(address: str) -> bool:
    """True for the address that means all addresses of this machine, which would let in from every network."""
    return _inner(address).is_unspecified


class Listener(socket.socket):
    """A listening socket that accepts only so many connections of one address, so that one cannot use up all."""

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection of an address that has fewer than :data:`MOST_OPEN`."""
        opened: dict[str, list[socket.socket]] = self.__dict__.setdefault("opened", {})
        while True:
            connection, where = super().accept()
            for address in [a for a, all_of in opened.items() if all(one.fileno() < 0 for one in all_of)]:
                del opened[address]
            still = [one for one in opened.get(where[0], []) if one.fileno() >= 0]
            if len(still) < MOST_OPEN:
                opened[where[0]] = [*still, connection]
                return connection, where
            connection.close()


def listening(entrance: Entrance, port: int) -> list[socket.socket]:
    """Sockets on the addresses that the entrance's name has on this machine.

    Raises
    ------
    ArgumentError
        If the name has no usable address, or the port is taken.
    """
    host = entrance.host
    if not 0 <= port <= MOST_PORT:
        raise ArgumentError(
            f"--port {port}: is not a port", remedy=f"choose one up to {MOST_PORT}, or leave it out"
        )
    try:
        every = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except OSError as error:
        raise ArgumentError(
            f"--host {host}: no such name ({error.strerror})",
            remedy="give a name of this machine, or its address",
        ) from None
    inside = _is_loopback(host)
    addresses = {str(where[0]): family for family, _, _, _, where in every}
    usable = {
        address: family
        for address, family in addresses.items()
        if _is_loopback(address) == inside and not _is_every_address(address)
    }
    if not usable:
        raise ArgumentError(
            f"--host {host}: means {', '.join(addresses)} on this machine, which is not an address "
            f"{'of this machine alone' if inside else 'in the network'}",
            remedy=f"correct {host} in the hosts file, or give the address of this machine in the network",
        )
    sockets: list[socket.socket] = []
    try:
        for address, family in usable.items():
            taken = sockets[0].getsockname()[1] if sockets else port
            plain = socket.create_server((address, taken), family=family, backlog=WAITING)
            sockets.append(plain if entrance.login is None else Listener(fileno=plain.detach()))
    except OSError as error:
        for one in sockets:
            one.close()
        raise ArgumentError(
            f"--port {port}: cannot be used on {host} ({error})",
            remedy="choose another port, or leave it out; --host must be a name or address of this machine",
        ) from None
    return sockets


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """The TLS settings for a certificate and its key.

    Raises
    ------
    ArgumentError
        If one cannot be read or used, or they do not belong together.
    """
    for path, mark, what in (
        (certificate, b"CERTIFICATE-----", "certificate"),
        (key, b"PRIVATE KEY-----", "private key"),
    ):
        wanted = f"a PEM file with the {what}"
        if mark not in read_whole(path, MOST_PEM, wanted, ArgumentError):
            raise ArgumentError(f"{path}: holds no {what}", remedy="give --tls CERT KEY, both as PEM files")

    def encrypted() -> str:
        raise ArgumentError(
            f"{key}: the key is encrypted",
            remedy=f"write it without passphrase: openssl pkey -in {shlex.quote(str(key))}",
        )

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key, encrypted)
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        if getattr(error, "reason", "") == "KEY_VALUES_MISMATCH":
            raise ArgumentError(
                f"{key}: is not the key of {certificate}", remedy="give the certificate and its own key"
            ) from None
        raise ArgumentError(
            f"{certificate}, {key}: cannot be used for TLS ({error})",
            remedy="give --tls CERT KEY, both as PEM files",
        ) from None
    return context


def read_password(path: Path) -> str:
    """The password in a file.

    Raises
    ------
    ArgumentError
        If other users can read the file, or the password is too short or cannot be typed.
    """
    wanted = "a file with the password as its only line"
    try:
        with open_regular(path, MOST_PASSWORD, wanted, ArgumentError) as stream:
            if os.name == "posix" and os.fstat(stream.fileno()).st_mode & 0o077:
                raise ArgumentError(
                    f"{path}: other users of this machine can read or change the password",
                    remedy=f"chmod 600 {shlex.quote(str(path))}, and choose another password",
                )
            text = stream.read(MOST_PASSWORD).decode("utf-8-sig")
    except OSError as error:
        raise ArgumentError(
            f"{path}: cannot be read ({error.strerror})", remedy="check the name of the password file"
        ) from None
    except UnicodeDecodeError:
        raise ArgumentError(f"{path}: is not text in UTF-8", remedy=f"name {wanted}") from None
    password = text.removesuffix("\n").removesuffix("\r")
    if not password.isprintable() or password != password.strip():
        raise ArgumentError(
            f"{path}: has several lines, blanks around the password, or characters that nobody can type",
            remedy=f"write {wanted}",
        )
    if len(password) < LEAST_LETTERS:
        raise ArgumentError(
            f"{path}: the password has {len(password)} characters", remedy=f"use at least {LEAST_LETTERS}"
        )
    return password
