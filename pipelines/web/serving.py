"""The page of cases behind a socket."""

import socket
from pathlib import Path

import uvicorn

from pipelines.web.address import LOCAL
from pipelines.web.casebook import application


def serve_cases(home: Path, sock: socket.socket, names: tuple[str, ...] = (), https: bool = False) -> None:
    """Serve the page until someone stops it."""
    app = application(home, LOCAL | set(names), https)
    config = uvicorn.Config(app, log_level="warning", server_header=False, proxy_headers=False)
    uvicorn.Server(config).run(sockets=[sock])
