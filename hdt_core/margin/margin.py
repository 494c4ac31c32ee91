"""Margin before the message: each flight's demand against the present conductance, and the rule of the message."""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.margin.compressor_demand import CONDITIONS, FLOWS, curves_of, read_across, share_left
from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K, HOT_DAY, PARTS, SHARES
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.tables.features import CompressorMargin
from hdt_core.tracking.track import PROBE_SD

LEVEL_SD_K = {"flight": 0.5, "pack": 2.0}
"""Standard deviation of the target from the flight itself, or from the pack's others (trims differ by 2 K). [K]"""
RATIO_SD = 0.025
"""Standard deviation of the ln conductance at full door: scatter of a flight, and the map where samples are rare.
[-]"""
LN_RATIO_PER_K = 0.026
"""Ln conductance that a kelvin of the outlet is worth at full door, in the middle of the simulated designs. [1/K]"""
UNIT_FLIGHTS = 30
"""Flights of the running median of a unit's offset."""


@dataclass(frozen=True, slots=True)
class MessageRule:
    """Rule of the message: a flight is hot where `share` of its high samples lie `excess_k` above the target, door full
    open; the message comes with the second hot flight of `of`, with the first where `of` is 1.

    Attributes
    ----------
    excess_sd_k : float
        Standard deviation of `excess_k`. [K]
    messages : int
        Messages behind the rule.
    """

    share: float = SHARES[0]
    excess_k: float = 7.0
    excess_sd_k: float = 2.5
    of: int = 3
    messages: int = 0


PRIOR_RULE = MessageRule()
"""Before any message: a controller keeps its outlet within 2 or 3 K of the target, and a message without false alarms
needs two or three times that, on two flights of three."""


def exchanger_margin(wide: pl.DataFrame, demand: pl.DataFrame) -> pl.DataFrame:
    """Compute the margin after each flight: its demand against the present conductance.

    Parameters
    ----------
    wide : DataFrame
        One row a flight and pack, in order of departure within each pack: `FLIGHT_PACK`, `hx_fouling`, `ln_ua_ratio`,
        `hx_life` (units so far).
    demand : DataFrame
        Of `exchanger_demand`.

    Returns
    -------
    DataFrame
        `FLIGHT_PACK`; `hx_ln_ua_ratio`, the tracked conductance with the unit's offset; `hx_margin_k` (own conditions,
        the hottest fifth of the high samples) and `hx_margin_hot_day_k`, each with `_sd_k` (`_sd`) and status; its
        parts. Positive: reserve of the door; negative: the outlet was above its target.
    """
    ln_ratio = ln_ratio_margin(pl.col("ln_ua_ratio"), "hx_fouling", "hx_life").alias("hx_ln_ua_ratio")
    rows = wide.select(*FLIGHT_PACK, ln_ratio).join(
        demand, on=FLIGHT_PACK, how="left", maintain_order="left", validate="m:1"
    )
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
    level_sd = rows["held_status"].replace_strict(LEVEL_SD_K, default=None, return_dtype=pl.Float64).to_numpy()
    sds = [np.sqrt((RATIO_SD * slope) ** 2 + level_sd**2) for slope in per_ratio]
    clean = rows.select(PARTS[:-1]).to_numpy().sum(axis=1)
    columns = {
        "hx_margin_k": margins[0], "hx_margin_sd_k": sds[0],
        "hx_margin_hot_day_k": margins[1], "hx_margin_hot_day_sd_k": sds[1],
        "hx_margin_wear_k": margins[2] - clean, "hx_margin_profile_k": margins[0] - margins[2],
    }  # fmt: skip
    status = pl.when(pl.col("hx_margin_k").is_null()).then(pl.lit("not_known")).when(pl.col("held_status") == "pack")
    return rows.with_columns(pl.Series(n, v).fill_nan(None) for n, v in columns.items()).with_columns(
        status.then(pl.lit("level_of_pack")).otherwise(pl.lit("ok")).alias("hx_margin_status")
    )


