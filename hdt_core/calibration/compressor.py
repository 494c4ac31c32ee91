"""Compute a compressor's effective diameter, flow group and efficiency of each sample and flight."""

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import LEVEL_M
from hdt_core.components.compressor import CC
from hdt_core.components.exchanger import HX
from hdt_core.physics.compressor import area_diameter_tan_beta_m3, effective_diameter_m, isentropic_efficiency
from hdt_core.physics.model import declared
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.robust import median_error, spread_expr

MAX_EXIT_SHARE = 0.8
EXIT_BIAS_SD_LN = declared(CC.model.signal("cc_out_pa").gain_sd)
PROBE_BIASES = ("inlet_bias_k", "inlet_bias_ln", "exit_bias_ln")
"""Of the inlet temperature and pressure, and the exit pressure."""


def _share(own_sd: float | None, other_sd: float | None) -> float:
    """Compute the share of two sensors' difference that belongs to the first, by their declared calibration errors."""
    return declared(own_sd) ** 2 / (declared(own_sd) ** 2 + declared(other_sd) ** 2)


SHARE_K = _share(CC.model.signal("cc_in_k").bias_sd, HX.model.signal("tat_k").bias_sd)
SHARE_LN = _share(CC.model.signal("cc_in_pa").gain_sd, HX.model.signal("total_pressure_pa").gain_sd)
"""Of inlet temperature and pressure, against the air data."""

MIN_FLIGHTS, MIN_PACKS = 40, 4
STEADY_SAMPLES = 5


def probe_corrections(cruise: pl.DataFrame, packs: pl.DataFrame) -> pl.DataFrame:
    """Estimate biases of each pack's compressor probes: `PROBE_BIASES`, one row a pack of `packs`.

    The inlet sits behind the same intake everywhere, so its temperature over TAT and pressure over total pressure are
    the fleet's, and so is the exit pressure by altitude and flow; a pack's difference is shared between its
    probes by their known quality.
    """
    ratio = (pl.col("cc_in_pa") / pl.col("total_pressure_pa")).log()
    medians = cruise.group_by(PACK).agg(
        (pl.col("cc_in_k") - pl.col("tat_k")).median().alias("above_k"), ratio.median().alias("ln_ratio")
    )
    biases = medians.with_columns(
        ((pl.col("above_k") - pl.col("above_k").median()) * SHARE_K).alias("inlet_bias_k"),
        ((pl.col("ln_ratio") - pl.col("ln_ratio").median()) * SHARE_LN).alias("inlet_bias_ln"),
    )
    rows = packs.join(biases, on=PACK, how="left", maintain_order="left", validate="m:1")
    rows = rows.join(_exit_pressure_bias(cruise), on=PACK, how="left", maintain_order="left", validate="m:1")
    return rows.select(*PACK, pl.col(PROBE_BIASES).fill_nan(0.0).fill_null(0.0))


def _exit_pressure_bias(cruise: pl.DataFrame) -> pl.DataFrame:
    """Estimate each pack's excess exit pressure over the fleet's law of altitude and flow: `exit_bias_ln`."""
    flow = pl.mean_horizontal(pl.col("cc_flow_kg_s").log(), pl.col("pack_flow_kg_s").log())
    flights = (
        cruise.with_columns(flow.alias("ln_flow"), (pl.col("altitude_m") / 1e4).alias("height"))
        .group_by(FLIGHT_PACK)
        .agg(pl.col("cc_out_pa").log().median(), pl.col("ln_flow", "height").median())
        .drop_nulls()
        .sort(FLIGHT_PACK)
    )
    if flights.height < MIN_FLIGHTS or flights.select(PACK).unique().height < MIN_PACKS:
        return flights.select(PACK).unique().with_columns(exit_bias_ln=pl.lit(0.0))
    height = flights["height"].to_numpy()
    columns = np.stack([np.ones(len(height)), height, height**2, height**3, flights["ln_flow"].to_numpy()], axis=1)
    law = np.linalg.lstsq(columns, flights["cc_out_pa"].to_numpy(), rcond=None)[0]
    beyond = flights.with_columns((pl.col("cc_out_pa") - pl.Series(columns @ law)).alias("beyond"))
    packs = beyond.group_by(PACK).agg(pl.col("beyond").median())
    deviations = packs["beyond"].to_numpy()
    share = min(MAX_EXIT_SHARE, EXIT_BIAS_SD_LN**2 / max(float(np.var(deviations, ddof=1)), 1e-12))
    return packs.select(*PACK, ((pl.col("beyond") - float(np.median(deviations))) * share).alias("exit_bias_ln"))


