"""Commands after the night: what changed, and work orders."""

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.base import AsJson, HomeDir, StopError, app, home_folder, out, say_error

OperatorOnly = Annotated[str | None, typer.Option("--operator", help="Only this operator, as its folder is called.")]


@app.command()
def digest(
    home: HomeDir = None,
    since: Annotated[
        str | None,
        typer.Option(help="A date or time in UTC: since the last night by then; else the last but one."),
    ] = None,
    operator: OperatorOnly = None,
    target: Annotated[Path | None, typer.Option("--out", help="Folder for it as text, page and JSON.")] = None,
    trial: Annotated[
        bool,
        typer.Option("--try", help="Send what stands now to every receiver of notify.toml; nothing is noted."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """What changed since an earlier night.

    Alerts, flights left, gaps, refused files. `notify.toml` in the home says who is told of it each night.
    """
    where = home_folder(home)
    if trial:
        _try(where)
        return
    from pipelines.digest import as_json as told_as_json
    from pipelines.digest import as_text, changes_since, write_digest

    found = changes_since(where, since).of(operator)
    if target is not None:
        write_digest(found, target, "digest")
    if as_json:
        out.print_json(told_as_json(found))
    else:
        out.print(as_text(found).strip(), markup=False, soft_wrap=True)


def _try(where: Path) -> None:
    from pipelines.digest import NotifyError, try_out
    from pipelines.storage.settings import notify_file

    try:
        told = try_out(where)
    except NotifyError as error:
        raise StopError(str(error)) from None
    if not told:
        raise StopError(f"no receiver; declare them in {notify_file(where)}")
    for name, fault in told:
        if fault:
            say_error(f"{name} was not told: {fault}")
        else:
            out.print(f"{name} was told", markup=False, soft_wrap=True)
    if any(fault for _, fault in told):
        raise typer.Exit(1)


@app.command()
def orders(
    target: Annotated[Path, typer.Option("--out", help="Folder for orders.csv, orders.json and orders.html.")],
    home: HomeDir = None,
    operator: OperatorOnly = None,
) -> None:
    """Open alerts as work orders.

    As CSV and JSON for a maintenance system, and as a page to print.
    """
    from pipelines.digest import work_orders, write_orders
    from pipelines.storage.catalog import connect

    with connect(home_folder(home)) as con:
        ((until,),) = con.execute("select max(departed_at) from flights").fetchall()
        found = work_orders(con, operator)
    write_orders(found, target, f"Flights up to {until:%Y-%m-%d %H:%M} UTC." if until else "")
    out.print(f"{found.height} work orders: {target}", soft_wrap=True)
