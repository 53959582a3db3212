"""Long commands show at once what they do, on a terminal only; a stop says what was stopped and what is on disk."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import numba
import pytest

import piga._kernels.jit  # noqa: F401
from piga.cli.common import progress
from piga.data import copy_example
from piga.progress import FIRST_USE
from tests.cli.runner import ENVIRONMENT, on_terminal

STOPPED = (130, -signal.SIGINT)
"""Exit by a stop. Python ends itself with the signal if the stop came while it made a class; shells show 130 for both."""
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")


def test_calibrate_shows_what_it_does_and_what_a_stop_left(tmp_path: Path) -> None:
    run = copy_example(tmp_path)
    text, code = on_terminal(["calibrate", run], "calibrating")
    assert "reading" in text
    assert code in STOPPED, text
    assert "piga: stopped while calibrating" in text
    left = f"{tmp_path / 'tumble-a-calibration'}: not made; nothing of this run was kept"
    assert left in " ".join(text.split())
    assert "Traceback" not in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tumble-a.csv", "tumble-a.toml"]


def test_nothing_is_shown_without_a_terminal(tmp_path: Path) -> None:
    run = copy_example(tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", "piga", "check", str(run)],
        capture_output=True,
        text=True,
        env=ENVIRONMENT,
        check=True,
    )
    assert done.stderr == ""


@pytest.mark.long
def test_first_use_is_said_once_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with progress("calibrating"):
        for more in (1, 2):
            numba.njit(lambda x, more=more: x + more)(1)
    assert capsys.readouterr().err.splitlines() == [f"calibrating; {FIRST_USE}"]
