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
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

BETWEEN = 0.2
"""Least time [s] between two notes."""
PATIENCE = 10.0
"""Time [s] that a command has to end by itself when its server is gone."""


def progress_file(path: Path, title: str, total: float | None) -> Callable[[float, float | None, str], None]:
    """Function that writes progress into a small file: what is done now, and which share of it is done, if known."""
    last = 0.0

    def show(done: float, total: float | None, what: str) -> None:
        nonlocal last
        now = time.monotonic()
        if last and now - last < BETWEEN:
            return
        last = now
        share = min(done / total, 1.0) if total else None
        part = path.with_suffix(".part")
        with suppress(OSError):
            part.write_text(
                json.dumps({"what": f"{title}: {what}" if what else title, "share": share}), "utf-8"
            )
            part.replace(path)

    show(0.0, total, "")
    return show


def run(folder: Path, arguments: list[str]) -> None:
    """Run the command. It ends as after Ctrl-C when the server stops it or is gone: standard input then ends."""
    arguments = arguments or _asked()
    threading.Thread(target=_end_with_server, daemon=True).start()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    from piga.cli import common
    from piga.cli.main import guarded, main

    common.outlet = lambda title, total: progress_file(folder / "progress", title, total)
    if arguments[:1] == ["envelopes"]:
        guarded(lambda: _write_envelopes(*map(Path, arguments[1:])))
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
    line = sys.stdin.readline()  # one line; then the server is silent
    return [str(word) for word in json.loads(line)] if line else sys.exit(0)


def _end_with_server() -> None:
    """Wait for the end of standard input; then Ctrl-C, and the hard end for a command that does not listen."""
    while os.read(0, 1):
        pass
    signal.raise_signal(signal.SIGINT) if os.name == "nt" else os.kill(os.getpid(), signal.SIGINT)
    time.sleep(PATIENCE)
    os._exit(130)


def _write_envelopes(run: Path, folder: Path) -> None:
    from piga.records.run_file import read_run_file
    from piga.stand import read_run
    from piga.workbench.signals import write_envelopes

    write_envelopes(read_run(run), read_run_file(run), folder)


if __name__ == "__main__":
    run(Path(sys.argv[1]), sys.argv[2:])
