"""Code shared by all commands: console, JSON output, writing of results, options, groups with fast help."""

from __future__ import annotations

import datetime as dt
import glob
import inspect
import io
import itertools
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any, TextIO, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

import piga
from piga.errors import PigaError
from piga.output import results
from piga.progress import FIRST_USE, WHEN_COMPILED

Command = TypeVar("Command", bound=Callable[..., Any])

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""What may steer a terminal; file names and headers may hold it."""


def _discarded() -> TextIO:
    """A stream in place of a standard output that cannot be written."""
    return Path(os.devnull).open("w", encoding="utf-8")


def prepare_output() -> None:
    """Let stdout and stderr accept any text. Characters that their encoding lacks are replaced."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # the parent process closed it
            setattr(sys, name, _discarded())
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _write_out(text: str) -> None:
    """Write on stdout. That nobody reads it any more is no error; that its disk is full is one."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        sys.stdout = _discarded()  # no second error at the end of the process
        if not isinstance(error, BrokenPipeError):
            raise


def print_json(document: Any) -> None:
    """Write one JSON document on stdout and nothing else. If stdout is not UTF-8, other characters are escaped."""
    encoding = (getattr(sys.stdout, "encoding", None) or "utf-8").lower().replace("-", "")
    plain = encoding not in ("utf8", "utf8sig")
    _write_out(json.dumps(document, indent=1, allow_nan=False, ensure_ascii=plain) + "\n")


def counted(count: int, noun: str) -> str:
    """A number and a noun in the singular or plural."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def say(text: str) -> None:
    """Print a line for people on stdout."""
    _write_out(_fitted(text, sys.stdout) + "\n")


def _fitted(text: str, stream: Any) -> str:
    """Clean text, on a terminal in lines as wide as it; a name or a number is never broken."""
    text = _CONTROL.sub("?", text)
    if not getattr(stream, "isatty", bool)():
        return text
    from piga.units import wrapped

    width = shutil.get_terminal_size().columns
    parts = (wrapped(line, width, later="    ") if len(line) > width else [line] for line in text.split("\n"))
    return "\n".join(itertools.chain(*parts))


def note(text: str) -> None:
    """Print a line for people on stderr (warnings, progress summaries)."""
    with suppress(OSError):  # stderr is closed: nobody reads the message
        sys.stderr.write(_fitted(text, sys.stderr) + "\n")
        sys.stderr.flush()


class Ending:
    """How the command that runs ends: its options ``--force`` and ``--json``, and which other ``options`` were given."""

    force = as_json = False
    options: tuple[str, ...] = ()


