"""A connection that does not finish its request is closed, and one that waits for its answer is not."""

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
import uvicorn
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse

from pipelines.web import timed_requests
from pipelines.web.guard import LOCAL, Guard

HEAD = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n"
SLOW = HEAD.replace(b"/ ", b"/slow ", 1) + b"\r\n"
POST = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\nContent-Length: 9\r\n\r\nx"
REQUEST_S = 0.2


async def page(scope, receive, send) -> None:
    with suppress(ClientDisconnect):
        await Request(scope, receive).body()
    if scope["path"] == "/slow":
        await asyncio.sleep(4 * REQUEST_S)
    await PlainTextResponse("answer")(scope, receive, send)


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    """Port of a guarded page."""
    servers = []
    serve = uvicorn.Server.run

    def run(server: uvicorn.Server, sockets: list[socket.socket]) -> None:
        servers.append(server)
        serve(server, sockets)

    with pytest.MonkeyPatch.context() as patch, socket.create_server(("127.0.0.1", 0)) as sock:
        patch.setattr(timed_requests, "REQUEST_S", REQUEST_S)
        patch.setattr(uvicorn.Server, "run", run)
        thread = threading.Thread(target=Guard(page, LOCAL).serve, args=(sock,))
        thread.start()
        yield sock.getsockname()[1]
        servers[0].should_exit = True
        thread.join()


def is_closed(client: socket.socket) -> bool:
    """Wait until the server closes a connection; false where it sends something instead."""
    try:
        return client.recv(65536) == b""
    except ConnectionResetError:
        return True


@pytest.mark.parametrize("content", [b"", b"GET", HEAD, POST], ids=["nothing", "line", "head", "body"])
def test_unfinished_request_is_closed(port, content):
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(content)

        assert is_closed(client)


def test_second_unfinished_request_is_closed(port):
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(HEAD + b"\r\n")
        assert client.recv(65536).endswith(b"answer")
        client.sendall(HEAD)

        assert is_closed(client)


def test_drip_of_bytes_is_closed(port):
    n_bytes = 0
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client, suppress(ConnectionError):
        for n_bytes in range(200):  # noqa: B007  # read below
            client.sendall(b"x")
            time.sleep(REQUEST_S / 4)

    assert n_bytes < 100


def test_slow_answer_is_awaited(port):
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(SLOW)

        assert client.recv(65536).endswith(b"answer")
