"""A real PostgreSQL server for the tests: Debian's package, in a temporary folder, on a socket only."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SETTINGS = "-c listen_addresses='' -c shared_buffers=16MB -c max_connections=30 -c fsync=off"


def programs() -> Path | None:
    """Folder of ``initdb`` and ``pg_ctl``, if there is one."""
    places = [Path(program).resolve().parent for name in ("initdb",) if (program := shutil.which(name))]
    places += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next(
        (place for place in places if (place / "pg_ctl").exists() and (place / "postgres").exists()), None
    )


def missing() -> str | None:
    """Why no server can be started here; None when one can."""
    if os.name == "nt" or programs() is None:
        return "no PostgreSQL server here (Debian: apt-get install postgresql)"
    if os.getuid() == 0 and shutil.which("setpriv") is None:
        return "PostgreSQL refuses to run as root, and there is no setpriv to become another user"
    return None


def _as_user(command: list[str]) -> list[str]:
    if os.getuid() != 0:
        return command
    return ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", *command]


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, cwd="/", stdout=subprocess.DEVNULL)


@contextmanager
def server() -> Iterator[Path]:
    """Start a server; yields the folder of its socket. Its user is ``piga``, without a password."""
    place = programs()
    assert place is not None
    with tempfile.TemporaryDirectory(prefix="piga-pg-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        if os.getuid() == 0:
            os.chown(folder, 65534, 65534)
        data = ["-D", str(folder / "data")]
        control = _as_user([str(place / "pg_ctl"), *data])
        start = ["-A", "trust", "-U", "piga", "-E", "UTF8", "--no-locale", "--no-sync"]
        _run(_as_user([str(place / "initdb"), *data, *start]))
        settings = ["-w", "-l", str(folder / "log"), "-o", f"-k {folder} {SETTINGS}", "start"]
        _run([*control, *settings])
        try:
            yield folder
        finally:
            _run([*control, "-w", "-m", "immediate", "stop"])
