"""What stands before the page of cases: its own name only, small requests, and no end of guesses."""

import time
from collections import deque
from collections.abc import Collection

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipelines.web.address import is_stranger

MAX_BODY = 64 << 10
TRIES, TRIES_OF_ADDRESS, WINDOW_S = 5, 50, 300.0
"""Tries to log in with a name, and from an address, before it waits; and for how long they count. [-, -, s]"""
_KNOWN = 10_000  # names and addresses that are remembered
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


class Guard:
    """Lets through what came by one of the `names`, with a body that is small and told beforehand."""

    def __init__(self, app: ASGIApp, names: Collection[str]) -> None:
        self.app, self.names = app, frozenset(names)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or let the page do it."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return
        headers = Headers(scope=scope)
        if is_stranger(headers, self.names):
            await PlainTextResponse("this page answers under its own address only", 403)(scope, receive, send)
            return
        length = headers.get("content-length", "0")
        told = scope["method"] != "POST" or "content-length" in headers
        if not told or not length.isdecimal() or int(length) > MAX_BODY:
            await PlainTextResponse("too large", 413)(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                found = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    found.setdefault(name, value)
            await send(message)

        await self.app(scope, receive, with_headers)


class Guesses:
    """Wrong passwords of late, by name and by address; many people may share an address."""

    def __init__(self) -> None:
        self._held: dict[tuple[str, str], deque[float]] = {}

    def too_many(self, name: str, address: str) -> bool:
        """Whether this name or this address has to wait."""
        return len(self._late("name", name)) >= TRIES or len(self._late("address", address)) >= TRIES_OF_ADDRESS

    def note(self, name: str, address: str) -> None:
        """One more try."""
        if len(self._held) > _KNOWN:  # who floods it with names only forgets the oldest
            for key in list(self._held)[: _KNOWN // 10]:
                del self._held[key]
        for kind, who in (("name", name), ("address", address)):
            self._late(kind, who).append(time.monotonic())

    def forget(self, name: str) -> None:
        """The right password came."""
        self._held.pop(("name", name), None)

    def _late(self, kind: str, who: str) -> deque[float]:
        late = self._held.setdefault((kind, who), deque(maxlen=TRIES_OF_ADDRESS))
        while late and late[0] < time.monotonic() - WINDOW_S:
            late.popleft()
        return late
