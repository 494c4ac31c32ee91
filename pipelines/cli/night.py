"""Commands that process new data: nightly, backfill and tidy."""

import datetime as dt
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import polars as pl
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

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
    print_error,
    stop_at_once,
)
from pipelines.orchestration.local_executor import cores
from pipelines.storage.settings import MAX_DAYS, retention

if TYPE_CHECKING:
    from pipelines.report.rows import UnitRow

MAX_ROWS = 10
"""Packs, and units, that the terminal lists."""
DryRun = Annotated[bool, typer.Option("--dry-run", help="List the new files without processing them.")]
Jobs = Annotated[int, typer.Option("--jobs", "-j", min=1, help="Parallel processes, at most.")]
Day = Annotated[dt.datetime | None, typer.Option(formats=["%Y-%m-%d"])]


class Bars:
    """Progress bars of a long run, on standard error."""

    def __init__(self, quiet: bool) -> None:
        counts = (TextColumn("{task.description:<28}"), BarColumn(), MofNCompleteColumn())
        self.bars = Progress(*counts, TimeElapsedColumn(), TimeRemainingColumn(), console=err, disable=quiet)
        self.task: Any = None

    def start(self, label: str, total: int) -> None:
        """Begin a step."""
        if self.task is None:
            self.bars.start()
        self.task = self.bars.add_task(label, total=total)

    def advance(self, cells: int) -> None:
        """Count cells of the step as done."""
        self.bars.advance(self.task, cells)

    def stop(self) -> None:
        """Restore the terminal."""
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
    """Process new files and print the packs that need attention.

    From raw data to alerts. Exit code 1 if an aircraft failed; the others are complete.
    """
    from pipelines.orchestration.around_night import report_failure

    if home is None:
        landing_folder(landing)  # of two folders that are not named the landing zone is asked for first
    where = home_folder(home, must_exist=False)
    with report_failure(where, print_error):
        zone = landing_folder(landing)
    if dry_run:
        _print_new_files(zone, where, as_json)
    else:
        from pipelines.words import use_language

        with use_language(language):
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
    """Process history in bulk.

    By operator, aircraft or departure date, both ends included. It may be stopped and started again.
    """
    where = landing_folder(landing)
    from pipelines.intake.landing_file import is_operator, is_tail

    if operator and not (is_operator(operator) and (where / operator).is_dir()):
        raise StopError(f"no operator {operator} in {where}")
    if tail and not (is_tail(tail) and any(where.glob(f"*/{tail}"))):
        raise StopError(f"no aircraft {tail} in {where}")
    if since and until and since > until:
        raise StopError(f"--since {since:%Y-%m-%d} is after --until {until:%Y-%m-%d}; exchange them")
    day = pl.col("flight_id").str.extract(r"_(\d{8})_\d+$")
    conditions = [pl.col(column) == name for column, name in (("operator", operator), ("tail", tail)) if name]
    conditions += [(day >= f"{since:%Y%m%d}").fill_null(True)] if since else []
    conditions += [(day <= f"{until:%Y%m%d}").fill_null(True)] if until else []
    only = pl.all_horizontal(pl.lit(True), *conditions)
    _bring_up_to_date(where, home_folder(home, must_exist=False), as_json, jobs, only)


@app.command()
def tidy(
    home: HomeDir = None,
    keep_days: Annotated[
        int | None,
        typer.Option("--keep-days", min=0, max=MAX_DAYS, help="Keep runs younger than this; the home's. [days]"),
    ] = None,
) -> None:
    """Delete old runs, or a damaged file, of Dagster's history.

    A night deletes some; this deletes all at once, and makes the files as small as they can be. Tables are not touched,
    nothing is computed again, and Dagster's page shows the same cells as materialized.
    """
    from dagster_batched.history import compact_files, forget_runs
    from pipelines.orchestration.around_night import lock_home
    from pipelines.orchestration.runs import open_instance
    from pipelines.repair import replace_damaged_history

    where = home_folder(home)
    days = retention(where).dagster_history_days if keep_days is None else keep_days
    with lock_home(where):
        if message := replace_damaged_history(where):
            out.print(message)
    with lock_home(where), open_instance(where) as instance:
        before = dt.datetime.now(dt.UTC) - dt.timedelta(days=days)
        runs = sum(iter(lambda: forget_runs(instance, before), 0))
        compact_files(instance)
    out.print(f"{runs} runs deleted")


def _print_new_files(landing: Path, home: Path, as_json: bool) -> None:
    from pipelines.intake.scan import list_new_files
    from pipelines.storage.ledger import Ledger

    files, new = list_new_files(landing, Ledger(home, read_only=True))
    if as_json:
        out.print_json(json.dumps({"files": files, "new_files": [f.path for f in new]}))
        return
    for file in new:
        out.print(file.path)
    out.print(f"{len(new)} new of {files} files; none was processed")


def _bring_up_to_date(landing: Path, home: Path, as_json: bool, jobs: int, only: pl.Expr | None = None) -> None:
    from pipelines.orchestration.around_night import lock_home, notify_failure, report_failure
    from pipelines.orchestration.nightly import complete_night

    start_s = time.monotonic()
    bars = Bars(quiet=as_json)

    def report_stop() -> None:
        bars.stop()
        print_error("stopped; the next run continues from here")

    with stop_at_once(report_stop), report_failure(home, print_error), lock_home(home):
        try:
            night, fault = complete_night(landing, home, bars, only, jobs=jobs)
        finally:
            bars.stop()
    seconds = time.monotonic() - start_s
    for line in night.repairs:
        err.print(f"repaired: {line}", soft_wrap=True)
    if as_json:
        values = {"seconds": round(seconds, 2), "idle": night.idle, "catalog_fault": fault} | night.hook_results
        values |= {f: getattr(night, f) for f in night.__slots__ if f not in ("new_paths", "instance")}
        out.print_json(json.dumps(values))
    else:
        _print_night(landing, home, night, fault, seconds)
    for line in (*night.failed_deliveries, *night.failed_hooks):
        print_error(line)
    if clock := "" if night.idle else _clock_fault(home, night.new_paths):
        print_error(clock)
    failed = [*(f"{cell}: {why}" for cell, why in night.failed.items()), *night.failed_hooks, *filter(None, [clock])]
    if failed:
        for line in notify_failure(home, failed):
            print_error(line)
        raise typer.Exit(1)


