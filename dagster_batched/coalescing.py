"""An event log in which events that stand alike are one group (`represents`), whatever database keeps it.

What a run plans is one event an asset; cells appear as planned only where the run failed (`mark_failed_partitions`),
since one that succeeded has materialised them. Events that only tell how far a step is wait for the next that matters.
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
from dagster_batched.partitions import uncollected

_PLANNED, _MADE = DagsterEventType.ASSET_MATERIALIZATION_PLANNED, DagsterEventType.ASSET_MATERIALIZATION
_PATIENT = {
    DagsterEventType.RESOURCE_INIT_STARTED,
    DagsterEventType.RESOURCE_INIT_SUCCESS,
    DagsterEventType.LOGS_CAPTURED,
    DagsterEventType.STEP_OUTPUT,
    DagsterEventType.HANDLED_OUTPUT,
    DagsterEventType.ASSET_CHECK_EVALUATION,
}
"""Always followed, in the same process, by the start, the end or a materialisation of a step."""
INDEXED = ASSET_EVENTS | ASSET_CHECK_EVENTS | set(EVENT_TYPE_TO_PIPELINE_RUN_STATUS)
"""Of these the index of all runs tells."""
_MOST_NAMED = 30_000  # partitions or events in one question: SQLite takes 32,766 values


class CoalescingEventLog(SqlEventLogStorage):
    """An event log in which one event may stand for those that differ in nothing but the partition.

    To be mixed in before one of Dagster's; whoever does says how groups are stored.
    """

    supports_partition_subset_in_asset_materialization_planned_events = True

    def __init__(self, *args: Any, **settings: Any) -> None:
        self._alike: dict[tuple[str, AssetKey], tuple[Sequence[str], Sequence[Mapping[str, int]]]] = {}
        self._waiting: list[EventLogEntry] = []
        super().__init__(*args, **settings)  # type: ignore[no-untyped-call]

    @abstractmethod
    def _store(self, groups: Sequence[EventGroup]) -> None:
        """Store them, together."""

    @abstractmethod
    def _index(self) -> AbstractContextManager[Connection]:
        """A transaction on the index of all runs; what stock's own methods write within it is a part of it."""

    @abstractmethod
    def _written(self, conn: Connection, one: EventGroup) -> int:
        """Id of the group's last row, once it is in the index."""

    def represents(
        self, run_id: str, asset_key: AssetKey, partitions: Sequence[str], numbers: Sequence[Mapping[str, int]] = ()
    ) -> None:
        """Let the run's next materialisation of the asset, that of the first partition, count for all of these.

        `numbers` are what the others' events tell as metadata, one mapping a partition, the first's among them.
        """
        self._alike[run_id, asset_key] = partitions, numbers

    def mark_failed_partitions(self, run_id: str, partitions: Sequence[str]) -> None:
        """Show these partitions as planned for every asset that the failed run did not materialise."""
        made = {e.get_dagster_event().asset_key for e in self.get_logs_for_run(run_id, of_type=_MADE)}
        planned = self.get_logs_for_run(run_id, of_type=_PLANNED)
        self._mirror([self._one(e, partitions) for e in planned if _what(e)[1] not in made])

    def store_event(self, event: EventLogEntry) -> None:
        """Store one event, and those that waited for it."""
        self.store_event_batch([event])

    def store_event_batch(self, events: Sequence[EventLogEntry]) -> None:
        """Store events of one or more runs in one transaction, with those that waited."""
        self._waiting += events
        if not all(e.dagster_event_type in _PATIENT for e in events):
            due, self._waiting = self._waiting, []
            self._store([self._one(e, *self._partitions(e)) for e in due])

    @uncollected()
    def get_materialized_partitions(
        self, asset_key: AssetKey, before_cursor: int | None = None, after_cursor: int | None = None
    ) -> set[str]:
        """Partitions that were made, as stock finds them."""
        return super().get_materialized_partitions(asset_key, before_cursor, after_cursor)

    def get_latest_asset_partition_materialization_attempts_without_materializations(
        self, asset_key: AssetKey, after_storage_id: int | None = None
    ) -> dict[str, tuple[str, int]]:
        """Run and event of each partition that was planned and not made since.

        Looks for what was made among the partitions that were planned: few here, while stock reads all that were made.
        """
        latest = self.get_latest_storage_id_by_partition
        planned = {p: i for p, i in latest(asset_key, _PLANNED).items() if i > (after_storage_id or 0)}
        asked = set(planned) if len(planned) <= _MOST_NAMED else None
        made = latest(asset_key, _MADE, asked) if planned else {}
        left = {i: p for p, i in planned.items() if i > made.get(p, 0)}
        ids, kept, found = list(left), SqlEventLogStorageTable.c, dict[str, tuple[str, int]]()
        with self.index_connection() as conn:
            for at in range(0, len(ids), _MOST_NAMED):
                own = kept.id.in_(ids[at : at + _MOST_NAMED])
                found |= {left[i]: (run_id, i) for i, run_id in conn.execute(select(kept.id, kept.run_id).where(own))}
        return found

    def _mirror(self, groups: Sequence[EventGroup]) -> None:
        """Write the groups into the index with their tags; of each asset the newest of a type counts."""
        newest: dict[tuple[Any, DagsterEventType | None], tuple[EventLogEntry, int]] = {}
        with self._index() as conn:
            for one in groups:
                event_id = self._written(conn, one)
                kind = one.event.dagster_event_type
                if kind in ASSET_EVENTS:
                    newest[one.row["asset_key"], kind] = one.event, event_id
                elif kind in ASSET_CHECK_EVENTS:
                    if kind == DagsterEventType.ASSET_CHECK_EVALUATION:
                        _place_last(conn, one.event)
                    self.store_asset_check_event(one.event, event_id)
            for event, event_id in newest.values():
                self.store_asset_event(event, event_id)

    def _partitions(self, event: EventLogEntry) -> tuple[Sequence[str | None], Sequence[Mapping[str, int]]]:
        """Partitions that the event stands for, and their numbers."""
        if event.dagster_event_type not in ASSET_EVENTS:
            return [None], ()
        stands = self._alike.pop(_what(event), None) if event.dagster_event_type == _MADE else None
        return stands or ([event.get_dagster_event().partition], ())

    def _one(
        self, event: EventLogEntry, partitions: Sequence[str | None], numbers: Sequence[Mapping[str, int]] = ()
    ) -> EventGroup:
        if event.dagster_event_type == _PLANNED:
            event = _of(event, partitions[0])  # the run's tags name its range; its keys once more would be 100 kB
        return EventGroup(event, self._event_to_row(event), self._tags_for_asset_event(event), partitions, numbers)


