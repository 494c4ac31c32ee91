"""Commands that take data in: nightly and backfill."""

import datetime as dt
import json
import time
from pathlib import Path
from typing import Annotated, Any

import polars as pl
import typer
from rich.box import SIMPLE_HEAD
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from pipelines.cli.base import (
    AsJson,
    HomeDir,
    LandingDir,
    Language,
    StopError,
    app,
    err,
    home_folder,
    landing_folder,
    out,
    say_error,
    spoken,
)
from pipelines.cli.stops import ends_at_once
from pipelines.orchestration.local_executor import cores
from pipelines.storage.settings import MOST_DAYS

SHOWN = 10
"""Packs, and units, that the terminal lists."""
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be taken in, and take nothing in.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Processes side by side, where there is enough to do.")]
Day = Annotated[dt.datetime | None, typer.Option(formats=["%Y-%m-%d"])]


class Bars:
    """Progress bars of a long run, on standard error."""

    def __init__(self, quiet: bool) -> None:
        columns = (
            TextColumn("{task.description:<28}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self.bars = Progress(*columns, console=err, disable=quiet)
        self.task: Any = None

    def start(self, label: str, total: int) -> None:
        """A step begins."""
        if self.task is None:
            self.bars.start()
        self.task = self.bars.add_task(label, total=total)

    def advance(self, cells: int) -> None:
        """Some of the step is done."""
        self.bars.advance(self.task, cells)

    def stop(self) -> None:
        """Leave the terminal as it was."""
        self.bars.stop()


@app.command()
def nightly(
    landing: LandingDir = None,
    home: HomeDir = None,
    dry_run: DryRun = False,
    jobs: Jobs = cores(),  # noqa: B008  the machine's, and it does not change
    as_json: AsJson = False,
    language: Language = None,
) -> None:
    """Take in what is new and say which packs need attention.

    From raw files to alerts; exit code 1 if an aircraft failed, and the others are done.
    """
    zone, where = landing_folder(landing), home_folder(home, must_exist=False)
    if dry_run:
        _say_what_is_new(zone, where, as_json)
    else:
        with spoken(language):
            _bring_up_to_date(zone, where, as_json, jobs)


@app.command()
def backfill(
    landing: LandingDir = None,
    home: HomeDir = None,
    operator: Annotated[str | None, typer.Option(help="Only this operator, as its folder is called.")] = None,
    tail: Annotated[str | None, typer.Option(help="Only this aircraft.")] = None,
    since: Day = None,
    until: Day = None,
    jobs: Jobs = cores(),  # noqa: B008
    as_json: AsJson = False,
) -> None:
    """Take in history, in bulk.

    By operator, aircraft or departure date (both ends included). It may be stopped and started again.
    """
    where = landing_folder(landing)
    from pipelines.intake.names import is_operator, is_tail

    if operator and not (is_operator(operator) and (where / operator).is_dir()):
        raise StopError(f"no operator {operator} in {where}")
    if tail and not (is_tail(tail) and any(where.glob(f"*/{tail}"))):
        raise StopError(f"no aircraft {tail} in {where}")
    wanted = pl.lit(True)
    for column, name in (("operator", operator), ("tail", tail)):
        wanted &= pl.col(column) == name if name else pl.lit(True)
    day = pl.col("flight_id").str.extract(r"_(\d{8})_\d+$")
    wanted &= (day >= f"{since:%Y%m%d}").fill_null(True) if since else pl.lit(True)
    wanted &= (day <= f"{until:%Y%m%d}").fill_null(True) if until else pl.lit(True)
    _bring_up_to_date(where, home_folder(home, must_exist=False), as_json, jobs, wanted)


@app.command()
def tidy(
    home: HomeDir = None,
    keep_days: Annotated[
        int, typer.Option("--keep-days", min=0, max=MOST_DAYS, help="Runs younger than so many days stay.")
    ] = 90,
) -> None:
    """Forget Dagster's history of long ago, or one that is damaged.

    Nothing that was made is touched, and nothing is made again; cells that only those runs made show as not
    materialized on Dagster's page.
    """
    from dagster_batched.history import forget
    from pipelines.orchestration.around_night import holding
    from pipelines.orchestration.runs import open_instance
    from pipelines.storage.history import set_aside

    where = home_folder(home)
    with holding(where):
        if anew := set_aside(where):
            out.print(anew, soft_wrap=True)
    with holding(where), open_instance(where) as instance:
        runs = forget(instance, dt.datetime.now(dt.UTC) - dt.timedelta(days=keep_days))
    out.print(f"{runs} runs forgotten")


def _say_what_is_new(landing: Path, home: Path, as_json: bool) -> None:
    from pipelines.intake.scan import unseen
    from pipelines.storage.ledger import Ledger

    files, new = unseen(landing, Ledger(home, looks=True))
    if as_json:
        out.print_json(json.dumps({"files": files, "new_files": [f.path for f in new]}))
        return
    for file in new:
        out.print(file.path, soft_wrap=True)
    out.print(f"{len(new)} new of {files} files; nothing was taken in")


def _bring_up_to_date(landing: Path, home: Path, as_json: bool, jobs: int, only: pl.Expr | None = None) -> None:
    from pipelines.orchestration.around_night import holding
    from pipelines.orchestration.nightly import complete_night

    began, bars = time.monotonic(), Bars(quiet=as_json)

    def say_stopped() -> None:
        bars.stop()
        say_error("stopped; the next run goes on from here")

    with ends_at_once(say_stopped), holding(home):
        try:
            night, fault = complete_night(landing, home, bars, only, jobs=jobs)
        finally:
            bars.stop()
    seconds = time.monotonic() - began
    for line in night.mended:
        err.print(f"mended: {line}", markup=False, soft_wrap=True)
    if as_json:
        told = {"seconds": round(seconds, 2), "idle": night.idle, "catalog_fault": fault} | night.after
        out.print_json(json.dumps(told | {f: getattr(night, f) for f in night.__slots__ if f not in ("came", "after")}))
    elif night.idle:
        said = f"Nothing new in {landing} ({night.files} files, {seconds:.1f} s)."
        mended = f" made anew, for {fault}" if fault else ""
        out.print(f"{said} Catalog{mended}: {home / 'catalog.duckdb'}", soft_wrap=True)
    else:
        _say(home, night, seconds)
    for line in () if as_json else night.not_read:
        err.print(f"not read: {line}", markup=False, soft_wrap=True)
    for name, value in () if as_json else night.after.items():
        if value:
            out.print(f"{name.replace('_', ' ')}: {value}", markup=False, soft_wrap=True)
    for line in (*night.untold, *night.not_followed):
        say_error(line)
    if night.failed or night.not_followed:
        raise typer.Exit(1)


def _say(home: Path, night: Any, seconds: float) -> None:
    _ranking(home)
    for where, why in night.failed.items():
        err.print(f"failed: {where}: {why}", markup=False, soft_wrap=True)
    out.print(
        f"{night.new_files} new of {night.files} files, {night.cells} cells in {night.runs} runs, {seconds:.0f} s."
    )
    _refusals(home, night.came)
    out.print(f"Catalog: {home / 'catalog.duckdb'}", soft_wrap=True)


def _refusals(home: Path, came: frozenset[str]) -> None:
    """What of tonight's files was set aside, and which columns of their aircraft fell silent."""
    from pipelines.intake.refusals import set_aside, silent_columns, silent_lines
    from pipelines.storage.catalog import connect

    with connect(home) as con:
        aside, silent = set_aside(con, came), silent_columns(con)
    if aside:
        err.print(f"set aside: {aside}", markup=False, soft_wrap=True)
    own = {tuple(path.split("/")[:2]) for path in came}
    for line in silent_lines(r for r in silent if (r["operator"], r["tail"]) in own):
        err.print(f"silent: {line}", markup=False, soft_wrap=True)


def _ranking(home: Path) -> None:
    """The packs most in need of attention, as the engineer reads them; in the words and the order of the report."""
    from pipelines.report import words
    from pipelines.storage.catalog import connect
    from pipelines.words import _

    with connect(home) as con:
        rows, units = (
            con.sql(f"select * from {view} order by place").pl().to_dicts()
            for view in ("fleet_ranking", "component_ranking")
        )
    table = Table(title=_("Packs most in need of attention"), box=SIMPLE_HEAD, pad_edge=False)
    names = (_("pack"), _("urgency"), _("UA lost\n(90 %)"), _("flights left\n(90 %)"), _("message\nin 50"))
    for k, name in enumerate((*names, _("open alerts"))):
        table.add_column(name, justify="right" if k in (2, 4) else "left", no_wrap=k not in (3, 5))
    for r in rows[:SHOWN]:
        outlook = words.loss(r), words.flights_left(r), words.chance(r["p_event_50"])
        table.add_row(f"{r['operator']} {r['tail']} {r['pack']}", words.urgency(r), *outlook, r["diagnoses"] or "")
    out.print(table)
    _components(units[:SHOWN])
    for line in words.unknown([*rows, *units]):
        out.print(line, markup=False, soft_wrap=True)


def _components(rows: list[dict[str, Any]]) -> None:
    """The units of other components most in need of attention; nothing where none is declared."""
    from pipelines.report import words
    from pipelines.words import _

    if not rows:
        return
    table = Table(title=_("Other components most in need of attention"), box=SIMPLE_HEAD, pad_edge=False)
    names = (_("unit"), _("urgency"), _("lost\n(90 %)"), _("flights left\n(90 %)"), _("failure\nin 50"))
    for k, name in enumerate((*names, _("open alerts"))):
        table.add_column(name, no_wrap=k not in (3, 5))
    for r in rows:
        outlook = words.share(r["loss"], r["loss_sd"]), words.flights_left(r), words.chance(r["p_event_50"])
        name = f"{r['operator']} {r['tail']} {r['component']} {r['pack']}"
        table.add_row(name, words.urgency(r), *outlook, r["diagnoses"] or "")
    out.print(table)
