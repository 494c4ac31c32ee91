"""The margin that is left: what flights ask against the conductance there is, and by which rule the message comes."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.margin.compressor_demand import CLEAN_PARTS, FLOWS, WHERE, curves_of, share_left
from hdt_core.margin.curves import read_across
from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K, HOT_DAY, PARTS, SHARES
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT_PACK
from hdt_core.tracking.compressor_tracking import PROBE_SD

HELD_SD_K = {"flight": 0.5, "pack": 2.0}
"""How well the held level is known: from the flight itself, or from the pack's others (trims differ by 2 K)."""
TOLD_RATIO_SD = 0.025
"""What is not known of the conductance that is left at full door: the flight's scatter, and the map where it was seldom
seen. ln [-]"""
UNIT_FLIGHTS = 30
"""Flights over which a unit's offset is taken."""
SHOWN_MARGIN = (
    "hx_ln_ua_ratio", "hx_margin_k", "hx_margin_sd_k", "hx_margin_status", "hx_margin_hot_day_k",
    "hx_margin_hot_day_sd_k", *PARTS, "hx_margin_wear_k", "hx_margin_profile_k", "overheat_p20_k", "full_open_share",
)  # fmt: skip
"""What is told of the margin after each flight: see `exchanger_margin`."""
SHOWN_DELIVERY = (
    "cc_ln_diameter_ratio", "cc_diameter_left", "cc_diameter_left_sd", "cc_diameter_left_hot_high",
    "cc_flow_asked_kg_s", "cc_flow_margin_kg_s", "cc_flow_margin_sd_kg_s", "cc_flow_margin_status",
    "cc_flow_margin_hot_high_kg_s", "cc_flow_margin_hot_high_sd_kg_s", "cc_flow_margin_hot_high_status", *CLEAN_PARTS,
    "cc_flow_margin_wear_kg_s", "cc_flow_margin_profile_kg_s",
)  # fmt: skip
"""What is told of the compressor's: see `compressor_margin`."""


@dataclass(frozen=True, slots=True)
class MessageRule:
    """When the message comes: a flight is hot where `share` of its high samples lie `excess_k` above the level
    held, door full open; the message comes with the second hot flight of `of`, with the first where `of` is 1.

    Attributes
    ----------
    excess_sd_k : float
        Standard deviation of `excess_k`. [K]
    messages : int
        Messages it was learned from.
    """

    share: float = SHARES[0]
    excess_k: float = 7.0
    excess_sd_k: float = 2.5
    of: int = 3
    messages: int = 0


PRIOR_RULE = MessageRule()
"""Before any message: a controller holds its outlet within 2 or 3 K, and a message that is not to cry wolf waits for
two or three times that, on two flights of three."""


def exchanger_margin(wide: pl.DataFrame, asks: pl.DataFrame) -> pl.DataFrame:
    """The margin after each flight: what its conditions ask against the conductance that is left.

    Parameters
    ----------
    wide : DataFrame
        One row a flight and pack, in order of departure within each pack: `FLIGHT_PACK`, `hx_fouling`, `ln_ua_ratio`,
        `hx_life` (units so far).
    asks : DataFrame
        Of `exchanger_demand`.

    Returns
    -------
    DataFrame
        `FLIGHT_PACK`; `hx_ln_ua_ratio`, the conductance that is left as the track has it, the unit's offset in it;
        `hx_margin_k` (own conditions, the hottest fifth of the high samples) and `hx_margin_hot_day_k`, each with
        `_sd_k` (`_sd`) and status; its parts. Positive: the door has so many kelvin in hand; negative: the outlet was
        above its level.
    """
    left = ln_ratio_margin(pl.col("ln_ua_ratio"), "hx_fouling", "hx_life").alias("hx_ln_ua_ratio")
    rows = wide.select(*FLIGHT_PACK, left).join(asks, on=FLIGHT_PACK, how="left", maintain_order="left", validate="m:1")
    ratio = rows["hx_ln_ua_ratio"].to_numpy().astype(float)
    half = len(EXCESS_K)
    excess, per_ratio = zip(
        *(
            read_across(-rows.select(names).to_numpy().astype(float), np.array(EXCESS_K), -ratio)
            for names in (CRITICAL[:half], HOT_DAY, CRITICAL[half:])
        ),
        strict=True,
    )
    margins = [-k for k in excess]
    held_sd = rows["held_status"].replace_strict(HELD_SD_K, default=None, return_dtype=pl.Float64).to_numpy()
    sds = [np.sqrt((TOLD_RATIO_SD * slope) ** 2 + held_sd**2) for slope in per_ratio]
    clean = rows.select(PARTS[:-1]).to_numpy().sum(axis=1)
    named = {
        "hx_margin_k": margins[0], "hx_margin_sd_k": sds[0],
        "hx_margin_hot_day_k": margins[1], "hx_margin_hot_day_sd_k": sds[1],
        "hx_margin_wear_k": margins[2] - clean, "hx_margin_profile_k": margins[0] - margins[2],
    }  # fmt: skip
    status = pl.when(pl.col("hx_margin_k").is_null()).then(pl.lit("not_known")).when(pl.col("held_status") == "pack")
    return rows.with_columns(pl.Series(n, v).fill_nan(None) for n, v in named.items()).with_columns(
        status.then(pl.lit("level_of_pack")).otherwise(pl.lit("ok")).alias("hx_margin_status")
    )


