"""Intake: turn files of the landing zone into typed SI frames and quarantine rows; nothing raises, no row is lost.

Read in this order: `landing` and `landing_file` (which files there are, which are new), `text`, `parquet`, `readers`
(bytes become columns), `row_validation` and `snapshots` (columns become validated rows; `components` likewise for
components' own files), `merge` (several deliveries of a flight become one), `logs` (messages, maintenance,
fleet) and `kept_lines` (what a shorter log leaves be), `findings` (what the home adds), `ingest` (all of it for an
aircraft), `faults` with `reasons.toml`.
"""
