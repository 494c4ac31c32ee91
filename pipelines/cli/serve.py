"""Commands that serve the two pages: cases for the shift, and Dagster's."""

import re
import socket
from ipaddress import ip_network
from typing import Annotated

import typer

from pipelines.cli.base import HomeDir, LandingDir, StopError, app, home_folder, landing_folder, out

Name = Annotated[list[str] | None, typer.Option(help="Name, without a port, under which a proxy shows the page.")]


@app.command()
def serve(
    home: HomeDir = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes any free port.")] = 8460,
    listen: Annotated[str, typer.Option(help="Address to listen on; any other needs https before it.")] = "127.0.0.1",
    name: Name = None,
    https: Annotated[bool, typer.Option("--https", help="Browsers use https, through a proxy.")] = False,
    proxy: Annotated[
        list[str] | None, typer.Option(help="Address or network of the site's proxy, which names the person; no token.")
    ] = None,
    header: Annotated[str, typer.Option(help="Header with the name that the proxy writes.")] = "X-Remote-User",
) -> None:
    """Serve the shift's page: units by urgency, and their cases.

    The address it prints holds the token to sign in with, a new one at each start. Behind the site's proxy (--proxy)
    people have their own names; `roles.toml` in the home sets their roles.
    """
    where = home_folder(home).resolve()
    try:
        from pipelines.web.casebook import application
        from pipelines.web.guard import LOCAL
        from pipelines.web.sign_in import FILE, LocalToken, ProxyHeader, local_person, read_people
    except ImportError:
        raise StopError("the page of cases needs the extra serve: pip install 'hybrid-digital-twin[serve]'") from None
    if not re.fullmatch(r"[A-Za-z0-9-]+", header):
        raise StopError(f"--header {header} is not a header's name")
    try:
        people = read_people(where)
        sign_in = LocalToken(local_person(where), https)
        behind = ProxyHeader(where, header, [ip_network(p) for p in proxy]) if proxy else None
    except ValueError as error:
        raise StopError(f"--proxy: {error}") from None
    if behind and not people:
        raise StopError(f"nobody has a role yet; name people below [people] in {where / FILE}")
    with _listening(listen, port) as sock:
        address = f"http://127.0.0.1:{sock.getsockname()[1]}/"
        out.print(f"Cases: {address}{'' if behind else f'?token={sign_in.token}'}")
        application(where, LOCAL | set(name or ()), behind or sign_in).serve(sock)


@app.command()
def ui(
    landing: LandingDir = None,
    home: HomeDir = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes any free port.")] = 3000,
    read_only: Annotated[
        bool, typer.Option("--read-only/--launch", help="Look only, or allow to start runs, schedules and sensors.")
    ] = True,
    listen: Annotated[str, typer.Option(help="Address to listen on; 0.0.0.0 in a container.")] = "127.0.0.1",
    name: Name = None,
    daemon: Annotated[bool, typer.Option(help="With --launch: Dagster's daemon, for schedules and sensors.")] = True,
) -> None:
    """Serve Dagster's page on this machine.

    It shows the assets and run history that the other commands work on. With --launch it can start runs; the address
    it prints then holds the token to sign in with, a new one at each start.
    """
    where = home_folder(home, must_exist=False).resolve()
    zone = landing_folder(landing).resolve()
    try:
        from pipelines.web import page
    except ImportError:
        raise StopError("Dagster's page needs the extra ui: pip install 'hybrid-digital-twin[ui]'") from None
    with _listening(listen, port) as sock:
        page.serve(where, zone, sock, _print_address, tuple(name or ()), read_only, daemon)


def _print_address(address: str) -> None:
    out.print(f"Dagster's page: {address}")


def _listening(address: str, port: int) -> socket.socket:
    """Open the listening socket first, so that early requests wait until the server is ready."""
    try:
        return socket.create_server((address, port), family=socket.AF_INET6 if ":" in address else socket.AF_INET)
    except OSError as error:
        raise StopError(f"can't listen on {address}:{port} ({error.strerror}); name another --port") from None
