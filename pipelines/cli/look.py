"""Commands that read a home: status, report, query, explain, terms."""

import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import polars as pl
import typer
from rich.table import Table

from pipelines.cli.base import AsJson, HomeDir, Language, StopError, app, home_folder, out, print_error, stop_at_once

if TYPE_CHECKING:
    from hdt_core.calibration.dsm import Dsm


@app.command()
def status(home: HomeDir = None, as_json: AsJson = False) -> None:
    """Print what failed and what waits, then each asset.

    With the last good run, the catalog's age and the rows in quarantine.
    """
    values = _status(home_folder(home))
    if as_json:
        out.print_json(json.dumps(values))
        return
    table = Table()
    for name in ("asset", "cells", "up to date", "waiting"):
        table.add_column(name, justify="left" if name == "asset" else "right")
    assets = values.pop("assets")
    for name, row in sorted(assets.items(), key=lambda item: -item[1]["waiting"]):  # as declared where none waits
        table.add_row(name, *(str(row[k]) for k in ("cells", "up_to_date", "waiting")))
    for name, value in values.items():
        out.print(f"{name.replace('_', ' ')}: {value if value is not None else '-'}")
    out.print(table, soft_wrap=False)


def _status(home: Path) -> dict[str, Any]:
    """Collect the values of `status`.

    A cell waits when it was never computed or its inputs have changed; what depends on a waiting cell counts once that
    cell is computed.
    """
    from pipelines.lineage import LINEAGE
    from pipelines.storage.catalog import CATALOG, connect
    from pipelines.storage.ledger import Ledger
    from pipelines.versions import expected_versions, stale_cells_of

    ledger = Ledger(home, read_only=True)
    assets = {}
    for table in LINEAGE:
        cells = expected_versions(ledger, table).height
        waiting = stale_cells_of(ledger, [table]).height
        assets[table] = {"cells": cells, "up_to_date": cells - waiting, "waiting": waiting}
    nights = ledger.nights().rows(named=True)
    good = [n for n in nights if n["failed"] == "{}"]
    age_s = datetime.now(UTC).timestamp() - (home / CATALOG).stat().st_mtime
    with connect(home) as con:
        ((quarantined,),) = con.execute("select count(*) from quarantine").fetchall()
    return {
        "assets": assets,
        "last_run_failed": nights[-1]["failed"] if nights and nights[-1]["failed"] != "{}" else None,
        "waiting": sum(row["waiting"] for row in assets.values()),
        "last_run": nights[-1]["ended_at"] if nights else None,
        "last_good_run": good[-1]["ended_at"] if good else None,
        "catalog_age_hours": round(age_s / 3600, 2),
        "quarantined": quarantined,
    }


@app.command()
def report(
    home: HomeDir = None,
    target: Annotated[Path, typer.Option("--out", help="HTML file to write.")] = Path("report.html"),
    units: Annotated[
        Literal["si", "us"], typer.Option(help="Units at opening: degC and kg/s, or degF and lb/min.")
    ] = "si",
    thresholds: Annotated[
        bool, typer.Option("--thresholds", help="Include alert counts at other thresholds: 3 s an aircraft.")
    ] = False,
    language: Language = None,
) -> None:
    """Write the fleet's health as one page that needs no network."""
    from pipelines.report.page import write_report
    from pipelines.words import use_language

    where = home_folder(home)
    if not target.resolve().parent.is_dir():
        raise StopError(f"no folder {target.resolve().parent} to write {target.name} into")
    with use_language(language):
        write_report(where, target, units, thresholds)
    out.print(f"Report: {target}")


@app.command()
def query(
    sql: Annotated[str, typer.Argument(help="A select over the catalog's views.")],
    home: HomeDir = None,
    as_of: Annotated[str | None, typer.Option(help="Date or time in UTC: use the last night before it.")] = None,
) -> None:
    """Query the catalog of the last or an earlier night.

    Read only.
    """
    import duckdb

    from pipelines.storage.catalog import connect, run_select
    from pipelines.storage.publication import connect_as_of

    where = home_folder(home)
    with (
        stop_at_once(lambda: print_error("stopped")),
        connect_as_of(where, as_of, as_delivered=True) if as_of else connect(where, as_delivered=True) as con,
    ):
        try:
            result = run_select(con, sql)
            if result is not None:
                result.show(max_width=10_000 if not sys.stdout.isatty() else out.width, max_rows=1_000)
        except (duckdb.Error, ValueError) as error:
            message, _, _ = str(error).strip().partition("\n\n")  # below stands where in the text
            raise StopError(" ".join(message.split())) from None


