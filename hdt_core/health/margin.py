"""The margin that is left: how warm the hot outlet would be with the ram door full open, against the level held.

While the door can move, the outlet sits at the level the controller holds and says nothing of wear. The aircraft's
message comes when the door is full open and the outlet leaves that level. So the model is asked what the outlet would
be with the door full open, and, turned round, how low the conductance may fall before it gets there.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.health.controller import RUNNING_KG_S, Laws, has_authority
from hdt_core.physics.air import (
    standard_pressure_pa,
    standard_temperature_k,
    total_to_static_pressure,
    total_to_static_temperature,
)
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.model import Array
from hdt_core.twin import exchanger as hx
from hdt_core.twin.crossing import FLIGHT_PACK, flights_of
from hdt_core.twin.dsm import Dsm

HIGH_M = 4572.0
"""15,000 ft: below, the pack works against warm air for minutes, and no message comes of it."""
FULL_OPEN = 0.95
"""Ram door beyond this has nothing left to give: two per cent of sensor error, and the last of the travel is flat."""
SHARES = (0.2, 0.5)
"""Shares of a flight's high samples of which a critical ratio is kept: the hottest fifth, the hotter half."""
EXCESS_K = (-20.0, -10.0, 0.0, 5.0, 10.0)
"""Outlet above its held level at which critical ratios are kept; others are read between them. [K]"""
SHOWN = ("high_n", "held_k", "held_status", "full_open_share", *(f"overheat_p{round(100 * s)}_k" for s in SHARES))
REFERENCE_M, REFERENCE_MACH, REFERENCE_INLET_K = 11_000.0, 0.84, 390.0
LN_RATIOS = np.array([-1.2, -0.8, -0.55, -0.35, -0.2, -0.05, 0.1, 0.3, 0.6])
"""Conductance ratios at which the model is asked; between them the outlet is all but linear. [-]"""
HOT_DAY_K = 15.0
"""The hot day that a margin is stated for: the standard atmosphere and 15 K, at the flight's level, speed and flow."""
TRIM_SAMPLES = 2
"""Samples with the door in motion that give a flight's own held level."""
HELD_SD_K = {"flight": 0.5, "pack": 2.0}
"""How well the held level is known: from the flight itself, or from the pack's others (trims differ by 2 K)."""
RATIO_SD = 0.025
"""What is not known of the conductance that is left at full door: the flight's scatter, and the map where it was seldom
seen. ln [-]"""
UNIT_FLIGHTS = 30
"""Flights over which a unit's offset is taken."""


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


def critical_name(share: float, excess_k: float) -> str:
    """Column of a critical ratio."""
    sign = "minus_" if excess_k < 0.0 else ""
    return f"critical_ln_ratio_p{round(100 * share)}_{sign}{abs(round(excess_k))}k"


CRITICAL = tuple(critical_name(share, excess) for share in SHARES for excess in EXCESS_K)
HOT_DAY = tuple(name.replace("_p20_", "_hot_day_") for name in CRITICAL[: len(EXCESS_K)])
PARTS = ("hx_margin_design_k", "hx_margin_target_k", "hx_margin_flow_k", "hx_margin_ambient_k", "hx_margin_blockage_k")
SHOWN_MARGIN = (
    "hx_ln_ua_ratio", "hx_margin_k", "hx_margin_sd_k", "hx_margin_status", "hx_margin_hot_day_k",
    "hx_margin_hot_day_sd_k", *PARTS, "hx_margin_wear_k", "hx_margin_profile_k", "overheat_p20_k", "full_open_share",
)  # fmt: skip
"""What is told of the margin after each flight: see `left_margin`."""


def margin_flights(samples: pl.DataFrame, dsm: Dsm, laws: Laws) -> pl.DataFrame:
    """What each flight asked of the exchangers, whatever their wear: from that flight and the model alone.

    Parameters
    ----------
    samples : DataFrame
        Of the leg filter: signals in SI, `phase`, all phases.
    dsm : Dsm
        Digital System Model in service.
    laws : Laws
        What the controllers hold.

    Returns
    -------
    DataFrame
        One row a flight and pack: `held_k` (level the outlet is held at, median of the high samples), `held_status`
        (flight, pack or unknown: whose level that is), `high_n`, `critical_ln_ratio_p<share>_<excess>k` (ln conductance
        ratio below which that share of the high samples leaves the held level by more than the excess with the door
        full open), the same `_hot_day_`, `full_open_share`, `overheat_p<share>_k` (how far the outlet was above its
        level, door full open, in that share of the high samples), and `PARTS`. Missing is null.
    """
    flights = flights_of(samples)
    high = _high(samples, dsm, laws)
    found = high.group_by(FLIGHT_PACK, maintain_order=True).agg(
        pl.len().alias("high_n"),
        pl.col("held_k").median(),
        pl.col("held_status").first(),
        (pl.col("ram_door_open") > FULL_OPEN).mean().alias("full_open_share"),
        *(pl.col("overheat_k").quantile(1.0 - s).alias(f"overheat_p{round(100 * s)}_k") for s in SHARES),
        *(pl.col(f"excess_{j}").quantile(1.0 - s).alias(f"{s}_{j}") for s in SHARES for j in range(LN_RATIOS.size)),
        *(pl.col(name).median() for name in (*hx.SIGNALS, "ln_ram_ratio", "trim_k")),
    )
    curves = {s: found.select(f"{s}_{j}" for j in range(LN_RATIOS.size)).to_numpy() for s in SHARES}
    critical = [
        pl.Series(critical_name(s, e), critical_ln_ratio(curves[s], e)).fill_nan(None) for s in SHARES for e in EXCESS_K
    ]
    middle = {name: found[name].to_numpy().astype(float) for name in (*hx.SIGNALS, "ln_ram_ratio", "trim_k")}
    parts = [*_hot_day(middle, found, dsm, laws), *margin_parts(middle, found, dsm, laws)]
    found = found.select(*FLIGHT_PACK, *SHOWN).with_columns(*critical, *parts)
    keep = flights.select(*FLIGHT_PACK, "departed_at").join(found, on=FLIGHT_PACK, how="left")
    return keep.with_columns(pl.col("high_n").fill_null(0), pl.col("held_status").fill_null("unknown"))


