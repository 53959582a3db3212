"""Jobs: commands of piga that run beside the server, each in a process of its own.

A job is a command line, written to a process that waits for it. Its results are identical to those of the command, and
the page shows how to repeat it in a terminal. Jobs are known to this server alone. A job whose server is gone ends as
after Ctrl-C: it reads the end of its standard input then.
"""

from __future__ import annotations

import json
import math
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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from piga.errors import ArgumentError

MOST_RUNNING = 4
"""Jobs that may run at the same time."""
MOST_KEPT = 200
"""Jobs that are remembered. The oldest that have ended are forgotten."""
PATIENCE = 2.0
"""Time [s] that a stopped job has to end by itself."""
_MOST_DOCUMENT = 20_000_000
"""Bytes of printed JSON that are read."""
MOST_TEXT = 200_000
"""Bytes of printed text that a page shows."""


class BusyError(ArgumentError):
    """As many jobs run as may run."""


State = Literal["running", "done", "failed", "stopped"]


@dataclass(frozen=True)
class Job:
    """A job as it was started.

    Attributes
    ----------
    key:
        Name of its folder.
    command:
        Arguments of ``piga``; paths are relative to the opened folder.
    title, subject:
        What it does, and the record it is for.
    result:
        Folder or file of the results below the opened folder, or "".
    started:
        Time of the start [s since 1970].
    """

    key: str
    command: tuple[str, ...]
    title: str
    subject: str
    result: str = ""
    started: float = 0.0


@dataclass(frozen=True)
class Status:
    """What became of a job: its state, exit code, seconds, progress (0 to 1, or None) and what it does now."""

    state: State
    code: int | None
    seconds: float
    share: float | None = None
    doing: str = ""


@dataclass
class _Process:
    """The process of a job, and when and how it ended."""

    child: subprocess.Popen[bytes]
    was_stopped: bool = False
    ended: float = field(default=math.nan)


