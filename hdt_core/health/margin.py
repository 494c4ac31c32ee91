"""The margin that is left: what flights ask against the conductance there is, and when the aircraft speaks."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.health.asks import CRITICAL, EXCESS_K, HOT_DAY, PARTS, SHARES
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT_PACK

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
"""What is told of the margin after each flight: see `left_margin`."""


@dataclass(frozen=True, slots=True)
class MessageRule:
    """When the aircraft speaks: a flight is hot where `share` of its high samples lie `excess_k` above the level
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


def left_margin(wide: pl.DataFrame, asks: pl.DataFrame) -> pl.DataFrame:
    """The margin after each flight: what its conditions ask against the conductance that is left.

    Parameters
    ----------
    wide : DataFrame
        One row a flight and pack, in order of departure within each pack: `FLIGHT_PACK`, `hx_fouling`, `ln_ua_ratio`,
        `hx_life` (units so far).
    asks : DataFrame
        Of `asks.margin_flights`.

    Returns
    -------
    DataFrame
        `FLIGHT_PACK`; `hx_ln_ua_ratio`, the conductance that is left as the track has it, the unit's offset in it;
        `hx_margin_k` (own conditions, the hottest fifth of the high samples) and `hx_margin_hot_day_k`, each with
        `_sd_k` (`_sd`) and status; its parts. Positive: the door has so many kelvin in hand; negative: the outlet was
        above its level.
    """
    rows = wide.select(*FLIGHT_PACK, left_ln_ratio()).join(asks, on=FLIGHT_PACK, how="left", maintain_order="left")
    ratio = rows["hx_ln_ua_ratio"].to_numpy().astype(float)
    half = len(EXCESS_K)
    margins, per_ratio = zip(
        *(
            _margin_at(ratio, rows.select(names).to_numpy().astype(float))
            for names in (CRITICAL[:half], HOT_DAY, CRITICAL[half:])
        ),
        strict=True,
    )
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


def left_ln_ratio() -> pl.Expr:
    """Ln conductance ratio as tracked: what the filter says is worn off, from the level that the unit itself shows."""
    worn = -(1.0 - pl.col("hx_fouling")).log()
    offset = (pl.col("ln_ua_ratio") + worn).rolling_median(UNIT_FLIGHTS, min_samples=1).forward_fill()
    return (offset.over("operator", "tail", "pack", "hx_life") - worn).alias("hx_ln_ua_ratio")


def at_excess(curve: Array, excess_k: float) -> Array:
    """Curves over `EXCESS_K` read at one value, straight beyond the ends: (..., excesses) to (...)."""
    grid = np.array(EXCESS_K)
    j = int(np.clip(np.searchsorted(grid, excess_k) - 1, 0, grid.size - 2))
    share = (excess_k - grid[j]) / (grid[j + 1] - grid[j])
    return np.asarray(curve[..., j] + share * (curve[..., j + 1] - curve[..., j]))


def _margin_at(ratio: Array, critical: Array) -> tuple[Array, Array]:
    """Margin at a ln ratio [K] and kelvin a unit of it, from critical ratios over `EXCESS_K`."""
    grid = np.array(EXCESS_K)
    left = np.clip((critical > ratio[:, None]).sum(axis=1) - 1, 0, grid.size - 2)
    rows = np.arange(len(ratio))
    high, low = critical[rows, left], critical[rows, left + 1]
    per_ratio = (grid[left + 1] - grid[left]) / np.maximum(high - low, 1e-6)
    return -(grid[left] + (high - ratio) * per_ratio), per_ratio