def compressor_margin(wide: pl.DataFrame, demand: pl.DataFrame) -> pl.DataFrame:
    """Compute the flow that compressors can deliver beyond each flight's demand.

    Parameters
    ----------
    wide : DataFrame
        One row a flight and pack in order of departure: `FLIGHT_PACK`, `cc_diameter_loss`, `cc_diameter_loss_sd` (as
        tracked), `diameter_m`, `expected_diameter_m` (the flight alone), `cc_life`.
    demand : DataFrame
        Of `compressor_demand`.

    Returns
    -------
    DataFrame
        `FLIGHT_PACK` and the columns of `CompressorMargin`. `cc_flow_margin_kg_s` (own conditions, the hardest fifth of
        the cruise) and `cc_flow_margin_hot_high_kg_s`, each with `_sd` and status: negative where flow or pressure
        fell short.
        Status: ok, at_least (bounded by the diffuser's map and the speeds on record; no sd where the map ends) or
        not_known. `cc_diameter_left` (`_sd`) and `cc_diameter_left_hot_high`: share of its diameter that it may still
        lose before the demanded flow falls short. It needs no position beyond those on record, so no map bounds it.
    """
    ln_ratio = (pl.col("diameter_m") / pl.col("expected_diameter_m")).log()
    ln_diameter = ln_ratio_margin(ln_ratio, "cc_diameter_loss", "cc_life").alias("cc_ln_diameter_ratio")
    rows = wide.select(*FLIGHT_PACK, "cc_diameter_loss_sd", ln_diameter).join(
        demand, on=FLIGHT_PACK, how="left", maintain_order="left", validate="m:1"
    )
    ratio, flow = (rows[c].to_numpy().astype(float) for c in ("cc_ln_diameter_ratio", "cc_flow_asked_kg_s"))
    ratio_sd = np.hypot(rows["cc_diameter_loss_sd"].to_numpy().astype(float), PROBE_SD)
    (hard, hard_sd), (hot, hot_sd) = (
        ((share - 1.0) * flow, slope * ratio_sd * flow)
        for share, slope in (share_left(ratio, *curves_of(rows, where)) for where in CONDITIONS)
    )
    spare = _spare(rows, "p20", ratio)
    columns = {
        "cc_flow_margin_kg_s": hard, "cc_flow_margin_sd_kg_s": hard_sd,
        "cc_flow_margin_hot_high_kg_s": hot, "cc_flow_margin_hot_high_sd_kg_s": hot_sd,
        "cc_diameter_left": spare, "cc_diameter_left_sd": (1.0 - spare) * ratio_sd,
        "cc_diameter_left_hot_high": _spare(rows, "hot_high", ratio),
    }  # fmt: skip
    margins = rows.with_columns(pl.Series(n, v).fill_nan(None) for n, v in columns.items())
    return margins.with_columns(_reach("cc_flow_margin"), _reach("cc_flow_margin_hot_high")).select(
        *FLIGHT_PACK, *CompressorMargin.columns()
    )


def _spare(rows: pl.DataFrame, condition: str, ln_diameter: Array) -> Array:
    """Return the share of a diameter that may still be lost before the demanded flow falls short."""
    whole = curves_of(rows, condition)[0][:, FLOWS.tolist().index(1.0)]
    return np.asarray(-np.expm1(whole - ln_diameter))


def _reach(name: str) -> pl.Expr:
    """Return the status of a flow margin: a bound where the map ends first or the speed limit was not reached."""
    is_exact = pl.col("cc_speed_limit_met") & pl.col(f"{name}_sd_kg_s").is_not_null()
    status = pl.when(pl.col(f"{name}_kg_s").is_null()).then(pl.lit("not_known")).when(is_exact)
    return status.then(pl.lit("ok")).otherwise(pl.lit("at_least")).alias(f"{name}_status")


def ln_ratio_margin(ln_ratio: pl.Expr, loss: str, life: str) -> pl.Expr:
    """Return the tracked ln ratio: the filter's loss plus the unit's own offset."""
    ln_loss = -(1.0 - pl.col(loss)).log()
    offset = (ln_ratio + ln_loss).rolling_median(UNIT_FLIGHTS, min_samples=1).forward_fill()
    return offset.over(*PACK, life) - ln_loss


def at_excess(curve: Array, excess_k: float) -> Array:
    """Interpolate curves over `EXCESS_K` at one value, extrapolating linearly: (..., excesses) to (...)."""
    grid = np.array(EXCESS_K)
    j = int(np.clip(np.searchsorted(grid, excess_k) - 1, 0, grid.size - 2))
    share = (excess_k - grid[j]) / (grid[j + 1] - grid[j])
    return np.asarray(curve[..., j] + share * (curve[..., j + 1] - curve[..., j]))
