"""Serve Dagster's page behind the guard, with Dagster's daemon beside it where runs may be started."""

import os
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from dagster_batched.webserver import application, daemon_command
from pipelines.orchestration.runs import LOCATION, open_instance
from pipelines.web.guard import LOCAL, Guard
from pipelines.web.sign_in import LocalToken, Person

_DAEMON_ENDS_S = 20


def serve(
    home: Path,
    landing: Path,
    sock: socket.socket,
    report_address: Callable[[str], None],
    names: tuple[str, ...] = (),
    read_only: bool = True,
    daemon: bool = True,
) -> None:
    """Serve the page until the process is stopped.

    A read-only page needs no sign-in; one that starts runs needs the printed token, with the daemon beside it.

    Parameters
    ----------
    home, landing : Path
        Folders the page's assets work on.
    sock : socket
        Listening socket.
    report_address : callable
        Gets the address, with the token where one is needed.
    names : tuple of str
        Names, without a port, by which a proxy calls this machine.
    read_only : bool
        Refuse to start runs, schedules and sensors.
    daemon : bool
        Start the daemon where the page is not read only.
    """
    os.environ |= {"HDT_HOME": str(home), "HDT_LANDING": str(landing), "DAGSTER_HOME": str(home / "dagster")}
    os.chdir(home)  # dagster reads a dagster.yaml in its working directory
    sign_in = None if read_only else LocalToken(Person("local"))
    with (
        open_instance(home) as instance,
        application(instance, LOCATION, read_only) as app,
        _daemon() if daemon and not read_only else nullcontext(),
    ):
        report_address(f"http://127.0.0.1:{sock.getsockname()[1]}/{f'?token={sign_in.token}' if sign_in else ''}")
        # Dagster carries out a GraphQL mutation sent by GET, which any page in this browser could send
        Guard(app, LOCAL | set(names), sign_in, post_only=("/graphql",)).serve(sock)


@contextmanager
def _daemon() -> Iterator[None]:
    """Run the daemon for schedules, sensors and queued runs."""
    process = subprocess.Popen(daemon_command(LOCATION))
    try:
        yield
    finally:
        process.terminate()
        try:
            process.wait(_DAEMON_ENDS_S)
        except subprocess.TimeoutExpired:
            process.kill()
