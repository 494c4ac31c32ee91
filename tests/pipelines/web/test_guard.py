"""The guard: a page answers under its own name, changes nothing for another page, and takes small requests."""

import asyncio

import pytest
from asgi_client import ADDRESS, Client
from starlette.responses import PlainTextResponse

from pipelines.web.guard import HEADERS, LOCAL, Guard


async def page(scope, receive, send) -> None:
    if scope["type"] == "http":
        await PlainTextResponse("through", headers={"referrer-policy": "no-referrer"})(scope, receive, send)
    else:
        await send({"type": "websocket.accept"})


GUARD = Guard(page, LOCAL | {"hdt.example.com"}, max_body=10, post_only=["/graphql"])
OWN = {"origin": ADDRESS}


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("GET", "/", {"host": "evil.example:3000"}, 403),
        ("GET", "/", {"host": "127.0.0.1.evil.example"}, 403),
        ("GET", "/", {"host": "127.0.0.1:999999"}, 403),
        ("GET", "/", {"host": ""}, 403),
        ("GET", "/", {"origin": "http://127.0.0.1:8000"}, 403),
        ("POST", "/", {}, 403),
        ("POST", "/", {"origin": "null"}, 403),
        ("POST", "/", {"origin": "http://evil.example"}, 403),
        ("POST", "/", {"origin": "http://evil.example", "host": "evil.example"}, 403),
        ("POST", "/", {"origin": "http://127.0.0.1", "host": "127.0.0.1:3000"}, 403),
        ("PUT", "/", OWN, 405),
        ("DELETE", "/", OWN, 405),
        ("OPTIONS", "/", {}, 405),
        ("GET", "/graphql?query=mutation", {}, 405),
        ("HEAD", "/graphql", {}, 405),
        ("POST", "/", OWN | {"content-length": "11"}, 413),
        ("POST", "/", OWN | {"content-length": "9" * 5000}, 413),
        ("POST", "/", OWN | {"content-length": "-1"}, 413),
        ("GET", "/", {"content-length": "11"}, 413),
        ("GET", "/", {}, 200),
        ("GET", "/a?b=c", {"host": "localhost:8080"}, 200),
        ("GET", "/", {"host": "[::1]:3000"}, 200),
        ("GET", "/", {"origin": "http://LOCALHOST:1", "host": "LOCALHOST:1"}, 200),
        ("POST", "/graphql", OWN, 200),
        ("POST", "/", {"origin": "https://hdt.example.com", "host": "hdt.example.com"}, 200),
    ],
)
def test_guard_judges_each_request(method, path, headers, status):
    body = b"x" * 10 if method == "POST" else b""
    assert Client(GUARD).ask(method, path, headers=headers, content=body).status_code == status


def test_endless_body_is_refused():
    async def chunks():
        yield b"x"

    assert Client(GUARD).post("/", content=chunks()).status_code == 413


@pytest.mark.parametrize("headers", [{}, {"host": "evil.example"}])
def test_every_answer_has_headers(headers):
    expected = {k: v for k, v in HEADERS.items() if k != "referrer-policy"}
    assert expected.items() <= dict(Client(GUARD).get("/", headers=headers).headers).items()


def test_page_keeps_its_own_header():
    assert Client(GUARD).get("/").headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize(
    ("origin", "opens"), [(b"http://127.0.0.1:3000", True), (b"http://evil.example", False), (None, False)]
)
def test_foreign_page_opens_no_socket(origin, opens):
    replies = []

    async def send(message) -> None:
        replies.append(message["type"])

    headers = [(b"host", b"127.0.0.1:3000"), *([(b"origin", origin)] if origin else [])]
    scope = {"type": "websocket", "path": "/graphql", "query_string": b"", "headers": headers}
    asyncio.run(GUARD(scope, None, send))
    assert replies == ["websocket.accept" if opens else "websocket.close"]
