"""Threads where they pay: short records are worked on at once, long ones by a pool."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache
from typing import Any

SHORT = 1 << 16
"""Rows up to which handing work to a thread takes longer than the work."""


class _AtOnce(Executor):
    """An executor that does the work when it is handed in."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class _Shared(ThreadPoolExecutor):
    """Threads that are kept for the next user: starting one takes as long as a block of work."""

    def __exit__(self, *_error: object) -> None:
        """Leave the threads waiting."""


@cache
def _shared(threads: int) -> _Shared:
    return _Shared(threads)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_shared.cache_clear)


def workers(rows: int, threads: int) -> Executor:
    """Executor for work on a record of so many rows; with one thread, work is done in the order it is handed in."""
    return _AtOnce() if rows <= SHORT else _shared(threads)


def beside(rows: int) -> Executor:
    """Executor for one piece of work on a record that itself hands work to :func:`workers`."""
    return _AtOnce() if rows <= SHORT else ThreadPoolExecutor(1)
