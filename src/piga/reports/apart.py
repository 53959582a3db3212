"""A page rendered in a process of its own: what draws takes 60 MB beside all that a long record has loaded."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

from piga.errors import PigaError
from piga.reports.page import Page, page_html


def write_page_apart(page: Page, path: Path) -> Path:
    """Write the page as one HTML file, the same to the byte as :func:`piga.reports.write_page` does.

    Raises
    ------
    PigaError
        If the other process fails.
    """
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-P", "-m", __name__],
        input=pickle.dumps(page),
        capture_output=True,
        check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)},
    )
    if done.returncode:
        words = done.stderr.decode("utf-8", errors="replace").strip().splitlines()
        reason = words[-1] if words else f"signal {-done.returncode}"
        raise PigaError(
            f"{path}: the page cannot be drawn ({reason[:200]})",
            remedy="the result is written; check that the extra 'report' is whole: pip install 'piga[report]'",
        )
    path.write_bytes(done.stdout)
    return path


if __name__ == "__main__":
    drawn = page_html(pickle.load(sys.stdin.buffer))  # noqa: S301
    sys.stdout.buffer.write(drawn.encode("utf-8"))
