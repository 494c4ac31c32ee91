"""Commands that only look: status, report, query, explain, ui."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.table import Table

from pipelines.cli.base import (
    AsJson,
    HomeDir,
    Language,
    StopError,
    app,
    home_folder,
    out,
    say_error,
    spoken,
)
from pipelines.cli.stops import ends_at_once


@app.command()
def status(home: HomeDir = None, as_json: AsJson = False) -> None:
    """What is up to date, what waits and what failed.

    With the last good run, the catalog's age and the quarantine.
    """
    from pipelines.cli.status import status_of

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
    units: Annotated[
        Literal["si", "us"], typer.Option(help="Units it opens in, degC and kg/s or degF and lb/min; a switch on it.")
    ] = "si",
    thresholds: Annotated[
        bool, typer.Option("--thresholds", help="And how alerts would have fared at other thresholds: 3 s an aircraft.")
    ] = False,
    language: Language = None,
) -> None:
    """Write the fleet's health as one page that needs no network."""
    from pipelines.report.page import write_report

    where = home_folder(home)
    if not target.resolve().parent.is_dir():
        raise StopError(f"no folder {target.resolve().parent} to write {target.name} into")
    with spoken(language):
        write_report(where, target, units, thresholds)
    out.print(f"Report: {target}", soft_wrap=True)


@app.command()
def query(
    sql: Annotated[str, typer.Argument(help="A select over the catalog's views.")],
    home: HomeDir = None,
    as_of: Annotated[str | None, typer.Option(help="A date or time in UTC: what the last night by then said.")] = None,
) -> None:
    """Ask the catalog of the last night or an earlier one, read only."""
    import duckdb

    from pipelines.storage.catalog import ask, connect
    from pipelines.storage.publication import connect_as_of

    where = home_folder(home)
    with ends_at_once(lambda: say_error("stopped")), connect_as_of(where, as_of) if as_of else connect(where) as con:
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
    language: Language = None,
) -> None:
    """One pack or one alert in words: when it was raised, and now.

    What moved, by how much, since when, which witnesses speak for or against it, what else it could be, what to do.
    """
    from pipelines.report.explain import explain as told_of

    where, named = home_folder(home), " ".join(asked)
    try:
        with spoken(language):
            told = told_of(where, named)
    except ValueError as error:
        raise StopError(str(error)) from None
    if told is None:
        raise StopError(
            f'no pack or alert {named}; `hdt query --home {where} "select alert_id, tail, pack from alerts"` lists them'
        )
    out.print(told, markup=False, soft_wrap=True)


@app.command()
def terms(
    home: HomeDir = None,
    accept: Annotated[
        list[str] | None, typer.Option(help="Let the model have this term from the next night on.")
    ] = None,
    drop: Annotated[list[str] | None, typer.Option(help="Take it from the model again.")] = None,
    as_json: AsJson = False,
) -> None:
    """Physical terms that residuals from flight to flight ask for.

    What the model has is a term a line in `terms.txt` of the home.
    """
    from hdt_core.calibration.dsm import Dsm
    from hdt_core.physics.terms import TERMS
    from pipelines.casework.terms import accept as write
    from pipelines.casework.terms import proposals
    from pipelines.storage.settings import accepted_terms
    from pipelines.storage.store import Store

    where = home_folder(home)
    unknown = sorted({*(accept or ()), *(drop or ())} - set(TERMS))
    if unknown:
        raise StopError(f"no term {', '.join(unknown)}; there are {', '.join(sorted(TERMS))}")
    if accept or drop:
        write(where, [n for n in {*accepted_terms(where), *(accept or ())} if n not in (drop or ())])
        out.print(f"Terms from the next night on: {', '.join(accepted_terms(where)) or 'none'}")
        return
    held = Store(where).read("calibration_dsm")
    if not held.height:
        raise StopError("no model yet; run `hdt nightly` first")
    dsm = Dsm.from_dict(json.loads(held["model"][0]))
    found = proposals(where, dsm)
    if as_json:
        out.print_json(json.dumps({"accepted": dsm.terms, "terms": found.to_dicts()}))
        return
    for name, value in dsm.terms.items():
        out.print(f"accepted  {name} = {value:.3g} {TERMS[name].unit}", soft_wrap=True)
    for row in found.iter_rows(named=True):
        out.print(_term_line(row), markup=False, soft_wrap=True)


def _term_line(row: dict[str, Any]) -> str:
    head = f"{'PROPOSED' if row['proposed'] else '-':8}  {row['term']}"
    if row["value"] is None:
        return f"{head}: {row['n']} changes between flights are too few"
    return (
        f"{head} = {row['value']:.3g} +- {row['sd']:.2g} {row['unit']} ({row['meaning']}): BIC falls by "
        f"{row['bic_gain']:.0f}, F {row['f']:.0f}; residual of aircraft left out "
        f"{100 * row['held_out_change']:+.0f} %; "
        f"moves a flight's loss by {row['loss_shift_sd']:.3f}; {row['n']} changes"
    )
