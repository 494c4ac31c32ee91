"""Estimate biases of redundant sensors from their differences."""

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.components.pack import CC, HX
from hdt_core.physics.model import Array, declared
from hdt_core.records.keys import AIRCRAFT, FLIGHT, FLIGHT_PACK, PACK

MAX_EXIT_SHARE = 0.8
EXIT_BIAS_SD_LN = declared(CC.model.signal("cc_out_pa").gain_sd)
PROBE_BIASES = ("inlet_bias_k", "inlet_bias_ln", "exit_bias_ln")
"""Of the inlet temperature and pressure, and the exit pressure."""
MIN_FLIGHTS, MIN_PACKS = 40, 4
CC_FLOW_BIAS_SD = declared(CC.model.signal("cc_flow_kg_s").gain_sd)
CC_INLET_BIAS_SD_K = declared(CC.model.signal("cc_in_k").bias_sd)
DOOR_FREE, MOSTLY_FREE = (0.05, 0.95), 0.8


def _share(own_sd: float, other_sd: Array | float) -> Array:
    """Compute the share of two sensors' difference that belongs to the first, by their declared calibration errors."""
    return np.asarray(own_sd**2 / (own_sd**2 + other_sd**2))


SHARE_K = float(_share(CC_INLET_BIAS_SD_K, declared(HX.model.signal("tat_k").bias_sd)))
SHARE_LN = float(
    _share(declared(CC.model.signal("cc_in_pa").gain_sd), declared(HX.model.signal("total_pressure_pa").gain_sd))
)
"""Of inlet temperature and pressure, against the air data."""


def sensor_prior(cruise: pl.DataFrame, packs: pl.DataFrame) -> tuple[Array, Array]:
    """Compute mean and sd of each pack's sensor biases before the fit, (packs, 6) each, order of `hx.BIASES`.

    Notes
    -----
    All air of a pack passes its compressor: the ratio of both flows is the fleet's, and a pack's difference from it is
    shared between the sensors by their quality. The same holds for TAT and the compressors' inlet temperatures.
    """
    mean = np.zeros((packs.height, len(hx.BIASES)))
    sd = np.tile(hx.BIAS_SDS, (packs.height, 1))
    flow = hx.BIASES.index("pack_flow_kg_s")
    tat = hx.BIASES.index("tat_k")
    medians = cruise.group_by(PACK).agg(
        (pl.col("pack_flow_kg_s") / pl.col("cc_flow_kg_s")).log().median().alias("ln_flows"),
        (pl.col("tat_k") - pl.col("cc_in_k")).median().alias("apart_k"),
    )
    rows = packs.join(medians, on=PACK, how="left", maintain_order="left", validate="m:1").with_columns(
        # TAT is one probe an aircraft: average over its packs' inlets
        apart_k=pl.col("apart_k").mean().over(AIRCRAFT),
        n_inlets=pl.col("apart_k").count().over(AIRCRAFT),
    )
    mean[:, flow], sd[:, flow] = _share_difference(_beyond(rows["ln_flows"]), hx.BIAS_SDS[flow], CC_FLOW_BIAS_SD)
    inlet_sd = CC_INLET_BIAS_SD_K / np.sqrt(np.maximum(rows["n_inlets"].to_numpy().astype(float), 1.0))
    mean[:, tat], sd[:, tat] = _share_difference(_beyond(rows["apart_k"]), hx.BIAS_SDS[tat], inlet_sd)
    return mean, sd


def _beyond(column: pl.Series) -> Array:
    values = column.to_numpy().astype(float)
    return values - np.nanmedian(values) if np.isfinite(values).any() else values


def _share_difference(difference: Array, own_sd: float, other_sd: Array | float) -> tuple[Array, Array]:
    """Compute the posterior of a bias from the difference of two sensors; the prior where there is none."""
    is_known = np.isfinite(difference)
    share = np.where(is_known, _share(own_sd, other_sd), 0.0)
    return share * np.nan_to_num(difference), own_sd * np.sqrt(1.0 - share)


def exit_differences(cruise: pl.DataFrame) -> pl.DataFrame:
    """Compute each pack's exit temperature above the other's in a flight, `apart_k`, while both doors can move."""
    free = pl.col("ram_door_open").is_between(*DOOR_FREE)
    flights = cruise.group_by(FLIGHT_PACK).agg(pl.col("hx_out_k").median(), free.mean().alias("free"))
    is_pair = (pl.len() == 2) & (pl.col("free").min() > MOSTLY_FREE)
    differences = flights.with_columns(
        pl.when(is_pair.over(FLIGHT))
        .then(2.0 * (pl.col("hx_out_k") - pl.col("hx_out_k").mean().over(FLIGHT)))
        .alias("apart_k")
    )
    return differences.select(*FLIGHT_PACK, "apart_k")


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
