"""Demand of each flight on an exchanger: its outlet with the ram door full open against the controller's target.

While the door can move, the outlet is at the target and carries no information on wear. The aircraft's message comes
when the door is full open and the outlet exceeds the target. So the model computes the outlet with the door full open
and, conversely, the conductance at which it reaches the target.
"""

from collections.abc import Mapping

import numpy as np
import polars as pl

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import flights_of
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.inlet_law import full_open_inlet_k
from hdt_core.flight.control_schedules import FULL_OPEN, ControlSchedules, has_authority
from hdt_core.flight.quality import RUNNING_KG_S
from hdt_core.margin.compressor_demand import compressor_demand
from hdt_core.physics.air import hot_day_tat_k, reference_air
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT_PACK

HIGH_M = 4572.0
"""15,000 ft: below, the pack runs in warm air for minutes without a message. [m]"""
SHARES = (0.2, 0.5)
"""Shares of a flight's high samples with a critical ratio each: the hottest fifth, the hotter half. [-]"""
EXCESS_K = (-20.0, -10.0, 0.0, 5.0, 10.0)
"""Outlet above its target at which critical ratios are stored; others are interpolated. [K]"""
DEMAND_COLUMNS = (
    "high_n",
    "held_k",
    "held_status",
    "full_open_share",
    *(f"overheat_p{round(100 * s)}_k" for s in SHARES),
)
REFERENCE_INLET_K = 390.0
LN_RATIOS = np.array([-1.2, -0.8, -0.55, -0.35, -0.2, -0.05, 0.1, 0.3, 0.6])
"""Ln conductance ratios at which the model is evaluated; between them the outlet is nearly linear. [-]"""
TRIM_SAMPLES = 2
"""Samples with a free door that determine a flight's own trim."""


def critical_name(share: float, excess_k: float) -> str:
    """Return the column of a critical ratio."""
    sign = "minus_" if excess_k < 0.0 else ""
    return f"critical_ln_ratio_p{round(100 * share)}_{sign}{abs(round(excess_k))}k"


CRITICAL = tuple(critical_name(share, excess) for share in SHARES for excess in EXCESS_K)
HOT_DAY = tuple(name.replace("_p20_", "_hot_day_") for name in CRITICAL[: len(EXCESS_K)])
PARTS = ("hx_margin_design_k", "hx_margin_target_k", "hx_margin_flow_k", "hx_margin_ambient_k", "hx_margin_blockage_k")


def exchanger_demand(samples: pl.DataFrame, dsm: Dsm, schedules: ControlSchedules) -> pl.DataFrame:
    """Compute each flight's demand on its exchangers, whatever their wear, from that flight and the model alone.

    Parameters
    ----------
    samples : DataFrame
        Of the leg filter: signals in SI, `phase`, all phases.
    dsm : Dsm
        Digital System Model in service.
    schedules : ControlSchedules
        Of the controllers.

    Returns
    -------
    DataFrame
        One row a flight and pack: `held_k` (target of the outlet, median of the high samples), `held_status` (its
        source: flight, pack or unknown), `high_n`, `critical_ln_ratio_p<share>_<excess>k` (ln conductance ratio below
        which that share of the high samples exceeds the target by more than the excess with the door full open), the
        same `_hot_day_`, `full_open_share`, `overheat_p<share>_k` (outlet above target, door full open, in that share
        of the high samples), and `PARTS`. Missing is null.
    """
    flights = flights_of(samples)
    high = _high(samples, dsm, schedules)
    demand = high.group_by(FLIGHT_PACK, maintain_order=True).agg(
        pl.len().alias("high_n"),
        pl.col("held_k").median(),
        pl.col("held_status").first(),
        (pl.col("ram_door_open") > FULL_OPEN).mean().alias("full_open_share"),
        *(pl.col("overheat_k").quantile(1.0 - s).alias(f"overheat_p{round(100 * s)}_k") for s in SHARES),
        *(pl.col(f"excess_{j}").quantile(1.0 - s).alias(f"{s}_{j}") for s in SHARES for j in range(LN_RATIOS.size)),
        *(pl.col(name).median() for name in (*hx.SIGNALS, "ln_ram_ratio", "trim_k")),
    )
    curves = {s: demand.select(f"{s}_{j}" for j in range(LN_RATIOS.size)).to_numpy() for s in SHARES}
    critical = [
        pl.Series(critical_name(s, e), falls_through(curves[s], LN_RATIOS, e)).fill_nan(None)
        for s in SHARES
        for e in EXCESS_K
    ]
    middle = {name: demand[name].to_numpy().astype(float) for name in (*hx.SIGNALS, "ln_ram_ratio", "trim_k")}
    parts = [*_hot_day(middle, demand, dsm, schedules), *margin_parts(middle, demand, dsm, schedules)]
    demand = demand.select(*FLIGHT_PACK, *DEMAND_COLUMNS).with_columns(*critical, *parts)
    rows = flights.select(*FLIGHT_PACK, "departed_at").join(demand, on=FLIGHT_PACK, how="left", validate="m:1")
    rows = rows.join(compressor_demand(samples, dsm, schedules), on=FLIGHT_PACK, how="left", validate="m:1")
    return rows.with_columns(pl.col("high_n").fill_null(0), pl.col("held_status").fill_null("unknown"))


