"""Threads for long records; work on short records is done at once."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import cache
from typing import Any

SHORT = 1 << 16
"""Rows below which handing work to a thread takes longer than the work."""


class _AtOnce(Executor):
    """An executor that does the work immediately."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class _Shared(ThreadPoolExecutor):
    """Threads kept for the next user; starting a thread takes as long as one block of work."""

    def __exit__(self, *_error: object) -> None:
        """Keep the threads."""


@cache
def _shared(threads: int) -> _Shared:
    return _Shared(threads)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_shared.cache_clear)


def workers(rows: int, threads: int) -> Executor:
    """Executor for work on a record of ``rows`` rows; one thread does the work in order of submission."""
    return _AtOnce() if rows <= SHORT else _shared(threads)


def beside(rows: int) -> Executor:
    """Executor for one task on a record that itself submits work to :func:`workers`."""
    return _AtOnce() if rows <= SHORT else ThreadPoolExecutor(1)
