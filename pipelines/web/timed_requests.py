"""Close connections that do not finish a request: uvicorn would wait for its rest without end."""

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_S = 20.0
"""Time for a request's head, and again for its body; twice that on a connection that has been used before. [s]"""
_SENDING = (h11.IDLE, h11.SEND_BODY)


class TimedRequests(H11Protocol):
    """HTTP/1.1 whose requests arrive in `REQUEST_S`; an answer may take longer."""

    def __init__(self, *settings: Any, **named_settings: Any) -> None:
        super().__init__(*settings, **named_settings)
        self._check: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Await the first request."""
        super().connection_made(transport)
        self._check_later()

    def connection_lost(self, exc: Exception | None) -> None:
        """End the checks."""
        super().connection_lost(exc)
        if self._check:
            self._check.cancel()

    def _check_later(self) -> None:
        self._check = self.loop.call_later(REQUEST_S, self._close_if_unchanged, self.cycle, self.conn.their_state)

    def _close_if_unchanged(self, request: object, state: object) -> None:
        """Close the connection where its client is still sending what it was at the last check."""
        if self not in self.connections:  # it is a web socket now
            return
        if state in _SENDING and self.cycle is request and self.conn.their_state is state:
            self.transport.abort()
        else:
            self._check_later()
