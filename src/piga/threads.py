"""One thread of linear algebra, because the matrices of piga are small.

With more, the threads of OpenBLAS wait for each other: on a busy machine of two cores a calibration then takes ten times
the processor time. Needs the package ``threadpoolctl`` (extra ``lab``); without it nothing is changed.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from threading import Lock, current_thread, main_thread
from typing import Any

_LOCK = Lock()
_HELD: list[Any] = [0, None]
"""Number of nested uses, and the limit in force. The limit holds for the whole process."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Let NumPy and SciPy use one thread of linear algebra inside; the former number is restored at the end.

    ``@one_thread()`` before a function does so whenever the function runs.
    """
    with _LOCK:
        if _HELD[0] == 0:
            with suppress(ImportError):  # nothing is changed without the package
                _HELD[1] = _libraries().limit(limits=1, user_api="blas")
        _HELD[0] += 1
    try:
        yield
    finally:
        with _LOCK:
            _HELD[0] -= 1
            if _HELD[0] == 0 and _HELD[1] is not None:
                limit, _HELD[1] = _HELD[1], None
                limit.restore_original_limits()


@cache
def _libraries() -> Any:
    """The libraries of linear algebra. SciPy is loaded first: it brings one of its own."""
    import scipy.linalg  # noqa: F401 - its library of linear algebra must be there to be found
    from threadpoolctl import ThreadpoolController

    with _stop_later():
        return ThreadpoolController()


@contextmanager
def _stop_later() -> Iterator[None]:
    """Hold Ctrl-C back: Python prints and forgets what is raised inside a callback of C, as the search for libraries has."""
    before = signal.getsignal(signal.SIGINT)
    if before is None or current_thread() is not main_thread():
        yield
        return
    stops: list[Any] = []
    signal.signal(signal.SIGINT, lambda *stop: stops.append(stop))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if stops and callable(before):
            before(*stops[0])
