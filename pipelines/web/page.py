"""Dagster's page behind its gate, and Dagster's daemon beside it."""

import os
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import uvicorn
from starlette.types import ASGIApp

from dagster_batched.webserver import application, daemon_command
from pipelines.orchestration.runs import open_instance
from pipelines.web.gate import LOCAL, Gate, token_of

_DEFINITIONS = "pipelines.definitions"
_DAEMON_ENDS_S = 20


def listening(address: str, port: int) -> socket.socket:
    """A socket at an address; OSError where it is taken."""
    sock = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind((address, port))
    sock.listen()  # who comes before the server is ready waits
    return sock


def serve(
    home: Path,
    landing: Path,
    sock: socket.socket,
    say: Callable[[str], None],
    names: tuple[str, ...] = (),
    read_only: bool = False,
    daemon: bool = True,
) -> None:
    """Serve the page until someone stops it; `say` is told the address that lets one in."""
    os.environ |= {"HDT_HOME": str(home), "HDT_LANDING": str(landing), "DAGSTER_HOME": str(home / "dagster")}
    os.chdir(home)  # dagster would read a dagster.yaml that lies in the folder it is started from
    with page(home, names, read_only) as app, _daemon() if daemon and not read_only else nullcontext():
        address = f"http://127.0.0.1:{sock.getsockname()[1]}/"
        say(address if read_only else f"{address}?token={token_of(home)}")
        uvicorn.Server(uvicorn.Config(app, log_level="warning")).run(sockets=[sock])


@contextmanager
def page(home: Path, names: tuple[str, ...], read_only: bool) -> Iterator[ASGIApp]:
    """Dagster's application with the gate before it."""
    with open_instance(home) as instance, application(instance, _DEFINITIONS, read_only) as app:
        yield Gate(app, LOCAL | set(names), None if read_only else token_of(home))


@contextmanager
def _daemon() -> Iterator[None]:
    """What runs schedules, sensors and queued runs."""
    started = subprocess.Popen(daemon_command(_DEFINITIONS))
    try:
        yield
    finally:
        started.terminate()
        try:
            started.wait(_DAEMON_ENDS_S)
        except subprocess.TimeoutExpired:
            started.kill()
