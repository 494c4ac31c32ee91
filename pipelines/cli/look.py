"""Commands that only look: status, report, query, explain, ui."""

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from pipelines.cli.base import AsJson, HomeDir, LandingDir, StopError, app, home_folder, landing_folder, out


@app.command()
def status(home: HomeDir = None, as_json: AsJson = False) -> None:
    """What is up to date, what waits and what failed.

    With the last good run, the catalog's age and the quarantine.
    """
    from pipelines.status import status_of

    told = status_of(home_folder(home))
    if as_json:
        out.print_json(json.dumps(told))
        return
    table = Table()
    for name in ("asset", "cells", "up to date", "waiting"):
        table.add_column(name, justify="left" if name == "asset" else "right")
    for name, row in told.pop("assets").items():
        table.add_row(name, *(str(row[k]) for k in ("cells", "up_to_date", "waiting")))
    out.print(table)
    for name, value in told.items():
        out.print(f"{name.replace('_', ' ')}: {value if value is not None else '-'}", soft_wrap=True)


@app.command()
def report(
    home: HomeDir = None,
    target: Annotated[Path, typer.Option("--out", help="HTML file to write.")] = Path("report.html"),
) -> None:
    """Write the fleet's health as one page that needs no network."""
    from pipelines.report import write_report

    where = home_folder(home)
    if not target.resolve().parent.is_dir():
        raise StopError(f"no folder {target.resolve().parent} to write {target.name} into")
    write_report(where, target)
    out.print(f"Report: {target}", soft_wrap=True)


@app.command()
def query(sql: Annotated[str, typer.Argument(help="A select over the catalog's views.")], home: HomeDir = None) -> None:
    """Ask the catalog, read only."""
    import duckdb

    from pipelines.catalog import ask, connect

    with connect(home_folder(home)) as con:
        try:
            answer = ask(con, sql)
            if answer is not None:
                answer.show(max_width=10_000 if not sys.stdout.isatty() else out.width, max_rows=1_000)
        except (duckdb.Error, ValueError) as error:
            raise StopError(str(error).strip().splitlines()[0]) from None


@app.command()
def explain(
    asked: Annotated[
        list[str],
        typer.Argument(metavar="PACK", help="TAIL for its most urgent pack, TAIL PACK or TAIL/PACK, or an alert's id."),
    ],
    home: HomeDir = None,
) -> None:
    """One pack or one alert in words: when it was raised, and now.

    What moved, by how much, since when, which witnesses speak for or against it, what else it could be, what to do.
    """
    from pipelines.explain import explain as told_of

    where, named = home_folder(home), " ".join(asked)
    try:
        told = told_of(where, named)
    except ValueError as error:
        raise StopError(str(error)) from None
    if told is None:
        raise StopError(
            f'no pack or alert {named}; `hdt query --home {where} "select alert_id, tail, pack from alerts"` lists them'
        )
    out.print(told, markup=False, soft_wrap=True)


@app.command()
def ui(
    landing: LandingDir = None,
    home: HomeDir = None,
    port: int = 3000,
    read_only: Annotated[bool, typer.Option("--read-only", help="Look only: no run can be started.")] = False,
) -> None:
    """Open Dagster's page on this machine.

    It shows the same assets and run history that the other commands work on.
    """
    from pipelines.runs import open_instance

    where, zone = home_folder(home, must_exist=False).resolve(), landing_folder(landing).resolve()
    open_instance(where).dispose()
    os.environ |= {"HDT_HOME": str(where), "HDT_LANDING": str(zone), "DAGSTER_HOME": str(where / "dagster")}
    os.chdir(where)  # dagster would read a dagster.yaml that lies in the folder it is started from
    page = ["dagster_webserver", "--read-only"] if read_only else ["dagster", "dev"]
    at = ["-m", "pipelines.definitions", "--host", "127.0.0.1", "--port", str(port)]
    os.execv(sys.executable, [sys.executable, "-m", *page, *at])
