"""What flights ask of a compressor, and how small it may become before it cannot deliver that at its highest speed.

The machine is held to a flow and an exit pressure. At its highest speed equations (2)-(4) say how wide the diffuser
must stand for a flow, equation (6) what diameter a sound machine has there, and equation (5) what diameter the pressure
needs. A machine that has lost diameter has to close its diffuser to hold the pressure, and so loses flow.
"""

from collections.abc import Mapping

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.compressor import compressor_samples
from hdt_core.calibration.compressor_fit import CompressorFit
from hdt_core.calibration.dsm import Dsm
from hdt_core.margin.control_schedules import ControlSchedules
from hdt_core.margin.curves import read_across
from hdt_core.margin.reference_air import HIGH_CRUISE_M, hot_day_tat_k, reference_air
from hdt_core.physics.compressor import (
    area_diameter_tan_beta_m3,
    effective_diameter_m,
    inlet_flow_kg_s,
)
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT_PACK, PACK

FLOWS = np.array([0.6, 0.8, 1.0, 1.2, 1.5])
"""Flow over the flow asked for at which critical diameters are kept; others are read between them."""
SURE_SD, LEAST_SLOPE_M3_COUNT = 5.0, 1e-8
"""Standard deviations, and m3 a count, beyond which the diffuser is known to move the flow: else there is no map."""
HARDEST = 0.2
"""Share of the cruise that is harder than what the margin is stated for."""
WHERE = ("p20", "middle", "hot_high")
"""The hardest fifth of the cruise, its middle, and the same flow asked at 41,000 ft on a hot day."""
SIGNALS = (
    "cc_speed_rad_s", "vda_counts", "inlet_k", "inlet_pa", "altitude_m", "mach", "tat_k", "total_pressure_pa",
    "pack_flow_kg_s",
)  # fmt: skip
CRITICAL_DIAMETER = {w: tuple(f"critical_ln_diameter_{w}_{round(100 * f)}pct" for f in FLOWS) for w in WHERE}
WIDEST = {w: f"cc_widest_share_{w}" for w in WHERE}
CLEAN_PARTS = ("cc_flow_margin_design_kg_s", "cc_flow_margin_demand_kg_s", "cc_flow_margin_ambient_kg_s")
ASKED = {"cc_flow_asked_kg_s": pl.Float64, "cc_speed_limit_met": pl.Boolean} | dict.fromkeys(
    (*(name for where in WHERE for name in (*CRITICAL_DIAMETER[where], WIDEST[where])), *CLEAN_PARTS), pl.Float64
)
"""What is kept of each flight: see `compressor_demand`."""


def compressor_demand(samples: pl.DataFrame, dsm: Dsm, laws: ControlSchedules) -> pl.DataFrame:
    """What each flight asked of the compressors, whatever their wear: from that flight and the model alone.

    Parameters
    ----------
    samples : DataFrame
        Of the leg filter: signals in SI, `phase`, all phases.
    dsm : Dsm
        Digital System Model in service.
    laws : ControlSchedules
        What the controllers hold.

    Returns
    -------
    DataFrame
        One row a flight and pack with such samples in cruise, none where the diffuser's map or the highest speed is not
        known: `cc_flow_asked_kg_s` (median, by speed and diffuser), `cc_speed_limit_met` (that speed is known to be the
        limit), `critical_ln_diameter_<where>_<flow>pct` (ln of the least diameter over equation (6)'s that delivers
        such a share of the flow asked for), `cc_widest_share_<where>` (the share that the widest position known
        delivers) and `CLEAN_PARTS`. Missing is null.
    """
    fit, limit_rad_s = dsm.compressor, laws.speed.rad_s
    mapped = fit.group_slope_m3_per_count > max(SURE_SD * fit.group_slope_sd_m3_per_count, LEAST_SLOPE_M3_COUNT)
    cruise = cruise_samples(samples, monitored=False)
    if limit_rad_s is None or not mapped or not cruise.height:
        nothing = (pl.lit(None, dtype).alias(name) for name, dtype in ASKED.items())
        return samples.select(FLIGHT_PACK).clear().with_columns(nothing)
    flights = _at_their_hardest(cruise, dsm, laws, limit_rad_s)
    return flights.with_columns(
        *_at_the_middle(flights, dsm, laws, limit_rad_s),
        cc_flow_asked_kg_s=pl.col("flow_kg_s"),
        cc_speed_limit_met=pl.lit(laws.speed.met),
    ).select(*FLIGHT_PACK, *ASKED)


