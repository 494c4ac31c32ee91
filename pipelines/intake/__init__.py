"""Intake: files of the landing zone become typed SI frames and quarantine rows; nothing raises, no row is lost.

Read in this order: `scan` and `landing` (what lies there, what is new), `text`, `text_columns`, `parquet` and
`recordings` (bytes become columns), `snapshots`, `components` and `row_validation` (columns become judged rows),
`merge` (deliveries become one truth), `logs` (messages, maintenance, fleet), `ingest` (all of it for an aircraft),
`ledger` (where every row went). `reasons` says what each verdict means.
"""