def compressor_margin(wide: pl.DataFrame, asks: pl.DataFrame) -> pl.DataFrame:
    """Flow that compressors can still deliver, beyond what each flight asked.

    Parameters
    ----------
    wide : DataFrame
        One row a flight and pack in order of departure: `FLIGHT_PACK`, `cc_diameter_loss`, `cc_diameter_loss_sd` (as
        tracked), `diameter_m`, `expected_diameter_m` (the flight alone), `cc_life`.
    asks : DataFrame
        Of `compressor_demand`.

    Returns
    -------
    DataFrame
        `FLIGHT_PACK` and `SHOWN_DELIVERY`. `cc_flow_margin_kg_s` (own conditions, the hardest fifth of the cruise) and
        `cc_flow_margin_hot_high_kg_s`, each with `_sd` and status: negative where flow or pressure fell short. Status:
        ok, at_least (as far as the diffuser's map and the speeds on record reach; no sd where the map ends) or
        not_known.
        `cc_diameter_left` (`_sd`) and `cc_diameter_left_hot_high`: share of its diameter that it may still lose before
        the flow asked for falls short. No position beyond those on record is asked for, so that no map bounds it.
    """
    seen = (pl.col("diameter_m") / pl.col("expected_diameter_m")).log()
    left = ln_ratio_margin(seen, "cc_diameter_loss", "cc_life").alias("cc_ln_diameter_ratio")
    rows = wide.select(*FLIGHT_PACK, "cc_diameter_loss_sd", left).join(
        asks, on=FLIGHT_PACK, how="left", maintain_order="left", validate="m:1"
    )
    ratio, flow = (rows[c].to_numpy().astype(float) for c in ("cc_ln_diameter_ratio", "cc_flow_asked_kg_s"))
    ratio_sd = np.hypot(rows["cc_diameter_loss_sd"].to_numpy().astype(float), PROBE_SD)
    (hard, hard_sd), (middle, _), (hot, hot_sd) = (
        ((share - 1.0) * flow, slope * ratio_sd * flow)
        for share, slope in (share_left(ratio, *curves_of(rows, where)) for where in WHERE)
    )
    spare = _spare(rows, "p20", ratio)
    named = {
        "cc_flow_margin_kg_s": hard, "cc_flow_margin_sd_kg_s": hard_sd,
        "cc_flow_margin_hot_high_kg_s": hot, "cc_flow_margin_hot_high_sd_kg_s": hot_sd,
        "cc_flow_margin_wear_kg_s": middle - rows.select(CLEAN_PARTS).to_numpy().sum(axis=1),
        "cc_flow_margin_profile_kg_s": hard - middle,
        "cc_diameter_left": spare, "cc_diameter_left_sd": (1.0 - spare) * ratio_sd,
        "cc_diameter_left_hot_high": _spare(rows, "hot_high", ratio),
    }  # fmt: skip
    told = rows.with_columns(pl.Series(n, v).fill_nan(None) for n, v in named.items())
    return told.with_columns(_reach("cc_flow_margin"), _reach("cc_flow_margin_hot_high")).select(
        *FLIGHT_PACK, *SHOWN_DELIVERY
    )


def _spare(rows: pl.DataFrame, where: str, ln_diameter: Array) -> Array:
    """Share of a diameter that may still go before the whole flow asked for is no longer delivered."""
    whole = curves_of(rows, where)[0][:, FLOWS.tolist().index(1.0)]
    return np.asarray(-np.expm1(whole - ln_diameter))


def _reach(name: str) -> pl.Expr:
    """Status of a flow margin: a bound where the map ends first, or no limit of the speed was met."""
    bounded = pl.col("cc_speed_limit_met") & pl.col(f"{name}_sd_kg_s").is_not_null()
    status = pl.when(pl.col(f"{name}_kg_s").is_null()).then(pl.lit("not_known")).when(bounded)
    return status.then(pl.lit("ok")).otherwise(pl.lit("at_least")).alias(f"{name}_status")


def ln_ratio_margin(seen: pl.Expr, loss: str, life: str) -> pl.Expr:
    """Ln of what is left as tracked: what the filter says is worn off, from the level that the unit itself shows."""
    worn = -(1.0 - pl.col(loss)).log()
    offset = (seen + worn).rolling_median(UNIT_FLIGHTS, min_samples=1).forward_fill()
    return offset.over("operator", "tail", "pack", life) - worn


def at_excess(curve: Array, excess_k: float) -> Array:
    """Curves over `EXCESS_K` read at one value, straight beyond the ends: (..., excesses) to (...)."""
    grid = np.array(EXCESS_K)
    j = int(np.clip(np.searchsorted(grid, excess_k) - 1, 0, grid.size - 2))
    share = (excess_k - grid[j]) / (grid[j + 1] - grid[j])
    return np.asarray(curve[..., j] + share * (curve[..., j + 1] - curve[..., j]))
