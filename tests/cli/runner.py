"""The command line in this process: quicker than a process of its own, with the same exit codes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import patch

import pytest
from typer.testing import CliRunner, Result

from piga.cli.main import app, main

ENVIRONMENT = os.environ | {
    "PYTHONPATH": str(Path(__file__).resolve().parents[2] / "src"), "NUMBA_DISABLE_JIT": "1", "TERM": "xterm", "COLUMNS": "100",
}  # fmt: skip
"""Variables of a command of this checkout on a terminal."""


def exit_code(*arguments: object) -> int:
    """Run ``piga ARGUMENTS`` and give its exit code; what it writes goes where ``capsys`` sees it."""
    with patch.object(sys, "argv", ["piga", *map(str, arguments)]):
        try:
            main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def outcome(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    """Run ``piga ARGUMENTS`` and give its exit code, and what it writes to stdout and stderr."""
    code = exit_code(*arguments)
    done = capsys.readouterr()
    return code, done.out, done.err


def invoked(*arguments: object) -> Result:
    """Run ``piga ARGUMENTS`` and give its exit code, its output and the error that stopped it."""
    return CliRunner().invoke(app, [str(one) for one in arguments])


def on_terminal(
    arguments: list[object], until: str | None = None, typed: bytes = b"", seconds: float = 60.0
) -> tuple[str, int]:
    """Run a command on a terminal and answer it; stop it with Ctrl-C when it has shown ``until``. Text and exit code.

    Ctrl-C is pressed again after three seconds, as a user would: Python drops one that arrives within a callback from C.
    """
    import pty

    # A background job of a shell ignores Ctrl-C, and its children would, too.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "piga", *map(str, arguments)],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        env=ENVIRONMENT,
    )
    os.close(slave)
    os.write(master, typed)
    text, pressed, limit = "", 0.0, time.monotonic() + seconds
    while time.monotonic() < limit:
        try:
            part = os.read(master, 4096)
        except OSError:
            break
        if not part:
            break
        text += part.decode("utf-8", errors="replace")
        if until is not None and until in text and time.monotonic() > pressed + 3.0:
            time.sleep(0.3)
            process.send_signal(signal.SIGINT)
            pressed = time.monotonic()
    process.kill() if process.poll() is None and time.monotonic() >= limit else None
    code = process.wait(timeout=60)
    os.close(master)
    return text, code
