"""Fleets with truth: simulated here, or by others: as recorded, with their legs, and through the whole chain.

The truth of others is in `health.parquet` and `events.parquet`, in the columns of `hdt_core.simulate.fleet`.
"""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.chain import RECORD, UP_TO_ALERTS, Tables, run
from hdt_core.flight.legs import judge_legs
from hdt_core.prognosis.unit_lives import episodes, flight_rows
from hdt_core.records.keys import PACK
from hdt_core.simulate.design import FleetSettings, PackDesign, draw_design, draw_operators
from hdt_core.simulate.fleet import simulate_fleet
from hdt_core.simulate.packs import (
    Demand,
    ExchangerWear,
    outlets,
    reference,
    reference_demand,
    sized_target_k,
    target_k,
)
from pipelines.intake.columns import SIGNAL_COLUMNS
from pipelines.storage.store import Store

Frames = dict[str, pl.DataFrame]

HOT_DAY_K = 12.0
"""A hot day's temperature above its operator's mean."""
RESERVE_CLASSES = {"ample reserve": 0.4, "middle reserve": 0.3, "little reserve": 0.0}
"""Classes of types, each with the least loss at which a hot day draws the message. [-]"""


def recorded_in_si(snapshots: pl.DataFrame, operator: str, tail: str) -> pl.DataFrame:
    """Snapshots as the raw stage stores them."""
    there = set(snapshots.columns)
    signals = [
        (pl.col(c.name) * c.scale + c.offset if c.name in there else pl.lit(None)).cast(pl.Float64).alias(c.si_name)
        for c in SIGNAL_COLUMNS
    ]
    key = [pl.lit(operator).alias("operator"), pl.lit(tail).alias("tail"), "flight_id", pl.col("pack").cast(pl.Int32)]
    when = pl.col("report_time").cast(pl.Datetime("us", "UTC")).alias("time_utc")
    return snapshots.select(*key, when, pl.lit("acms").alias("source"), "phase_code", *signals)


def simulate_record(seed: int, settings: FleetSettings) -> Frames:
    """Simulate a fleet: snapshots, maintenance and messages as the raw stage stores them; health and events."""
    frames: dict[str, list[pl.DataFrame]] = defaultdict(list)
    for craft in simulate_fleet(seed, settings):
        whose = [pl.lit(craft.operator).alias("operator"), pl.lit(craft.tail).alias("tail")]
        frames["snapshots"].append(recorded_in_si(craft.snapshots, craft.operator, craft.tail))
        for name in ("maintenance", "messages"):
            frames[name].append(getattr(craft, name).with_columns(whose).with_columns(pl.col("pack").cast(pl.Int32)))
        for name in ("health", "events"):
            frames[name].append(getattr(craft, name))
    return {name: pl.concat(parts, how="diagonal_relaxed") for name, parts in frames.items()}


class Fleet(NamedTuple):
    """Samples and first verdicts of a simulated fleet, its logs, and its truth on flights that arrived."""

    legs: pl.DataFrame
    samples: pl.DataFrame
    maintenance: pl.DataFrame
    messages: pl.DataFrame
    truth: pl.DataFrame


def fleet_of(seed: int, settings: FleetSettings) -> Fleet:
    """Simulate a fleet and judge its legs by themselves, as before a first calibration."""
    record = simulate_record(seed, settings)
    snapshots, maintenance, messages = (record[name] for name in RECORD)
    legs, samples = judge_legs(snapshots)
    truth = record["health"].filter("arrived").with_columns(pl.col("pack").cast(pl.Int32))
    return Fleet(legs, samples, maintenance, messages, truth)


def fly(seed: int, settings: FleetSettings) -> Frames:
    """Run one fleet through the chain: alerts, features with demand, logs and lives, truth and events."""
    all_of = simulate_record(seed, settings)
    tables = run({name: all_of[name] for name in RECORD}, UP_TO_ALERTS)
    lives = episodes(tables["features"], tables["messages"], tables["maintenance"])
    outputs = {name: tables[name] for name in ("messages", "maintenance", "alerts", "features")}
    return outputs | {"events": all_of["events"], "truth": all_of["health"], "lives": lives}


def flown(seeds: Iterable[int], settings: FleetSettings) -> Iterator[Frames]:
    """Fleets of the seeds, a type each; tails and flights carry the seed in their names."""
    for seed in seeds:
        yield {name: _named(frame, seed) for name, frame in fly(seed, settings).items()}


def reserve_class(seed: int) -> str:
    """Name the class of a simulated type by its operator with the least reserve.

    Design and climate decide, never what was estimated.
    """
    rng = np.random.default_rng(seed)
    design = draw_design(rng)
    losses = [loss_at_message(design, o.warmer_k + HOT_DAY_K) for o in draw_operators(rng, FleetSettings())]
    return next(name for name, least in RESERVE_CLASSES.items() if min(losses) >= least)


def loss_at_message(design: PackDesign, warmer_k: float) -> float:
    """Loss by film at which the controller gives up in cruise so much warmer than standard, door full open; 0.7 at
    most. [-]"""
    loss = np.linspace(0.0, 0.7, 71)
    one = np.ones(loss.size)
    now = reference(one)
    demand = reference_demand(design, one)
    now = replace(now, tat_k=now.tat_k + warmer_k)
    standard = target_k(reference(np.ones(1)), np.zeros(1))[0]
    target = target_k(now, np.asarray(sized_target_k(design) - standard))
    demand = Demand(demand.flow_kg_s, demand.hot_in_k + 1.2 * warmer_k, target)
    worn = ExchangerWear(loss / (1.0 - loss) / design.hx_ua_reference_w_k, 0.0 * one, 0.0 * one, one)
    over = outlets(design, now, demand, one, worn)[0] - target > design.unmet_limit_k
    return float(loss[over.argmax()]) if over.any() else 0.7


def _named(frame: pl.DataFrame, seed: int) -> pl.DataFrame:
    names = [c for c in ("operator", "tail", "flight_id", "raised_flight_id", "alert_id") if c in frame.columns]
    frame = frame.with_columns(pl.concat_str(pl.lit(f"{seed}:"), c).alias(c) for c in names)
    return frame.with_columns(pl.col("pack").cast(pl.Int32))


def read_record(home: Path) -> Tables:
    """Record a chain starts from, of a home that `hdt nightly` has filled."""
    store = Store(home)
    snapshots = pl.concat([store.read_table("raw_snapshots"), store.read_table("raw_logs")])
    logs = {name: store.read_table(f"raw_{name}") for name in ("maintenance", "messages")}
    return {"snapshots": snapshots, **logs}


def read_truth(folder: Path) -> Tables:
    """Truth of another simulator, `truth` by flight and pack, `events` by unit."""
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
