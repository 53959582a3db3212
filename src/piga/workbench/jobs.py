"""Jobs: commands of piga that run beside the server, each in a process of its own.

A job is a command line. Its results are identical to those of the command, and the page shows how to repeat it in a
terminal. The folder of a job holds ``job.json`` (what it is), ``out`` and ``err`` (what it printed), ``progress``
(how far it is), ``stop`` if it was asked to end and, once it has ended, ``end.json`` (its exit code). These files
hold the state of the job, even if the server ends.
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
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from piga.errors import ArgumentError
from piga.output import write_whole

MOST_RUNNING = 4
"""Jobs that may run at the same time."""
MOST_KEPT = 200
"""Jobs that are kept. The oldest that have ended are removed."""
PATIENCE = 5.0
"""Time [s] that a stopped job has to end by itself."""
_NUMBERS_ONLY = not Path("/proc/self/stat").exists()
"""Without ``/proc`` a number does not tell a job from another process; only the server that started a job knows it runs."""
LARGEST = 1e12
"""Largest number in the record of a job."""
MOST_DOCUMENT = 20_000_000
"""Bytes of printed JSON that are read."""
MOST_TEXT = 200_000
"""Bytes of printed text that a page shows."""


class BusyError(ArgumentError):
    """As many jobs run as may run."""


State = Literal["running", "done", "failed", "stopped", "lost"]


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
    pid, born:
        Process number, and the time at which that process began, which tells it from a later one of the same number.
    started:
        Time of the start [s since 1970].
    """

    key: str
    command: tuple[str, ...]
    title: str
    subject: str
    result: str = ""
    pid: int = 0
    born: str = ""
    started: float = 0.0


@dataclass(frozen=True)
class Status:
    """What became of a job: its state, exit code, seconds, progress (0 to 1, or None) and what it does now."""

    state: State
    code: int | None
    seconds: float
    share: float | None = None
    doing: str = ""


