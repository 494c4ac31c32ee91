"""A real cooler, throttled on purpose: the functions behind a declared component, called one by one.

2,205 one-minute cycles of a hydraulic test rig whose cooler was set to 100, 20 and 3 % of its duty
(`tests/data/hydraulic_cooler/README.md`). A cycle is a flight, the rig an aircraft with one pack.
"""

from pathlib import Path
from typing import Any

import polars as pl

from benchmarks.real.hydraulic import COOLER
from hdt_core.calibration.component_fit import calibrate_component, flight_by_flight
from hdt_core.components import Component, Limit
from hdt_core.flight.admission import learn_scatter
from hdt_core.flight.steady import drift_free
from hdt_core.health.features import features
from hdt_core.health.residuals import component_residuals
from hdt_core.tracking.component import DesignOffset, track_component

FOLDER = Path(__file__).parents[1] / "data/hydraulic_cooler"
FAULTS = ("valve_pct", "pump_leakage", "accumulator_bar")
"""Settings of the rig's other faults."""


def read_samples() -> pl.DataFrame:
    """Samples; rate and air temperature follow from the rig's virtual sensors of cooling power and efficiency."""
    hot, cold, efficiency, power_kw = (pl.col(f"{c}_1e3") / 1e3 for c in ("ts3_degc", "ts4_degc", "ce_pct", "cp_kw"))
    began = pl.datetime(2015, 1, 1, time_zone="UTC")  # the rig's clock is not published
    return pl.read_parquet(FOLDER / "cycles.parquet").select(
        pl.lit("RIG").alias("operator"),
        pl.lit("COOLER").alias("tail"),
        pl.lit(1, pl.Int32).alias("pack"),
        _flight_id(),
        (began + pl.duration(minutes="cycle", seconds="second")).alias("time_utc"),
        (hot + 273.15).alias("oil_in_k"),
        (cold + 273.15).alias("oil_out_k"),
        # neither moves within a minute: the median leaves the outlet a measurement of its own
        (1e3 * power_kw / (hot - cold)).median().over("cycle").alias("oil_capacity_w_k"),
        (hot - 100.0 * (hot - cold) / efficiency + 273.15).median().over("cycle").alias("air_in_k"),
    )


def judge_cycles(samples: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
    """All cycles with the rig's settings; those nominal by rules; of these those nominal by statistics (FAST-MCD)."""
    hot_k = pl.col("oil_in_k")
    cold_k = pl.col("oil_out_k")
    cycles = samples.group_by("flight_id", maintain_order=True).agg(
        drift_free(pl.col("time_utc").dt.epoch("s").cast(pl.Float64), "oil_in_k", harmful=0.005).alias("steady"),
        pl.col("oil_capacity_w_k").first().log().alias("rate"),
        ((hot_k - cold_k) / (hot_k - pl.col("air_in_k"))).mean().alias("effectiveness"),
    )
    cycles = pl.read_csv(FOLDER / "profile.csv").with_columns(_flight_id()).join(cycles, on="flight_id")
    ruled = cycles.filter((pl.col("cooler_pct") == 100) & (pl.col("unstable") == 0) & pl.col("steady"))
    off = ruled.select((pl.col(c) - pl.col(c).median()) for c in ("rate", "effectiveness"))
    return cycles, ruled, ruled.filter(~learn_scatter(off, off.columns).flag_outliers(off))


def follow_rig() -> dict[str, Any]:
    """Calibrate, estimate and track the cooler; compare and describe; all tables by name."""
    samples = read_samples()
    cycles, ruled, nominal = judge_cycles(samples)
    dsm, fit = calibrate_component(COOLER, samples.join(nominal, on="flight_id", how="semi"))
    flights = flight_by_flight(samples, dsm, ["hc_fouling"])
    ua_w_k = (dsm.nominal["hc_ua_w_k"] * (1.0 - pl.col("hc_fouling"))).alias("ua_w_k")
    cycles = cycles.join(flights.select("flight_id", "hc_fouling", ua_w_k), on="flight_id").sort("cycle")
    cycles = cycles.with_columns(run=pl.struct("cooler_pct", *FAULTS).rle_id())
    entry = dict.fromkeys(("operator", "tail", "component", "action"), pl.String) | {"pack": pl.Int32}
    no_work = pl.DataFrame(schema=entry | {"done_on": pl.Date})
    limit = Limit(mean=0.6, sd=0.1, unit_sd=0.05)
    cooler = Component("HC", "oil cooler", "UA lost", dsm, "hc_fouling", limit, 2000.0, "Clean its fins")
    # calibrated on cycles that are as built
    health = track_component(flights, cooler, no_work, DesignOffset(sd=0.01)).health
    residuals = component_residuals(samples, flights, dsm, "HC")
    legs = flights.select("operator", "tail", "flight_id", "pack", "departed_at")
    described = features(health, residuals, legs, no_work, health=["hc_fouling"])
    return {
        "cycles": cycles, "ruled": ruled, "nominal": nominal, "dsm": dsm, "fit": fit, "flights": flights,
        "settled": cycles.filter(pl.col("unstable") == 0), "residuals": residuals,
        "described": described.join(cycles, on="flight_id", how="left"),
    }  # fmt: skip


def _flight_id() -> pl.Expr:
    return pl.format("CYCLE-{}", pl.col("cycle").cast(pl.String).str.zfill(4)).alias("flight_id")
