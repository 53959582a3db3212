"""Run one command of ``piga`` for the workbench: ``python -m piga.cli.job FOLDER ARGUMENT...``.

The exit code goes into ``FOLDER/end.json``, so that it is known even if the server is gone by then.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from pathlib import Path
from typing import Any


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
        from piga.cli.main import guarded, main

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
    from piga.stand import read_run
    from piga.workbench.signals import write_envelopes

    write_envelopes(read_run(run), folder)


if __name__ == "__main__":
    run(Path(sys.argv[1]), sys.argv[2:])
