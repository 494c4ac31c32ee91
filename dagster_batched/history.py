"""Bound Dagster's history: old runs are deleted, and of what they made one short event a partition remains.

Dagster's own `delete_run` deletes a run's materializations, too: cells that no later run made then show as missing, and
a backfill of missing cells makes them again. Here the last materialization of each partition remains in the index under
its id, as an event of no run, with its time and the versions by which Dagster tells stale cells. A run that holds the
last state of anything remains whole.

Every step can be repeated. A run is deleted from the list of runs last, so a killed process leaves it to the next.
"""

import json
import sqlite3
import sys
from contextlib import AbstractContextManager, closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import dagster as dg
from dagster._core.execution.backfill import BULK_ACTION_TERMINAL_STATUSES, BulkActionsFilter, BulkActionStatus
from dagster._core.instance.utils import RUNLESS_RUN_ID
from dagster._core.storage.dagster_run import FINISHED_STATUSES
from dagster._core.storage.event_log.schema import (
    AssetCheckExecutionsTable,
    AssetEventTagsTable,
    AssetKeyTable,
    SqlEventLogStorageTable,
)
from dagster._core.storage.event_log.sql_event_log import SqlEventLogStorage
from dagster._core.storage.event_log.sqlite import SqliteEventLogStorage
from dagster._core.storage.event_log.sqlite.sqlite_event_log import INDEX_SHARD_NAME
from dagster._core.storage.tags import BACKFILL_ID_TAG
from sqlalchemy import ColumnElement, Connection, and_, exists, func, select

from dagster_batched.event_log import CoalescingEventLog
from dagster_batched.runs import may_retry

RUNS_AT_ONCE = 200
_EVENTS_AT_ONCE = 5_000  # in one transaction: a tenth of a second
_PAGES_AT_ONCE = 2_500  # 20 MB of the index, which takes a quarter of a second
_SPARE_SHARE = 8  # an eighth of the index may be free, for the next night's events
_BUSY_S = 30
_MATERIALIZED = dg.DagsterEventType.ASSET_MATERIALIZATION.value
_PLANNED = dg.DagsterEventType.ASSET_MATERIALIZATION_PLANNED.value

_events = SqlEventLogStorageTable
_tags = AssetEventTagsTable
_checks = AssetCheckExecutionsTable


def forget_runs(instance: dg.DagsterInstance, before: datetime, most_events: int = sys.maxsize) -> int:
    """Delete runs that ended before a time, the oldest first; their number, at most `RUNS_AT_ONCE`.

    Parameters
    ----------
    instance : DagsterInstance
        Its event log is one of Dagster's, in SQLite or PostgreSQL, or of this package.
    before : datetime
        With a time zone.
    most_events : int
        Events of the index that may be deleted or shortened; a run with more is continued by the next call.
    """
    log = instance.event_log_storage
    assert isinstance(log, SqlEventLogStorage)
    ended = list[dg.DagsterRun]()
    for run in _expired_runs(instance, log, before):
        handled = _clear_index(log, run.run_id, most_events)
        most_events -= handled
        if most_events <= 0:
            break
        ended.append(run)
    _delete_checks(log, [run.run_id for run in ended])
    _delete_reports(log, before)
    for run in ended:
        instance.compute_log_manager.delete_logs(prefix=[run.run_id])
        if isinstance(log, SqliteEventLogStorage):
            _delete_shard(log, run.run_id)
        instance.run_storage.delete_run(run.run_id)
    if isinstance(log, SqliteEventLogStorage):
        _return_pages(Path(log.path_for_shard(INDEX_SHARD_NAME)))
    return len(ended)


def compact_files(instance: dg.DagsterInstance) -> None:
    """Rewrite SQLite's shared files without free pages: 100 MB take half a second, and as much of the disk.

    From then on the index returns free pages bit by bit, as one does that this version has created.
    """
    log = instance.event_log_storage
    if not isinstance(log, SqliteEventLogStorage):
        return
    index = Path(log.path_for_shard(INDEX_SHARD_NAME))
    others = (Path(log.path_for_shard(RUNLESS_RUN_ID)), index.with_name("runs.db"))
    log.dispose()
    for file in (index, *filter(Path.exists, others)):
        with closing(sqlite3.connect(file, timeout=_BUSY_S, isolation_level=None)) as con:
            if file == index:
                con.execute("pragma auto_vacuum = incremental")
            con.execute("vacuum")


