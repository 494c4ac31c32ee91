"""Seal the frozen configuration at the start, changed alerts and prognoses each night, and outcomes from files."""

import math
from collections.abc import Iterable, Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import duckdb
import polars as pl

from hdt_trial.declaration import Declaration, Rule, TrialError, read_declaration
from hdt_trial.frozen import changes, frozen
from hdt_trial.log import LogEntry, append, entries
from pipelines.storage.catalog import connect, run_select

FOLDER = "trial"
OURS = "hdt"
PLACE = ("operator", "tail", "pack", "component")
Place = tuple[str, str, int, str]

_FLOWN = "select operator, tail, max(departed_at) as until from flights group by all order by all"
_ALERTS = """
select alert_id, operator, tail, pack, component, diagnosis, severity, raised_at, closed_at
from alerts order by raised_at, alert_id
"""
_PROGNOSES = """
select
    operator, tail, pack, component, departed_at, round(rul_low, 1) as rul_low, round(rul_flights, 1) as rul_flights,
    round(rul_high, 1) as rul_high, round(p_event_50, 5) as p_event_50, model_version, split
from prognoses
qualify row_number() over (partition by operator, tail, pack, component order by departed_at desc, flight_id desc) = 1
order by all
"""


def log_folder(home: Path) -> Path:
    """Return the folder of a home's trial log."""
    return home / FOLDER


def start(home: Path, declaration: str, now: datetime | None = None) -> LogEntry:
    """Start a trial: seal configuration, declaration, open alerts and current prognoses.

    Raises
    ------
    TrialError
        The folder holds a trial, or the declaration is invalid.
    """
    folder = log_folder(home)
    if folder.exists() and any(folder.iterdir()):
        raise TrialError(f"{folder} holds a trial; move it away to start another")
    declared = read_declaration(declaration)
    with connect(home) as con:
        body = {"declaration": declaration, "frozen": frozen(con, home)}
        body |= _collect_changes(con, declared, {}, {})
    folder.mkdir(parents=True, exist_ok=True)
    return append(folder, "start", body, now or datetime.now(UTC))


def seal_night(home: Path, now: datetime | None = None) -> LogEntry | None:
    """Seal tonight's changes; None where no trial runs.

    Raises
    ------
    TrialError
        The log was altered, or a rule of the operator fails.
    """
    folder = log_folder(home)
    now = now or datetime.now(UTC)
    if not folder.is_dir():
        return None
    log = entries(folder)
    declared = declaration_of(log)
    if now >= log[0].sealed_at + timedelta(days=declared.days):
        return None
    with connect(home) as con:
        differences = changes(_last_frozen(log), is_now := frozen(con, home))
        body = ({"changes": differences, "frozen": is_now} if differences else {}) | _collect_changes(
            con, declared, *_state(log)
        )
    return append(folder, "night", body, now)


def after_night(home: Path) -> dict[str, str | None]:
    """Seal a night after its publication; return the entry's digest, None where nothing was sealed.

    Raises
    ------
    TrialError
        As of `seal_night`.
    """
    try:
        entry = seal_night(home)
    except TrialError as error:
        raise TrialError(f"the trial was not sealed: {error}") from None
    return {"trial_digest": entry.digest if entry else None}


def declaration_of(log: Sequence[LogEntry]) -> Declaration:
    """Return the declaration the trial was started with."""
    if not log or log[0].kind != "start":
        raise TrialError("no trial was started here; start one with `hdt trial start`")
    return read_declaration(log[0].body["declaration"])


def _collect_changes(
    con: duckdb.DuckDBPyConnection,
    declared: Declaration,
    alerts: dict[str, dict[str, dict[str, Any]]],
    prognoses: dict[Place, dict[str, Any]],
) -> dict[str, Any]:
    """Collect what changed since the last entry: flights on record, alerts by source, prognoses."""
    sources = {OURS: con.sql(_ALERTS).pl()}
    sources |= {rule.name: _by_rule(con, rule) for rule in declared.rules if rule.sql}
    new = {}
    withdrawn = {}
    for source, frame in sources.items():
        before = alerts.get(source, {})
        now = {row["alert_id"]: row for row in _rows(frame)}
        new[source] = [row for name, row in now.items() if before.get(name) != row]
        withdrawn[source] = sorted(set(before) - set(now))
    outlook = [row for row in _rows(con.sql(_PROGNOSES).pl()) if prognoses.get(place_of(row)) != row]
    return {"flown": _rows(con.sql(_FLOWN).pl()), "alerts": new, "withdrawn": withdrawn, "prognoses": outlook}


def _by_rule(con: duckdb.DuckDBPyConnection, rule: Rule) -> pl.DataFrame:
    try:
        answer = run_select(con, str(rule.sql))
        frame = answer.pl() if answer else pl.DataFrame()
    except (ValueError, duckdb.Error) as error:
        raise TrialError(f"rule {rule.name}: {str(error).splitlines()[0]}") from None
    return as_alerts(frame, f"rule {rule.name}")


def as_alerts(frame: pl.DataFrame, where: str) -> pl.DataFrame:
    """Convert an operator's alerts to our columns; an alert is identified by its place and time raised."""
    if missing := [c for c in (*PLACE, "raised_at") if c not in frame.columns]:
        raise TrialError(f"{where} has no column {missing[0]}; alerts have {', '.join((*PLACE, 'raised_at'))}")
    times = [pl.col(c) if c in frame.columns else pl.lit(None).alias(c) for c in ("raised_at", "closed_at")]
    alerts = frame.select(*PLACE, *(t.cast(pl.Datetime("us", "UTC")) for t in times))
    if alerts.select(pl.any_horizontal(pl.col(*PLACE, "raised_at").is_null().any())).item():
        raise TrialError(f"{where} has an alert without {', '.join(PLACE)} or raised_at")
    name = pl.concat_str(*PLACE, pl.col("raised_at").dt.to_string("iso:strict"), separator=" ")
    return alerts.with_columns(alert_id=name).unique("alert_id", keep="first", maintain_order=True).sort("alert_id")


def _state(
    log: Iterable[LogEntry],
) -> tuple[dict[str, dict[str, dict[str, Any]]], dict[Place, dict[str, Any]]]:
    """Return the last sealed state of each alert and of each unit's prognosis."""
    alerts: dict[str, dict[str, dict[str, Any]]] = {}
    prognoses: dict[Place, dict[str, Any]] = {}
    for entry in log:
        for source, rows in entry.body.get("alerts", {}).items():
            alerts.setdefault(source, {}).update({row["alert_id"]: row for row in rows})
        for source, names in entry.body.get("withdrawn", {}).items():
            for name in names:
                alerts[source].pop(name, None)
        prognoses |= {place_of(row): row for row in entry.body.get("prognoses", [])}
    return alerts, prognoses


def _last_frozen(log: Sequence[LogEntry]) -> dict[str, Any]:
    return next(dict(e.body["frozen"]) for e in reversed(log) if "frozen" in e.body)


def place_of(row: dict[str, Any]) -> Place:
    """Operator, tail, pack and component of a row."""
    operator, tail, pack, component = (row[c] for c in PLACE)
    return str(operator), str(tail), int(pack), str(component)


def _rows(frame: pl.DataFrame) -> list[dict[str, Any]]:
    """Rows as JSON holds them: times in ISO 8601, UTC; missing is null."""
    return [{name: _plain(value) for name, value in row.items()} for row in frame.iter_rows(named=True)]


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.astimezone(UTC).isoformat()
    if isinstance(value, date):
        return value.isoformat()
    return None if isinstance(value, float) and not math.isfinite(value) else value
