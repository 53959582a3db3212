"""Code shared by all commands: console, JSON output, writing of results, options, groups with fast help."""

from __future__ import annotations

import datetime as dt
import glob
import io
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TextIO, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

from piga.errors import PigaError
from piga.output import results
from piga.progress import FIRST_USE, WHEN_COMPILED

if TYPE_CHECKING:
    from piga.reports.render.page import Page

Command = TypeVar("Command", bound=Callable[..., Any])

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def clean(text: str) -> str:
    """Text without terminal control sequences (file names and headers may contain them)."""
    return _CONTROL.sub("?", text)


def _discarded() -> TextIO:
    """A stream in place of a standard output that cannot be written."""
    return Path(os.devnull).open("w", encoding="utf-8")


_LOST = 1
"""Exit code if a JSON document could not be written on stdout."""


def prepare_output() -> None:
    """Let stdout and stderr accept any text. Characters that their encoding lacks are replaced."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # the parent process closed it
            setattr(sys, name, _discarded())
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _write_out(text: str, *, needed: bool) -> None:
    """Write on stdout. If stdout is full or closed, the command has still done its work, and no error is reported.

    ``needed``: the text is the result itself (JSON), so a full disk behind stdout gives exit code 1.
    A closed pipe is not an error.
    """
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        sys.stdout = _discarded()  # no error at the end of the process either
        if isinstance(error, BrokenPipeError):
            return
        note(f"piga: standard output cannot be written ({error.strerror}); what the command did is done")
        if needed:
            raise SystemExit(_LOST) from None


def print_json(document: Any) -> None:
    """Write one JSON document on stdout and nothing else. If stdout is not UTF-8, other characters are escaped."""
    encoding = (getattr(sys.stdout, "encoding", None) or "utf-8").lower().replace("-", "")
    _write_out(_json_text(document, ascii_only=encoding not in ("utf8", "utf8sig")), needed=True)


def _json_text(document: Any, *, ascii_only: bool) -> str:
    return json.dumps(document, indent=1, allow_nan=False, ensure_ascii=ascii_only) + "\n"


def counted(count: int, noun: str) -> str:
    """A number and a noun in the singular or plural."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def say(text: str) -> None:
    """Print a line for people on stdout."""
    _write_out(_fitted(text, sys.stdout) + "\n", needed=False)


_LONGEST = 2000
"""Most characters of a line on stderr; a longer one shows its begin and its end."""


def _fitted(text: str, stream: Any) -> str:
    """Clean text, on a terminal in lines as wide as it; a name or a number is never broken."""
    lines = clean(text).split("\n")
    if getattr(stream, "isatty", bool)():
        from piga.units import wrapped

        width = shutil.get_terminal_size().columns
        lines = [
            part
            for line in lines
            for part in (wrapped(line, width, later="    ") if len(line) > width else [line])
        ]
    return "\n".join(lines)


def note(text: str) -> None:
    """Print a line for people on stderr (warnings, progress summaries)."""
    lines = (
        line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 4 :]}"
        for line in text.split("\n")
    )
    with suppress(OSError):  # stderr is closed: nobody reads the message
        sys.stderr.write(_fitted("\n".join(lines), sys.stderr) + "\n")
        sys.stderr.flush()


def tell(as_json: bool, document: Any, lines: Iterable[str]) -> None:
    """The ending of a command without files: one JSON document, or lines for people."""
    if as_json:
        print_json(document)
        return
    for line in lines:
        say(line)


def files_named_in(path: Path) -> list[Path]:
    """A TOML file and all files that it names, directly or indirectly. A command may read them and must not overwrite them."""
    from piga.text_files import files_named_in

    return files_named_in(path)


def write_text(path: Path, text: str) -> Path:
    """Write a text as UTF-8 with the same line ends everywhere."""
    path.write_text(text, encoding="utf-8", newline="\n")
    return path