def _hot_day(
    middle: Mapping[str, Array], flights: pl.DataFrame, dsm: Dsm, schedules: ControlSchedules
) -> list[pl.Series]:
    """Return critical ratios on the hot day, at the flight's own level, speed, flow and trim."""
    tat_k = hot_day_tat_k(middle["altitude_m"], middle["mach"])
    # bleed and compressor heat outside air, so the inlet follows it
    hot = {**middle, "tat_k": tat_k, "hx_in_k": middle["hx_in_k"] + tat_k - middle["tat_k"]}
    held_k = schedules.outlet.column(flights["tail"].to_numpy(), tat_k).to_numpy() + middle["trim_k"]
    excess = full_open_outlet_k(hot, dsm.design, LN_RATIOS) - held_k[:, None]
    return [
        pl.Series(name, falls_through(excess, LN_RATIOS, e)).fill_nan(None)
        for name, e in zip(HOT_DAY, EXCESS_K, strict=True)
    ]


def margin_parts(
    middle: Mapping[str, Array], flights: pl.DataFrame, dsm: Dsm, schedules: ControlSchedules
) -> list[pl.Series]:
    """Return the parts of a clean pack's margin, in turn from the reference cruise to the flight: `PARTS`. [K]

    The reference: the standard day at 11 km and Mach 0.84, the flow of the baseline, inlet 390 K, the fleet's own
    target. The blockage is the loss of ram flow by the heat balance of a measured ram outlet.
    """
    n = flights.height
    tail = flights["tail"].to_numpy()
    level_k = schedules.outlet.levels.get("", 0.0)
    now = reference_air(n) | {
        "hx_in_k": np.full(n, REFERENCE_INLET_K),
        "pack_flow_kg_s": np.full(n, dsm.cruise_flows_kg_s[0]),
    }

    def margin_k(signals: Mapping[str, Array], trim_k: Array | float, ln_ram: Array | float = 0.0) -> Array:
        held_k = schedules.outlet.column(tail, signals["tat_k"]).to_numpy() + trim_k
        return np.asarray(held_k - full_open_outlet_k(signals, dsm.design, np.array([dsm.clean_level]), ln_ram)[:, 0])

    steps = [margin_k(now, level_k), margin_k(now, middle["trim_k"])]
    now |= {name: middle[name] for name in ("pack_flow_kg_s", "hx_in_k")}
    steps.append(margin_k(now, middle["trim_k"]))
    now |= {name: middle[name] for name in ("altitude_m", "mach", "tat_k", "total_pressure_pa")}
    steps += [margin_k(now, middle["trim_k"]), margin_k(now, middle["trim_k"], middle["ln_ram_ratio"])]
    values = [steps[0], *np.diff(steps, axis=0)]
    return [pl.Series(name, value).fill_nan(None) for name, value in zip(PARTS, values, strict=True)]


