"""Demand of each flight on a compressor, and the least effective diameter that meets it at the highest speed.

The machine is controlled to a flow and an exit pressure. At its highest speed equations (2)-(4) give the diffuser
position for a flow, equation (6) the diameter of a sound machine there, and equation (5) the diameter that the pressure
needs. A machine that has lost diameter must close its diffuser to hold the pressure, and so loses flow.
"""

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.compressor import CompressorFit, compressor_samples
from hdt_core.calibration.dsm import Dsm
from hdt_core.flight.control_schedules import ControlSchedules
from hdt_core.physics.air import HIGH_CRUISE_M, hot_day_tat_k, reference_air
from hdt_core.physics.compressor import area_diameter_tan_beta_m3, effective_diameter_m, inlet_flow_kg_s
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.tables.demand import CompressorDemand, FeaturesMargin

FLOWS = np.array([0.6, 0.8, 1.0, 1.2, 1.5])
"""Shares of the demanded flow at which critical diameters are stored; others are interpolated. [-]"""
SURE_SD, LEAST_SLOPE_M3_COUNT = 5.0, 1e-8
"""Standard deviations, and m3 a count, above which the slope of the diffuser's map counts: else there is no map."""
HARD_SHARE = 0.2
"""Share of the cruise with a higher demand than the margin is stated for. [-]"""
CONDITIONS = ("p20", "hot_high")
"""The hardest fifth of the cruise, and the median flow at 41,000 ft on a hot day."""
SIGNALS = (
    "cc_speed_rad_s", "vda_counts", "inlet_k", "inlet_pa", "altitude_m", "mach", "tat_k", "total_pressure_pa",
    "pack_flow_kg_s",
)  # fmt: skip
CRITICAL_DIAMETER = {w: tuple(f"critical_ln_diameter_{w}_{round(100 * f)}pct" for f in FLOWS) for w in CONDITIONS}
WIDEST = {w: f"cc_widest_share_{w}" for w in CONDITIONS}


def compressor_demand(samples: pl.DataFrame, dsm: Dsm, schedules: ControlSchedules) -> pl.DataFrame:
    """Compute each flight's demand on its compressors, whatever their wear, from that flight and the model alone.

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
        One row a flight and pack with such samples in cruise, none where the diffuser's map or the highest speed is not
        known: `cc_flow_asked_kg_s` (median, by speed and diffuser), `cc_speed_limit_met` (that speed is the limit),
        `critical_ln_diameter_<condition>_<flow>pct` (ln of the least diameter over equation (6)'s that delivers that
        share of the demanded flow) and `cc_widest_share_<condition>` (share delivered at the widest position on
        record). Missing is null.
    """
    fit = dsm.compressor
    limit_rad_s = schedules.speed.rad_s
    has_map = fit.group_slope_m3_per_count > max(SURE_SD * fit.group_slope_sd_m3_per_count, LEAST_SLOPE_M3_COUNT)
    cruise = cruise_samples(samples, monitored=False)
    if limit_rad_s is None or not has_map or not cruise.height:
        return FeaturesMargin.create_empty().select(*FLIGHT_PACK, *CompressorDemand.columns())
    flights = _hardest_curves(cruise, dsm, schedules, limit_rad_s)
    hot = required_diameter(_with_pressure(_hot_and_high(flights), dsm, schedules), fit, limit_rad_s)
    return flights.with_columns(
        *_columns("hot_high", *hot),
        cc_flow_asked_kg_s=pl.col("flow_kg_s"),
        cc_speed_limit_met=pl.lit(schedules.speed.at_limit),
    ).select(*FLIGHT_PACK, *CompressorDemand.columns())


def required_diameter(demand: pl.DataFrame, fit: CompressorFit, speed_rad_s: float) -> tuple[Array, Array]:
    """Return the least ln diameter over equation (6)'s at shares `FLOWS` of the flow, and the widest position's share.

    Parameters
    ----------
    demand : DataFrame
        `flow_kg_s, inlet_k, inlet_pa`; `no_flow_ln` and `flow_ln`: ln of the scheduled exit pressure [Pa] at no
        flow, and the part of the flow squared.

    Returns
    -------
    array, shape (n, flows); array, shape (n,)
        NaN where any diameter suffices, or a reading is impossible.
    """
    flow, inlet_k, inlet_pa, no_flow_ln, flow_ln = (
        demand[c].to_numpy()[:, None] for c in ("flow_kg_s", "inlet_k", "inlet_pa", "no_flow_ln", "flow_ln")
    )
    speed = np.asarray(speed_rad_s)
    with np.errstate(all="ignore"):  # missing readings give NaN
        least_m = effective_diameter_m(inlet_pa, np.exp(no_flow_ln + FLOWS**2 * flow_ln), inlet_k, speed)
        design_m = fit.diameter_m(
            fit.position_counts(area_diameter_tan_beta_m3(FLOWS * flow, inlet_pa, inlet_k, speed))
        )
        critical = np.log(least_m / np.where(design_m > 0.0, design_m, np.nan))
        widest = inlet_flow_kg_s(fit.group_at_m3(np.asarray(fit.vda_widest_counts)), inlet_pa, inlet_k, speed) / flow
    return _finite(critical), _finite(np.where(flow > 0.0, widest, np.nan))[:, 0]


