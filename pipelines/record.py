"""Judge the stored record of a home: which flights are held, since when and by which file."""

from datetime import UTC, datetime

import polars as pl

from hdt_core.record.judge import CONTRADICTED, judge_flights
from hdt_core.records.keys import AIRCRAFT, FLIGHT
from pipelines.lineage import HELD
from pipelines.storage.ledger import Ledger
from pipelines.storage.store import Store


def judge_record(ledger: Ledger) -> pl.DataFrame:
    """Judge all stored flights by the present record and clock: rows of `record_held`."""
    store = Store(ledger.home)
    deliveries = store.read_table("raw_fleet").select(*AIRCRAFT, "delivered_on").unique(AIRCRAFT)
    held_rows = judge_flights(store.read_table("raw_flights"), deliveries, datetime.now(UTC))
    if held_rows.is_empty():
        return held_rows
    files = ledger.of(held_rows.select("operator", "tail").unique().rows()).flight_files().sort("path")
    received_at = pl.from_epoch(pl.col("mtime_ns").first() // 1_000_000_000).dt.replace_time_zone("UTC")
    is_log_at_fault = pl.col("reason") == CONTRADICTED
    of_log = is_log_at_fault & (pl.col("kind") == "cpl")
    verdicts = held_rows.select(*FLIGHT, "reason")
    blamed = files.join(verdicts, on=FLIGHT, validate="m:1").filter(~is_log_at_fault | of_log)
    first_files = blamed.group_by(FLIGHT).agg(pl.col("path").first().alias("file"), received_at.alias("held_since"))
    named = held_rows.drop("file", "held_since").join(first_files, on=FLIGHT, how="left", validate="1:1")
    return named.select(held_rows.columns).sort(*FLIGHT)


def held_flights(ledger: Ledger) -> pl.DataFrame:
    """Read the held flights, of all aircraft or those of the ledger: rows of `record_held`."""
    held_rows = Store(ledger.home).read_table(HELD)
    if ledger.only is None:
        return held_rows
    aircraft = pl.DataFrame(ledger.only, schema=AIRCRAFT, orient="row")
    return held_rows.join(aircraft, on=AIRCRAFT, how="semi")


def is_any_due(ledger: Ledger) -> bool:
    """Return whether the clock has passed the time of a flight that was held for lying after it."""
    held_rows = Store(ledger.home).read_table(HELD)
    return not held_rows.filter(pl.col("reason") == "after_clock", pl.col("landed_at") <= datetime.now(UTC)).is_empty()
