"""The table of features and its parts.

A feature that follows from others of its flight, or of those before it, has its value in its declaration.
"""

import dataframely as dy
import polars as pl

from hdt_core.records.keys import FLIGHT, PACK
from hdt_core.tables.base import DatedLegTable, Table, column, flag, number, text


def feature(meaning: str, unit: str = "-", value: pl.Expr | None = None) -> dy.Float64:
    """A number without limits, for an odd ratio must not stop a night; the catalog checks it."""
    return number(meaning, unit, value=value, allow_inf=True, allow_nan=True)


def tally(meaning: str) -> dy.Int32:
    """A number of samples."""
    return column(dy.Int32, meaning, "-", nullable=True)


def latest_step(now: pl.Expr) -> pl.Expr:
    """Return the median of the last three flights less that of the twelve before."""
    return now.rolling_median(3, min_samples=2) - now.rolling_median(12, min_samples=4).shift(3)


def less_other_pack(name: str) -> pl.Expr:
    """Return the difference to the other pack of the same flight."""
    left, right = (pl.col(name).filter(pl.col("pack") == pack).first().over(FLIGHT) for pack in (1, 2))
    return pl.col(name) - pl.when(pl.col("pack") == 1).then(right).when(pl.col("pack") == 2).then(left)


class _Health(Table):
    """Health of the pack's parts after a flight."""

    flight_index = column(dy.Int64, "flights of the tail before this one, in order of departure", "-", nullable=True)
    hx_fouling = feature("conductance lost by the heat exchanger, after this flight")
    hx_fouling_sd = feature("standard deviation of it")
    hx_fouling_status = text("how that estimate ended")
    cc_efficiency_loss = feature("efficiency lost by the compressor, after this flight")
    cc_efficiency_loss_sd = feature("standard deviation of it")
    cc_efficiency_loss_status = text("how that estimate ended")
    cc_diameter_loss = feature("effective diameter lost, against equation (6), after this flight")
    cc_diameter_loss_sd = feature("standard deviation of it")
    cc_diameter_loss_status = text("how that estimate ended")
    cc_effective_diameter_m = feature("effective diameter of the compressor, equation (5), after this flight", "m")
    cc_effective_diameter_m_sd = feature("standard deviation of it", "m")
    cc_effective_diameter_m_status = text("how that estimate ended")


class _ResidualMeans(Table):
    """Residuals of a flight: `<signal without its unit>_<kind>_<unit>`."""

    cc_effective_diameter_dsm_minus_twin_m = feature(
        "effective diameter, equations (5) and (6): model less twin, mean", "m"
    )
    cc_effective_diameter_sensor_minus_dsm_m = feature(
        "effective diameter, equations (5) and (6): sensor less model, mean", "m"
    )
    cc_effective_diameter_sensor_minus_twin_m = feature(
        "effective diameter, equations (5) and (6): sensor less twin, mean", "m"
    )
    cc_flow_dsm_minus_twin_kg_s = feature("compressor flow, equations (2)-(4): model less twin, mean", "kg/s")
    cc_flow_sensor_minus_dsm_kg_s = feature("compressor flow, equations (2)-(4): sensor less model, mean", "kg/s")
    cc_flow_sensor_minus_twin_kg_s = feature("compressor flow, equations (2)-(4): sensor less twin, mean", "kg/s")
    cc_out_dsm_minus_twin_k = feature("compressor exit temperature: model less twin, mean", "K")
    cc_out_sensor_minus_dsm_k = feature("compressor exit temperature: sensor less model, mean", "K")
    cc_out_sensor_minus_twin_k = feature("compressor exit temperature: sensor less twin, mean", "K")
    cc_out_dsm_minus_twin_pa = feature("compressor exit pressure, equation (5): model less twin, mean", "Pa")
    cc_out_sensor_minus_dsm_pa = feature("compressor exit pressure, equation (5): sensor less model, mean", "Pa")
    cc_out_sensor_minus_twin_pa = feature("compressor exit pressure, equation (5): sensor less twin, mean", "Pa")
    hx_out_dsm_minus_twin_k = feature("exchanger outlet, bleed side: model less twin, mean", "K")
    hx_out_sensor_minus_dsm_k = feature("exchanger outlet, bleed side: sensor less model, mean", "K")
    hx_out_sensor_minus_twin_k = feature("exchanger outlet, bleed side: sensor less twin, mean", "K")
    ram_out_dsm_minus_twin_k = feature("exchanger outlet, ram side: model less twin, mean", "K")
    ram_out_sensor_minus_dsm_k = feature("exchanger outlet, ram side: sensor less model, mean", "K")
    ram_out_sensor_minus_twin_k = feature("exchanger outlet, ram side: sensor less twin, mean", "K")


