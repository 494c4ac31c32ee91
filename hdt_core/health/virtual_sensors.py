"""Virtual sensors: quantities without a probe, from the twin's estimates of a flight, with their uncertainty."""

import polars as pl

from hdt_core.calibration.exchanger import BIAS_SD, NOISE_SD
from hdt_core.physics.air import mean_specific_heat_j_kg_k, warmed_k
from hdt_core.records.keys import LEG

BALANCE_SIGNALS = ("pack_flow_kg_s", "hx_in_k", "hx_out_k", "ram_flow_kg_s", "tat_k")
RAM_MAP_SD = 0.05
"""Relative uncertainty of the clean duct's flow where no ram outlet probe anchors it: maps err by 4 to 10 %."""


def virtual_sensors(twin_flights: pl.DataFrame) -> pl.DataFrame:
    """Compute the quantities of each flight and pack from the twin's estimates of that flight.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights`: ln conductance ratio, flows and medians of the cruise.

    Returns
    -------
    DataFrame
        The key and, each with an `_sd` column of the same unit: `ram_flow_kg_s` (of the clean duct), `ram_outlet_k`,
        `effectiveness`, `ua_w_k`, `ram_flow_loss` (loss of the clean duct's flow by the heat balance; null
        without a ram outlet probe); and `hx_fouling_flight` (1 less measured over expected conductance, undamped, with
        its unit's offset), `cc_diameter_deficit` (deficit to the diameter of equation (6)). Cross
        checks that need the model: `w_hx_in_over_discharge_k`, or `w_hx_in_over_pressure_k` where the discharge
        temperature is not recorded, and `w_conductance_off_cruise_ln`.
    """
    flow, hot_in_k, hot_out_k, ram_flow, tat_k = (twin_flights[c].cast(pl.Float64).to_numpy() for c in BALANCE_SIGNALS)
    heat_j_kg = flow * mean_specific_heat_j_kg_k(hot_in_k, hot_out_k) * (hot_in_k - hot_out_k) / ram_flow
    rise_k = pl.Series(warmed_k(tat_k, heat_j_kg) - tat_k)
    drop_k = pl.col("hx_in_k") - pl.col("tat_k")
    ratio = pl.col("ln_ua_ratio").exp()
    ua_sd = (pl.col("ln_ua_ratio_sd") ** 2 + pl.col("ln_ua_ratio_map_sd") ** 2).sqrt()
    reading_sd = (NOISE_SD["hx_out_k"] ** 2 / pl.col("n_samples").clip(1) + BIAS_SD["hx_out_k"] ** 2).sqrt()
    return twin_flights.select(
        *LEG,
        "ram_flow_kg_s",
        (RAM_MAP_SD * pl.col("ram_flow_kg_s")).alias("ram_flow_kg_s_sd"),
        (pl.col("tat_k") + rise_k).alias("ram_outlet_k"),
        pl.Series("ram_outlet_k_sd", (RAM_MAP_SD * rise_k).abs()),
        "effectiveness",
        (reading_sd / drop_k).alias("effectiveness_sd"),
        "ua_w_k",
        (ua_sd * pl.col("ua_w_k")).alias("ua_w_k_sd"),
        (1.0 - pl.col("ln_ram_ratio").exp()).alias("ram_flow_loss"),
        (pl.col("ln_ram_ratio_sd") * pl.col("ln_ram_ratio").exp()).alias("ram_flow_loss_sd"),
        (1.0 - ratio).alias("hx_fouling_flight"),
        (pl.col("ln_ua_ratio_sd") * ratio).alias("hx_fouling_flight_sd"),
        (1.0 - pl.col("diameter_m") / pl.col("expected_diameter_m")).alias("cc_diameter_deficit"),
        (pl.col("diameter_m_se") / pl.col("expected_diameter_m")).alias("cc_diameter_deficit_sd"),
        *_cross_checks(),
    ).with_columns(pl.selectors.float().fill_nan(None))


def _cross_checks() -> list[pl.Expr]:
    has_efficiency = pl.col("efficiency").is_not_null()
    return [
        pl.when(has_efficiency).then("inlet_apart_k").alias("w_hx_in_over_discharge_k"),
        pl.when(~has_efficiency).then("inlet_apart_k").alias("w_hx_in_over_pressure_k"),
        pl.col("door_apart_ln").alias("w_conductance_off_cruise_ln"),
    ]