def _high(samples: pl.DataFrame, dsm: Dsm, schedules: ControlSchedules) -> pl.DataFrame:
    """Return samples above `HIGH_M` with target, overheat and excess over target with the door full open."""
    valid = samples.drop_nulls(list(hx.SIGNALS)).filter(pl.col("pack_flow_kg_s") > RUNNING_KG_S)
    rows = _with_level(valid, schedules).filter((pl.col("altitude_m") > HIGH_M) & pl.col("held_k").is_not_null())
    signals = {name: rows[name].to_numpy().astype(float) for name in (*hx.SIGNALS, "ram_out_k")}
    bias = dsm.bias_of(rows)
    held_k = rows["held_k"].to_numpy() - bias[hx.BIASES.index("hx_out_k")]
    full = signals | {"hx_in_k": full_open_inlet_k(rows, dsm.hot_inlet, dsm.design, bias, held_k)}
    excess = full_open_outlet_k(hx.without_bias(full, bias), dsm.design, LN_RATIOS) - held_k[:, None]
    over = pl.when(pl.col("ram_door_open") > FULL_OPEN).then(pl.col("hx_out_k") - pl.col("held_k"))
    balance = hx.ln_ram_flow_ratio(signals, dsm.design, bias)
    return rows.with_columns(
        pl.Series("ln_ram_ratio", np.where(np.isfinite(balance), balance, np.nan)).fill_nan(None),
        pl.Series("hx_in_k", full["hx_in_k"]),
        over.clip(0.0).fill_null(0.0).alias("overheat_k"),
        *(pl.Series(f"excess_{j}", column).fill_nan(None) for j, column in enumerate(excess.T)),
    )


def _with_level(samples: pl.DataFrame, schedules: ControlSchedules) -> pl.DataFrame:
    """Add each sample's target: schedule on TAT plus the flight's own trim or the pack's."""
    tail = samples["tail"].to_numpy()
    tat_k = samples["tat_k"].to_numpy().astype(float)
    rows = samples.with_columns(schedules.outlet.column(tail, tat_k).alias("shape_k"))
    above = (pl.col("hx_out_k") - pl.col("shape_k")).filter(has_authority())
    trims = rows.group_by(FLIGHT_PACK).agg(above.median().alias("own_k"), above.len().alias("own_n"))
    own = pl.when(pl.col("own_n") >= TRIM_SAMPLES).then("own_k")
    trims = trims.with_columns(own.alias("own_k"), schedules.outlet.level_column(trims).alias("pack_k"))
    status = pl.when(pl.col("own_k").is_not_null()).then(pl.lit("flight")).otherwise(pl.lit("pack"))
    trims = trims.with_columns(pl.coalesce("own_k", "pack_k").alias("trim_k"), status.alias("held_status"))
    levels = rows.join(trims.select(*FLIGHT_PACK, "trim_k", "held_status"), on=FLIGHT_PACK, validate="m:1")
    return levels.with_columns((pl.col("shape_k") + pl.col("trim_k")).alias("held_k"))


def full_open_outlet_k(
    signals: Mapping[str, Array], design: Array, ln_ratio: Array, ln_ram_ratio: Array | float = 0.0
) -> Array:
    """Compute the hot outlet with the ram door full open at some ln conductance ratios. (n, ratios) [K]

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

    Returns
    -------
    array
        NaN where the speed leaves no ram flow.
    """
    full = {**signals, "ram_door_open": np.ones_like(signals["tat_k"])}
    ram = clean_ram_flow_kg_s(full, design) * np.exp(ln_ram_ratio)
    with np.errstate(divide="ignore", invalid="ignore"):  # Mach 0 leaves no ram flow: NaN
        clean_ln = ln_clean_conductance(full, ram, design)
        flow, hot_in_k, cold_in_k = (signals[n][:, None] for n in ("pack_flow_kg_s", "hx_in_k", "tat_k"))
        return outlets_k(flow, ram[:, None], hot_in_k, cold_in_k, np.exp(clean_ln[:, None] + ln_ratio))[0]


def falls_through(curves: Array, grid: Array, value: float) -> Array:
    """Return where falling curves over one grid reach a value: (n, points) to (n,)."""
    index = np.clip((curves > value).sum(axis=1) - 1, 0, grid.size - 2)
    rows = np.arange(len(curves))
    high = curves[rows, index]
    low = curves[rows, index + 1]
    share = (high - value) / np.maximum(high - low, 1e-9)
    return np.asarray(grid[index] + share * (grid[index + 1] - grid[index]))
