"""The command line in this process: quicker than a process of its own, with the same exit codes."""

from __future__ import annotations

import sys
from unittest.mock import patch

import pytest

from piga.cli.main import main


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
