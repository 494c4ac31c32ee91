"""Guard a page: refuse foreign hosts, foreign origins and large bodies, and require a sign-in.

Any page that is open in the same browser can send requests to this machine. It can choose neither the `Host` by which
the browser reached this server nor the `Origin` that the browser adds, so both must be the page's own, and a request
that changes anything must name its origin: no form or script of another page can.
"""

import re
import socket
from collections.abc import Collection
from http import HTTPStatus

import uvicorn
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipelines.web.sign_in import SignIn
from pipelines.web.timed_requests import TimedRequests

LOCAL = frozenset({"127.0.0.1", "localhost", "[::1]"})
METHODS = ("GET", "HEAD", "POST")
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}


class Guard:
    """Middleware that passes requests to own host names from signed-in people; sets `request.state.person`.

    Parameters
    ----------
    app : ASGI application
        The page.
    names : collection of str
        Names, without a port, by which this machine or the proxy before it is called.
    sign_in : SignIn, optional
        Identifies the person; without one anybody may use the page.
    max_body : int, optional
        Limit of a request's body [bytes]; without it, none.
    post_only : collection of str
        Paths that answer POST alone.
    """

    def __init__(
        self, app: ASGIApp, names: Collection[str], sign_in: SignIn | None = None, max_body: int | None = None,
        post_only: Collection[str] = (),
    ) -> None:  # fmt: skip
        self.app, self.names, self.sign_in = app, frozenset(names), sign_in
        self.max_body, self.post_only = max_body, frozenset(post_only)

    def serve(self, sock: socket.socket) -> None:
        """Serve the page until the process is stopped."""
        config = uvicorn.Config(self, http=TimedRequests, log_level="warning", server_header=False, proxy_headers=False)
        uvicorn.Server(config).run(sockets=[sock])

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a refused request, or pass it to the page."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        response = self._response(scope)
        if response is None:
            await self.app(scope, receive, send_guarded)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await response(scope, receive, send_guarded)

    def _response(self, scope: Scope) -> Response | None:
        """Return the answer to a request that the page must not get; None where it may."""
        connection = HTTPConnection(scope)
        if refusal := self._refusal(scope, connection.headers):
            return PlainTextResponse(f"{refusal[1]}\n", refusal[0])
        person = self.sign_in(connection) if self.sign_in else None
        if isinstance(person, Response):
            return person
        scope.setdefault("state", {})["person"] = person
        return None

    def _refusal(self, scope: Scope, headers: Headers) -> tuple[int, str] | None:
        """Return status and reason where a request is refused whoever sends it."""
        method = scope.get("method", "GET")  # a web socket begins with one
        if is_foreign(headers, self.names, needs_origin=method == "POST" or scope["type"] == "websocket"):
            return HTTPStatus.FORBIDDEN, "this page answers under its own address only; --name adds a proxy's"
        if method not in METHODS or (method != "POST" and scope["type"] == "http" and scope["path"] in self.post_only):
            return HTTPStatus.METHOD_NOT_ALLOWED, "use POST" if method in METHODS else "no such method"
        if self.max_body is not None and not _is_small(method, headers, self.max_body):
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a request declares its length, at most {self.max_body} bytes"
        return None


def is_foreign(headers: Headers, names: Collection[str], *, needs_origin: bool) -> bool:
    """Test for another host name than ours, another page's origin, or a missing origin where one is needed."""
    hosts = headers.getlist("host")
    origin = headers.get("origin")
    if len(hosts) != 1 or re.sub(r":\d{1,5}$", "", hosts[0]).lower() not in names:
        return True
    return needs_origin if origin is None else origin not in {f"http://{hosts[0]}", f"https://{hosts[0]}"}


def _is_small(method: str, headers: Headers, max_body: int) -> bool:
    """Test that the declared length of the body is within the limit."""
    length = headers.get("content-length", "" if method == "POST" else "0")
    return re.fullmatch(r"[0-9]{1,9}", length) is not None and int(length) <= max_body
