"""Intake: turn files of the landing zone into typed SI frames and quarantine rows; nothing raises, no row is lost.

Read in this order: `scan` and `landing` (which files there are, which are new), `text`, `parquet` and `readers` (bytes
become columns), `row_validation` and `snapshots` (columns become validated rows; `components` likewise for components'
own files), `merge` (several deliveries of a flight become one), `lists` and `logs` (messages, maintenance, fleet),
`ingest` (all of it for an aircraft), `faults` with `reasons.toml` (quarantine rows).
"""