class _VirtualSensors(Table):
    """Quantities without a sensor, from the twin's estimates of a flight."""

    ram_flow_kg_s = feature("ram flow by the clean duct's map", "kg/s")
    ram_flow_kg_s_sd = feature("standard deviation of it", "kg/s")
    ram_outlet_k = feature("ram outlet temperature by heat balance", "K")
    ram_outlet_k_sd = feature("standard deviation of it", "K")
    effectiveness = feature("hot-side effectiveness")
    effectiveness_sd = feature("standard deviation of it")
    ua_w_k = feature("conductance", "W/K")
    ua_w_k_sd = feature("standard deviation of it", "W/K")
    ram_flow_loss = feature(
        "share of the clean duct's ram flow that the heat balance misses; null without a ram outlet probe"
    )
    ram_flow_loss_sd = feature("standard deviation of it")
    hx_fouling_flight = feature("conductance lost by this flight alone, its unit's offset still in it")
    hx_fouling_flight_sd = feature("standard deviation of it")
    cc_diameter_deficit = feature("share of the diameter expected by equation (6) that is missing in this flight alone")
    cc_diameter_deficit_sd = feature("standard deviation of it")
    w_hx_in_over_discharge_k = feature("exchanger inlet above the value by compressor discharge and ram outlet", "K")
    w_hx_in_over_pressure_k = feature(
        "the same where the discharge temperature is not recorded, from the pressure ratio", "K"
    )
    w_conductance_off_cruise_ln = feature("ln of the conductance ratio of climb and descent over that of the cruise")


