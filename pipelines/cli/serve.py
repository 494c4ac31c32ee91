"""Commands of the page of cases: serve it, and say who may use it."""

import sys
from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from pipelines.cli.base import HomeDir, StopError, app, home_folder, out

user = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Who may use the page of cases.")
app.add_typer(user, name="user")
_EXTRA = "the page of cases needs the extra serve: pip install 'hybrid-digital-twin[serve]'"


@app.command()
def serve(
    home: HomeDir = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes any that is free.")] = 8460,
    listen: Annotated[
        str, typer.Option(help="Address to listen at; others than this machine want https before it.")
    ] = ("127.0.0.1"),
    name: Annotated[
        list[str] | None, typer.Option(help="Name, without a port, under which a proxy shows the page.")
    ] = None,
    https: Annotated[bool, typer.Option("--https", help="Browsers come by https, through a proxy.")] = False,
) -> None:
    """The page of cases: who has what in hand, what was found.

    Nothing is seen without a name and a password; `hdt user add` gives them.
    """
    where = home_folder(home).resolve()
    try:
        from pipelines.web.address import listening
        from pipelines.web.casebook import serve_cases
    except ImportError:
        raise StopError(_EXTRA) from None
    from pipelines.web.people import people

    if not people(where):
        raise StopError(f"nobody may use the page yet; `hdt user add NAME --role admin --home {where}` adds somebody")
    try:
        sock = listening(listen, port)
    except OSError as error:
        raise StopError(f"can't listen at {listen}:{port} ({error.strerror}); name another --port") from None
    with sock:
        out.print(f"Cases: http://127.0.0.1:{sock.getsockname()[1]}/", soft_wrap=True, markup=False)
        serve_cases(where, sock, tuple(name or ()), https)


@user.command("add")
def add(
    name: str,
    role: Annotated[str, typer.Option(help="viewer (looks), engineer (changes cases) or admin (all operators).")],
    operator: Annotated[
        list[str] | None, typer.Option(help="Sees this operator's cases alone; may be given more than once.")
    ] = None,
    home: HomeDir = None,
) -> None:
    """Add a person, or give one another role and password; the password is asked for, or read from a pipe."""
    from pipelines.web.people import PeopleError, add_person

    where = home_folder(home)
    asked = sys.stdin.isatty()
    password = typer.prompt("Password", hide_input=True, confirmation_prompt=True) if asked else sys.stdin.readline()
    try:
        add_person(where, name, role, tuple(operator or ()), password.rstrip("\n"))
    except PeopleError as error:
        raise StopError(str(error)) from None
    out.print(f"{name} is {role}{' of ' + ', '.join(operator) if operator else ''}.", markup=False)


@user.command("remove")
def remove(name: str, home: HomeDir = None) -> None:
    """Take a person out; an open session ends at once."""
    from pipelines.web.people import PeopleError, remove_person

    try:
        remove_person(home_folder(home), name)
    except PeopleError as error:
        raise StopError(str(error)) from None
    out.print(f"{name} is no user any more.", markup=False)


@user.command("list")
def list_(home: HomeDir = None) -> None:
    """Who may use the page."""
    from pipelines.web.people import people

    table = Table("name", "role", "operators", box=SIMPLE_HEAD)
    for person in people(home_folder(home)).values():
        table.add_row(person.name, person.role, ", ".join(person.operators) or "all")
    out.print(table)
