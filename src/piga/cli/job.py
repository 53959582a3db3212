"""Run one command of ``piga`` for the workbench: ``python -m piga.cli.job FOLDER ARGUMENT...``.

Its progress is a small file in ``FOLDER``. It ends when its standard input ends. Without arguments it waits for them
there, with the packages loaded.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

BETWEEN = 0.2
"""Least time [s] between two notes."""
PATIENCE = 10.0
"""Time [s] that a command has to end by itself when its server is gone."""


class Note:
    """Progress as a small file: what is done now, and which share of it is done, if known."""

    def __init__(self, path: Path, title: str, total: float | None) -> None:
        self._path, self._title, self._last = path, title, 0.0
        self.show(0.0, total, "")

    def show(self, done: float, total: float | None, what: str) -> None:
        """``done`` of ``total`` are done, and ``what`` comes now."""
        now = time.monotonic()
        if self._last and now - self._last < BETWEEN:
            return
        self._last = now
        share = min(done / total, 1.0) if total else None
        words = f"{self._title}: {what}" if what else self._title
        part = self._path.with_suffix(".part")
        with suppress(OSError):
            part.write_text(json.dumps({"what": words, "share": share}), encoding="utf-8")
            part.replace(self._path)


def run(folder: Path, arguments: list[str]) -> None:
    """Run the command. It ends as after Ctrl-C when the server stops it or is gone: standard input then ends."""
    arguments = arguments or _asked()
    threading.Thread(target=_end_with_server, daemon=True).start()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    from piga.cli import common
    from piga.cli.main import guarded, main

    common.outlet = lambda title, total: Note(folder / "progress", title, total).show
    if arguments[:1] == ["envelopes"]:
        guarded(lambda: _envelopes(Path(arguments[1]), Path(arguments[2])))
        return
    sys.argv = ["piga", *arguments]
    main()


def _asked() -> list[str]:
    """Load what most commands need, then wait for the arguments: a line of JSON on standard input.

    The shipped record is calibrated meanwhile, because the first calibration of a process takes a second longer.
    """
    import warnings

    import pyarrow.parquet  # noqa: F401

    import piga.cli.main
    import piga.reports.calibration  # noqa: F401
    from piga.calibration.calibrate import calibrate
    from piga.data import copy_example
    from piga.stand import read_run

    with (
        suppress(OSError),  # no room for it: the command itself says so
        tempfile.TemporaryDirectory() as place,
        warnings.catch_warnings(action="ignore"),
    ):
        calibrate([read_run(copy_example(Path(place)))])
    line = bytearray()
    while not line.endswith(b"\n"):
        piece = os.read(0, 1)
        if not piece:
            sys.exit(0)
        line += piece
    return [str(word) for word in json.loads(line)]


def _end_with_server() -> None:
    """Wait for the end of standard input; then Ctrl-C, and the hard end for a command that does not listen."""
    while os.read(0, 1):
        pass
    signal.raise_signal(signal.SIGINT) if os.name == "nt" else os.kill(os.getpid(), signal.SIGINT)
    time.sleep(PATIENCE)
    os._exit(130)


def _envelopes(run: Path, folder: Path) -> None:
    from piga.records.run_file import read_run_file
    from piga.stand import read_run
    from piga.workbench.signals import write_envelopes

    write_envelopes(read_run(run), read_run_file(run), folder)


if __name__ == "__main__":
    run(Path(sys.argv[1]), sys.argv[2:])
