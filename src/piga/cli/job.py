"""Run one command of ``piga`` for the workbench: ``python -m piga.cli.job FOLDER ARGUMENT...``.

The exit code goes into ``FOLDER/end.json``, so that it is known even if the server is gone by then.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

BETWEEN = 0.2
"""Least time [s] between two notes."""


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
    """Run the command and note how it ended."""
    from piga.output import write_whole

    started = time.time()
    stopped = False

    def stop(number: int, frame: Any) -> None:
        nonlocal stopped
        stopped = True
        signal.default_int_handler(number, frame)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    code: object = 1
    try:
        from piga.cli import common
        from piga.cli.main import guarded, main

        common.outlet = lambda title, total: Note(folder / "progress", title, total).show
        if arguments[:1] == ["envelopes"]:
            guarded(lambda: _envelopes(Path(arguments[1]), Path(arguments[2])))
        else:
            sys.argv = ["piga", *arguments]
            main()
        code = 0
    except SystemExit as end:
        code = end.code
    finally:
        exit_code = code if isinstance(code, int) else 0 if code is None else 1
        document = json.dumps({"code": exit_code, "stopped": stopped, "seconds": time.time() - started})
        write_whole(folder / "end.json", lambda path: path.write_text(document, encoding="utf-8"))


def _envelopes(run: Path, folder: Path) -> None:
    """Read a record and write what the page of its signals draws."""
    from piga.records.run_file import read_run_file
    from piga.stand import read_run
    from piga.workbench.signals import write_envelopes

    temperature = read_run_file(run).data.temperature
    write_envelopes(read_run(run), folder, temperature.unit if temperature is not None else "K")


if __name__ == "__main__":
    run(Path(sys.argv[1]), sys.argv[2:])
