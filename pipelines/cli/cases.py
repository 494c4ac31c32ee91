"""Commands about cases: close an alert with a finding; acknowledge, assign, mute and watch cases."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from pipelines.cli.base import AsJson, HomeDir, app, home_folder, out

AlertId = Annotated[
    str,
    typer.Argument(
        metavar="ALERT", help="The case's id, or its first digits; also of an id that its alert has or had."
    ),
]
By = Annotated[str, typer.Option("--by", help="Your name.")]
Note = Annotated[str | None, typer.Option("--note", help="Reason or remark.")]

case = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Cases: who works on which alert.")
app.add_typer(case, name="case")


@app.command()
def close(
    alert: AlertId,
    finding: Annotated[
        str, typer.Option(help="clean, fouled, clogged, corroded, damaged, or one of the component's own.")
    ],
    by: By,
    action: Annotated[str, typer.Option(help="inspected, cleaned, replaced or adjusted.")] = "inspected",
    on: Annotated[str | None, typer.Option(help="Day or time (UTC) of the work; default now.")] = None,
    reference: Annotated[str | None, typer.Option(help="Work order.")] = None,
    note: Note = None,
    home: HomeDir = None,
) -> None:
    """Close an alert with a finding.

    It counts at once in every output; the next night treats it as an entry of the maintenance log.
    """
    _change(home, alert, "close", by, finding=finding, action=action, on=on, reference=reference, note=note)


@case.command("acknowledge")
def acknowledge(alert: AlertId, by: By, note: Note = None, home: HomeDir = None) -> None:
    """Acknowledge an alert."""
    _change(home, alert, "acknowledge", by, note=note)


@case.command("assign")
def assign(
    alert: AlertId,
    to: Annotated[str, typer.Option("--to", help="Its new owner.")],
    by: By,
    note: Note = None,
    home: HomeDir = None,
) -> None:
    """Assign a case to a person."""
    _change(home, alert, "assign", by, assignee=to, note=note)


@case.command("mute")
def mute(
    alert: AlertId,
    until: Annotated[str, typer.Option(help="Day or time (UTC); of a day, its end.")],
    by: By,
    note: Annotated[str, typer.Option("--note", help="Reason.")],
    home: HomeDir = None,
) -> None:
    """Mute a case until a day, or until it gets worse."""
    _change(home, alert, "mute", by, until=until, note=note)


@case.command("watch")
def watch(
    alert: AlertId,
    by: By,
    stop: Annotated[bool, typer.Option("--stop", help="Stop watching it.")] = False,
    note: Note = None,
    home: HomeDir = None,
) -> None:
    """Watch a case."""
    _change(home, alert, "unwatch" if stop else "watch", by, note=note)


@case.command("reopen")
def reopen(
    alert: AlertId, by: By, note: Annotated[str, typer.Option("--note", help="Reason.")], home: HomeDir = None
) -> None:
    """Take back a closing or a mute; its line stays in the log."""
    _change(home, alert, "reopen", by, note=note)


State = Literal["new", "acknowledged", "muted", "worsened", "confirmed", "closed"]


@case.command("list")
def list_(
    home: HomeDir = None,
    every: Annotated[bool, typer.Option("--all", help="Include closed cases.")] = False,
    state: Annotated[State | None, typer.Option(help="Only those in this state.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the open cases, the most urgent first."""
    from pipelines.casework import OPEN, list_cases
    from pipelines.report import words
    from pipelines.report.rows import rows_of

    where, values = ("state = $state", {"state": state}) if state else ("true" if every else OPEN, {})
    folder = home_folder(home)
    rows = list_cases(folder, where, **values)
    if as_json:
        out.print_json(json.dumps(rows, default=str))
        return
    table = Table(box=SIMPLE_HEAD)
    for name in ("alert", "unit", "diagnosis", "severity", "state", "owner"):
        table.add_column(name, no_wrap=name not in {"unit", "diagnosis", "state", "owner"})
    for r in rows:
        name = f"{r['operator']} {words.unit_name(r)}"
        labels = (name, words.diagnosis(r["diagnosis"]), r["severity"], _state(r), r["owner"] or "")
        table.add_row(r["case_id"][:8], *labels)
    for unit in rows_of(folder):
        if state is None and unit.needs_work and unit["alert_id"] is None:
            table.add_row("", unit.name(), unit.to_do(), "", "no alert", "")
    out.print(table, soft_wrap=False)


def _state(row: Mapping[str, Any]) -> str:
    from pipelines.report.words import last_day

    if row["state"] == "muted":
        return f"muted until {last_day(row['muted_until'])}"
    finding = row["finding"] if row["state"] == "confirmed" else None
    return f"{row['state']} ({finding.lower().replace('_', ' ')})" if finding else str(row["state"])


@case.command("show")
def show(alert: AlertId, home: HomeDir = None, as_json: AsJson = False) -> None:
    """Show one case: its state, evidence, action and history."""
    from pipelines.casework import find_case, findings, history_of
    from pipelines.report import words
    from pipelines.words.evidence import WITH_COLUMNS, action_text, evidence_text

    where = home_folder(home)
    row = find_case(where, alert)
    history = history_of(where, row)
    if as_json:
        out.print_json(json.dumps(row | {"history": history}, default=str))
        return
    head = f"{row['case_id']}  {row['operator']} {words.unit_name(row)}  {words.diagnosis(row['diagnosis'])}"
    lines = [head, f"{_state(row)}; severity {row['severity']}; raised {row['raised_at']:%Y-%m-%d}"]
    lines += [
        evidence_text(row["evidence_now_phrases"], WITH_COLUMNS),
        action_text(row["action_phrases"], WITH_COLUMNS),
    ]
    lines += [f"hdt close {row['case_id'][:8]} --finding: {', '.join(findings(row['component']))}"]
    for entry in history:
        values = (entry[c] for c in ("assignee", "until", "finding", "action", "note"))
        text = ", ".join(str(v) for v in values if v is not None)
        lines.append(f"{entry['at']:%Y-%m-%d %H:%M}  {entry['person']}  {entry['kind']}{': ' + text if text else ''}")
    out.print("\n".join(lines))


def _change(home: Path | None, alert: str, kind: str, by: str, **fields: Any) -> None:
    from pipelines.casework import change_case, find_case

    where = home_folder(home)
    out.print(change_case(where, find_case(where, alert), kind, by, **fields))
