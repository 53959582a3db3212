"""Progress of long calls, and how a caller stops them.

A long call takes ``progress``: a function of (done, total, what) that is called before each step. If it returns False, the
call stops with :class:`piga.CancelledError`. Nothing is half done then: results are made in memory or written beside their
target. Ctrl-C (``KeyboardInterrupt``) stops a call in the same way, between two steps or within one.
"""

from __future__ import annotations

from collections.abc import Callable

from piga.errors import CancelledError

Progress = Callable[[float, float, str], bool | None]
"""Function of the work done, the whole work, and what comes now. It returns False to stop the call."""


def report(progress: Progress | None, done: float, total: float, what: str) -> None:
    """Tell ``progress`` where a call is.

    Raises
    ------
    CancelledError
        If it returns False.
    """
    if progress is not None and progress(done, total, what) is False:
        raise CancelledError(f"stopped before: {what}", remedy="start again; nothing was written")


class Steps:
    """The steps of one call, reported in order.

    Parameters
    ----------
    progress:
        The caller's function, or None.
    total:
        Number of steps.
    """

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def __call__(self, what: str) -> None:
        """The next step begins."""
        report(self._progress, self._done, self._total, what)
        self._done += 1

    def finish(self) -> None:
        """All steps are done."""
        report(self._progress, self._total, self._total, "done")
