"""A connection of the server: it ends if its browser keeps it waiting for a request, and when the server ends."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol

LONGEST_HEAD = 20.0
"""Time [s] that a connection may take for the head of its next request. uvicorn itself sets no limit."""
LAST = 1.0
"""Time [s] that answers have to reach their readers when the server ends."""


class Connection(H11Protocol):
    """A connection that nobody can hold without a request."""

    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first head."""
        super().connection_made(transport)
        self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Part of a request. More parts of the same head get no more time."""
        super().data_received(data)
        if not self._is_idle():
            self._stop_waiting()

    def on_response_complete(self) -> None:
        """Wait for the next head; it may have come already."""
        super().on_response_complete()
        if self._is_idle():
            self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Nothing is waited for."""
        self._stop_waiting()
        super().connection_lost(exc)

    def shutdown(self) -> None:
        """End at once if no request is in progress, and soon if one is.

        A TLS connection would otherwise stay open until the browser agrees to its end.
        """
        if self._is_idle() and not self.transport.get_write_buffer_size():
            self.transport.abort()
            return
        super().shutdown()
        self.loop.call_later(LAST, self.transport.abort)

    def _is_idle(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def _wait_for_head(self) -> None:
        self._stop_waiting()
        self._late = self.loop.call_later(LONGEST_HEAD, self.transport.abort)

    def _stop_waiting(self) -> None:
        if self._late is not None:
            self._late.cancel()
            self._late = None
