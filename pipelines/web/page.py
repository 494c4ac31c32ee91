"""Dagster's page behind the guard, and Dagster's daemon beside it."""

import os
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from dagster_batched.webserver import application, daemon_command
from pipelines.orchestration.runs import LOCATION, open_instance
from pipelines.web.guard import LOCAL, Guard
from pipelines.web.roles import Person
from pipelines.web.sign_in import LocalToken

_DAEMON_ENDS_S = 20


def serve(
    home: Path,
    landing: Path,
    sock: socket.socket,
    say: Callable[[str], None],
    names: tuple[str, ...] = (),
    read_only: bool = True,
    daemon: bool = True,
) -> None:
    """Serve the page until someone stops it.

    Read only, anybody who reaches it may look. Else whoever comes must bring a token, and Dagster's daemon runs too.

    Parameters
    ----------
    home, landing : Path
        What the page's assets work on.
    sock : socket
        Where it listens.
    say : callable
        Gets the address, with the token where one is needed.
    names : tuple of str
        Names, without a port, by which a proxy calls this machine.
    read_only : bool
        Whether no run, schedule or sensor can be started.
    daemon : bool
        Whether the daemon is started where the page is not read only.
    """
    os.environ |= {"HDT_HOME": str(home), "HDT_LANDING": str(landing), "DAGSTER_HOME": str(home / "dagster")}
    os.chdir(home)  # dagster would read a dagster.yaml that lies in the folder it is started from
    sign_in = None if read_only else LocalToken(Person("local"))
    with (
        open_instance(home) as instance,
        application(instance, LOCATION, read_only) as app,
        _daemon() if daemon and not read_only else nullcontext(),
    ):
        say(f"http://127.0.0.1:{sock.getsockname()[1]}/{f'?token={sign_in.token}' if sign_in else ''}")
        # Dagster answers a GraphQL change that comes by GET, with which any page on this machine could begin one
        Guard(app, LOCAL | set(names), sign_in, by_post=("/graphql",)).serve(sock)


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