def needed(asked: pl.DataFrame, fit: CompressorFit, speed_rad_s: float) -> tuple[Array, Array]:
    """Least ln diameter over equation (6)'s at shares `FLOWS` of the flow, and the share the widest position delivers.

    Parameters
    ----------
    asked : DataFrame
        `flow_kg_s, inlet_k, inlet_pa`; `no_flow_ln` and `flow_ln`: ln of the exit pressure [Pa] asked for at no flow,
        and what the flow adds to it, with its square.

    Returns
    -------
    array, shape (n, flows); array, shape (n,)
        NaN where any diameter does, or a reading can't be.
    """
    flow, inlet_k, inlet_pa, no_flow_ln, flow_ln = (
        asked[c].to_numpy() for c in ("flow_kg_s", "inlet_k", "inlet_pa", "no_flow_ln", "flow_ln")
    )
    speed = np.full(asked.height, speed_rad_s)
    columns = []
    with np.errstate(all="ignore"):  # a probe that reads nothing gives no answer
        for share in FLOWS:
            least_m = effective_diameter_m(inlet_pa, np.exp(no_flow_ln + share**2 * flow_ln), inlet_k, speed)
            group_m3 = area_diameter_tan_beta_m3(share * flow, inlet_pa, inlet_k, speed)
            built_m = fit.diameter_m(fit.position_counts(group_m3))
            columns.append(np.log(least_m / np.where(built_m > 0.0, built_m, np.nan)))
        widest_m3 = fit.group_at_m3(np.asarray(fit.vda_widest_counts))
        share_of_widest = inlet_flow_kg_s(widest_m3, inlet_pa, inlet_k, speed) / flow
    return _finite(np.stack(columns, axis=1)), _finite(np.where(flow > 0.0, share_of_widest, np.nan))


def curves_of(flights: pl.DataFrame, where: str) -> tuple[Array, Array]:
    """What `compressor_demand` says of one place: critical diameters (n, flows) and the widest share (n,)."""
    return flights.select(CRITICAL_DIAMETER[where]).to_numpy(), flights[WIDEST[where]].to_numpy()


def share_left(ln_diameter: Array, critical: Array, widest: Array) -> tuple[Array, Array]:
    """Share of the flow asked for that a diameter delivers, and its slope.

    At most that of the widest position known, which is a bound and has no slope (NaN).
    """
    share, slope = read_across(critical, FLOWS, ln_diameter)
    return np.minimum(share, widest), np.where(share < widest, slope, np.nan)


def _at_their_hardest(cruise: pl.DataFrame, dsm: Dsm, laws: ControlSchedules, limit_rad_s: float) -> pl.DataFrame:
    """Curves in the hardest fifth of each flight's cruise; medians of `SIGNALS` and of the flow."""
    seen = compressor_samples(cruise, dsm.pack_table()).drop_nulls(SIGNALS).filter(pl.col("cc_speed_rad_s") > 0.0)
    rows = _with_flow(seen, dsm.compressor)
    critical, widest = needed(_with_pressure(rows, dsm, laws), dsm.compressor, limit_rad_s)
    curves = _columns("p20", critical - _hunting_ln(rows, dsm.compressor)[:, None], widest)
    return (
        rows.with_columns(curves)
        .group_by(FLIGHT_PACK, maintain_order=True)
        .agg(
            pl.col(*SIGNALS, "flow_kg_s").median(),
            pl.col(CRITICAL_DIAMETER["p20"]).quantile(1.0 - HARDEST),
            pl.col(WIDEST["p20"]).quantile(HARDEST),
        )
    )


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)


