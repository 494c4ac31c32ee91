"""Write Dagster's event log in PostgreSQL with one event for those that differ only in the partition.

Stock plans a run with an event and two transactions for every cell, 25 ms each, and writes materializations one by one.
The schema is unchanged, so stock reads it; a test compares the tables with stock's. It depends on private API as
`dagster_batched.event_log` does. Needs the extra `postgres`.
"""

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Self

import dagster_postgres.utils as settings_of
from dagster._core.storage.event_log.schema import SqlEventLogStorageTable
from dagster._serdes import ConfigurableClassData
from dagster_postgres.event_log import PostgresEventLogStorage
from sqlalchemy import Connection, text

from dagster_batched.event_log import CoalescingEventLog
from dagster_batched.partitions import EventGroup

_INSERT_OTHERS = text(
    "insert into event_logs (run_id, event, dagster_event_type, timestamp, step_key, asset_key, partition)"
    " select run_id, o.event, dagster_event_type, o.at, step_key, asset_key, o.partition"
    " from event_logs, unnest(cast(:events as text[]), cast(:partitions as text[]), cast(:times as timestamp[]))"
    " as o (event, partition, at)"
    " where id = :first returning id, partition"
)
_INSERT_TAGS = text(
    "insert into asset_event_tags (event_id, asset_key, key, value, event_timestamp)"
    " select o.id, e.asset_key, o.key, o.value, e.timestamp from event_logs as e"
    " join unnest(cast(:ids as bigint[]), cast(:keys as text[]), cast(:values as text[])) as o (id, key, value)"
    " using (id)"
)


class BatchedPostgresEventLogStorage(CoalescingEventLog, PostgresEventLogStorage):
    """Event log in PostgreSQL: stock's tables."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        self._open = threading.local()
        super().__init__(*args, **settings)

    @classmethod
    def from_config_value(cls, inst_data: ConfigurableClassData | None, config_value: Mapping[str, Any]) -> Self:
        """Build from `dagster.yaml`; stock names its own class here."""
        own = {k: v for k, v in config_value.items() if k == "should_autocreate_tables"}
        if tokens := getattr(settings_of, "get_token_provider_from_config", None):  # not in every version
            own["token_provider"] = tokens(config_value)
        return cls(settings_of.pg_url_from_config(config_value), inst_data=inst_data, **own)

    def _store(self, groups: Sequence[EventGroup]) -> None:
        """Store groups in the one table that stock has for them."""
        self._write_index(groups)

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """Open a transaction; stock's engine commits every statement on its own."""
        with self._engine.connect() as conn, conn.execution_options(isolation_level="READ COMMITTED").begin():
            self._open.conn = conn
            try:
                yield conn
            finally:
                del self._open.conn

    def _connect(self) -> AbstractContextManager[Connection]:
        """Return a connection of the pool, or that of an open transaction on the index."""
        conn = getattr(self._open, "conn", None)
        return super()._connect() if conn is None else nullcontext(conn)

    def _insert(self, conn: Connection, one: EventGroup) -> int:
        """Insert a group; the id of its last row."""
        into = SqlEventLogStorageTable.insert().values(one.row).returning(SqlEventLogStorageTable.c.id)
        first = int(conn.execute(into).scalar_one())
        self.store_asset_event_tags([one.event], [first])  # within the same transaction
        others = list(one.others())
        if not others:
            return first
        partitions, events, tags, times = (list(column) for column in zip(*others, strict=True))
        values = {"events": events, "partitions": partitions, "times": times, "first": first}
        ids = {partition: int(event_id) for event_id, partition in conn.execute(_INSERT_OTHERS, values)}
        rows = [(ids[p], key, value) for p, own in zip(partitions, tags, strict=True) for key, value in own.items()]
        if rows:
            event_ids, keys, texts = (list(column) for column in zip(*rows, strict=True))
            conn.execute(_INSERT_TAGS, {"ids": event_ids, "keys": keys, "values": texts})
        return max(ids.values())
