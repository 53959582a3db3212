"""Threads where they pay: short records are worked on at once, long ones by a pool."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any

SHORT = 1 << 16
"""Rows up to which handing work to a thread takes longer than the work."""


class _AtOnce(Executor):
    """An executor that does the work when it is handed in."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


def workers(rows: int, threads: int) -> Executor:
    """Executor for work on a record of so many rows."""
    return _AtOnce() if rows <= SHORT else ThreadPoolExecutor(threads)
