"""Outcomes of units: messages, removals and findings, from the catalog and from files of outcomes."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import duckdb
import polars as pl

from hdt_trial.declaration import Declaration, TrialError
from hdt_trial.log import LogEntry, append, entries
from hdt_trial.seal import PLACE, Place, declaration_of, log_folder

COLUMNS = ("operator", "tail", "pack", "component", "at", "kind", "finding", "reference")
KINDS = ("MESSAGE", "REPLACED", "INSPECTED")

_LOGGED = """
select m.operator, m.tail, m.pack, c.component, m.message_time as at, 'MESSAGE' as kind, null as finding
from tables.raw_messages as m
inner join tables.components as c on m.code = c.message_code
union all
select
    operator, tail, position as pack, component, flown_from as at,
    case when action = 'REPLACED' and in_force then 'REPLACED' else 'INSPECTED' end as kind, finding
from maintenance where is_done
union all
select operator, tail, position as pack, component, flown_from as at, 'ANSWERED' as kind, finding
from maintenance where is_shown and finding is distinct from 'NO_FAULT_FOUND'
"""
_FLIGHTS = "select operator, tail, list_sort(list(distinct departed_at)) as departed from flights group by all"


@dataclass(frozen=True, slots=True)
class Outcomes:
    """Outcomes of each place, in order of time."""

    departed: dict[tuple[str, str], list[datetime]]
    """Departures of each aircraft."""
    events: dict[Place, list[datetime]]
    """Events to be foretold: the first message of each unit, or its removal with a finding."""
    removals: dict[Place, list[datetime]]
    no_faults: dict[Place, list[datetime]]
    answers: dict[Place, list[datetime]]
    """Work whose recovery shows the loss that it took away."""
    without_pack: int
    """Messages and works that name no pack: of no unit, so not judged."""


def read_outcomes(con: duckdb.DuckDBPyConnection, log: Sequence[LogEntry], declared: Declaration) -> Outcomes:
    """Read the outcomes on record."""
    logged = con.sql(_LOGGED).pl().select(*COLUMNS[:7]).with_columns(pl.col("at").dt.convert_time_zone("UTC"))
    own = [row for entry in log if entry.kind == "outcomes" for row in entry.body["rows"]]
    if own:
        at = pl.col("at").str.to_datetime(time_unit="us", time_zone="UTC")
        sealed = pl.DataFrame(own, infer_schema_length=None).with_columns(at, pl.col("pack").cast(pl.Int32))
        logged = pl.concat([logged, sealed.select(*COLUMNS[:7])], how="vertical_relaxed")
    with_pack = logged.filter(pl.col("pack").is_not_null()).sort("at")
    departed = {(o, t): times for o, t, times in con.sql(_FLIGHTS).pl().iter_rows()}
    return outcomes_of(with_pack, departed, declared, logged.height - with_pack.height)


def outcomes_of(
    rows: pl.DataFrame, departed: dict[tuple[str, str], list[datetime]], declared: Declaration, without_pack: int = 0
) -> Outcomes:
    """Events, removals, findings without a fault and answers, of rows `COLUMNS[:7]` in order of time."""
    removals, no_faults, events, answers = (dict[Place, list[datetime]]() for _ in range(4))
    open_events: set[Place] = set()
    for *place, at, kind, finding in rows.iter_rows():
        key = (place[0], place[1], place[2], place[3])
        if kind == "ANSWERED":
            answers.setdefault(key, []).append(at)
            continue
        if finding in declared.no_fault:
            no_faults.setdefault(key, []).append(at)
        if key not in open_events and (kind == "MESSAGE" or (kind == "REPLACED" and finding in declared.findings)):
            events.setdefault(key, []).append(at)
            open_events.add(key)
        if kind == "REPLACED":
            removals.setdefault(key, []).append(at)
            open_events.discard(key)
    return Outcomes(departed, events, removals, no_faults, answers, without_pack)


def seal_outcomes(home: Path, file: Path, now: datetime | None = None) -> LogEntry:
    """Seal outcomes missing from the logs: shop findings, removals, messages reported orally.

    Raises
    ------
    TrialError
        A column is missing or a value is invalid; the message names file, row and column.
    """
    try:
        table = pl.read_csv(file, infer_schema=False)
    except pl.exceptions.PolarsError as error:
        raise TrialError(f"{file} is not valid CSV: {str(error).splitlines()[0]}") from None
    if missing := [c for c in COLUMNS[:6] if c not in table.columns]:
        raise TrialError(f"{file} has no column {missing[0]}; it has {', '.join(COLUMNS)}, the last two may be empty")
    rows = [_check_row(file, n, row) for n, row in enumerate(table.iter_rows(named=True), start=2)]
    folder = log_folder(home)
    declaration_of(entries(folder))
    return append(folder, "outcomes", {"file": file.name, "rows": rows}, now or datetime.now(UTC))


def _check_row(file: Path, number: int, row: dict[str, str | None]) -> dict[str, Any]:
    def refuse(column: str, expected: str) -> TrialError:
        return TrialError(f"{file} row {number} column {column}: {row.get(column)!r} is not {expected}")

    for column in ("operator", "tail", "component"):
        if not row[column]:
            raise refuse(column, "a name")
    if not (row["pack"] or "").isdecimal():
        raise refuse("pack", "a whole number")
    if row["kind"] not in KINDS:
        raise refuse("kind", f"one of {', '.join(KINDS)}")
    try:
        at = datetime.fromisoformat(row["at"] or "")
    except ValueError:
        raise refuse("at", "a time as 2026-03-01T14:05:00Z") from None
    at = at.replace(tzinfo=at.tzinfo or UTC).astimezone(UTC)
    key = {c: row[c] for c in PLACE if c != "pack"} | {"pack": int(row["pack"] or 0)}
    return key | {"at": at.isoformat(), "kind": row["kind"]} | {c: row.get(c) or None for c in COLUMNS[6:]}