@app.command()
def explain(
    name: Annotated[
        list[str],
        typer.Argument(metavar="PACK", help="TAIL for its most urgent pack, TAIL PACK or TAIL/PACK, or an alert's id."),
    ],
    home: HomeDir = None,
    language: Language = None,
) -> None:
    """Explain one pack or one alert, when raised and now.

    Evidence for and against the diagnosis, its alternatives, and what to do.
    """
    from pipelines.report.explain import explain as explanation_of
    from pipelines.words import use_language

    where = home_folder(home)
    pack = " ".join(name)
    with use_language(language):
        text = explanation_of(where, pack)
    if text is None:
        raise StopError(
            f'no pack or alert {pack}; `hdt query --home {where} "select alert_id, tail, pack from alerts"` lists them'
        )
    out.print(text)


@app.command()
def terms(
    home: HomeDir = None,
    accept: Annotated[list[str] | None, typer.Option(help="Use this term in the model from the next night on.")] = None,
    drop: Annotated[list[str] | None, typer.Option(help="Remove it from the model.")] = None,
    as_json: AsJson = False,
) -> None:
    """List physical terms that would improve the model.

    By the residuals between flights; `terms.txt` in the home holds the accepted terms, one a line.
    """
    from hdt_core.calibration.dsm import Dsm
    from hdt_core.physics.terms import TERMS
    from pipelines.storage.settings import accept_terms, accepted_terms
    from pipelines.storage.store import Store

    where = home_folder(home)
    extra = sorted({*(accept or ()), *(drop or ())} - set(TERMS))
    if extra:
        raise StopError(f"no term {', '.join(extra)}; there are {', '.join(sorted(TERMS))}")
    if accept or drop:
        accept_terms(where, [n for n in {*accepted_terms(where), *(accept or ())} if n not in (drop or ())])
        out.print(f"Terms from the next night on: {', '.join(accepted_terms(where)) or 'none'}")
        return
    models = Store(where).read_table("calibration_dsm")
    if not models.height:
        raise StopError("no model yet; run `hdt nightly` first")
    dsm = Dsm.from_dict(json.loads(models["model"][0]))
    evidence = propose_terms(where, dsm)
    if as_json:
        out.print_json(json.dumps({"accepted": dsm.terms, "terms": evidence.to_dicts()}))
        return
    for name, value in dsm.terms.items():
        out.print(f"accepted  {name} = {value:.3g} {TERMS[name].unit}")
    for row in evidence.iter_rows(named=True):
        out.print(_term_line(row))


def propose_terms(home: Path, dsm: "Dsm") -> pl.DataFrame:
    """Return the evidence for each term that the model in service lacks, from the flights of its baseline."""
    from hdt_core.calibration.calibrate import baseline_samples
    from hdt_core.calibration.flight_estimates import estimate_flights
    from hdt_core.calibration.missing_physics import propose
    from pipelines.storage.ledger import Ledger
    from pipelines.storage.store import Store
    from pipelines.versions import baseline_cells

    flights = baseline_cells(Ledger(home))["flight_id"]
    samples = Store(home).scan("legs_samples").filter(pl.col("flight_id").is_in(flights.implode())).collect()
    return propose(estimate_flights(baseline_samples(samples), dsm), dsm)


def _term_line(row: dict[str, Any]) -> str:
    head = f"{'PROPOSED' if row['proposed'] else '-':8}  {row['term']}"
    if row["value"] is None:
        return f"{head}: too few changes between flights ({row['n']})"
    return (
        f"{head} = {row['value']:.3g} +- {row['sd']:.2g} {row['unit']} ({row['meaning']}): BIC falls by "
        f"{row['bic_gain']:.0f}, F {row['f']:.0f}; residual of aircraft left out "
        f"{100 * row['held_out_change']:+.0f} %; "
        f"moves a flight's loss by {row['loss_shift_sd']:.3f}; {row['n']} changes"
    )