def _hot_day(middle: Mapping[str, Array], flights: pl.DataFrame, dsm: Dsm, laws: Laws) -> list[pl.Series]:
    """Critical ratios on the hot day, at the flight's own level, speed, flow and trim."""
    tat_k = (standard_temperature_k(middle["altitude_m"]) + HOT_DAY_K) * total_to_static_temperature(middle["mach"])
    # bleed and compressor warm what they take in: the inlet follows the air
    hot = {**middle, "tat_k": tat_k, "hx_in_k": middle["hx_in_k"] + tat_k - middle["tat_k"]}
    held_k = laws.outlet.column(flights["tail"].to_numpy(), tat_k).to_numpy() + middle["trim_k"]
    excess = full_open_outlet_k(hot, dsm.design, LN_RATIOS) - held_k[:, None]
    return [
        pl.Series(name, critical_ln_ratio(excess, e)).fill_nan(None) for name, e in zip(HOT_DAY, EXCESS_K, strict=True)
    ]


def margin_parts(middle: Mapping[str, Array], flights: pl.DataFrame, dsm: Dsm, laws: Laws) -> list[pl.Series]:
    """What a clean pack's margin is made of, taken in turn from the reference cruise to the flight: `PARTS`. [K]

    The reference: the standard day at 11 km and Mach 0.84, the flow of the baseline, inlet 390 K, the fleet's own
    target. The blockage is what the heat balance of a measured ram outlet says the door no longer lets through.
    """
    n = flights.height
    tail, level_k = flights["tail"].to_numpy(), laws.outlet.levels.get("", 0.0)
    altitude_m, mach = np.full(n, REFERENCE_M), np.full(n, REFERENCE_MACH)
    now = {
        "altitude_m": altitude_m,
        "mach": mach,
        "tat_k": standard_temperature_k(altitude_m) * total_to_static_temperature(mach),
        "total_pressure_pa": standard_pressure_pa(altitude_m) * total_to_static_pressure(mach),
        "hx_in_k": np.full(n, REFERENCE_INLET_K),
        "pack_flow_kg_s": np.full(n, dsm.cruise_flows_kg_s[0]),
    }

    def margin_k(signals: Mapping[str, Array], trim_k: Array | float, ln_ram: Array | float = 0.0) -> Array:
        held_k = laws.outlet.column(tail, signals["tat_k"]).to_numpy() + trim_k
        return np.asarray(held_k - full_open_outlet_k(signals, dsm.design, np.array([dsm.clean_level]), ln_ram)[:, 0])

    steps = [margin_k(now, level_k), margin_k(now, middle["trim_k"])]
    now |= {name: middle[name] for name in ("pack_flow_kg_s", "hx_in_k")}
    steps.append(margin_k(now, middle["trim_k"]))
    now |= {name: middle[name] for name in ("altitude_m", "mach", "tat_k", "total_pressure_pa")}
    steps += [margin_k(now, middle["trim_k"]), margin_k(now, middle["trim_k"], middle["ln_ram_ratio"])]
    values = [steps[0], *np.diff(steps, axis=0)]
    return [pl.Series(name, value).fill_nan(None) for name, value in zip(PARTS, values, strict=True)]


def critical_ln_ratio(excess_k: Array, at_k: float) -> Array:
    """Where curves of the outlet above its level, over `LN_RATIOS`, fall through a value: (n, ratios) to (n,).

    Straight lines between the ratios and beyond the last two at either end.
    """
    left = np.clip((excess_k > at_k).sum(axis=1) - 1, 0, LN_RATIOS.size - 2)
    rows = np.arange(len(excess_k))
    high, low = excess_k[rows, left], excess_k[rows, left + 1]
    share = (high - at_k) / np.maximum(high - low, 1e-9)
    return np.asarray(LN_RATIOS[left] + share * (LN_RATIOS[left + 1] - LN_RATIOS[left]))