def tell(document: Any, lines: Iterable[str]) -> None:
    """The ending of a command without files: one JSON document, or lines for people."""
    if Ending.as_json:
        print_json(document)
        return
    for line in lines:
        say(line)


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8 with the same line ends everywhere."""
    path.write_text(text, encoding="utf-8", newline="\n")


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

    def write_json(self, name: str, document: Any) -> None:
        """Write a document as JSON."""
        text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
        write_text(self / name, f"{text}\n")

    def show(self, document: Any, page: piga.reports.Page, brief: piga.reports.Page, *names: str) -> None:
        """Tell a result by its document and a brief page. In a folder: the document too, and a page, the last of ``names``."""
        if self.folder is not None:
            for name in names[:-1]:
                self.write_json(name, document)
            with progress("writing the report"):
                piga.reports.write_page(page, self / names[-1])
        self.tell(lambda: document, lambda: piga.reports.page_text(brief))


@contextmanager
def deliver(
    folder: Path | None, command: str, names: Sequence[str], inputs: Iterable[Path], *, force: bool = False
) -> Iterator[Delivery]:
    """The one ending of a command: its files appear together, then JSON alone, or the text and the files that were written.

    ``inputs`` and all files that they name are never overwritten. Results of other inputs or options are not replaced without
    ``--force``: the new ones go beside them (``folder/2``), and a sentence says why.
    """
    written, beside = list[str](), ""
    if folder is None:
        delivery = Delivery(None, Path())
        yield delivery
    else:
        from piga.text_files import files_named_in

        read = [file for path in inputs for file in files_named_in(path)]
        replaces = force or Ending.force
        with results(folder, command, names, read, options=Ending.options, force=replaces) as made:
            stage, place, why = made
            delivery = Delivery(place, stage)
            yield delivery
            paths = dict.fromkeys(path for name in names for path in sorted(stage.glob(name)))
            written = [f"wrote {place / path.relative_to(stage)}" for path in paths]
        if why:
            beside = f"{folder.resolve().name} holds {why}: the new ones are in {place}; --force replaces the old ones"
    if not Ending.as_json:
        text = delivery._text()
        say("\n".join([text, *written] if text else written))
    elif delivery._document is not None:
        print_json(delivery._document())
    if beside:
        note(beside)


def deliver_file(target: Path, command: str, inputs: Iterable[Path]) -> AbstractContextManager[Delivery]:
    """The same for one file that the user names: it is written at ``delivery / target.name``."""
    return deliver(target.parent, f"{command}-{target.stem[:40]}", [glob.escape(target.name)], inputs)


def day_in(text: str, option: str) -> dt.datetime:
    """The time of an option, UTC where it names no zone; of a date its begin."""
    try:
        time = dt.datetime.fromisoformat(text)
    except ValueError:
        raise PigaError(f"{option} {text}: is not a date", remedy="write e.g. 2027-06-01") from None
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
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

            columns = ("{task.description}", BarColumn(None), TimeElapsedColumn(), TimeRemainingColumn())
            with Progress(*columns, console=Console(stderr=True), transient=True, expand=True) as drawn:
                task = drawn.add_task(title, total=total)
                WHEN_COMPILED[:] = [lambda: drawn.update(task, description=f"{title}; {FIRST_USE}")]
                yield lambda done, total, what: drawn.update(
                    task, completed=done, total=total, description=f"{title}: {what}" if what else title
                )
        else:
            WHEN_COMPILED[:] = [partial(note, f"{title}; {FIRST_USE}")]
            yield lambda *_: None
    except KeyboardInterrupt as stop:
        stop.add_note(f"{DOING}{title}")
        raise


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

BOTH, JSON, FORCE = ("force", "as_json"), ("as_json",), ("force",)
"""Options of the ending of a command."""
_ENDINGS = {
    "force": Annotated[bool, flag("--force", "Replace existing results.")],
    "as_json": Annotated[bool, flag("--json", "Print one JSON document and nothing else.")],
}

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


def _names_files(value: Any) -> bool:
    return all(isinstance(one, Path) for one in (value if isinstance(value, list) else [value]))


class App(typer.Typer):
    """A Typer application: its groups are :class:`CommandGroup`, its commands :class:`PlainCommand`."""

    def __init__(self, name: str, words: str, **more: Any) -> None:
        settings: dict[str, Any] = {"no_args_is_help": True, "rich_markup_mode": None, "add_completion": False}
        super().__init__(name=name, help=words, cls=CommandGroup, **(settings | more))

    def command(
        self, name: str | None = None, ends: Sequence[str] = BOTH, **more: Any
    ) -> Callable[[Command], Command]:
        """Decorator that adds a command. ``ends`` are the options of its ending, which come last."""

        def added(function: Command) -> Command:
            @wraps(function)
            def run(**values: Any) -> None:
                Ending.force, Ending.as_json = (values.pop(one, False) for one in BOTH)
                given = {one: value for one, value in values.items() if value != own.parameters[one].default}
                Ending.options = tuple(
                    f"{one}={value}" for one, value in given.items() if not _names_files(value)
                )
                function(**values)

            own = inspect.signature(function, eval_str=True)
            options = [
                inspect.Parameter(one, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=_ENDINGS[one])
                for one in ends
            ]
            run.__signature__ = own.replace(parameters=[*own.parameters.values(), *options])  # type: ignore[attr-defined]
            super(App, self).command(name, cls=PlainCommand, **more)(run)
            return function

        return added