class Delivery:
    """What a command makes: files in a hidden folder (``delivery / name``), and its last words.

    ``folder`` is where the files will be; None if the command writes none.
    """

    def __init__(self, folder: Path | None, stage: Path) -> None:
        self.folder, self.stage = folder, stage
        self._document: Callable[[], Any] | None = None
        self._text: Callable[[], str] = str

    def __truediv__(self, name: str) -> Path:
        return self.stage / name

    def tell(self, document: Callable[[], Any], text: Callable[[], str]) -> None:
        """The result as a JSON document and as text; only what is asked for is made."""
        self._document, self._text = document, text

    def show(self, document: Any, page: Page, brief: Page, *names: str) -> None:
        """Tell a result by its document and a brief page. In a folder: the document too, and a page, the last of ``names``."""
        from piga.reports.render.page import page_text, write_page

        if self.folder is not None:
            for name in names[:-1]:
                write_text(self / name, _json_text(document, ascii_only=False))
            with progress("writing the report"):
                write_page(page, self / names[-1])
        self.tell(lambda: document, lambda: page_text(brief))


@contextmanager
def deliver(
    folder: Path | None,
    command: str,
    names: Sequence[str],
    inputs: Sequence[Path],
    *,
    force: bool,
    as_json: bool,
) -> Iterator[Delivery]:
    """The one ending of a command: its files appear together, then JSON alone, or the text and the files that were written.

    Results of other inputs are never replaced without ``force``: the new ones go beside them (``folder/2``).
    """
    if folder is None:
        delivery, written = Delivery(None, Path()), []
        yield delivery
    else:
        with results(folder, command, names, inputs, force=force) as (stage, place):
            delivery = Delivery(place, stage)
            yield delivery
            written = _listed(stage, place, names)
    if as_json:
        if delivery._document is not None:
            print_json(delivery._document())
        return
    text = delivery._text()
    say("\n".join([*([text] if text else []), *(f"wrote {line}" for line in written)]))


def deliver_file(
    target: Path, command: str, inputs: Sequence[Path], *, force: bool, as_json: bool = False
) -> AbstractContextManager[Delivery]:
    """The same for one file that the user names: it is written at ``delivery / target.name``."""
    names, mark = [glob.escape(target.name)], f"{command}-{target.stem[:40]}"
    return deliver(target.parent, mark, names, inputs, force=force, as_json=as_json)


def _listed(stage: Path, place: Path, names: Sequence[str]) -> list[str]:
    """The files of a hidden folder by their final names, in the order of the patterns; those of a folder together."""
    paths = dict.fromkeys(path for name in names for path in sorted(stage.glob(name)))
    lines: dict[str, int] = {}
    for path in paths:
        inside = path.relative_to(stage)
        line = str(place / (inside if len(inside.parts) == 1 else inside.parts[0]))
        lines[line] = lines.get(line, 0) + 1
    return [line if count == 1 else f"{line} ({count} files)" for line, count in lines.items()]


def day_in(text: str, option: str, also: str = "") -> dt.datetime:
    """The time of an option, UTC where it names no zone; of a date its begin. ``also``: another word that the option takes."""
    try:
        time = dt.datetime.fromisoformat(text)
    except ValueError:
        raise PigaError(f"{option} {text}: is not a date", remedy=f"write e.g. 2027-06-01{also}") from None
    return time if time.tzinfo else time.replace(tzinfo=dt.UTC)


Show = Callable[[float, float | None, str], None]
"""Function that shows progress: work done, the whole work if known, and what comes now (:mod:`piga.progress`)."""

outlet: Callable[[str, int | None], Show] | None = None
"""Where progress goes instead of a bar; set by a process that runs a command for another program."""


