"""Who may do what at Dagster's page, which by itself does what anybody asks: a gate before its ASGI application.

Any web page that is open in the same browser can send requests to this machine. It can choose neither the `Host` by
which the browser found this server nor the `Origin` that the browser adds, so both must be the page's own. What changes
anything must come with the token of the home, and only a POST may: the browser has the token as a cookie once the
address that `hdt ui` prints was opened, a program sends it as `X-HDT-Token`.
"""

import json
import secrets
from collections.abc import Collection
from pathlib import Path
from urllib.parse import urlencode

from graphql import GraphQLError, OperationDefinitionNode, OperationType, parse
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipelines.storage.files import kept_secret
from pipelines.web.address import is_stranger

COOKIE, HEADER = "hdt_token", "x-hdt-token"
_NEEDS_TOKEN = "only with the home's token may anything be changed; open the page by the address that `hdt ui` prints"


def token_of(home: Path) -> str:
    """The home's token: whoever may read this file in the home may change what its page shows."""
    return kept_secret(home / ".page_token", 32)


class Gate:
    """The page for who came by one of the `names`; without a token it can only be looked at.

    Parameters
    ----------
    app : ASGI application
        Dagster's.
    names : collection of str
        Names, without a port, by which this machine or the proxy before it is called.
    token : str or None
        What changes must come with; with None none is let through.
    """

    def __init__(self, app: ASGIApp, names: Collection[str], token: str | None) -> None:
        self.app, self.names, self.token = app, frozenset(names), token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or let Dagster do it."""
        if scope["type"] == "websocket":  # subscriptions, which only tell
            if is_stranger(Headers(scope=scope), self.names):
                await send({"type": "websocket.close", "code": 1008})
                return
        elif scope["type"] == "http":
            request = Request(scope, receive)
            if answer := self._at_the_door(request) or await self._within(request):
                await answer(scope, receive, send)
                return
            if request.method == "POST":
                receive = _again(await request.body(), receive)
        await self.app(scope, receive, send)

    def _at_the_door(self, request: Request) -> Response | None:
        """Turn away strangers and methods that nothing here needs; take a token that an address brings."""
        if is_stranger(request.headers, self.names):
            return _refused(403, "this page answers under its own address only; `hdt ui --name` adds a proxy's")
        if request.method not in {"GET", "HEAD", "POST"} or (
            request.method != "POST" and request.url.path == "/graphql"
        ):
            return _refused(405, "questions are asked by POST")
        if "token" in request.query_params and request.method == "GET":
            return self._welcome(request)
        return None

    def _welcome(self, request: Request) -> Response:
        """Let the browser keep the token, and its address forget it."""
        if not self._is_ours(request.query_params["token"]):
            return _refused(403, "that is not this home's token; `hdt ui` prints the address that holds it")
        rest = urlencode([(k, v) for k, v in request.query_params.multi_items() if k != "token"])
        path = "/" + request.url.path.lstrip("/")  # two slashes would lead to another machine
        answer = RedirectResponse(f"{path}?{rest}" if rest else path, status_code=303)
        answer.set_cookie(COOKIE, request.query_params["token"], httponly=True, samesite="strict", path="/")
        return answer

    async def _within(self, request: Request) -> Response | None:
        """Questions are free; whatever else is posted must come with the token."""
        if request.method != "POST":
            return None
        if request.url.path == "/graphql":
            if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
                return _refused(415, "questions are asked as application/json")
            if only_asks(await request.body()):
                return None
        brought = request.headers.get(HEADER) or request.cookies.get(COOKIE) or ""
        return None if self._is_ours(brought) else _refused(403, _NEEDS_TOKEN)

    def _is_ours(self, token: str) -> bool:
        return self.token is not None and secrets.compare_digest(token.encode(), self.token.encode())


def only_asks(body: bytes) -> bool:
    """Whether a GraphQL request changes nothing, whichever of its operations is run."""
    try:
        asked = parse(json.loads(body)["query"])
    except GraphQLError:  # Dagster's own parser will say where it is wrong
        return True
    except (ValueError, KeyError, TypeError, RecursionError):
        return False
    operations = [d.operation for d in asked.definitions if isinstance(d, OperationDefinitionNode)]
    return OperationType.MUTATION not in operations


def _refused(status: int, why: str) -> Response:
    """In the form in which the page expects what went wrong."""
    return JSONResponse({"errors": [{"message": why}]}, status_code=status)


def _again(body: bytes, receive: Receive) -> Receive:
    """The body that was read, once more."""
    first: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def answer() -> Message:
        return first.pop() if first else await receive()

    return answer
