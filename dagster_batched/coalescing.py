"""Group events that differ only in the partition (`group_partitions`), in any database.

A run's plan is one event an asset; cells appear as planned only where the run failed (`mark_failed_partitions`), since
a successful one has materialised them. Events of mere progress wait for the next important one.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

from dagster import AssetKey, DagsterEventType
from dagster._core.events import (
    ASSET_CHECK_EVENTS,
    ASSET_EVENTS,
    EVENT_TYPE_TO_PIPELINE_RUN_STATUS,
    AssetMaterializationPlannedData,
)
from dagster._core.events.log import EventLogEntry
from dagster._core.storage.event_log.schema import AssetCheckExecutionsTable, SqlEventLogStorageTable
from dagster._core.storage.event_log.sql_event_log import SqlEventLogStorage
from sqlalchemy import Connection, and_, func, select

from dagster_batched.event_group import EventGroup
from dagster_batched.partitions import without_garbage_collection

_PLANNED, _MATERIALIZED = DagsterEventType.ASSET_MATERIALIZATION_PLANNED, DagsterEventType.ASSET_MATERIALIZATION
_DEFERRED = {
    DagsterEventType.RESOURCE_INIT_STARTED,
    DagsterEventType.RESOURCE_INIT_SUCCESS,
    DagsterEventType.LOGS_CAPTURED,
    DagsterEventType.STEP_OUTPUT,
    DagsterEventType.HANDLED_OUTPUT,
    DagsterEventType.ASSET_CHECK_EVALUATION,
}
"""Types that are always followed, in the same process, by the start, end or a materialisation of a step."""
INDEXED = ASSET_EVENTS | ASSET_CHECK_EVENTS | set(EVENT_TYPE_TO_PIPELINE_RUN_STATUS)
"""Types in the index of all runs."""
_MAX_VALUES = 30_000  # partitions or events in one query: SQLite takes 32,766 values


class CoalescingEventLog(SqlEventLogStorage):
    """Mixin of an event log that handles events which differ only in the partition as one.

    It precedes one of Dagster's classes; the subclass stores the groups.
    """

    supports_partition_subset_in_asset_materialization_planned_events = True

    def __init__(self, *args: Any, **settings: Any) -> None:
        self._groups: dict[tuple[str, AssetKey], tuple[Sequence[str], Sequence[Mapping[str, int]]]] = {}
        self._deferred: list[EventLogEntry] = []
        super().__init__(*args, **settings)  # type: ignore[no-untyped-call]

    @abstractmethod
    def _store(self, groups: Sequence[EventGroup]) -> None:
        """Store groups together."""

    @abstractmethod
    def _index(self) -> AbstractContextManager[Connection]:
        """Open a transaction on the index of all runs, which stock's own methods join."""

    @abstractmethod
    def _insert(self, conn: Connection, one: EventGroup) -> int:
        """Insert a group into the index; the id of its last row."""

    def group_partitions(
        self, run_id: str, asset_key: AssetKey, partitions: Sequence[str], numbers: Sequence[Mapping[str, int]] = ()
    ) -> None:
        """Let the run's next materialisation of the asset, of the first partition, count for all of these.

        `numbers` are metadata of the events, one mapping a partition, the first included.
        """
        self._groups[run_id, asset_key] = partitions, numbers

    def mark_failed_partitions(self, run_id: str, partitions: Sequence[str]) -> None:
        """Show these partitions as planned for every asset that the failed run did not materialise."""
        done_assets = {e.get_dagster_event().asset_key for e in self.get_logs_for_run(run_id, of_type=_MATERIALIZED)}
        plans = self.get_logs_for_run(run_id, of_type=_PLANNED)
        self._write_index([self._group(e, partitions) for e in plans if _run_and_asset(e)[1] not in done_assets])

    def store_event(self, event: EventLogEntry) -> None:
        """Store one event, and the deferred ones before it."""
        self.store_event_batch([event])

    def store_event_batch(self, events: Sequence[EventLogEntry]) -> None:
        """Store events of one or more runs in one transaction, with the deferred ones."""
        self._deferred += events
        if not all(e.dagster_event_type in _DEFERRED for e in events):
            pending, self._deferred = self._deferred, []
            self._store([self._group(e, *self._partitions(e)) for e in pending])

    @without_garbage_collection()
    def get_materialized_partitions(
        self, asset_key: AssetKey, before_cursor: int | None = None, after_cursor: int | None = None
    ) -> set[str]:
        """List materialized partitions, as stock does."""
        return super().get_materialized_partitions(asset_key, before_cursor, after_cursor)

    def get_latest_asset_partition_materialization_attempts_without_materializations(
        self, asset_key: AssetKey, after_storage_id: int | None = None
    ) -> dict[str, tuple[str, int]]:
        """Map each partition that was planned and not materialized since to run and event.

        Searches among the planned partitions, which are few here, while stock reads all that were materialized.
        """
        latest = self.get_latest_storage_id_by_partition
        plan_ids = {p: i for p, i in latest(asset_key, _PLANNED).items() if i > (after_storage_id or 0)}
        partitions = set(plan_ids) if len(plan_ids) <= _MAX_VALUES else None
        event_ids = latest(asset_key, _MATERIALIZED, partitions) if plan_ids else {}
        open_plans = {i: p for p, i in plan_ids.items() if i > event_ids.get(p, 0)}
        ids, columns, attempts = list(open_plans), SqlEventLogStorageTable.c, dict[str, tuple[str, int]]()
        with self.index_connection() as conn:
            for at in range(0, len(ids), _MAX_VALUES):
                rows = select(columns.id, columns.run_id).where(columns.id.in_(ids[at : at + _MAX_VALUES]))
                attempts |= {open_plans[i]: (run_id, i) for i, run_id in conn.execute(rows)}
        return attempts

    def _write_index(self, groups: Sequence[EventGroup]) -> None:
        """Write groups into the index with their tags; of each asset the newest of a type counts."""
        newest: dict[tuple[Any, DagsterEventType | None], tuple[EventLogEntry, int]] = {}
        with self._index() as conn:
            for one in groups:
                event_id = self._insert(conn, one)
                kind = one.event.dagster_event_type
                if kind in ASSET_EVENTS:
                    newest[one.row["asset_key"], kind] = one.event, event_id
                elif kind in ASSET_CHECK_EVENTS:
                    if kind == DagsterEventType.ASSET_CHECK_EVALUATION:
                        _move_check_last(conn, one.event)
                    self.store_asset_check_event(one.event, event_id)
            for event, event_id in newest.values():
                self.store_asset_event(event, event_id)

    def _partitions(self, event: EventLogEntry) -> tuple[Sequence[str | None], Sequence[Mapping[str, int]]]:
        """List the partitions of an event's group, and their numbers."""
        if event.dagster_event_type not in ASSET_EVENTS:
            return [None], ()
        group = self._groups.pop(_run_and_asset(event), None) if event.dagster_event_type == _MATERIALIZED else None
        return group or ([event.get_dagster_event().partition], ())

    def _group(
        self, event: EventLogEntry, partitions: Sequence[str | None], numbers: Sequence[Mapping[str, int]] = ()
    ) -> EventGroup:
        if event.dagster_event_type == _PLANNED:
            event = _plan_of(event, partitions[0])  # the run's tags name its range; repeating its keys takes 100 kB
        return EventGroup(event, self._event_to_row(event), self._tags_for_asset_event(event), partitions, numbers)