def _what(event: EventLogEntry) -> tuple[str, AssetKey]:
    """Run and asset of an asset's event."""
    key = event.get_dagster_event().asset_key
    assert key is not None
    return event.run_id, key


def _place_last(conn: Connection, event: EventLogEntry) -> None:
    """Move what the run planned of a check behind what runs beside it planned meanwhile.

    A page holds the last record of a check against the last materialisation, and says that nothing was checked where
    they are of two runs. An evaluation comes with its materialisation, in one transaction.
    """
    said, kept = event.get_dagster_event().asset_check_evaluation_data, AssetCheckExecutionsTable.c
    of_check = and_(kept.asset_key == said.asset_key.to_string(), kept.check_name == said.check_name)
    own = and_(of_check, kept.run_id == event.run_id)
    last = conn.execute(select(func.max(kept.id)).where(of_check)).scalar()
    names = [c for c in AssetCheckExecutionsTable.columns if c.name not in ("id", "create_timestamp")]
    planned = conn.execute(select(*names, kept.id).where(own)).mappings().all()
    if planned and last not in {row["id"] for row in planned}:
        conn.execute(AssetCheckExecutionsTable.delete().where(own))
        conn.execute(AssetCheckExecutionsTable.insert(), [{c.name: row[c.name] for c in names} for row in planned])


def _of(event: EventLogEntry, partition: str | None) -> EventLogEntry:
    """The same plan for one partition, or for the run's."""
    planned = event.get_dagster_event()
    data = AssetMaterializationPlannedData(_what(event)[1], partition)
    return event._replace(dagster_event=planned._replace(event_specific_data=data))
