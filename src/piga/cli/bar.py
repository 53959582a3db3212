"""The progress bar of all commands, drawn with rich."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.table import Column
from rich.text import Text

from piga.progress import FIRST_USE, WHEN_COMPILED

_WIDE = 90
"""Columns of a terminal from which on the bar is long."""


class _Time(ProgressColumn):
    """Time passed; with a known total, also the time left."""

    def render(self, task: Task) -> Text:
        """The column of one line."""
        passed, left = f"{task.elapsed or 0.0:.0f} s", task.time_remaining
        return Text(passed if not task.total or left is None else f"{passed}, {left:.0f} s left", style="cyan")


@contextmanager
def bar(title: str, total: int | None) -> Iterator[Callable[[float, float | None, str], None]]:
    """A line on stderr that shows what is done and how far it is. It disappears at the end."""
    console = Console(stderr=True)
    words = TextColumn("{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1))
    share, time = BarColumn(24 if console.width >= _WIDE else 8), _Time(table_column=Column(no_wrap=True))
    with Progress(SpinnerColumn("line"), words, share, time, console=console, transient=True) as drawn:
        task = drawn.add_task(title, total=total)

        def show(done: float, total: float | None, what: str) -> None:
            said = f"{title}: {what}" if what else title
            drawn.update(task, completed=done, total=total, description=said)

        WHEN_COMPILED[:] = [lambda: drawn.update(task, description=f"{title}; {FIRST_USE}")]
        yield show
