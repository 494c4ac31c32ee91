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
from pipelines.orchestration.runs import LOCATION, open_instance
from pipelines.web.address import LOCAL
from pipelines.web.gate import Gate, token_of

_DAEMON_ENDS_S = 20


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
    with open_instance(home) as instance, application(instance, LOCATION, read_only) as app:
        yield Gate(app, LOCAL | set(names), None if read_only else token_of(home))


@contextmanager
def _daemon() -> Iterator[None]:
    """What runs schedules, sensors and queued runs."""
    started = subprocess.Popen(daemon_command(LOCATION))
    try:
        yield
    finally:
        started.terminate()
        try:
            started.wait(_DAEMON_ENDS_S)
        except subprocess.TimeoutExpired:
            started.kill()