class _CrossChecks(Table):
    """Cross checks of a pack in a flight."""

    running = flag("the pack was on", nullable=True)
    n_snapshots = tally("samples of the flight")
    altitude_m_lost_share = feature("share of the flight without a value of altitude_m")
    mach_lost_share = feature("share of the flight without a value of mach")
    tat_k_lost_share = feature("share of the flight without a value of tat_k")
    total_pressure_pa_lost_share = feature("share of the flight without a value of total_pressure_pa")
    hx_in_k_lost_share = feature("share of the flight without a value of hx_in_k")
    hx_out_k_lost_share = feature("share of the flight without a value of hx_out_k")
    ram_door_open_lost_share = feature("share of the flight without a value of ram_door_open")
    pack_flow_kg_s_lost_share = feature("share of the flight without a value of pack_flow_kg_s")
    ram_out_k_lost_share = feature("share of the flight without a value of ram_out_k")
    cc_speed_rad_s_lost_share = feature("share of the flight without a value of cc_speed_rad_s")
    cc_in_k_lost_share = feature("share of the flight without a value of cc_in_k")
    cc_in_pa_lost_share = feature("share of the flight without a value of cc_in_pa")
    cc_out_k_lost_share = feature("share of the flight without a value of cc_out_k")
    cc_out_pa_lost_share = feature("share of the flight without a value of cc_out_pa")
    cc_flow_kg_s_lost_share = feature("share of the flight without a value of cc_flow_kg_s")
    vda_counts_lost_share = feature("share of the flight without a value of vda_counts")
    altitude_m_still = flag("altitude_m had one value all flight", nullable=True)
    mach_still = flag("mach had one value all flight", nullable=True)
    tat_k_still = flag("tat_k had one value all flight", nullable=True)
    total_pressure_pa_still = flag("total_pressure_pa had one value all flight", nullable=True)
    hx_in_k_still = flag("hx_in_k had one value all flight", nullable=True)
    hx_out_k_still = flag("hx_out_k had one value all flight", nullable=True)
    ram_door_open_still = flag("ram_door_open had one value all flight", nullable=True)
    pack_flow_kg_s_still = flag("pack_flow_kg_s had one value all flight", nullable=True)
    ram_out_k_still = flag("ram_out_k had one value all flight", nullable=True)
    cc_speed_rad_s_still = flag("cc_speed_rad_s had one value all flight", nullable=True)
    cc_in_k_still = flag("cc_in_k had one value all flight", nullable=True)
    cc_in_pa_still = flag("cc_in_pa had one value all flight", nullable=True)
    cc_out_k_still = flag("cc_out_k had one value all flight", nullable=True)
    cc_out_pa_still = flag("cc_out_pa had one value all flight", nullable=True)
    cc_flow_kg_s_still = flag("cc_flow_kg_s had one value all flight", nullable=True)
    vda_counts_still = flag("vda_counts had one value all flight", nullable=True)
    door_span = feature("5 to 95 % span of the ram door's position in the flight")
    door_max = feature("widest ram door position")
    door_n = tally("readings of the ram door")
    door_travel = feature("sum of the ram door's moves")
    flight_hours = feature("from the first to the last sample", "h")
    w_inlet_minus_tat_k = feature("compressor inlet less total air temperature, median in cruise", "K")
    w_inlet_over_total_pressure_ln = feature("ln of compressor inlet over total pressure, median in cruise")
    w_total_over_pitot_pressure_ln = feature(
        "ln of total pressure over that of altitude and Mach number, median in cruise"
    )
    w_pack_over_compressor_flow_ln = feature("ln of pack over compressor flow, median in cruise")
    w_tat_between_packs_k = feature("total air temperature less the other pack's, median in cruise", "K")
    w_total_pressure_between_packs_ln = feature("ln of total pressure over the other pack's, median in cruise")
    w_pack_flow_between_packs_ln = feature("ln of pack flow over the other pack's, median in cruise")
    w_compressor_flow_between_packs_ln = feature("ln of compressor flow over the other pack's, median in cruise")
    w_cc_out_pressure_between_packs_ln = feature(
        "ln of compressor exit pressure over the other pack's, median in cruise"
    )
    w_cc_out_pressure_over_schedule_ln = feature(
        "ln of compressor exit pressure over its controller's schedule, median in cruise"
    )
    w_hx_in_between_packs_k = feature("exchanger inlet less the other pack's, median in cruise", "K")
    w_cc_out_between_packs_k = feature("compressor exit temperature less the other pack's, median in cruise", "K")
    w_inlet_minus_tat_k_n = tally("samples behind it")
    w_inlet_over_total_pressure_ln_n = tally("samples behind it")
    w_total_over_pitot_pressure_ln_n = tally("samples behind it")
    w_pack_over_compressor_flow_ln_n = tally("samples behind it")
    w_tat_between_packs_k_n = tally("samples behind it")
    w_total_pressure_between_packs_ln_n = tally("samples behind it")
    w_pack_flow_between_packs_ln_n = tally("samples behind it")
    w_compressor_flow_between_packs_ln_n = tally("samples behind it")
    w_cc_out_pressure_between_packs_ln_n = tally("samples behind it")
    w_cc_out_pressure_over_schedule_ln_n = tally("samples behind it")
    w_hx_in_between_packs_k_n = tally("samples behind it")
    w_cc_out_between_packs_k_n = tally("samples behind it")
    tat_cruise_k = feature("total air temperature, median in cruise", "K")
    altitude_cruise_m = feature("pressure altitude, median in cruise", "m")
    mach_cruise = feature("Mach number, median in cruise")
    hx_in_cruise_k = feature("exchanger inlet, median in cruise", "K")
    hx_out_cruise_k = feature("exchanger outlet, median in cruise", "K")
    pack_flow_cruise_kg_s = feature("pack flow, median in cruise", "kg/s")
    cc_speed_cruise_rad_s = feature("compressor speed, median in cruise", "rad/s")
    door_median = feature("ram door position, 0 shut, 1 full open, median in cruise")
    door_full_open_share = feature("share of cruise with the ram door full open")
    w_hx_out_minus_target_k = feature(
        "exchanger outlet less its controller's target, median while the door can move", "K"
    )
    w_hx_out_between_packs_k = feature("exchanger outlet less the other pack's, median while the door can move", "K")
    w_hx_out_minus_target_k_n = tally("samples behind it")
    w_hx_out_between_packs_k_n = tally("samples behind it")
    door_peg_excess_k = feature("outlet above target where the door is widest, less the same elsewhere", "K")
    door_peg_n = tally("samples where the door is widest")
    door_off_peg_n = tally("samples elsewhere")
    hx_out_target_sd_k = feature("scatter of the outlet about its target", "K")