class Jobs:
    """The jobs of one folder."""

    def __init__(self, folder: Path, root: Path) -> None:
        self._folder, self._root = folder, root
        folder.mkdir(exist_ok=True)
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._starting = threading.Lock()

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

        Raises
        ------
        BusyError
            If too many jobs run, or one makes the same results from something else.
        """
        with self._starting:  # many requests may ask at the same time
            return self._start(command, title, subject, result, reads)

    def _start(
        self, command: Sequence[str], title: str, subject: str, result: str, reads: Sequence[Path] | None
    ) -> Job:
        running = [job for job in self.all() if self.status(job).state == "running"]
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
                remedy="wait until that job has ended, or stop it on the page Jobs",
            )
        if len(running) >= MOST_RUNNING:
            raise BusyError(f"{MOST_RUNNING} jobs are running", remedy="wait for one, or stop one")
        key = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"
        place = self._folder / key
        place.mkdir(parents=True)
        environment = os.environ | {"PYTHONUTF8": "1", "PYTHONSAFEPATH": "1", "NO_COLOR": "1"}
        with (place / "out").open("wb") as out, (place / "err").open("wb") as err:
            child = subprocess.Popen(  # noqa: S603  piga's own command line, as a list
                [sys.executable, "-P", "-m", "piga.cli.job", str(place), *command],
                cwd=self._root, stdin=subprocess.DEVNULL, stdout=out, stderr=err, env=environment,
                start_new_session=True,
            )  # fmt: skip
        self._children[key] = child
        job = Job(key, tuple(command), title, subject, result, child.pid, _born(child.pid), time.time())
        text = json.dumps(asdict(job))
        write_whole(place / "job.json", lambda path: path.write_text(text, encoding="utf-8"))
        self._tidy()
        return job

    def all(self) -> list[Job]:
        """All jobs, the newest first."""
        jobs: list[Job] = []
        if not self._folder.is_dir():  # a user may remove it
            return jobs
        for place in sorted(self._folder.iterdir(), reverse=True):
            with suppress(OSError, ValueError, TypeError):
                fields = json.loads((place / "job.json").read_text(encoding="utf-8"))
                jobs.append(_job(fields | {"key": place.name}))
        return jobs

    def get(self, key: str) -> Job | None:
        """The job with this key, or None."""
        return next((job for job in self.all() if job.key == key), None)

    def latest(self, subject: str, result: str) -> Job | None:
        """The newest job for a record that makes this result, or None."""
        return next((job for job in self.all() if (job.subject, job.result) == (subject, result)), None)

    def status(self, job: Job) -> Status:
        """What became of the job."""
        child = self._children.get(job.key)
        place = self._folder / job.key
        there = (
            child is not None if _NUMBERS_ONLY else _alive(job, place)
        )  # asked before: a job writes its end and goes
        end = _document(place / "end.json")
        if child is not None:
            with suppress(subprocess.TimeoutExpired):
                child.wait(PATIENCE if end is not None or not there else 0.0)
                self._children.pop(job.key, None)  # two pages may ask at the same time
        if end is not None:
            code = int(end["code"]) if isinstance(end.get("code"), int) else 1
            state: State = "stopped" if end.get("stopped") else "failed" if code else "done"
            seconds = end.get("seconds")
            return Status(state, code, float(seconds) if isinstance(seconds, int | float) else 0.0)
        if not there:
            asked = (place / "stop").exists()  # it ended before it could say so
            return Status("stopped" if asked else "lost", None, 0.0)
        progress = _document(place / "progress") or {}
        share = progress.get("share")
        return Status(
            "running", None, time.time() - job.started,
            share if isinstance(share, float) else None, str(progress.get("what", "")),
        )  # fmt: skip

    def text(self, job: Job, name: Literal["out", "err"]) -> str:
        """What the job printed on standard output or standard error (the last part of a long text)."""
        with suppress(OSError), (self._folder / job.key / name).open("rb") as stream:
            stream.seek(max(stream.seek(0, os.SEEK_END) - MOST_TEXT, 0))
            return stream.read().decode("utf-8", "replace")
        return ""

    def document(self, job: Job) -> dict[str, Any]:
        """What the job printed as JSON.

        Raises
        ------
        ValueError
            If it printed none, or far too much.
        """
        path = self._folder / job.key / "out"
        if path.stat().st_size > MOST_DOCUMENT:
            raise ValueError("too much was printed")
        document = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(document, dict):
            raise ValueError("no table was printed")
        return document

    def stop(self, job: Job) -> None:
        """End a running job. Its results are then absent, as after Ctrl-C in a terminal."""
        if self.status(job).state != "running":
            return
        (self._folder / job.key / "stop").touch()
        _signal(job, signal.SIGINT)
        limit = time.monotonic() + PATIENCE
        while time.monotonic() < limit and self.status(job).state == "running":
            time.sleep(0.05)
        if self.status(job).state == "running":
            _signal(job, signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)

    def stop_all(self) -> None:
        """End all running jobs (when the server ends)."""
        running = [job for job in self.all() if self.status(job).state == "running"]
        for job in running:
            (self._folder / job.key / "stop").touch()
            _signal(job, signal.SIGINT)
        for job in running:
            self.stop(job)

    def forget(self, job: Job) -> None:
        """Remove a job that has ended."""
        if self.status(job).state != "running":
            shutil.rmtree(self._folder / job.key, ignore_errors=True)

    def _tidy(self) -> None:
        for job in self.all()[MOST_KEPT:]:
            self.forget(job)


def _job(fields: dict[str, Any]) -> Job:
    """A job from its record.

    Raises
    ------
    ValueError
        If a value is not of its type.
    """
    job = msgspec.convert(fields, Job)
    if not job.command or not all(abs(size) < LARGEST for size in (job.pid, job.started)):
        raise ValueError("the record of the job is damaged")
    return job


def _last_change(paths: Sequence[Path]) -> float:
    """Time of the last change of files [s since 1970]; a copy that keeps its time counts from when it came."""
    states = [path.stat() for path in paths if path.is_file()]
    return max((max(state.st_mtime, state.st_ctime) for state in states), default=math.inf)


def _document(path: Path) -> dict[str, Any] | None:
    with suppress(OSError, ValueError):
        document = json.loads(path.read_text(encoding="utf-8"))
        return document if isinstance(document, dict) else None
    return None


def _born(pid: int) -> str:
    """Start time of a process as the system tells it; "" where it does not."""
    with suppress(OSError, IndexError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    return ""


def _alive(job: Job, place: Path) -> bool:
    """True if the job's process runs: its number, its begin, and the folder of the job in its command line.

    The record of a job is a file of the folder, which may be a stranger's. No other process is taken for a job.
    """
    with suppress(OSError, IndexError):
        proc = Path(f"/proc/{job.pid}")
        fields = (proc / "stat").read_text().rpartition(")")[2].split()
        words = (proc / "cmdline").read_bytes().split(b"\0")
        return fields[0] != "Z" and fields[19] == job.born and os.fsencode(place) in words
    return False


def _signal(job: Job, number: int) -> None:
    with suppress(OSError):
        os.kill(job.pid, number)
