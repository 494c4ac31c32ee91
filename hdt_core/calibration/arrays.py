"""Convert frames to arrays: cruise samples of a flight and pack, and points to calibrate from."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from hdt_core.flight.legs import MODEL_SIGNALS
from hdt_core.physics.air import mach_from_pressures, standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.installed_exchanger import with_static_pressure
from hdt_core.physics.terms import correct_signals
from hdt_core.records.keys import FLIGHT, FLIGHT_PACK, PACK
from hdt_core.tables.raw import SIGNALS

Array = NDArray[Any]
"""Of numbers, counts or flags."""
LEVEL_M = 300.0


@dataclass(frozen=True, slots=True)
class Points:
    """Cruise points of many packs as arrays (n,), sorted by pack, then flight.

    `pack` counts packs from 0, `flight` is the tail's flight order from 0, `n_samples` how many samples a point
    averages, `flow_step_ln` how coarse the recorder's pack flow is, 0 of a fine one.
    """

    signals: dict[str, Array]
    pack: Array
    flight: Array
    n_samples: Array
    flow_step_ln: Array | float = 0.0

    def __len__(self) -> int:
        return len(self.pack)


def departure(samples: pl.DataFrame) -> pl.Expr:
    """Build the departure of a flight: its first recorded time.

    Samples of a log are averaged over minutes, so these have `departed_at`.
    """
    return pl.col("departed_at" if "departed_at" in samples.columns else "time_utc").min()


def flights_of(samples: pl.DataFrame) -> pl.DataFrame:
    """List flights and packs of the samples in order: `FLIGHT_PACK`, `departed_at`, `order` (of the tail, from 0)."""
    flights = samples.group_by(FLIGHT_PACK).agg(departure(samples).alias("first"))
    flights = flights.with_columns(pl.col("first").min().over(FLIGHT).alias("departed_at"))
    key = pl.struct("departed_at", "flight_id").rank("dense").over("operator", "tail")
    return flights.with_columns((key.cast(pl.Int32) - 1).alias("order")).drop("first").sort(*PACK, "order")


def cruise_samples(samples: pl.DataFrame, *, monitored: bool = True) -> pl.DataFrame:
    """Select cruise samples, with missing Mach number or total pressure computed from the other.

    The exchanger needs steady samples (`monitored`); the compressor responds at once, and every sample counts.
    """
    is_cruise = pl.col("phase") == "cruise"
    return complete_air_data(samples.filter(is_cruise & pl.col("monitored") if monitored else is_cruise))


def complete_air_data(cruise: pl.DataFrame) -> pl.DataFrame:
    """Complete the recorder's signals by null columns, and a missing Mach number or total pressure from the other."""
    missing = [pl.lit(None, dtype=pl.Float64).alias(c) for c in SIGNALS if c not in cruise.columns]
    cruise = cruise.with_columns(missing).with_columns(pl.col(c).cast(pl.Float64) for c in SIGNALS)
    altitude_m, mach, total_pa = (
        cruise[c].to_numpy().astype(float) for c in ("altitude_m", "mach", "total_pressure_pa")
    )
    static_pa = standard_pressure_pa(altitude_m)
    mach = np.where(np.isnan(mach), mach_from_pressures(total_pa, static_pa), mach)
    total_pa = np.where(np.isnan(total_pa), static_pa * total_to_static_pressure(mach), total_pa)
    air = pl.DataFrame({"mach": mach, "total_pressure_pa": total_pa}).fill_nan(None)
    return cruise.with_columns(air["mach"], air["total_pressure_pa"])


def correct_inputs(cruise: pl.DataFrame, terms: Mapping[str, float]) -> pl.DataFrame:
    """Remove the accepted physical terms from recorded cruise samples."""
    if not terms:
        return cruise
    corrected_signals = correct_signals({name: cruise[name].to_numpy().astype(float) for name in MODEL_SIGNALS}, terms)
    return cruise.with_columns(pl.Series(name, values).fill_nan(None) for name, values in corrected_signals.items())


def level_points(cruise: pl.DataFrame, flights: pl.DataFrame) -> pl.DataFrame:
    """Compute medians over each cruise level of each flight and pack, with `n_samples`."""
    level = (pl.col("altitude_m") / LEVEL_M).round().alias("level")
    usable = cruise.drop_nulls(list(MODEL_SIGNALS))
    points = usable.group_by(*FLIGHT_PACK, level).agg(
        pl.col(SIGNALS).median(), pl.len().cast(pl.Float64).alias("n_samples")
    )
    return points.join(flights, on=FLIGHT_PACK, validate="m:1").sort(*PACK, "order", "level")


def to_points(frame: pl.DataFrame, packs: pl.DataFrame) -> Points:
    """Convert a frame of points or samples to arrays; `packs` (rows of `PACK`) numbers the packs.

    With `pack_flow_step_ln` of `flow_steps` where the recorder's step counts.
    """
    rows = frame.join(packs.with_row_index("pack_index"), on=PACK, how="left", maintain_order="left", validate="m:1")
    signals = {name: rows[name].to_numpy().astype(float) for name in (*MODEL_SIGNALS, "ram_out_k")}
    return Points(
        with_static_pressure(signals),
        rows["pack_index"].to_numpy().astype(np.int64),
        rows["order"].to_numpy().astype(np.int64),
        rows["n_samples"].to_numpy().astype(float),
        rows["pack_flow_step_ln"].fill_null(0.0).to_numpy() if "pack_flow_step_ln" in rows.columns else 0.0,
    )
