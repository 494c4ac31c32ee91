"""What sensors that measure one thing twice say of each other's calibration."""

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.components.compressor import CC
from hdt_core.physics.model import Array, declared
from hdt_core.records.keys import FLIGHT_PACK, PACK

CC_FLOW_BIAS_SD = declared(CC.model.signal("cc_flow_kg_s").gain_sd)
CC_INLET_BIAS_SD_K = declared(CC.model.signal("cc_in_k").bias_sd)
DOOR_FREE, MOSTLY_FREE = (0.05, 0.95), 0.8


def sensor_prior(cruise: pl.DataFrame, packs: pl.DataFrame) -> tuple[Array, Array]:
    """Mean and standard deviation of each pack's sensor biases before the fit, (packs, 6) each, order of `hx.BIASES`.

    Notes
    -----
    All air of a pack passes its compressor: the ratio of both flows is the fleet's, and what a pack shows beyond it
    belongs to either sensor by their quality. The same holds for TAT and the temperature at the compressors' inlets.
    """
    mean = np.zeros((packs.height, len(hx.BIASES)))
    sd = np.tile(hx.BIAS_SDS, (packs.height, 1))
    flow, tat = hx.BIASES.index("pack_flow_kg_s"), hx.BIASES.index("tat_k")
    seen = cruise.group_by(PACK).agg(
        (pl.col("pack_flow_kg_s") / pl.col("cc_flow_kg_s")).log().median().alias("ln_flows"),
        (pl.col("tat_k") - pl.col("cc_in_k")).median().alias("apart_k"),
    )
    rows = packs.join(seen, on=PACK, how="left", maintain_order="left", validate="m:1").with_columns(
        # TAT is one probe an aircraft: its packs' inlets vote together
        apart_k=pl.col("apart_k").mean().over("operator", "tail"),
        votes=pl.col("apart_k").count().over("operator", "tail"),
    )
    beyond = _beyond(rows["ln_flows"])
    mean[:, flow], sd[:, flow] = _shared(beyond, hx.BIAS_SDS[flow], np.full(packs.height, CC_FLOW_BIAS_SD))
    voted = CC_INLET_BIAS_SD_K / np.sqrt(np.maximum(rows["votes"].to_numpy().astype(float), 1.0))
    mean[:, tat], sd[:, tat] = _shared(_beyond(rows["apart_k"]), hx.BIAS_SDS[tat], voted)
    return mean, sd


def _beyond(column: pl.Series) -> Array:
    values = column.to_numpy().astype(float)
    return values - np.nanmedian(values) if np.isfinite(values).any() else values


def _shared(difference: Array, own_sd: float, other_sd: Array) -> tuple[Array, Array]:
    """Posterior of a bias from the difference of two sensors; the prior where there is none."""
    known = np.isfinite(difference)
    share = np.where(known, own_sd**2 / (own_sd**2 + other_sd**2), 0.0)
    return share * np.nan_to_num(difference), own_sd * np.sqrt(1.0 - share)


def exit_differences(cruise: pl.DataFrame) -> pl.DataFrame:
    """Exit temperature of each pack above the other's in a flight, `apart_k`, while both doors can move.
    `FLIGHT_PACK`."""
    free = pl.col("ram_door_open").is_between(*DOOR_FREE)
    flights = cruise.group_by(FLIGHT_PACK).agg(pl.col("hx_out_k").median(), free.mean().alias("free"))
    pair = ["operator", "tail", "flight_id"]
    both = (pl.len() == 2) & (pl.col("free").min() > MOSTLY_FREE)
    apart = flights.with_columns(
        pl.when(both.over(pair))
        .then(2.0 * (pl.col("hx_out_k") - pl.col("hx_out_k").mean().over(pair)))
        .alias("apart_k")
    )
    return apart.select(*FLIGHT_PACK, "apart_k")