def _transaction(log: SqlEventLogStorage) -> AbstractContextManager[Connection]:
    return log.transaction() if isinstance(log, CoalescingEventLog) else log.index_transaction()


def _expired_runs(instance: dg.DagsterInstance, log: SqlEventLogStorage, before: datetime) -> list[dg.DagsterRun]:
    """List runs that ended before a time and hold the last state of nothing, the oldest first."""
    needed = _needed_runs(instance, log)
    backfills = _active_backfills(instance)
    records = instance.get_run_records(
        dg.RunsFilter(statuses=list(FINISHED_STATUSES), updated_before=before),
        limit=RUNS_AT_ONCE + len(needed),
        order_by="update_timestamp",
        ascending=True,
    )
    runs = [record.dagster_run for record in records if record.dagster_run.run_id not in needed]
    expired = [r for r in runs if r.tags.get(BACKFILL_ID_TAG) not in backfills and not may_retry(instance, r)]
    return expired[:RUNS_AT_ONCE]


def _active_backfills(instance: dg.DagsterInstance) -> set[str]:
    active = [status for status in BulkActionStatus if status not in BULK_ACTION_TERMINAL_STATUSES]
    return {b.backfill_id for b in instance.get_backfills(BulkActionsFilter(statuses=active))}


def _needed_runs(instance: dg.DagsterInstance, log: SqlEventLogStorage) -> set[str]:
    """List the last runs of assets and of checks, and those whose partitions show as failed."""
    newest_checks = select(func.max(_checks.c.id)).group_by(_checks.c.asset_key, _checks.c.check_name)
    planned = and_(_events.c.dagster_event_type == _PLANNED, _events.c.partition.is_not(None))
    with log.index_connection() as conn:
        checks = conn.execute(select(_checks.c.run_id).where(_checks.c.id.in_(newest_checks))).scalars().all()
        planned_assets = conn.execute(select(_events.c.asset_key).where(planned).distinct()).scalars().all()
    needed = {*checks}
    for asset in (record.asset_entry for record in instance.get_asset_records()):
        needed |= {asset.last_run_id, asset.last_materialization.run_id if asset.last_materialization else None}
    for key in map(dg.AssetKey.from_db_string, planned_assets):
        if key is not None:
            attempts = log.get_latest_asset_partition_materialization_attempts_without_materializations(key)
            needed |= {run_id for run_id, _ in attempts.values()}
    return {run_id for run_id in needed if run_id}


def _clear_index(log: SqlEventLogStorage, run_id: str, most: int) -> int:
    """Delete or shorten a run's events in the index; their number, `most` where some may be left."""
    handled = 0
    while handled < most:
        with _transaction(log) as conn:
            number = _clear_some(conn, run_id, min(_EVENTS_AT_ONCE, most - handled))
        if not number:
            break
        handled += number
    return handled


def _clear_some(conn: Connection, run_id: str, most: int) -> int:
    """Delete the run's first events with their tags; insert a short one for each that is the last of its partition."""
    newer = _events.alias("newer")
    is_newer = exists().where(_of_same_cell(newer), newer.c.id > _events.c.id)
    is_last = and_(_events.c.dagster_event_type == _MATERIALIZED, _events.c.partition.is_not(None), ~is_newer)
    own = _events.c.run_id == run_id
    rows = conn.execute(select(_events, is_last.label("is_last")).where(own).order_by(_events.c.id).limit(most)).all()
    if not rows:
        return 0
    first_own = and_(own, _events.c.id <= rows[-1].id)
    conn.execute(_events.delete().where(_events.c.id.in_(_short_events_before(conn, first_own))))
    conn.execute(_tags.delete().where(_tags.c.event_id.in_(select(_events.c.id).where(first_own))))
    conn.execute(_events.delete().where(first_own))
    if remaining := [_short_row(row) for row in rows if row.is_last]:
        conn.execute(_events.insert(), remaining)
    return len(rows)


