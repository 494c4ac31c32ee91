"""Estimate biases of redundant sensors from their differences."""

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.components.compressor import CC
from hdt_core.physics.model import Array, declared
from hdt_core.records.keys import AIRCRAFT, FLIGHT, FLIGHT_PACK, PACK

CC_FLOW_BIAS_SD = declared(CC.model.signal("cc_flow_kg_s").gain_sd)
CC_INLET_BIAS_SD_K = declared(CC.model.signal("cc_in_k").bias_sd)
DOOR_FREE, MOSTLY_FREE = (0.05, 0.95), 0.8


def sensor_prior(cruise: pl.DataFrame, packs: pl.DataFrame) -> tuple[Array, Array]:
    """Compute mean and sd of each pack's sensor biases before the fit, (packs, 6) each, order of `hx.BIASES`.

    Notes
    -----
    All air of a pack passes its compressor: the ratio of both flows is the fleet's, and a pack's difference from it is
    shared between the sensors by their quality. The same holds for TAT and the compressors' inlet temperatures.
    """
    mean = np.zeros((packs.height, len(hx.BIASES)))
    sd = np.tile(hx.BIAS_SDS, (packs.height, 1))
    flow, tat = hx.BIASES.index("pack_flow_kg_s"), hx.BIASES.index("tat_k")
    medians = cruise.group_by(PACK).agg(
        (pl.col("pack_flow_kg_s") / pl.col("cc_flow_kg_s")).log().median().alias("ln_flows"),
        (pl.col("tat_k") - pl.col("cc_in_k")).median().alias("apart_k"),
    )
    rows = packs.join(medians, on=PACK, how="left", maintain_order="left", validate="m:1").with_columns(
        # TAT is one probe an aircraft: average over its packs' inlets
        apart_k=pl.col("apart_k").mean().over(AIRCRAFT),
        n_inlets=pl.col("apart_k").count().over(AIRCRAFT),
    )
    flow_sd = np.full(packs.height, CC_FLOW_BIAS_SD)
    mean[:, flow], sd[:, flow] = _share_difference(_beyond(rows["ln_flows"]), hx.BIAS_SDS[flow], flow_sd)
    inlet_sd = CC_INLET_BIAS_SD_K / np.sqrt(np.maximum(rows["n_inlets"].to_numpy().astype(float), 1.0))
    mean[:, tat], sd[:, tat] = _share_difference(_beyond(rows["apart_k"]), hx.BIAS_SDS[tat], inlet_sd)
    return mean, sd


def _beyond(column: pl.Series) -> Array:
    values = column.to_numpy().astype(float)
    return values - np.nanmedian(values) if np.isfinite(values).any() else values


def _share_difference(difference: Array, own_sd: float, other_sd: Array) -> tuple[Array, Array]:
    """Compute the posterior of a bias from the difference of two sensors; the prior where there is none."""
    is_known = np.isfinite(difference)
    share = np.where(is_known, own_sd**2 / (own_sd**2 + other_sd**2), 0.0)
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
