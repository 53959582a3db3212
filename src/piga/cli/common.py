"""What every command shares: console, JSON output, results by rename, options, groups whose help comes quickly."""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer
from typer.core import TyperGroup, TyperOption

from piga.errors import PigaError
from piga.output import write_whole

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def clean(text: str) -> str:
    """Text without terminal control sequences (file names and headers may carry them)."""
    return _CONTROL.sub("?", text)


class _Nowhere(io.TextIOBase):
    """A stream that drops what is written: it replaces a standard output that cannot be written."""

    def write(self, text: str, /) -> int:
        """Take the text and drop it."""
        return len(text)


def check_pipes() -> None:
    """Refuse a live stream whose standard input or output is closed: nothing comes in, or the result is lost.

    Raises
    ------
    PigaError
        Naming the one that is closed.
    """
    closed = "input" if sys.stdin is None else "output" if isinstance(sys.stdout, _Nowhere) else ""
    if closed:
        raise PigaError(f"standard {closed} is closed", remedy="connect it: ... | piga compensate - ... > FILE")


LOST = 1
"""Exit code when a JSON document could not be written on stdout."""


def prepare_output() -> None:
    """Make stdout and stderr take any text: characters that the terminal or the pipe lacks are replaced."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed by who started the command
            setattr(sys, name, _Nowhere())
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def write_out(text: str, *, needed: bool) -> None:
    """Write on stdout; where it is full or closed, what the command did stays done and is not reported as failed.

    ``needed``: the text is the result itself (JSON), and a full disk behind stdout ends with exit code 1.
    It is not an error when the reader has gone.
    """
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        sys.stdout = _Nowhere()  # nor at the end of the process
        if isinstance(error, BrokenPipeError):
            return
        note(f"piga: standard output cannot be written ({error.strerror}); what the command did is done")
        if needed:
            raise SystemExit(LOST) from None


def as_json(document: Any) -> str:
    """Indented JSON; with escapes where stdout takes no UTF-8, so that nothing is replaced in it."""
    plain = (getattr(sys.stdout, "encoding", None) or "utf-8").lower().replace("-", "") not in (
        "utf8",
        "utf8sig",
    )
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=plain)


def print_json(document: Any) -> None:
    """Write one JSON document on stdout and nothing else."""
    write_out(as_json(document) + "\n", needed=True)


def print_json_list(document: dict[str, Any], name: str, items: Iterable[Any]) -> None:
    """Write ``document`` with a last entry ``name``, the list of ``items``, one by one as they come."""
    start = as_json(document).removesuffix("\n}")
    write_out(f"{start},\n {json.dumps(name)}: [", needed=True)
    between = "\n"
    for item in items:
        text = as_json(item)
        write_out(between + "\n".join(f"  {line}" for line in text.split("\n")), needed=True)
        between = ",\n"
    write_out("\n ]\n}\n" if between != "\n" else "]\n}\n", needed=True)


def say(text: str) -> None:
    """A line for people on stdout."""
    write_out(clean(text) + "\n", needed=False)


def note(text: str) -> None:
    """A line for people on stderr (warnings, progress summaries)."""
    with suppress(OSError):  # nobody is left to be told
        sys.stderr.write(clean(text) + "\n")
        sys.stderr.flush()


def output_directory(path: Path, option: str = "--out") -> Path:
    """Create the output directory that ``option`` names, or say why it cannot be.

    Raises
    ------
    PigaError
        If the path is a file or cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PigaError(
            f"{option} {path}: the directory cannot be created ({error.strerror})",
            remedy="name a directory you may write to",
        ) from None
    return path


def files_named_in(path: Path) -> list[Path]:
    """A TOML file and all files that it leads to: what a command may read, and must not write over."""
    from piga.records.text_files import files_named_in

    return files_named_in(path)


def write_by_rename(path: Path, write: Callable[[Path], object], option: str = "--out") -> Path:
    """Let ``write`` fill a temporary file beside ``path``, then rename it: never a half-written result.

    Raises
    ------
    PigaError
        If it cannot be written; names the ``option`` that the path comes from.
    """
    return write_whole(path, write, remedy=f"choose another {option}")


def write_text(path: Path, text: str) -> Path:
    """Write a text as UTF-8 with the same line ends everywhere."""
    path.write_text(text, encoding="utf-8", newline="\n")
    return path


class Advance(Protocol):
    """Tells a progress bar how much was done since the last call, and how much there is, where that is known."""

    def __call__(self, count: int, total: int | None = None, /) -> None:
        """``count`` more are done, of ``total``."""


@contextmanager
def progress(title: str, total: int | None = None) -> Iterator[Advance]:
    """Progress bar on stderr, shown only on a terminal and after a second; yields ``advance(n, total)``."""
    if not sys.stderr.isatty():
        yield lambda _count, _total=None: None
        return
    import time

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    started = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task(title, total=total)

    def advance(count: int, total: int | None = None) -> None:
        bar.update(task, advance=count, total=total)
        if not bar.live.is_started and time.monotonic() - started > 1.0:
            bar.start()

    try:
        yield advance
    finally:
        bar.stop()


RunFileArgument = Annotated[Path, typer.Argument(metavar="RUN.toml", help="Run file of the recorded test.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document and nothing else.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing results.")]


class CommandGroup(TyperGroup):
    """A group that does not load pydantic to learn that ``--help`` was not given.

    Typer converts every value that is not of its type yet through pydantic (0.1 s to import). A flag that was not given
    is None, no truth value, so that ``piga check --help`` paid for the ``--help`` that ``piga`` was not given.
    """

    def get_help_option(self, ctx: Any) -> TyperOption | None:
        """The option ``--help``, False when it is not given."""
        option = super().get_help_option(ctx)
        if option is not None:
            option.default = False
        return option
