"""Memory of a process as Linux states it. Scripts that measure themselves use it too, so that it loads next to nothing."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

LIMIT = 600_000_000
"""Most memory of a command on a record of any length [bytes]: columns of at most 32 MB, their temporaries, and libraries."""


def kilobytes(field: str, process: int | str = "self") -> int:
    """A field of ``/proc/<process>/status`` [kB]: ``RssAnon``, memory without mapped files, or ``VmHWM``, the largest with them.

    Raises
    ------
    OSError, KeyError
        If the process has ended.
    """
    lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    return int(dict(line.split(":", 1) for line in lines)[field].split()[0])


def largest_memory(command: Sequence[str]) -> int:
    """Largest memory of a command without mapped files, which the system takes back when it needs them [bytes]."""
    largest = 0
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as work:
        while work.poll() is None:
            try:
                largest = max(largest, kilobytes("RssAnon", work.pid))
            except (OSError, KeyError):
                break  # it has just ended
            time.sleep(0.01)
        _, error = work.communicate()
    assert work.returncode == 0, error
    return 1024 * largest