def _high(samples: pl.DataFrame, dsm: Dsm, laws: Laws) -> pl.DataFrame:
    """Samples above `HIGH_M` with the level held and the conductance needed to hold it with the door full open."""
    known = samples.drop_nulls(list(hx.SIGNALS)).filter(pl.col("pack_flow_kg_s") > RUNNING_KG_S)
    rows = _with_level(known, laws).filter((pl.col("altitude_m") > HIGH_M) & pl.col("held_k").is_not_null())
    signals = {name: rows[name].to_numpy().astype(float) for name in hx.SIGNALS}
    bias = dsm.bias_of(rows)
    held_k = rows["held_k"].to_numpy() - bias[hx.BIASES.index("hx_out_k")]
    excess = full_open_outlet_k(hx.without_bias(signals, bias), dsm.design, LN_RATIOS) - held_k[:, None]
    over = pl.when(pl.col("ram_door_open") > FULL_OPEN).then(pl.col("hx_out_k") - pl.col("held_k"))
    ram_out = {"ram_out_k": rows["ram_out_k"].to_numpy().astype(float)} if "ram_out_k" in rows.columns else {}
    balance = (
        hx.ln_ram_flow_ratio({**signals, **ram_out}, dsm.design, bias) if ram_out else np.full(rows.height, np.nan)
    )
    return rows.with_columns(
        pl.Series("ln_ram_ratio", np.where(np.isfinite(balance), balance, np.nan)).fill_nan(None),
        over.clip(0.0).fill_null(0.0).alias("overheat_k"),
        *(pl.Series(f"excess_{j}", column).fill_nan(None) for j, column in enumerate(excess.T)),
    )


def _with_level(samples: pl.DataFrame, laws: Laws) -> pl.DataFrame:
    """Each sample with the level its controller holds: schedule on TAT, and the flight's own trim or the pack's."""
    tail, tat_k = samples["tail"].to_numpy(), samples["tat_k"].to_numpy().astype(float)
    shaped = samples.with_columns(laws.outlet.column(tail, tat_k).alias("shape_k"))
    above = (pl.col("hx_out_k") - pl.col("shape_k")).filter(has_authority())
    trims = shaped.group_by(FLIGHT_PACK).agg(above.median().alias("own_k"), above.len().alias("own_n"))
    own = pl.when(pl.col("own_n") >= TRIM_SAMPLES).then("own_k")
    trims = trims.with_columns(own.alias("own_k"), laws.outlet.level_column(trims).alias("pack_k"))
    status = pl.when(pl.col("own_k").is_not_null()).then(pl.lit("flight")).otherwise(pl.lit("pack"))
    trims = trims.with_columns(pl.coalesce("own_k", "pack_k").alias("trim_k"), status.alias("held_status"))
    joined = shaped.join(trims.select(*FLIGHT_PACK, "trim_k", "held_status"), on=FLIGHT_PACK)
    return joined.with_columns((pl.col("shape_k") + pl.col("trim_k")).alias("held_k"))


def full_open_outlet_k(
    signals: Mapping[str, Array], design: Array, ln_ratio: Array, ln_ram_ratio: Array | float = 0.0
) -> Array:
    """Hot outlet with the ram door full open at each of some ln conductance ratios. (n, ratios) [K]

    Parameters
    ----------
    signals : mapping
        `hx.SIGNALS` without sensor bias, (n,).
    design : array
        Design vector in the order of `hx.NAMES`.
    ln_ratio : array
        ln of conductance over that of the clean model at the same flows, (ratios,). [-]
    ln_ram_ratio : array, optional
        ln of ram flow over that of the clean duct, (n,). [-]
    """
    full = {**signals, "ram_door_open": np.ones_like(signals["tat_k"])}
    ram = hx.clean_ram_flow_kg_s(full, design) * np.exp(ln_ram_ratio)
    expected = hx.ln_clean_conductance(full, ram, design)
    columns = [
        outlets_k(signals["pack_flow_kg_s"], ram, signals["hx_in_k"], signals["tat_k"], np.exp(expected + r))[0]
        for r in ln_ratio
    ]
    return np.stack(columns, axis=1)


def left_margin(wide: pl.DataFrame, asks: pl.DataFrame) -> pl.DataFrame:
    """The margin after each flight: what its conditions ask against the conductance that is left.

    Parameters
    ----------
    wide : DataFrame
        One row a flight and pack, in order of departure within each pack: `FLIGHT_PACK`, `hx_fouling`, `ln_ua_ratio`,
        `hx_life` (units so far).
    asks : DataFrame
        Of `margin_flights`.

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
    sds = [np.sqrt((RATIO_SD * slope) ** 2 + held_sd**2) for slope in per_ratio]
    clean = rows.select(pl.sum_horizontal(PARTS[:-1])).to_series().to_numpy()
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
