"""Memory of a process as Linux states it. Scripts that measure themselves use it too, so that it loads next to nothing."""

from __future__ import annotations

from pathlib import Path


def kilobytes(field: str, process: int | str = "self") -> int:
    """A field of ``/proc/<process>/status`` [kB]: ``RssAnon``, memory without mapped files, or ``VmHWM``, the largest with them.

    Raises
    ------
    OSError, KeyError
        If the process has ended.
    """
    lines = Path(f"/proc/{process}/status").read_text(encoding="utf-8").splitlines()
    return int(dict(line.split(":", 1) for line in lines)[field].split()[0])
