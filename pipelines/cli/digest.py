"""Commands after the night: the digest of changes, and work orders."""

from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.base import AsJson, HomeDir, StopError, app, home_folder, out, print_error

OperatorOnly = Annotated[str | None, typer.Option("--operator", help="Only this operator, as its folder is called.")]


@app.command()
def digest(
    home: HomeDir = None,
    since: Annotated[
        str | None,
        typer.Option(help="Date or time in UTC: since the last night before it; default the last but one."),
    ] = None,
    operator: OperatorOnly = None,
    target: Annotated[Path | None, typer.Option("--out", help="Folder to write text, page and JSON into.")] = None,
    trial: Annotated[
        bool,
        typer.Option("--try", help="Send the present state to every receiver of notify.toml; nothing is recorded."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Print what changed since an earlier night.

    Alerts, flights left, gaps, refused files. `notify.toml` in the home declares who receives it after each night.
    """
    where = home_folder(home)
    if trial:
        _try(where)
        return
    from pipelines.digest.changes import changes_since
    from pipelines.digest.render import as_json as digest_json
    from pipelines.digest.render import as_text, write_digest

    changes = changes_since(where, since).of(operator)
    if target is not None:
        write_digest(changes, target, "digest")
    if as_json:
        out.print_json(digest_json(changes))
    else:
        out.print(as_text(changes).strip())


def _try(where: Path) -> None:
    from pipelines.digest.delivery import send_trial
    from pipelines.storage.settings import notify_file

    results = send_trial(where)
    if not results:
        raise StopError(f"no receiver; declare them in {notify_file(where)}")
    for name, fault in results:
        if fault:
            print_error(f"{name}: not sent: {fault}")
        else:
            out.print(f"{name}: sent")
    if any(fault for _, fault in results):
        raise typer.Exit(1)


@app.command()
def orders(
    target: Annotated[Path, typer.Option("--out", help="Folder for orders.csv, orders.json and orders.html.")],
    home: HomeDir = None,
    operator: OperatorOnly = None,
) -> None:
    """Write open alerts as work orders.

    As CSV and JSON for a maintenance system, and as a page to print.
    """
    from pipelines.digest.orders import work_orders, write_orders
    from pipelines.report.tasks import read_tasks
    from pipelines.storage.catalog import connect

    where = home_folder(home)
    with connect(where) as con:
        ((until,),) = con.execute("select max(departed_at) from flights").fetchall()
        table = work_orders(con, read_tasks(where), operator)
    write_orders(table, target, f"Flights up to {until:%Y-%m-%d %H:%M} UTC." if until else "")
    out.print(f"{table.height} work orders: {target}")
