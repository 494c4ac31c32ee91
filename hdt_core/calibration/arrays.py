"""The one crossing between frames and arrays: cruise samples of a flight and pack, and points fit for a calibration."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from hdt_core.calibration.exchanger import SIGNALS
from hdt_core.physics.air import mach_from_pressures, standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.installed_exchanger import with_static_pressure
from hdt_core.physics.terms import correct_signals
from hdt_core.records.keys import FLIGHT_PACK, PACK

Array = NDArray[Any]
"""Of numbers, counts or flags: what stands on this side of the crossing."""
LEVEL_M = 300.0
RECORDED = (
    *SIGNALS,
    "ram_out_k",
    "cc_speed_rad_s",
    "cc_in_k",
    "cc_in_pa",
    "cc_out_k",
    "cc_out_pa",
    "cc_flow_kg_s",
    "vda_counts",
)


@dataclass(frozen=True, slots=True)
class Points:
    """Cruise points of many packs as arrays (n,), sorted by pack, then flight.

    `pack` counts packs from 0, `flight` is the tail's flight order from 0, `n_samples` how many samples a point
    averages.
    """

    signals: dict[str, Array]
    pack: Array
    flight: Array
    n_samples: Array

    def __len__(self) -> int:
        return len(self.pack)


def departure(samples: pl.DataFrame) -> pl.Expr:
    """First recorded time of the rows of a flight.

    Samples of a log are averaged minutes, and the middle of the first is later; so they carry their `departed_at`.
    """
    return pl.col("departed_at" if "departed_at" in samples.columns else "time_utc").min()


def flights_of(samples: pl.DataFrame) -> pl.DataFrame:
    """Every flight and pack of the samples in order: `FLIGHT_PACK`, `departed_at`, `order` (of the tail, from 0)."""
    flights = samples.group_by(FLIGHT_PACK).agg(departure(samples).alias("first"))
    flights = flights.with_columns(pl.col("first").min().over("operator", "tail", "flight_id").alias("departed_at"))
    key = pl.struct("departed_at", "flight_id").rank("dense").over("operator", "tail")
    return flights.with_columns((key.cast(pl.Int32) - 1).alias("order")).drop("first").sort(*PACK, "order")


def cruise_samples(samples: pl.DataFrame, *, monitored: bool = True) -> pl.DataFrame:
    """Cruise samples, Mach number and total pressure filled from each other where one is missing.

    The exchanger needs steady ones (`monitored`); the compressor answers at once, and every sample counts.
    """
    wanted = pl.col("phase") == "cruise"
    return complete_air_data(samples.filter(wanted & pl.col("monitored") if monitored else wanted))


def complete_air_data(cruise: pl.DataFrame) -> pl.DataFrame:
    """Samples with all of `RECORDED`, Mach number and total pressure filled from each other where one is missing."""
    absent = [pl.lit(None, dtype=pl.Float64).alias(c) for c in RECORDED if c not in cruise.columns]
    cruise = cruise.with_columns(absent).with_columns(pl.col(c).cast(pl.Float64) for c in RECORDED)
    altitude_m, mach, total_pa = (
        cruise[c].to_numpy().astype(float) for c in ("altitude_m", "mach", "total_pressure_pa")
    )
    static_pa = standard_pressure_pa(altitude_m)
    mach = np.where(np.isnan(mach), mach_from_pressures(total_pa, static_pa), mach)
    total_pa = np.where(np.isnan(total_pa), static_pa * total_to_static_pressure(mach), total_pa)
    filled = pl.DataFrame({"mach": mach, "total_pressure_pa": total_pa}).fill_nan(None)
    return cruise.with_columns(filled["mach"], filled["total_pressure_pa"])


def as_met(cruise: pl.DataFrame, terms: Mapping[str, float]) -> pl.DataFrame:
    """Cruise samples with the accepted physical terms taken out of what was recorded."""
    if not terms:
        return cruise
    met = correct_signals({name: cruise[name].to_numpy().astype(float) for name in SIGNALS}, terms)
    return cruise.with_columns(pl.Series(name, values).fill_nan(None) for name, values in met.items())


def level_points(cruise: pl.DataFrame, flights: pl.DataFrame) -> pl.DataFrame:
    """Medians over each cruise level of each flight and pack, with `n_samples`: steady, and cheap to calibrate from."""
    level = (pl.col("altitude_m") / LEVEL_M).round().alias("level")
    usable = cruise.drop_nulls(list(SIGNALS))
    points = usable.group_by(*FLIGHT_PACK, level).agg(
        pl.col(list(RECORDED)).median(), pl.len().cast(pl.Float64).alias("n_samples")
    )
    return points.join(flights, on=FLIGHT_PACK, validate="m:1").sort(*PACK, "order", "level")


def to_points(frame: pl.DataFrame, packs: pl.DataFrame) -> Points:
    """Arrays of a frame of points or samples; `packs` (rows of `PACK`) numbers the packs.

    Raises
    ------
    ValueError
        A row belongs to a pack that `packs` does not hold.
    """
    numbered = frame.join(
        packs.with_row_index("pack_index"), on=PACK, how="left", maintain_order="left", validate="m:1"
    )
    if numbered["pack_index"].null_count():
        raise ValueError("points of a pack that the list of packs does not hold")
    signals = {name: numbered[name].to_numpy().astype(float) for name in (*SIGNALS, "ram_out_k")}
    return Points(
        with_static_pressure(signals),
        numbered["pack_index"].to_numpy().astype(np.int64),
        numbered["order"].to_numpy().astype(np.int64),
        numbered["n_samples"].to_numpy().astype(float),
    )
