"""Code shared by all commands: console, JSON output, writing of results, options, groups with fast help."""

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
    """Text without terminal control sequences (file names and headers may contain them)."""
    return _CONTROL.sub("?", text)


class _Nowhere(io.TextIOBase):
    """A stream that discards its text. It replaces a standard output that cannot be written."""

    def write(self, text: str, /) -> int:
        """Discard the text."""
        return len(text)


def check_pipes() -> None:
    """Refuse a live stream if standard input or output is closed.

    Raises
    ------
    PigaError
        If one is closed. The message names it.
    """
    closed = "input" if sys.stdin is None else "output" if isinstance(sys.stdout, _Nowhere) else ""
    if closed:
        raise PigaError(f"standard {closed} is closed", remedy="connect it: ... | piga compensate - ... > FILE")


LOST = 1
"""Exit code if a JSON document could not be written on stdout."""


def prepare_output() -> None:
    """Let stdout and stderr accept any text. Characters that their encoding lacks are replaced."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # the parent process closed it
            setattr(sys, name, _Nowhere())
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def write_out(text: str, *, needed: bool) -> None:
    """Write on stdout. If stdout is full or closed, the command has still done its work, and no error is reported.

    ``needed``: the text is the result itself (JSON), so a full disk behind stdout gives exit code 1.
    A closed pipe is not an error.
    """
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        sys.stdout = _Nowhere()  # no error at the end of the process either
        if isinstance(error, BrokenPipeError):
            return
        note(f"piga: standard output cannot be written ({error.strerror}); what the command did is done")
        if needed:
            raise SystemExit(LOST) from None


def as_json(document: Any) -> str:
    """Indented JSON. If stdout is not UTF-8, other characters are escaped, so that none is replaced."""
    plain = (getattr(sys.stdout, "encoding", None) or "utf-8").lower().replace("-", "") not in (
        "utf8",
        "utf8sig",
    )
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=plain)


def print_json(document: Any) -> None:
    """Write one JSON document on stdout and nothing else."""
    write_out(as_json(document) + "\n", needed=True)


def print_json_list(document: dict[str, Any], name: str, items: Iterable[Any]) -> None:
    """Write ``document`` with a last entry ``name``: the list of ``items``, written one by one as they come."""
    start = as_json(document).removesuffix("\n}")
    write_out(f"{start},\n {json.dumps(name)}: [", needed=True)
    between = "\n"
    for item in items:
        text = as_json(item)
        write_out(between + "\n".join(f"  {line}" for line in text.split("\n")), needed=True)
        between = ",\n"
    write_out("\n ]\n}\n" if between != "\n" else "]\n}\n", needed=True)


def say(text: str) -> None:
    """Print a line for people on stdout."""
    write_out(clean(text) + "\n", needed=False)


def note(text: str) -> None:
    """Print a line for people on stderr (warnings, progress summaries)."""
    with suppress(OSError):  # stderr is closed: nobody reads the message
        sys.stderr.write(clean(text) + "\n")
        sys.stderr.flush()


def output_directory(path: Path, option: str = "--out") -> Path:
    """Create the output directory that ``option`` names.

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
    """A TOML file and all files that it names, directly or indirectly. A command may read them and must not overwrite them."""
    from piga.records.text_files import files_named_in

    return files_named_in(path)


def write_by_rename(path: Path, write: Callable[[Path], object], option: str = "--out") -> Path:
    """Let ``write`` fill a temporary file beside ``path``, then rename it. So no result is half written.

    Raises
    ------
    PigaError
        If it cannot be written. The message names the ``option`` of the path.
    """
    return write_whole(path, write, remedy=f"choose another {option}")


def write_text(path: Path, text: str) -> Path:
    """Write a text as UTF-8 with the same line ends everywhere."""
    path.write_text(text, encoding="utf-8", newline="\n")
    return path


class Advance(Protocol):
    """Function that advances a progress bar: work done since the last call, and total work if known."""

    def __call__(self, count: int, total: int | None = None, /) -> None:
        """``count`` more of ``total`` are done."""


@contextmanager
def progress(title: str, total: int | None = None) -> Iterator[Advance]:
    """Progress bar on stderr, shown only on a terminal and after one second. Yields ``advance(n, total)``."""
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
    """A group whose ``--help`` option does not load pydantic.

    Typer converts every value of the wrong type with pydantic, whose import takes 0.1 s. A missing flag is None, not a
    bool, so the ``--help`` of the group, when not given, caused this import. Here a missing ``--help`` is False.
    """

    def get_help_option(self, ctx: Any) -> TyperOption | None:
        """The option ``--help``. It is False if not given."""
        option = super().get_help_option(ctx)
        if option is not None:
            option.default = False
        return option
