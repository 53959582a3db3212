"""Progress of long calls, and how a caller stops them.

A long call takes ``progress``: a function of (done, total, what) that is called before each step. If it returns False, the
call stops with :class:`piga.CancelledError`. Nothing is half done then, nor after Ctrl-C (``KeyboardInterrupt``).
"""

from __future__ import annotations

from collections.abc import Callable

from piga.errors import CancelledError

Progress = Callable[[float, float, str], bool | None]
"""Function of the work done, the whole work, and what comes now. It returns False to stop the call."""

FIRST_USE = "first use: compiling, once for all commands, up to half a minute"
"""Said while kernels are compiled."""

WHEN_COMPILED: list[Callable[[], None]] = []
"""Called once when the first kernel of this process is compiled, not only loaded."""


def report(
    progress: Progress | None,
    done: float,
    total: float,
    what: str,
    remedy: str = "start again; nothing was written",
) -> None:
    """Tell ``progress`` where a call is. ``remedy`` says what to do after a stop."""
    if progress is not None and progress(done, total, what) is False:
        raise CancelledError(f"stopped before: {what}", remedy=remedy)


class Steps:
    """The steps of one call, reported in order to the caller's function, if there is one. ``total`` is their number."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done, self._parts = progress, total, 0, 0

    def __call__(self, what: str) -> None:
        """The next step begins."""
        report(self._progress, self._done, self._total, what)
        self._done, self._parts = self._done + 1, 0

    def within(self, share: float, what: str) -> None:
        """A part of the present step begins; ``share`` of the step is done (0 to 1)."""
        report(self._progress, self._done - 1 + share, self._total, what)

    def part(self, what: str) -> None:
        """The next part of the present step begins, where nobody knows how many there are."""
        self.within(self._parts / (self._parts + 1.0), what)
        self._parts += 1

    def finish(self) -> None:
        """All steps are done."""
        report(self._progress, self._total, self._total, "done")


SILENT = Steps(None, 0)
"""Steps that nobody hears of."""