class ExchangerMargin(Table):
    """Margin of the exchanger before its message, after a flight."""

    hx_ln_ua_ratio = feature("ln of the conductance that is left over the model's, unit's offset included, as tracked")
    hx_margin_k = feature(
        "margin: level held less outlet with the ram door full open, hottest fifth of the high samples", "K"
    )
    hx_margin_sd_k = feature("standard deviation of it", "K")
    hx_margin_hot_day_k = feature(
        "the same on the standard's hot day (ISA + 15 K) at the flight's own level, speed and flow", "K"
    )
    hx_margin_hot_day_sd_k = feature("standard deviation of it", "K")
    hx_margin_design_k = feature("margin of a clean pack at the reference cruise", "K")
    hx_margin_target_k = feature("of the margin: what the flight's own target adds", "K")
    hx_margin_flow_k = feature("of the margin: what its flow and inlet temperature add", "K")
    hx_margin_ambient_k = feature("of the margin: what the air outside adds", "K")
    hx_margin_wear_k = feature("of the margin: what wear, blockage and the unit's own build add", "K")
    hx_margin_blockage_k = feature("of that: what a blocked ram side adds; null without a ram outlet probe", "K")
    hx_margin_profile_k = feature("of the margin: what the hottest fifth of the flight adds to its middle", "K")
    overheat_p20_k = feature(
        "outlet above its level with the ram door full open, hottest fifth of the high samples", "K"
    )
    full_open_share = feature("share of the high samples with the ram door full open")
    hx_passage_100 = feature(
        "chance of the exchanger's message within 100 flights, by physics alone: no fleet's messages are in it"
    )
    hx_passage_300 = feature(
        "chance of the exchanger's message within 300 flights, by physics alone: no fleet's messages are in it"
    )
    hx_margin_status = text("ok, level_of_pack (the flight does not show its own) or not_known")


class CompressorMargin(Table):
    """Margin of the compressor before its flow falls short, after a flight."""

    cc_ln_diameter_ratio = feature(
        "ln of the effective diameter that is left over equation (6)'s, unit's offset included, as tracked"
    )
    cc_diameter_left = feature(
        "share of it that may still go before flow or pressure falls short, hardest fifth of cruise"
    )
    cc_diameter_left_sd = feature("standard deviation of it")
    cc_diameter_left_hot_high = feature("the same with that flow asked at 41,000 ft on a hot day (ISA + 15 K)")
    cc_flow_asked_kg_s = feature(
        "flow that the flight asked of the compressor, by speed and diffuser, median in cruise", "kg/s"
    )
    cc_flow_margin_kg_s = feature(
        "margin: flow it can deliver at its highest speed less the flow asked, hardest fifth of the cruise", "kg/s"
    )
    cc_flow_margin_sd_kg_s = feature(
        "standard deviation of it; null where it is as much as the diffuser's map reaches to", "kg/s"
    )
    cc_flow_margin_hot_high_kg_s = feature(
        "the same with that flow asked at 41,000 ft on a hot day (ISA + 15 K)", "kg/s"
    )
    cc_flow_margin_hot_high_sd_kg_s = feature("standard deviation of it; null in the same way", "kg/s")
    cc_flow_margin_status = text(
        "ok, at_least (as far as the diffuser's map or the speeds on record reach) or not_known"
    )
    cc_flow_margin_hot_high_status = text(
        "ok, at_least (as far as the diffuser's map or the speeds on record reach) or not_known"
    )


