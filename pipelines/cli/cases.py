"""Commands about cases: close an alert with what was found, and who has which case in hand."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from pipelines.cli.base import AsJson, HomeDir, StopError, app, home_folder, out

AlertId = Annotated[str, typer.Argument(metavar="ALERT", help="The alert's id, or its first digits.")]
By = Annotated[str, typer.Option("--by", help="Who does it.")]
Note = Annotated[str | None, typer.Option("--note", help="Why, or what else there is to say.")]

case = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Who has which case in hand.")
app.add_typer(case, name="case")


@app.command()
def close(
    alert: AlertId,
    finding: Annotated[str, typer.Option(help="clean, fouled, clogged, corroded or damaged.")],
    by: By,
    action: Annotated[str, typer.Option(help="inspected, cleaned, replaced or adjusted.")] = "inspected",
    on: Annotated[str | None, typer.Option(help="Day or time (UTC) of the work; now, if not given.")] = None,
    reference: Annotated[str | None, typer.Option(help="Work order.")] = None,
    note: Note = None,
    home: HomeDir = None,
) -> None:
    """Close an alert with what was found.

    It is on record at once; the next night answers as if the maintenance log had said so.
    """
    _change(home, alert, "close", by, finding=finding, action=action, on=on, reference=reference, note=note)


@case.command("acknowledge")
def acknowledge(alert: AlertId, by: By, note: Note = None, home: HomeDir = None) -> None:
    """Say that an alert is seen."""
    _change(home, alert, "acknowledge", by, note=note)


@case.command("assign")
def assign(
    alert: AlertId,
    to: Annotated[str, typer.Option("--to", help="Whose it is from now on.")],
    by: By,
    note: Note = None,
    home: HomeDir = None,
) -> None:
    """Give a case to somebody."""
    _change(home, alert, "assign", by, assignee=to, note=note)


@case.command("mute")
def mute(
    alert: AlertId,
    until: Annotated[str, typer.Option(help="Day or time (UTC); of a day, its end.")],
    by: By,
    note: Annotated[str, typer.Option("--note", help="Why.")],
    home: HomeDir = None,
) -> None:
    """Hear nothing of a case until a day, or until it is worse."""
    _change(home, alert, "mute", by, until=until, note=note)


@case.command("watch")
def watch(
    alert: AlertId,
    by: By,
    stop: Annotated[bool, typer.Option("--stop", help="Watch it no more.")] = False,
    note: Note = None,
    home: HomeDir = None,
) -> None:
    """Keep an eye on a case."""
    _change(home, alert, "unwatch" if stop else "watch", by, note=note)


@case.command("reopen")
def reopen(
    alert: AlertId, by: By, note: Annotated[str, typer.Option("--note", help="Why.")], home: HomeDir = None
) -> None:
    """Take back a closing or a mute; the line stays on record."""
    _change(home, alert, "reopen", by, note=note)


@case.command("list")
def list_(
    home: HomeDir = None,
    every: Annotated[bool, typer.Option("--all", help="Closed ones too.")] = False,
    state: Annotated[str | None, typer.Option(help="Only those in this state.")] = None,
    as_json: AsJson = False,
) -> None:
    """How the open cases stand now, the most urgent first."""
    from pipelines.casework.listing import OPEN, list_cases

    where, given = ("state = $state", {"state": state}) if state else ("true" if every else OPEN, {})
    folder = home_folder(home)
    rows = _asked(lambda: list_cases(folder, where, given))
    if as_json:
        out.print_json(json.dumps(rows, default=str))
        return
    table = Table(box=SIMPLE_HEAD)
    for name in ("alert", "pack", "diagnosis", "severity", "state", "owner"):
        table.add_column(name, no_wrap=name not in {"state", "owner"})
    for r in rows:
        place = f"{r['tail']} {r['pack']}"
        table.add_row(r["alert_id"][:8], place, r["diagnosis"], r["severity"], state_of(r), r["owner"] or "")
    out.print(table)


def state_of(row: Mapping[str, Any]) -> str:
    """A case's state as it is told."""
    if row["state"] == "muted":
        return f"muted until {row['muted_until'].date()}"
    found = row["finding"] if row["state"] in {"answered", "confirmed"} else None
    return f"{row['state']} ({found.lower().replace('_', ' ')})" if found else str(row["state"])


@case.command("show")
def show(alert: AlertId, home: HomeDir = None, as_json: AsJson = False) -> None:
    """One case: how it stands, why, and all that was said of it."""
    from pipelines.casework.listing import find_case, history_of

    where = home_folder(home)
    found = _asked(lambda: find_case(where, alert))
    told = history_of(where, found["alert_id"])
    if as_json:
        out.print_json(json.dumps(found | {"history": told}, default=str))
        return
    head = f"{found['alert_id']}  {found['operator']} {found['tail']} pack {found['pack']}  {found['diagnosis']}"
    lines = [head, f"{state_of(found)}; severity {found['severity']}; raised {found['raised_at']:%Y-%m-%d}"]
    lines += [found["evidence_now"], found["recommended_action"]]
    for row in told:
        extra = (row["assignee"], row["until"], row["finding"], row["action"], row["note"])
        said = ", ".join(str(x) for x in extra if x is not None)
        lines.append(f"{row['at']:%Y-%m-%d %H:%M}  {row['person']}  {row['kind']}{': ' + said if said else ''}")
    out.print("\n".join(lines), markup=False, soft_wrap=True)


def _change(home: Path | None, alert: str, kind: str, by: str, **asked: Any) -> None:
    from pipelines.casework.changes import change_case
    from pipelines.casework.listing import find_case

    where = home_folder(home)
    message = _asked(lambda: change_case(where, find_case(where, alert), kind, by, **asked))
    out.print(message, markup=False, soft_wrap=True)


def _asked(what: Any) -> Any:
    """What was asked for, or a line that says why not."""
    import duckdb

    from pipelines.storage.cases import ConflictError

    try:
        return what()
    except (duckdb.CatalogException, duckdb.BinderException):
        raise StopError("the catalog was made by an earlier version; `hdt nightly` makes it anew") from None
    except (LookupError, ValueError, ConflictError) as error:
        raise StopError(str(error.args[0] if error.args else error)) from None
