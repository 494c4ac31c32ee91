"""Commands that hand results on: the digest of changes, work orders, and the catalog's views."""

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.base import AsJson, HomeDir, StopError, app, home_folder, out, print_error

KEY = "HDT_EXPORT_KEY"
_MAX_KEY_BYTES = 10_000


class Format(StrEnum):
    """File formats of an export."""

    parquet = "parquet"
    csv = "csv"
    duckdb = "duckdb"


@app.command()
def export(
    target: Annotated[Path, typer.Option("--out", help="Folder to write: a new one, or an earlier export's.")],
    home: HomeDir = None,
    operator: Annotated[str | None, typer.Option(help="Only rows of this operator.")] = None,
    view: Annotated[list[str] | None, typer.Option(help="Only this view; may be given more than once.")] = None,
    form: Annotated[Format, typer.Option("--format", help="Files of views, or one catalog.")] = Format.parquet,
    pseudonymise: Annotated[
        bool,
        typer.Option("--pseudonymise", help="Replace tails, serial numbers and document references by a keyed hash."),
    ] = False,
    key_file: Annotated[Path | None, typer.Option(help=f"File with the key; default: variable {KEY}.")] = None,
) -> None:
    """Write the catalog's views as Parquet, CSV or DuckDB."""
    from pipelines.sharing import access_scope
    from pipelines.sharing import export as write
    from pipelines.storage.view_headers import views

    where = home_folder(home)
    names = views()
    if unknown_views := [v for v in view or () if v not in names]:
        raise StopError(f"no view {unknown_views[0]}; the catalog has {', '.join(sorted(names))}")
    if view and form == Format.duckdb:
        raise StopError("a DuckDB file holds every view; leave --view out")
    if key_file and not pseudonymise:
        raise StopError("a key is for --pseudonymise; give both or neither")
    try:
        rows = write(where, target, access_scope(where, operator, _key(key_file) if pseudonymise else None), form, view)
    except (ValueError, FileExistsError) as error:
        raise StopError(str(error)) from None
    out.print(f"{sum(rows.values())} rows of {len(rows)} views: {target}")


def _key(file: Path | None) -> bytes:
    """Read the key, which no message ever shows."""
    key = _read_key(file) if file else os.environ.get(KEY, "").strip().encode()
    if not key:
        raise StopError(f"pseudonyms need a key: name a file with --key-file or set {KEY}")
    return key


def _read_key(file: Path) -> bytes:
    with file.open("rb") as source:  # which may be a pipe from a store of passwords
        key = source.read(_MAX_KEY_BYTES + 1)
    if len(key) > _MAX_KEY_BYTES:
        raise StopError(f"{file} holds no key: it has more than {_MAX_KEY_BYTES} bytes")
    return key.strip()


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
    """Write what needs work as work orders.

    Open alerts, and units that need work without one: CSV and JSON for a
    maintenance system, and a page to print.
    """
    from pipelines.digest.orders import work_orders, write_orders
    from pipelines.report.rows import dates_line
    from pipelines.report.tasks import read_tasks
    from pipelines.storage.catalog import connect
    from pipelines.storage.publication import publish_lines

    where = home_folder(home)
    publish_lines(where)
    with connect(where) as con:
        table = work_orders(con, read_tasks(where), operator)
        dates = dates_line(con)
    write_orders(table, target, dates)
    out.print(f"work orders: {table.height}, in {target}")