def _of_same_cell(other: Any) -> ColumnElement[bool]:
    return and_(
        other.c.asset_key == _events.c.asset_key,
        other.c.dagster_event_type == _MATERIALIZED,
        other.c.partition == _events.c.partition,
    )


def _short_events_before(conn: Connection, own: ColumnElement[bool]) -> list[int]:
    """List short events of the same cells as the own ones, which are newer."""
    short = _events.alias("short")
    is_short = func.coalesce(short.c.run_id, "") == RUNLESS_RUN_ID  # no index: most events may be short
    query = select(short.c.id).select_from(_events).join(short, and_(_of_same_cell(short), short.c.id < _events.c.id))
    return list(conn.execute(query.where(own, is_short)).scalars())


def _short_row(row: Any) -> dict[str, Any]:
    """Return the row of an event of no run with a materialization's id, time, partition and versions."""
    content = json.loads(row.event)
    event = content["dagster_event"]
    whole = event["event_specific_data"]["materialization"]
    materialization = {name: whole[name] for name in ("__class__", "asset_key", "partition", "tags")}
    short = {
        "__class__": content["__class__"],
        "dagster_event": {
            "__class__": event["__class__"],
            "event_specific_data": {"__class__": "StepMaterializationData", "materialization": materialization},
            "event_type_value": _MATERIALIZED,
            "pipeline_name": event["pipeline_name"],
        },
        "error_info": None,
        "level": content["level"],
        "run_id": RUNLESS_RUN_ID,
        "timestamp": content["timestamp"],
        "user_message": "",
    }
    return {
        "id": row.id,
        "run_id": RUNLESS_RUN_ID,
        "event": json.dumps(short, separators=(",", ":")),
        "dagster_event_type": _MATERIALIZED,
        "timestamp": row.timestamp,
        "asset_key": row.asset_key,
        "partition": row.partition,
    }


def _delete_checks(log: SqlEventLogStorage, run_ids: list[str]) -> None:
    if run_ids:
        with _transaction(log) as conn:
            conn.execute(_checks.delete().where(_checks.c.run_id.in_(run_ids)))


def _delete_reports(log: SqlEventLogStorage, before: datetime) -> None:
    """Delete old materializations of no run and no partition, but the last of each asset."""
    newer = _events.alias("newer")
    is_newer = exists().where(
        newer.c.asset_key == _events.c.asset_key,
        newer.c.dagster_event_type == _MATERIALIZED,
        newer.c.partition.is_(None),
        newer.c.id > _events.c.id,
    )
    is_old = _events.c.timestamp < before.astimezone(UTC).replace(tzinfo=None)
    reports = select(_events.c.id).where(
        _events.c.asset_key.in_(select(AssetKeyTable.c.asset_key)),
        _events.c.dagster_event_type == _MATERIALIZED,
        _events.c.partition.is_(None),
        func.coalesce(_events.c.run_id, "") == RUNLESS_RUN_ID,  # no index: most events of no run have a partition
        is_old,
        is_newer,
    )
    with _transaction(log) as conn:
        ids = list(conn.execute(reports.limit(_EVENTS_AT_ONCE)).scalars())
        conn.execute(_tags.delete().where(_tags.c.event_id.in_(ids)))
        conn.execute(_events.delete().where(_events.c.id.in_(ids)))
    if isinstance(log, SqliteEventLogStorage):  # each is a second time in a file of its own
        with log.run_connection(RUNLESS_RUN_ID) as conn:
            conn.execute(_events.delete().where(is_old))


def _delete_shard(log: SqliteEventLogStorage, run_id: str) -> None:
    """Delete a run's own file, and SQLite's files beside it."""
    for end in ("-wal", "-shm", ""):
        Path(f"{log.path_for_shard(run_id)}{end}").unlink(missing_ok=True)


def _return_pages(index: Path) -> None:
    """Return some of the index's free pages to the disk; one of an older version has none to return."""
    with closing(sqlite3.connect(index, timeout=_BUSY_S, isolation_level=None)) as con:
        (free,), (pages,) = (con.execute(f"pragma {name}").fetchone() for name in ("freelist_count", "page_count"))
        surplus = min(free - pages // _SPARE_SHARE, _PAGES_AT_ONCE)
        if surplus > 0:
            con.executescript(f"pragma incremental_vacuum({surplus})")  # `execute` would return one page
