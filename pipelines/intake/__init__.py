"""Intake: turn files of the landing zone into typed SI frames and quarantine rows; nothing raises, no row is lost.

Read in this order: `scan` and `landing` (which files there are, which are new), `text`, `text_columns`, `parquet` and
`readers` (bytes become columns), `snapshots`, `components` and `row_validation` (columns become validated rows),
`merge` (several deliveries of a flight become one), `logs` (messages, maintenance, fleet), `ingest` (all of it for an
aircraft), `faults` (quarantine rows). `reasons` explains each reason.
"""