class Jobs:
    """The jobs of one folder. What they print is kept in a private temporary folder until the server ends."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._folder = Path(tempfile.mkdtemp(prefix="piga-ui-"))
        self._jobs: dict[str, tuple[Job, _Process]] = {}
        self._lock = threading.Lock()
        self._spare = self._waiting()

    def _waiting(self) -> tuple[str, subprocess.Popen[bytes]]:
        """A process that has loaded what a command needs and waits for it: a command then starts at once."""
        key = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
        place = self._folder / key
        place.mkdir()
        environment = os.environ | {"PYTHONUTF8": "1", "PYTHONSAFEPATH": "1", "NO_COLOR": "1"}
        with (place / "out").open("wb") as out, (place / "err").open("wb") as err:
            return key, subprocess.Popen(  # noqa: S603  piga itself
                [sys.executable, "-P", "-m", "piga.cli.job", str(place)],
                cwd=self._root, stdin=subprocess.PIPE, stdout=out, stderr=err, env=environment,
                start_new_session=True,
            )  # fmt: skip

    def start(
        self,
        command: Sequence[str],
        title: str,
        subject: str,
        result: str = "",
        reads: Sequence[Path] | None = None,
    ) -> Job:
        """Start ``piga`` with these arguments in the opened folder.

        If a job already does the same, no new one is started, and the running one is returned. ``reads`` are the
        files that the command reads: if they are given, a job that began before they changed does something else, and
        one with another place for its results does the same.
        """
        with self._lock:  # many requests may ask at the same time
            return self._start(command, title, subject, result, reads)

    def _start(
        self, command: Sequence[str], title: str, subject: str, result: str, reads: Sequence[Path] | None
    ) -> Job:
        running = self.running()
        changed = -math.inf if reads is None else _last_change(reads)
        asked = [word for word in command if word != result]
        here = [job for job in running if result and job.result == result]
        for job in here if reads is None else running:
            words = [word for word in job.command if word != job.result]
            if result and job.started > changed and (job.title, words) == (title, asked):
                return job
        if here:
            raise BusyError(
                f"{result} is just being made from another input or with other options",
                remedy="wait until that job has ended, or stop it",
            )
        if len(running) >= MOST_RUNNING:
            raise BusyError(f"{MOST_RUNNING} jobs are running", remedy="wait for one, or stop one")
        key, child = self._spare if self._spare[1].poll() is None else self._waiting()
        self._spare = self._waiting()
        job = Job(key, tuple(command), title, subject, result, time.time())
        assert child.stdin is not None  # noqa: S101  a pipe
        child.stdin.write(json.dumps(command).encode() + b"\n")
        child.stdin.flush()
        self._jobs[key] = (job, _Process(child))
        for old in self.all()[MOST_KEPT:]:
            self.forget(old)
        return job

    def all(self) -> list[Job]:
        """All jobs, the newest first."""
        return [job for job, _ in reversed(list(self._jobs.values()))]

    def running(self) -> list[Job]:
        """The jobs that run."""
        return [job for job in self.all() if self.status(job).state == "running"]

    def get(self, key: str) -> Job | None:
        """The job with this key, or None."""
        return self._jobs[key][0] if key in self._jobs else None

    def latest(self, subject: str, result: str) -> Job | None:
        """The newest job for a record that makes this result, or None."""
        return next((job for job in self.all() if (job.subject, job.result) == (subject, result)), None)

    def status(self, job: Job) -> Status:
        """What became of the job."""
        process = self._jobs[job.key][1]
        code = process.child.poll()
        if code is None:
            progress = _document(self._folder / job.key / "progress")
            share = progress.get("share")
            return Status(
                "running", None, time.time() - job.started,
                share if isinstance(share, float) else None, str(progress.get("what", "")),
            )  # fmt: skip
        if math.isnan(process.ended):
            process.ended = time.time()
            _close(process.child)
        state: State = "done" if code == 0 else "stopped" if process.was_stopped else "failed"
        return Status(state, code, process.ended - job.started)

    def text(self, job: Job, name: Literal["out", "err"]) -> str:
        """What the job printed on standard output or standard error (the last part of a long text)."""
        with suppress(OSError), (self._folder / job.key / name).open("rb") as stream:
            stream.seek(max(stream.seek(0, os.SEEK_END) - MOST_TEXT, 0))
            return stream.read().decode("utf-8", "replace")
        return ""

    def document(self, job: Job) -> dict[str, Any]:
        """What the job printed as JSON."""
        path = self._folder / job.key / "out"
        if path.stat().st_size > _MOST_DOCUMENT:
            raise ValueError("too much was printed")
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise ValueError("no table was printed")
        return document

    def stop(self, *jobs: Job, patience: float = PATIENCE) -> None:
        """End running jobs. Their results are then absent, as after Ctrl-C in a terminal."""
        processes = [process for _, process in map(self._jobs.__getitem__, {job.key for job in jobs})]
        for process in processes:
            if process.child.poll() is None:
                process.was_stopped = True
            _close(process.child)
        limit = time.monotonic() + patience
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.child.wait(max(limit - time.monotonic(), 0.0))
            _kill(process.child)

    def stop_all(self) -> None:
        """End all running jobs and remove what they printed (when the server ends)."""
        _close(self._spare[1])
        self.stop(*self.all())
        _kill(self._spare[1])
        shutil.rmtree(self._folder, ignore_errors=True)

    def forget(self, job: Job) -> None:
        """Remove a job that has ended."""
        if self.status(job).state != "running":
            self._jobs.pop(job.key, None)
            shutil.rmtree(self._folder / job.key, ignore_errors=True)


def _close(child: subprocess.Popen[bytes]) -> None:
    """End the standard input of a process."""
    assert child.stdin is not None  # noqa: S101  a pipe
    child.stdin.close()


def _kill(child: subprocess.Popen[bytes]) -> None:
    """End a process that did not end by itself, and what it started."""
    if child.poll() is None:
        with suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(child.pid, signal.SIGKILL)
            else:
                child.kill()
        child.wait()


def _last_change(paths: Sequence[Path]) -> float:
    """Time of the last change of files [s since 1970]; a copy that keeps its time counts from when it came."""
    states = [path.stat() for path in paths if path.is_file()]
    return max((max(state.st_mtime, state.st_ctime) for state in states), default=math.inf)


def _document(path: Path) -> dict[str, Any]:
    with suppress(OSError, ValueError):
        document = json.loads(path.read_text(encoding="utf-8"))
        return document if isinstance(document, dict) else {}
    return {}
