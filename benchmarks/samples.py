"""A fleet with truth that this project did not simulate: its record from a home, its truth from a folder.

The home is one that `hdt nightly` has filled; the folder holds `health.parquet` and `events.parquet` of the same
flights, in the columns of `hdt_core.simulate.fleet`.
"""

from pathlib import Path

import polars as pl

from benchmarks.chain import Tables
from hdt_core.prognosis.unit_lives import flight_rows
from hdt_core.records.keys import PACK
from pipelines.storage.store import Store


def record(home: Path) -> Tables:
    """Read the record a chain starts from."""
    store = Store(home)
    snapshots = pl.concat([store.read_table("raw_snapshots"), store.read_table("raw_logs")])
    logs = {name: store.read_table(f"raw_{name}") for name in ("maintenance", "messages")}
    return {"snapshots": snapshots, **logs}


def truth(folder: Path) -> Tables:
    """Read the truth: `truth` by flight and pack, `events` by unit."""
    health, events = (pl.read_parquet(folder / f"{name}.parquet") for name in ("health", "events"))
    pack = pl.col("pack").cast(pl.Int32)
    return {"truth": health.with_columns(pack).sort("tail", "pack", "index"), "events": events.with_columns(pack)}


def thinned(tables: Tables, every: int) -> Tables:
    """One aircraft in `every` of record and truth, whichever operator flies it."""
    tails = tables["truth"]["tail"].unique().sort().gather_every(every)
    return {name: frame.filter(pl.col("tail").is_in(tails.implode())) for name, frame in tables.items()}


def true_lives(features: pl.DataFrame, truth: pl.DataFrame, events: pl.DataFrame) -> pl.DataFrame:
    """Lives of the exchangers as they were, in the columns of `unit_lives.episodes`, whatever the logs say of them."""
    index = truth.select("tail", "flight_id", "pack", "index")
    flown = flight_rows(features).join(index, on=["tail", "flight_id", "pack"])
    units = events.filter(component="HX").select(*PACK, "installed_index", "message_index", "removal_index")
    following = pl.col("installed_index").sort().shift(-1).over(PACK, order_by="installed_index")
    ends = units.with_columns(ends=pl.min_horizontal("message_index", "removal_index"), next=following)
    rows = flown.join(ends, on=PACK).filter(pl.col("index") >= pl.col("installed_index"))
    until = pl.col("next").is_null() | (pl.col("index") < pl.col("next"))
    before = pl.col("ends").is_null() | (pl.col("index") < pl.col("ends"))
    lives = (
        rows.filter(until)
        .group_by(*PACK, "installed_index")
        .agg(
            first_row=pl.col("row").min(),
            end_row=pl.col("row").filter(before).max() + 1,
            failed=pl.col("message_index").is_not_null().first(),
        )
    )
    ordered = lives.drop_nulls("end_row").sort(*PACK, "first_row")
    return ordered.select(
        *PACK,
        component=pl.lit("HX"),
        life=pl.int_range(pl.len()).over(PACK),
        first_row="first_row",
        end_row="end_row",
        failed="failed",
        age_known=pl.col("first_row") > 0,
        mute=pl.lit(False),
    )
