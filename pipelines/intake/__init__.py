"""Intake: files of the landing zone become typed SI frames and quarantine rows; nothing raises, no row is lost.

Read in this order: `landing` (what lies there), `text` and `parquet` (bytes become columns), `snapshots` and `judge`
(columns become judged rows), `merge` (deliveries become one truth), `logs` (messages, maintenance, fleet), `ledger`
(where every row went). `reasons` says what each verdict means.
"""

from pipelines.intake.landing import Landing, LandingFile, list_landing
from pipelines.intake.ledger import QUARANTINE_SCHEMA, account
from pipelines.intake.logs import Log, read_fleet, read_maintenance, read_messages
from pipelines.intake.merge import Merged, merge_deliveries
from pipelines.intake.snapshots import Intake, flights_in, read_snapshots

__all__ = [
    "QUARANTINE_SCHEMA",
    "Intake",
    "Landing",
    "LandingFile",
    "Log",
    "Merged",
    "account",
    "flights_in",
    "list_landing",
    "merge_deliveries",
    "read_fleet",
    "read_maintenance",
    "read_messages",
    "read_snapshots",
]