@contextmanager
def progress(title: str, total: int | None = None) -> Iterator[Show]:
    """Progress bar on stderr, shown at once on a terminal. Yields the function that library calls take as ``progress``.

    Without a terminal only a line says that kernels are compiled. If the command is stopped, the message names ``title``.
    """
    try:
        if outlet is not None:
            yield outlet(title, total)
        elif sys.stderr is not None and sys.stderr.isatty():
            with _bar(title, total) as show:
                yield show
        else:
            WHEN_COMPILED[:] = [partial(note, f"{title}; {FIRST_USE}")]
            yield _silent
    except KeyboardInterrupt as stop:
        stop.add_note(f"{DOING}{title}")
        raise


_WIDE = 90
"""Columns of a terminal from which on the bar is long."""


@contextmanager
def _bar(title: str, total: int | None) -> Iterator[Show]:
    """A line on stderr, drawn with rich, that shows what is done and how far it is. It disappears at the end."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.table import Column

    console = Console(stderr=True)
    words = TextColumn("{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1))
    share = BarColumn(24 if console.width >= _WIDE else 8)
    columns = (SpinnerColumn("line"), words, share, TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as drawn:
        task = drawn.add_task(title, total=total)

        def show(done: float, total: float | None, what: str) -> None:
            said = f"{title}: {what}" if what else title
            drawn.update(task, completed=done, total=total, description=said)

        WHEN_COMPILED[:] = [lambda: drawn.update(task, description=f"{title}; {FIRST_USE}")]
        yield show


def _silent(done: float, total: float | None, what: str) -> None:
    """Progress that nobody sees."""


DOING = "while "
"""Start of the note on a stop that names what was being done."""


def option(value: str, words: str, *names: str, **more: Any) -> Any:
    """An option, named as its parameter unless ``names`` are given: what help shows for its value, and what it does."""
    return typer.Option(*names, metavar=value, help=words, **more)


def flag(name: str, words: str) -> Any:
    """An option without a value: its name, and what it does."""
    return typer.Option(name, help=words)


def argument(value: str, words: str, **more: Any) -> Any:
    """An argument: what help shows for it, and what it is; ``more`` as for ``typer.Argument``."""
    return typer.Argument(metavar=value, help=words, **more)


RunFileArgument = Annotated[Path, argument("RUN.toml", "Run file of the recorded test.")]
JsonOption = Annotated[bool, flag("--json", "Print one JSON document and nothing else.")]
TermsOption = Annotated[str | None, option("A,B,...", "Terms to estimate, instead of the run file's.")]
MethodOption = Annotated[str | None, option("NAME", "Estimator: information | rate | revolutions.")]
PhasesOption = Annotated[
    str | None, option("NAME", "Phases of the output zero: shared | per-segment.", "--phases", "--phase")
]
ForceOption = Annotated[bool, flag("--force", "Replace existing results.")]


_TYPE = re.compile(r" <(?:list\[)?(?:path|str|int|float)\]?>", re.IGNORECASE)
"""The Python type of an argument, in help."""


class PlainCommand(TyperCommand):
    """A command whose help names values as its user does, and not by their Python types."""

    def get_help(self, ctx: Any) -> str:
        """The whole help, without the Python types of arguments."""
        return _TYPE.sub(lambda match: " " * len(match[0]), super().get_help(ctx))


class CommandGroup(TyperGroup):
    """A group whose help does not load pydantic (0.1 s), with which Typer would convert flags that are not given."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The options. Flags are False if they are not given."""
        params = super().get_params(ctx)
        for param in params:
            if getattr(param, "is_flag", False) and param.default is None:
                param.default = False
        return params


class App(typer.Typer):
    """A Typer application: its groups are :class:`CommandGroup`, its commands :class:`PlainCommand`."""

    def __init__(self, name: str, words: str, **more: Any) -> None:
        settings: dict[str, Any] = {"no_args_is_help": True, "rich_markup_mode": None, "add_completion": False}
        super().__init__(name=name, help=words, cls=CommandGroup, **(settings | more))

    def command(self, name: str | None = None, **options: Any) -> Callable[[Command], Command]:
        """Decorator that adds a command."""
        return super().command(name, cls=PlainCommand, **options)