class _Course(Table):
    """The unit's life so far, recent changes, the other pack and usage."""

    flights_since_replacement = column(
        dy.Int64, "flights of this exchanger; null before the first logged", "-", nullable=True
    )
    flights_seen_of_unit = column(dy.Int64, "flights of this exchanger on record", "-", nullable=True)
    flights_since_drop = column(
        dy.Int64, "flights since its fouling last fell as after work, or of this exchanger", "-", nullable=True
    )
    hx_fouling_slope_10_per_flight = feature("slope of hx_fouling over the unit's last 10 flights", "1/flight")
    hx_fouling_slope_30_per_flight = feature("slope of hx_fouling over the unit's last 30 flights", "1/flight")
    hx_fouling_slope_100_per_flight = feature("slope of hx_fouling over the unit's last 100 flights", "1/flight")
    cc_efficiency_loss_slope_10_per_flight = feature(
        "slope of cc_efficiency_loss over the unit's last 10 flights", "1/flight"
    )
    cc_efficiency_loss_slope_30_per_flight = feature(
        "slope of cc_efficiency_loss over the unit's last 30 flights", "1/flight"
    )
    cc_efficiency_loss_slope_100_per_flight = feature(
        "slope of cc_efficiency_loss over the unit's last 100 flights", "1/flight"
    )
    cc_diameter_loss_slope_10_per_flight = feature(
        "slope of cc_diameter_loss over the unit's last 10 flights", "1/flight"
    )
    cc_diameter_loss_slope_30_per_flight = feature(
        "slope of cc_diameter_loss over the unit's last 30 flights", "1/flight"
    )
    cc_diameter_loss_slope_100_per_flight = feature(
        "slope of cc_diameter_loss over the unit's last 100 flights", "1/flight"
    )
    cc_effective_diameter_m_slope_10_per_flight = feature(
        "slope of cc_effective_diameter_m over the unit's last 10 flights", "m/flight"
    )
    cc_effective_diameter_m_slope_30_per_flight = feature(
        "slope of cc_effective_diameter_m over the unit's last 30 flights", "m/flight"
    )
    cc_effective_diameter_m_slope_100_per_flight = feature(
        "slope of cc_effective_diameter_m over the unit's last 100 flights", "m/flight"
    )
    hx_fouling_jump_10 = feature("hx_fouling less its value ten flights ago")
    hx_fouling_step_3 = feature(
        "hx_fouling_flight: median of three flights less that of the twelve before, wear in between taken out; without "
        "flights whose sensor was corrected"
    )
    ram_flow_loss_step_3 = feature(
        "ram_flow_loss: median of three flights less that of the twelve before",
        value=latest_step(pl.col("ram_flow_loss")).over(*PACK, "hx_life"),
    )
    hx_fouling_between_packs = feature("hx_fouling less the other pack's", value=less_other_pack("hx_fouling"))
    cc_efficiency_loss_between_packs = feature(
        "cc_efficiency_loss less the other pack's", value=less_other_pack("cc_efficiency_loss")
    )
    cc_effective_diameter_m_between_packs = feature(
        "cc_effective_diameter_m less the other pack's", "m", value=less_other_pack("cc_effective_diameter_m")
    )
    door_median_between_packs = feature("door_median less the other pack's", value=less_other_pack("door_median"))
    hx_out_excess_k = feature(
        "hx_out_sensor_minus_dsm_k, as the alerts name it", "K", value=pl.col("hx_out_sensor_minus_dsm_k")
    )
    ram_door_open_cruise = feature("door_median, as the prognosis names it", value=pl.col("door_median"))
    ram_door_margin = feature("what the ram door has left at its widest, 1 - door_max", value=1.0 - pl.col("door_max"))
    usage_hours = feature("flight_hours so far", "h", value=pl.col("flight_hours").cum_sum().over(PACK))


class FeaturesCrossChecks(DatedLegTable, _CrossChecks):
    """Cross checks of a pack in a flight, by its own sensors, door and controllers: flight, pack."""


class Features(
    DatedLegTable,
    _Health,
    _ResidualMeans,
    _VirtualSensors,
    _CrossChecks,
    ExchangerMargin,
    CompressorMargin,
    _Course,
):
    """Features of a pack after a flight, one column a feature: flight, pack."""


HEALTH = tuple(name.removesuffix("_status") for name in _Health.columns() if name.endswith("_status"))
"""Health parameters of the pack's parts."""