def curves_of(flights: pl.DataFrame, condition: str) -> tuple[Array, Array]:
    """Return critical diameters (n, flows) and the widest share (n,) in one of `CONDITIONS`."""
    return flights.select(CRITICAL_DIAMETER[condition]).to_numpy(), flights[WIDEST[condition]].to_numpy()


def share_left(ln_diameter: Array, critical: Array, widest: Array) -> tuple[Array, Array]:
    """Return the share of the demanded flow that a diameter delivers, and its slope.

    At most that of the widest position on record, which is a bound without slope (NaN).
    """
    share, slope = read_across(critical, FLOWS, ln_diameter)
    return np.minimum(share, widest), np.where(share < widest, slope, np.nan)


def _hardest_curves(cruise: pl.DataFrame, dsm: Dsm, schedules: ControlSchedules, limit_rad_s: float) -> pl.DataFrame:
    """Return the curves in the hardest fifth of each flight's cruise, with medians of `SIGNALS` and flow."""
    cruise = compressor_samples(cruise, dsm.pack_table()).drop_nulls(SIGNALS).filter(pl.col("cc_speed_rad_s") > 0.0)
    rows = _with_flow(cruise, dsm.compressor)
    critical, widest = required_diameter(_with_pressure(rows, dsm, schedules), dsm.compressor, limit_rad_s)
    curves = _columns("p20", critical - _hunting_ln(rows, dsm.compressor)[:, None], widest)
    return (
        rows.with_columns(curves)
        .group_by(FLIGHT_PACK, maintain_order=True)
        .agg(
            pl.col(*SIGNALS, "flow_kg_s").median(),
            pl.col(CRITICAL_DIAMETER["p20"]).quantile(1.0 - HARD_SHARE),
            pl.col(WIDEST["p20"]).quantile(HARD_SHARE),
        )
    )


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)


def _with_flow(rows: pl.DataFrame, fit: CompressorFit) -> pl.DataFrame:
    """Add `flow_kg_s` by speed and diffuser, because flow sensors differ by two per cent between packs."""
    vda, inlet_pa, inlet_k, speed = (
        rows[c].to_numpy() for c in ("vda_counts", "inlet_pa", "inlet_k", "cc_speed_rad_s")
    )
    return rows.with_columns(flow_kg_s=pl.Series(inlet_flow_kg_s(fit.group_at_m3(vda), inlet_pa, inlet_k, speed)))


def _with_pressure(rows: pl.DataFrame, dsm: Dsm, schedules: ControlSchedules) -> pl.DataFrame:
    """Add `no_flow_ln` and `flow_ln` of the scheduled exit pressure, less its sensor's bias."""
    tail, altitude_m, flow = (rows[c].to_numpy() for c in ("tail", "altitude_m", "pack_flow_kg_s"))
    still = schedules.delivery.column(tail, altitude_m)
    bias = rows.join(dsm.pack_table(), on=PACK, how="left", maintain_order="left", validate="m:1")[
        "exit_bias_ln"
    ].fill_null(0.0)
    return rows.with_columns(
        (still + schedules.delivery.level_column(rows) - bias).alias("no_flow_ln"),
        (schedules.delivery.column(tail, altitude_m, flow**2) - still).alias("flow_ln"),
    )


def _hunting_ln(rows: pl.DataFrame, fit: CompressorFit) -> Array:
    """Return ln of each sample's diameter over its flight's: a hunting machine meets its limit for moments."""
    built_m = fit.diameter_m(rows["vda_counts"].to_numpy())
    ratios = rows.with_columns(ratio=(pl.col("diameter_m") / pl.Series(built_m)).log())
    return ratios.select((pl.col("ratio") - pl.col("ratio").median().over(FLIGHT_PACK)).fill_null(0.0))[:, 0].to_numpy()


def _columns(condition: str, critical: Array, widest: Array) -> list[pl.Series]:
    columns = zip((*CRITICAL_DIAMETER[condition], WIDEST[condition]), (*critical.T, widest), strict=True)
    return [pl.Series(name, values).fill_nan(None) for name, values in columns]


def _hot_and_high(flights: pl.DataFrame) -> pl.DataFrame:
    """Return the same flows at 41,000 ft on a hot day; the compressor's inlet follows the air."""
    air = reference_air(flights.height, HIGH_CRUISE_M)
    air["tat_k"] = hot_day_tat_k(air["altitude_m"], air["mach"])
    above_k = pl.col("inlet_k") - pl.col("tat_k")
    share = pl.col("inlet_pa") / pl.col("total_pressure_pa")
    now = {name: pl.Series(values) for name, values in air.items()}
    return flights.with_columns(**now, inlet_k=now["tat_k"] + above_k, inlet_pa=now["total_pressure_pa"] * share)


def read_across(grids: Array, values: Array, at: Array) -> tuple[Array, Array]:
    """Interpolate curves of the same values, each over its own rising grid, at a point each; with slopes.

    Parameters
    ----------
    grids : array, shape (n, points)
        Rising along each row.
    values : array, shape (points,)
    at : array, shape (n,)

    Returns
    -------
    array, array, shape (n,)
        NaN where the grid or the point is not known.
    """
    index = np.clip((grids < at[:, None]).sum(axis=1) - 1, 0, values.size - 2)
    rows = np.arange(len(at))
    low = grids[rows, index]
    high = grids[rows, index + 1]
    slope = (values[index + 1] - values[index]) / np.maximum(high - low, 1e-6)
    return values[index] + (at - low) * slope, slope
