"""What the commands say of a record as it is now: asked once in a job, shown until a file of the record changes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from piga.errors import ArgumentError
from piga.records.text_files import files_named_in
from piga.workbench.jobs import Job, Status
from piga.workbench.pages.common import Workbench
from piga.workbench.signals import cache_key

LARGEST = 200_000_000
"""Size of a record [bytes] up to which it is asked without being told to. Larger ones take long."""


@dataclass(frozen=True)
class LogQuestion:
    """A command that prints JSON about a run file: the mark of its jobs, their title, the command and its options."""

    mark: str
    title: str
    command: str
    options: tuple[str, ...]


CHECK = LogQuestion("check", "Check", "check", ("--json",))
TERMS = LogQuestion("terms", "Ask for each term", "check", ("--terms", "--json"))


@dataclass(frozen=True)
class Answer:
    """What became of a question: its job and state, the document if it is done, the message if it failed."""

    job: Job
    status: Status
    document: dict[str, Any]
    message: str


def ask(bench: Workbench, name: str, question: LogQuestion, *, always: bool = False) -> Answer | None:
    """The answer for a run file and its log as they are now; it is asked if it was not.

    Parameters
    ----------
    bench, name:
        The workbench, and the run file.
    question:
        What to ask.
    always:
        Ask also for a large record.

    Returns
    -------
    Answer or None
        None if nothing was asked: the record is large, or too many jobs run.
    """
    files = files_named_in(bench.folder.toml(name))
    mark = f"{question.mark}/{cache_key(files)}"
    job = next((job for job in bench.jobs.all() if job.result == mark and job.subject == name), None)
    if job is None or bench.jobs.status(job).state == "lost":
        size = sum(path.stat().st_size for path in files if path.is_file())
        if size > LARGEST and not always:
            return None
        try:
            command = (question.command, name, *question.options)
            job = bench.jobs.start(command, question.title, name, mark)
        except ArgumentError:
            return None
    status, document, message = bench.jobs.status(job), {}, ""
    if status.state == "done":
        try:
            document = bench.jobs.document(job)
        except (OSError, ValueError):
            message = "its answer cannot be read; ask again"
    elif status.state != "running":
        message = bench.jobs.text(job, "err") or "It was stopped."
    return Answer(job, status, document, message)
