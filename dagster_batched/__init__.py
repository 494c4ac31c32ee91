"""Dagster runs over thousands of partitions at the price of one: events in groups, and a range that knows its cells.

Stock Dagster makes, serialises and commits an event for every partition of a step, 19 to 59 s per 1,000 partitions
and asset in SQLite. Most of these events differ in nothing but the partition. Here

- an IO manager says with `report_partitions` which partitions of a run's range an output has filled;
- an event log, `dagster_batched.event_log.BatchedSqliteEventLogStorage` or
  `dagster_batched.postgres.BatchedPostgresEventLogStorage`, named in `dagster.yaml`, stores them as one group in one
  transaction. Tables and rows are those of stock, so stock Dagster reads what these wrote.

All that the project needs of Dagster's private API stands in this package and nowhere else, so that a new minor
version of Dagster is a matter of these modules and their tests (`tests/pipelines/test_eventlog.py` compares the tables
with stock's): `partitions` (ranges and keys), `runs` and `remote` (a run here, a run elsewhere), `checks`, `celery`,
`webserver`, `history`.
"""

from dagster_batched.materialization import report_partitions

__all__ = ["report_partitions"]
