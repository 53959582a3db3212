"""The progress bar of all commands, drawn with rich."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.table import Column
from rich.text import Text

from piga.progress import FIRST_USE

WIDE = 90
"""Columns of a terminal from which on the bar is long."""


class _Time(ProgressColumn):
    """Time passed; with a known total, also the time left."""

    def render(self, task: Task) -> Text:
        """The column of one line."""
        passed = f"{task.elapsed or 0.0:.0f} s"
        left = task.time_remaining
        return Text(passed if not task.total or left is None else f"{passed}, {left:.0f} s left", style="cyan")


class _Compiling(ProgressColumn):
    """Says that kernels are compiled."""

    def render(self, _task: Task) -> Text:
        """The column of one line."""
        jit = sys.modules.get("piga._kernels.jit")
        compiling = getattr(
            jit, "compiling", None
        )  # missing while another thread is still importing the module
        return Text(FIRST_USE if compiling is not None and compiling() else "")


class Bar:
    """A line on stderr that shows what is done and how far it is. It disappears at the end."""

    def __init__(self, title: str, total: int | None = None) -> None:
        console = Console(stderr=True)
        columns = (
            SpinnerColumn("line"),
            TextColumn("{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)),
            BarColumn(24 if console.width >= WIDE else 8),
            _Time(table_column=Column(no_wrap=True)),
            _Compiling(table_column=Column(no_wrap=True, overflow="ellipsis")),
        )
        self._bar = Progress(*columns, console=console, transient=True)
        self._title = title
        self._task = self._bar.add_task(title, total=total)

    def __enter__(self) -> Bar:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def show(self, done: float, total: float | None, what: str) -> None:
        """``done`` of ``total`` are done, and ``what`` comes now."""
        self._bar.update(
            self._task,
            completed=done,
            total=total,
            description=f"{self._title}: {what}" if what else self._title,
        )
