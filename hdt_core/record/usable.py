"""Select what is used of a judged record: whole flights, flights without their log, flights with packs exchanged."""

import polars as pl

from hdt_core.record.exchange import EXCHANGED
from hdt_core.record.two_sources import without_logs
from hdt_core.records.keys import FLIGHT


def unused(held_flights: pl.DataFrame) -> pl.DataFrame:
    """Select the held flights from which nothing is computed."""
    return held_flights.filter(~pl.col("is_used"))


def usable_rows(rows: pl.DataFrame, held_flights: pl.DataFrame) -> pl.DataFrame:
    """Return the recorded rows that are used, with exchanged packs in their own places.

    Parameters
    ----------
    rows : DataFrame
        Of `raw_snapshots` and `raw_logs`.
    held_flights : DataFrame
        Of `record_held`.
    """
    used = rows.join(unused(held_flights), on=FLIGHT, how="anti", maintain_order="left")
    used = without_logs(used, held_flights.filter("without_log"))
    exchanged = held_flights.filter(reason=EXCHANGED).select(*FLIGHT, is_exchanged=True)
    if exchanged.is_empty():
        return used
    marked = used.join(exchanged, on=FLIGHT, how="left", maintain_order="left", validate="m:1")
    own_pack = pl.when("is_exchanged").then(3 - pl.col("pack")).otherwise("pack")
    return marked.with_columns(own_pack.cast(rows.schema["pack"]).alias("pack")).select(rows.columns)