def _run_and_asset(event: EventLogEntry) -> tuple[str, AssetKey]:
    """Return run and asset of an asset's event."""
    key = event.get_dagster_event().asset_key
    assert key is not None
    return event.run_id, key


def _move_check_last(conn: Connection, event: EventLogEntry) -> None:
    """Move a run's planned check behind those that parallel runs planned meanwhile.

    A page compares the last record of a check with the last materialisation, and shows the check as missing where they
    are of two runs. An evaluation comes with its materialisation, in one transaction.
    """
    evaluation, columns = event.get_dagster_event().asset_check_evaluation_data, AssetCheckExecutionsTable.c
    of_check = and_(columns.asset_key == evaluation.asset_key.to_string(), columns.check_name == evaluation.check_name)
    own = and_(of_check, columns.run_id == event.run_id)
    last = conn.execute(select(func.max(columns.id)).where(of_check)).scalar()
    names = [c for c in AssetCheckExecutionsTable.columns if c.name not in ("id", "create_timestamp")]
    rows = conn.execute(select(*names, columns.id).where(own)).mappings().all()
    if rows and last not in {row["id"] for row in rows}:
        conn.execute(AssetCheckExecutionsTable.delete().where(own))
        conn.execute(AssetCheckExecutionsTable.insert(), [{c.name: row[c.name] for c in names} for row in rows])


def _plan_of(event: EventLogEntry, partition: str | None) -> EventLogEntry:
    """Copy a plan for one partition, or for the run's."""
    plan = event.get_dagster_event()
    data = AssetMaterializationPlannedData(_run_and_asset(event)[1], partition)
    return event._replace(dagster_event=plan._replace(event_specific_data=data))
