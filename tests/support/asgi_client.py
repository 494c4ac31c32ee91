"""A browser's part in a conversation with an ASGI application, one request after the other."""

import asyncio
from typing import Any

import httpx
from starlette.types import ASGIApp


class Client:
    """Keeps its cookies; follows no redirect."""

    def __init__(self, app: ASGIApp) -> None:
        self._http = httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://127.0.0.1")

    @property
    def cookies(self) -> httpx.Cookies:
        return self._http.cookies

    def get(self, path: str, **asked: Any) -> httpx.Response:
        return asyncio.run(self._http.get(path, **asked))

    def post(self, path: str, **asked: Any) -> httpx.Response:
        return asyncio.run(self._http.post(path, **asked))