def _with_flow(rows: pl.DataFrame, fit: CompressorFit) -> pl.DataFrame:
    """`flow_kg_s` by speed and diffuser: the flow's own sensor is two per cent off from pack to pack."""
    vda, inlet_pa, inlet_k, speed = (
        rows[c].to_numpy() for c in ("vda_counts", "inlet_pa", "inlet_k", "cc_speed_rad_s")
    )
    return rows.with_columns(flow_kg_s=pl.Series(inlet_flow_kg_s(fit.group_at_m3(vda), inlet_pa, inlet_k, speed)))


def _with_pressure(rows: pl.DataFrame, dsm: Dsm, laws: ControlSchedules) -> pl.DataFrame:
    """`no_flow_ln` and `flow_ln` of the exit pressure that the controller asks for, its sensor's bias taken out."""
    tail, altitude_m, flow = (rows[c].to_numpy() for c in ("tail", "altitude_m", "pack_flow_kg_s"))
    still = laws.delivery.column(tail, altitude_m)
    bias = rows.join(dsm.pack_table(), on=PACK, how="left", maintain_order="left", validate="m:1")[
        "exit_bias_ln"
    ].fill_null(0.0)
    return rows.with_columns(
        (still + laws.delivery.level_column(rows) - bias).alias("no_flow_ln"),
        (laws.delivery.column(tail, altitude_m, flow**2) - still).alias("flow_ln"),
    )


def _hunting_ln(rows: pl.DataFrame, fit: CompressorFit) -> Array:
    """Ln of each sample's diameter over its flight's: a machine hunts, and meets its limit for moments."""
    built_m = fit.diameter_m(rows["vda_counts"].to_numpy())
    own = rows.with_columns(own=(pl.col("diameter_m") / pl.Series(built_m)).log())
    return own.select((pl.col("own") - pl.col("own").median().over(FLIGHT_PACK)).fill_null(0.0))[:, 0].to_numpy()


def _columns(where: str, critical: Array, widest: Array) -> list[pl.Series]:
    named = zip((*CRITICAL_DIAMETER[where], WIDEST[where]), (*critical.T, widest), strict=True)
    return [pl.Series(name, values).fill_nan(None) for name, values in named]


def _at_the_middle(flights: pl.DataFrame, dsm: Dsm, laws: ControlSchedules, limit_rad_s: float) -> list[pl.Series]:
    """Curves at each flight's medians and hot and high; what a clean machine's margin is made of, taken in turn from
    the reference cruise to the flight: `CLEAN_PARTS`."""
    fit = dsm.compressor
    high = reference_air(flights.height, HIGH_CRUISE_M)
    high["tat_k"] = hot_day_tat_k(high["altitude_m"], high["mach"])
    demand, hot = _in_air(flights, reference_air(flights.height)), _in_air(flights, high)
    usual = dsm.cruise_flows_kg_s[0] / pl.col("pack_flow_kg_s")
    design = demand.with_columns(pl.col("flow_kg_s", "pack_flow_kg_s") * usual)
    at = [needed(_with_pressure(rows, dsm, laws), fit, limit_rad_s) for rows in (design, demand, flights, hot)]
    flows = [rows["flow_kg_s"].to_numpy() for rows in (design, demand, flights)]
    clean = np.zeros(flights.height)
    margins = [(share_left(clean, *a)[0] - 1.0) * flow for a, flow in zip(at[:3], flows, strict=True)]
    parts = zip(CLEAN_PARTS, (margins[0], *np.diff(margins, axis=0)), strict=True)
    told = [pl.Series(name, values).fill_nan(None) for name, values in parts]
    return [*_columns("middle", *at[2]), *_columns("hot_high", *at[3]), *told]


def _in_air(flights: pl.DataFrame, air: Mapping[str, Array]) -> pl.DataFrame:
    """The same flows in other air: the compressor's inlet follows it."""
    above_k, share = pl.col("inlet_k") - pl.col("tat_k"), pl.col("inlet_pa") / pl.col("total_pressure_pa")
    now = {name: pl.Series(values) for name, values in air.items()}
    return flights.with_columns(**now, inlet_k=now["tat_k"] + above_k, inlet_pa=now["total_pressure_pa"] * share)
