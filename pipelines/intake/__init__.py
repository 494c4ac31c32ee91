"""Intake: files of the landing zone become typed SI frames and quarantine rows; nothing raises, no row is lost.

Read in this order: `landing` (what lies there), `text` and `parquet` (bytes become columns), `snapshots` and `judge`
(columns become judged rows), `merge` (deliveries become one truth), `logs` (messages, maintenance, fleet), `ledger`
(where every row went). `reasons` says what each verdict means.
"""