def compressor_samples(cruise: pl.DataFrame, corrections: pl.DataFrame) -> pl.DataFrame:
    """Add `diameter_m` (equation 5), `group_m3` (equations 2-4), `efficiency` and their inlet, `inlet_k` and
    `inlet_pa`, to cruise samples; null where not recorded."""
    cruise_rows = cruise.sort(*FLIGHT_PACK, "time_utc")
    rows = _average_levels(cruise_rows).join(corrections, on=PACK, how="left", maintain_order="left", validate="m:1")
    s = {
        c: rows[c].to_numpy().astype(float)
        for c in ("cc_in_k", "cc_in_pa", "cc_out_k", "cc_out_pa", "cc_speed_rad_s", "cc_flow_kg_s")
    }
    inlet_k = s["cc_in_k"] - rows["inlet_bias_k"].fill_null(0.0).to_numpy()
    exit_pa = s["cc_out_pa"] * np.exp(-rows["exit_bias_ln"].fill_null(0.0).to_numpy())
    inlet_pa = s["cc_in_pa"] * np.exp(-rows["inlet_bias_ln"].fill_null(0.0).to_numpy())
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        values = {
            "inlet_k": inlet_k,
            "inlet_pa": inlet_pa,
            "diameter_m": effective_diameter_m(inlet_pa, exit_pa, inlet_k, s["cc_speed_rad_s"]),
            "group_m3": area_diameter_tan_beta_m3(s["cc_flow_kg_s"], inlet_pa, inlet_k, s["cc_speed_rad_s"]),
            "efficiency": isentropic_efficiency(inlet_pa, exit_pa, inlet_k, s["cc_out_k"]),
        }
    valid = {name: np.where(np.isfinite(v) & (v > 0.0), v, np.nan) for name, v in values.items()}
    return cruise_rows.with_columns(pl.Series(name, v).fill_nan(None) for name, v in valid.items())


def _average_levels(cruise: pl.DataFrame) -> pl.DataFrame:
    """Average pressures and temperatures along a cruise level, the inlet's from the air data plus the flight's offset.

    In a cruise the states of the air move slowly while speed and diffuser vary from one sample to the next: a flight's
    median diameter is one sample's, and should not have that sample's noise. Nor must a missing reading cost the
    sample.
    """
    above_k = (pl.col("cc_in_k") - pl.col("tat_k")).median().over(FLIGHT_PACK)
    ratio = (pl.col("cc_in_pa") / pl.col("total_pressure_pa")).median().over(FLIGHT_PACK)
    level = (pl.col("altitude_m") / LEVEL_M).round().fill_null(strategy="forward").alias("_level")
    along = [*FLIGHT_PACK, "_level"]
    return (
        cruise.with_columns(
            level,
            pl.coalesce(pl.col("tat_k") + above_k, "cc_in_k").alias("cc_in_k"),
            pl.coalesce(pl.col("total_pressure_pa") * ratio, "cc_in_pa").alias("cc_in_pa"),
        )
        .with_columns(
            pl.col(c).rolling_mean(STEADY_SAMPLES, center=True, min_samples=1).over(along)
            for c in ("cc_in_k", "cc_in_pa", "cc_out_pa", "cc_out_k")
        )
        .drop("_level")
    )


def compressor_flights(samples: pl.DataFrame) -> pl.DataFrame:
    """Compute medians of each flight and pack, with the standard error of each."""
    columns = ("diameter_m", "group_m3", "efficiency", "vda_counts")

    def error(name: str) -> pl.Expr:
        sd = spread_expr(pl.col(name) - pl.col(name).median())
        return (sd * median_error(pl.col(name).count())).alias(f"{name}_se")

    return samples.group_by(FLIGHT_PACK).agg(
        *(pl.col(c).median() for c in columns),
        *(error(c) for c in columns[:3]),
        pl.col("diameter_m").count().alias("cc_n_samples"),
    )
