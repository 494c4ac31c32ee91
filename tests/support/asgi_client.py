"""A browser's part in a conversation with an ASGI application, one request after the other."""

import asyncio
from typing import Any

import httpx
from starlette.types import ASGIApp

ADDRESS = "http://127.0.0.1"


class Client:
    """Keeps its cookies, follows no redirect, names its origin where it posts; sends `headers` with every request."""

    def __init__(self, app: ASGIApp, headers: dict[str, str] | None = None, address: str = "127.0.0.1") -> None:
        transport = httpx.ASGITransport(app, client=(address, 40_000))
        self._http = httpx.AsyncClient(transport=transport, base_url=ADDRESS, headers=headers)

    @property
    def cookies(self) -> httpx.Cookies:
        return self._http.cookies

    def ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        return asyncio.run(self._http.request(method, path, **options))

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.ask("GET", path, **options)

    def post(self, path: str, headers: dict[str, str] | None = None, **options: Any) -> httpx.Response:
        return self.ask("POST", path, headers={"origin": ADDRESS} | (headers or {}), **options)