def _clock_fault(home: Path, files: frozenset[str]) -> str:
    """Describe the machine's clock where most of what is new lies after it."""
    from pipelines.intake.held import clock_fault
    from pipelines.storage.catalog import connect

    with connect(home) as con:
        return clock_fault(con, files)


def _print_night(landing: Path, home: Path, night: Any, fault: str | None, seconds: float) -> None:
    if night.idle:
        catalog = f"Catalog written again, for {fault}" if fault else "Catalog"
        idle = f"Nothing new in {landing} ({night.files} files, {seconds:.1f} s)"
        out.print(f"{idle}. {catalog}: {home / 'catalog.duckdb'}")
    else:
        _print_results(home, night, seconds)
    for line in night.ignored_names:
        err.print(f"not read: {line}", soft_wrap=True)
    for name, value in night.hook_results.items():
        if value:
            out.print(f"{name.replace('_', ' ')}: {value}")


def _print_results(home: Path, night: Any, seconds: float) -> None:
    _print_log_faults(home)
    print_ranking(home)
    for where, why in night.failed.items():
        err.print(f"failed: {where}: {why}", soft_wrap=True)
    out.print(
        f"{night.new_files} new of {night.files} files, {night.cells} cells in {night.runs} runs, {seconds:.0f} s."
    )
    _print_refusals(home, night.new_paths)
    out.print(f"Catalog: {home / 'catalog.duckdb'}")


def _print_log_faults(home: Path) -> None:
    """Print logs of which most lines are refused, and work that the flights do not show as it is logged."""
    from pipelines.intake.faults import judged_work_lines, refused_logs
    from pipelines.storage.catalog import connect

    with connect(home) as con:
        refused = refused_logs(con)
        work_lines = judged_work_lines(con)
    for line in refused:
        err.print(f"refused: {line}", soft_wrap=True)
    for line in work_lines:
        err.print(f"log: {line}", soft_wrap=True)


def _print_refusals(home: Path, files: frozenset[str]) -> None:
    """Print held flights, what of tonight's files was refused or noted, and the silent columns of their aircraft."""
    from pipelines.intake.faults import file_lines, quarantine_line, silent_columns, silent_lines
    from pipelines.intake.held import HELD_GROUPS, held_flights, held_lines
    from pipelines.storage.catalog import connect

    with connect(home) as con:
        quarantined = quarantine_line(con, files)
        silent = silent_columns(con)
        refused = file_lines(con, files, notes=False)
        noted = file_lines(con, files, notes=True)
        lines_of_held = held_lines(held_flights(con, HELD_GROUPS))
    if quarantined:
        err.print(f"set aside: {quarantined}", soft_wrap=True)
    for line in lines_of_held:
        err.print(f"held: {line}", soft_wrap=True)
    for line in refused:
        err.print(f"nothing stored of: {line}", soft_wrap=True)
    for line in noted:
        err.print(f"noted: {line}", soft_wrap=True)
    own = {tuple(path.split("/")[:2]) for path in files}
    for line in silent_lines(r for r in silent if (r["operator"], r["tail"]) in own):
        err.print(f"silent: {line}", soft_wrap=True)


def print_ranking(home: Path) -> None:
    """Print the packs, and units of other components, most in need of attention, in the report's order and words."""
    from pipelines.report import words
    from pipelines.report.rows import rows_of, silence_lines
    from pipelines.words import _

    rows = rows_of(home)
    packs = [unit for unit in rows if unit["component"] is None]
    others = [unit for unit in rows if unit["component"]]
    _print_rows(_("Packs most in need of attention"), packs)
    if others:
        _print_rows(_("Other components most in need of attention"), others)
    for line in (*words.unknown([unit.values for unit in rows]), *silence_lines(rows)):
        out.print(line)


def _print_rows(title: str, units: list["UnitRow"]) -> None:
    """Print two lines a unit: its values in columns, then what to do, why, and its message."""
    from pipelines.report.words import urgency, wrap
    from pipelines.words import _, several

    lines = [(_("unit"), _("urgency"), _("lost"), _("flights left (90 %)"))]
    for unit in units[:MAX_ROWS]:
        part = f"{unit['component']} " if unit["component"] else ""
        name = f"{unit['operator']} {unit['tail']} {part}{unit['pack']}"
        lines.append((name, urgency(unit.values), unit.loss(), unit.flights_left()))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    head, *rows = ("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)
    rule = "─" * max(map(len, (head, *rows)))
    out.print(f"{title}\n\n{head}\n{rule}")
    for unit, row in zip(units, rows, strict=False):
        why = "; ".join(filter(None, (unit.to_do(), unit.diagnosis(), unit.message_phrase(), *unit.notes())))
        out.print(row)
        out.print(wrap(why, out.width, indent=4))
    out.print()
    if (n := len(units) - MAX_ROWS) > 0:
        out.print(several("{n} more in the report.", "{n} more in the report.", n))
