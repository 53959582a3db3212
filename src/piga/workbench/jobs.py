"""Jobs: commands of piga that run beside the server, each in a process of its own.

A job is a command line, written to a process that waits for it. Its results are identical to those of the command, and
the page shows how to repeat it in a terminal. Jobs are known to this server alone. A job whose server is gone ends as
after Ctrl-C: it reads the end of its standard input then.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, cast

from piga.errors import ArgumentError

LAPSE = 3.0
"""Time [s] after which a fit that no page asks for is ended, while a page waits for another fit of the record."""
FIT = "Fit"
"""Title of the fits of a record."""
_PATIENCE, _LAST_PATIENCE = 2.0, 1.0
"""Time [s] that a stopped job has to end by itself, and when the server ends."""
_MOST_TEXT = 200_000
"""Bytes of printed text that a page shows."""


@dataclass(eq=False)
class Job:
    """A job: its process with standard input, and the folder of what it prints.

    ``command`` are the arguments of ``piga``, ``title`` and ``subject`` what it does and the record it is for, ``result`` the
    folder or file of the results below the opened folder. ``started``, ``ended`` and ``asked`` are times [s since 1970]: of the
    start, of the end (0 before), and of the last question of a page.
    """

    child: subprocess.Popen[bytes]
    input: IO[bytes]
    place: Path
    command: tuple[str, ...] = ()
    title: str = ""
    subject: str = ""
    result: str = ""
    started: float = 0.0
    ended: float = 0.0
    asked: float = 0.0
    was_stopped: bool = False

    @property
    def key(self) -> str:
        """Name of its folder, and of its page."""
        return self.place.name

    @property
    def state(self) -> Literal["running", "done", "failed", "stopped"]:
        """What became of it."""
        code = self.child.poll()
        if code is None:
            return "running"
        if not self.ended:
            self.ended = time.time()
            self.input.close()
        return "done" if code == 0 else "stopped" if self.was_stopped else "failed"

    @property
    def seconds(self) -> float:
        """Time that it runs or ran [s]."""
        return (time.time() if self.state == "running" else self.ended) - self.started

    @property
    def progress(self) -> dict[str, Any]:
        """What it does now (``what``), and which ``share`` of it is done, if known."""
        with suppress(OSError, ValueError):
            return dict(json.loads((self.place / "progress").read_text(encoding="utf-8")))
        return {"what": "", "share": None}

    def text(self, name: Literal["out", "err"]) -> str:
        """What it printed on standard output or standard error (the last part of a long text)."""
        with suppress(OSError), (self.place / name).open("rb") as stream:
            stream.seek(max(stream.seek(0, os.SEEK_END) - _MOST_TEXT, 0))
            return stream.read().decode("utf-8", "replace")
        return ""


class Jobs:
    """The jobs of one folder. What they print is kept in a private temporary folder until the server ends."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._folder = Path(tempfile.mkdtemp(prefix="piga-ui-"))
        self._jobs: dict[str, Job] = {}
        self._lock = threading.Lock()
        self._spare = self._waiting()

    def _waiting(self) -> Job:
        """A process that has loaded what a command needs and waits for it: a command then starts at once."""
        place = self._folder / f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
        place.mkdir()
        environment = os.environ | {"PYTHONUTF8": "1", "PYTHONSAFEPATH": "1", "NO_COLOR": "1"}
        with (place / "out").open("wb") as out, (place / "err").open("wb") as err:
            child = subprocess.Popen(  # noqa: S603  piga itself
                [sys.executable, "-P", "-m", "piga.cli.job", str(place)],
                cwd=self._root, stdin=subprocess.PIPE, stdout=out, stderr=err, env=environment,
                start_new_session=True,
            )  # fmt: skip
        return Job(child, cast("IO[bytes]", child.stdin), place)

    def start(self, command: Sequence[str], title: str, subject: str, result: str = "") -> Job:
        """Start ``piga`` with these arguments in the opened folder.

        If the same command makes this result already, that job is returned.
        """
        with self._lock:  # many requests may ask at the same time
            for job in (
                job for job in self.all() if result and job.result == result and job.state == "running"
            ):
                if job.command == tuple(command):
                    return job
                words = f"{result} is just being made with other options"
                raise ArgumentError(words, remedy="wait until that job has ended, or stop it")
            job = self._spare if self._spare.child.poll() is None else self._waiting()
            self._spare = self._waiting()
            job.command, job.title, job.subject, job.result = tuple(command), title, subject, result
            job.started = job.asked = time.time()
            job.input.write(json.dumps(command).encode() + b"\n")
            job.input.flush()
            self._jobs[job.key] = job
            return job

    def all(self) -> list[Job]:
        """All jobs, the newest first."""
        return list(reversed(list(self._jobs.values())))

    def get(self, key: str) -> Job | None:
        """The job with this key, or None."""
        return self._jobs.get(key)

    def latest(self, subject: str, result: str) -> Job | None:
        """The newest job for a record that makes this result, or None."""
        return next((job for job in self.all() if (job.subject, job.result) == (subject, result)), None)

    def attend(self, job: Job) -> None:
        """A page waits for this job. Fits of the same record that no page waits for any more are ended and forgotten."""
        job.asked = now = time.time()
        for other in self.all():
            is_fit = (other.title, other.subject) == (FIT, job.subject) and other.state == "running"
            if is_fit and now - other.asked > LAPSE:
                self.stop(other, patience=0.0)
                self.forget(other)

    def stop(self, *jobs: Job, patience: float = _PATIENCE) -> None:
        """End running jobs. Their results are then absent, as after Ctrl-C in a terminal."""
        for job in jobs:
            job.was_stopped |= job.child.poll() is None
            job.input.close()
        limit = time.monotonic() + patience
        for job in jobs:
            with suppress(subprocess.TimeoutExpired):
                job.child.wait(max(limit - time.monotonic(), 0.0))
            if job.child.poll() is None:
                with suppress(OSError):
                    os.killpg(job.child.pid, signal.SIGKILL) if hasattr(os, "killpg") else job.child.kill()
                job.child.wait()

    def stop_all(self) -> None:
        """End all running jobs and remove what they printed (when the server ends)."""
        self.stop(self._spare, *self.all(), patience=_LAST_PATIENCE)
        shutil.rmtree(self._folder, ignore_errors=True)

    def forget(self, job: Job) -> None:
        """Remove a job that has ended."""
        if job.state != "running":
            self._jobs.pop(job.key, None)
            shutil.rmtree(job.place, ignore_errors=True)
