"""Compute the rows that a recorder keeps of one pack, from conditions and wear."""

from dataclasses import replace

import numpy as np
import polars as pl
from scipy.signal import lfilter

from hdt_core.physics.heat_exchanger import specific_heat_j_kg_k
from hdt_core.robust import Array
from hdt_core.simulate.design import Conditions, PackDesign
from hdt_core.simulate.packs import (
    Demand,
    behind_worn_compressor,
    compressor_pressures_pa,
    compressor_rows,
    controlled_door,
    outlets,
    reference,
    sized_target_k,
    target_k,
)
from hdt_core.simulate.recorder import (
    FOOT,
    LB_PER_MIN,
    PSI,
    RPM,
    SENSORS,
    Plan,
    frame,
    record,
    with_sensor_fault,
)
from hdt_core.simulate.unit_histories import PackHistory

ZERO_C = 273.15
WANDER_S = 60.0
"""Seconds in which diffusers move by their own scatter; within a second they hardly do, in one recording of a 787."""
GUST_SD = 0.03
"""Of the ram flow while an aircraft taxies: with it the effectiveness scatters as one recording of a 787 has it."""
ACMS_COLUMNS = ("flight_id", "report_time", "phase_code", "pack", *SENSORS)
_PHASES = ("TO", "CL", "CR", "DS", "AP", "GR", "")


def air_data(now: Conditions) -> dict[str, Array]:
    """Air data in recorded units, the same for both packs."""
    return {
        "altitude_ft": now.altitude_m / FOOT,
        "mach": now.mach,
        "tat_degc": now.tat_k - ZERO_C,
        "pt_psia": now.total_pressure_pa / PSI,
    }


def demand(rng: np.random.Generator, design: PackDesign, now: Conditions) -> Demand:
    """Flow and target of one pack: load differs by flight, the pack warms the air more where it is thin."""
    per_flight = rng.standard_normal((2, int(now.flight.max()) + 1))[:, now.flight]
    height = np.clip(now.altitude_m / 11000.0, 0.0, 1.1)
    descending = np.isin(now.phase, ("DS", "AP"))
    flow = design.flow_cruise_kg_s * (1.0 + 0.06 * (1.0 - height) - 0.1 * descending + 0.035 * per_flight[0])
    flow = flow * (1.0 + 0.008 * np.sin(now.time_s / 500.0 + 6.28 * per_flight[0]))
    offset = target_k(reference(np.ones(1)), np.zeros(1))[0]
    wish_k = sized_target_k(design) - offset + 0.7 * per_flight[1]
    return Demand(flow, hot_inlet_k(design, now), target_k(now, wish_k))


def hot_inlet_k(design: PackDesign, now: Conditions) -> Array:
    """Compute air temperature at the exchanger: behind a sound compressor, warmed more where the air is dense. [K]"""
    nominal = _compressor(design, now, np.full(now.mach.size, design.diameter_intercept_m - 0.011), 0.0 * now.mach)
    height = np.clip(now.altitude_m / 11000.0, 0.0, 1.1)
    return np.asarray(nominal["cc_out_k"] + design.hot_rise_k + 22.0 * (1.0 - height))


def pick(now: Conditions, load: Demand, flights: int) -> tuple[Conditions, Demand]:
    """Select conditions and demand in the middle of each flight's cruise."""
    rows = np.nonzero(now.cruise)[0]
    at = rows[np.searchsorted(now.flight[rows], np.arange(flights) + 0.5, side="left") // 1 - 1]
    first = rows[np.searchsorted(now.flight[rows], np.arange(flights), side="left")]
    middle = (at + first) // 2
    return now.at(middle), load.at(middle)


def true_signals(
    rng: np.random.Generator,
    design: PackDesign,
    now: Conditions,
    *,
    load: Demand,
    history: PackHistory,
    dt_s: float = 0.0,
) -> dict[str, Array]:
    """Compute true values at each row, SI; with `dt_s` the rows are a time series with the core's thermal lag."""
    load = behind_worn_compressor(design, now, load, history.cc_loss[now.flight])
    wear = history.wear.at(now.flight)
    ice = history.icing[now.flight] & (now.altitude_m > 1200.0) & (now.altitude_m < 6500.0)
    wear = replace(wear, blockage=np.where(ice, 1.0 - 0.75 * (1.0 - wear.blockage), wear.blockage))
    jam_position = history.door_stuck[now.flight]
    reach = history.door_reach[now.flight]
    wobble = 0.004 * (rng.standard_normal(now.mach.size) if dt_s == 0.0 else np.sin(now.time_s / 37.0))
    command = np.clip(controlled_door(design, now, load, wear) + wobble, design.door_least, 1.0)
    door = np.where(np.isnan(jam_position), np.minimum(command, reach), jam_position)
    hot_k, ram_k, flow, ua = outlets(design, _gusty(rng, now, dt_s), load, door, wear)
    if dt_s > 0.0:
        settling_s = design.hx_core_heat_j_k / (0.9 * specific_heat_j_kg_k(load.hot_in_k) * (load.flow_kg_s + flow))
        hot_k = _lag(hot_k, settling_s, dt_s)
        ram_k = _lag(ram_k, settling_s, dt_s)
    is_off = history.pack_off[now.flight]
    diameter, vda = _diameter(rng, design, now, history, dt_s)
    air = _compressor(design, now, diameter, history.cc_loss[now.flight])
    resting = {"pack_flow_kg_s": 0.0, "cc_flow_kg_s": 0.0, "cc_speed_rad_s": 0.0}
    values = air | {
        "door": door, "hot_in_k": load.hot_in_k,
        "hot_out_k": hot_k, "ram_out_k": ram_k, "ram_flow_kg_s": flow, "ua_w_k": ua, "vda": vda,
        "pack_flow_kg_s": load.flow_kg_s, "cc_flow_kg_s": 1.06 * load.flow_kg_s, "diameter_m": diameter,
        "unmet_k": np.maximum(hot_k - load.target_k, 0.0),
    }  # fmt: skip
    warm = dict.fromkeys(("hot_in_k", "hot_out_k", "ram_out_k", "cc_out_k"), now.tat_k) | {"cc_out_pa": air["cc_in_pa"]}
    return {k: np.asarray(np.where(is_off, (resting | warm).get(k, v), v)) for k, v in values.items()}


def pack_rows(
    rng: np.random.Generator,
    plan: Plan,
    now: Conditions,
    *,
    true: dict[str, Array],
    history: PackHistory,
    pack: int,
    air: dict[str, Array],
) -> pl.DataFrame:
    """Record the rows of one pack in the contract's columns."""
    readings = record(rng, _recorded_units(true), plan.biases[pack - 1], plan.operator.temperature_step_k, plan.suite)
    if not plan.has_ram_out:
        readings["ram_out_degc"] = np.full(now.mach.size, np.nan)
    for name in np.unique(history.sensor[history.sensor != ""]):
        for kind in np.unique(history.fault[history.sensor == name]):
            faulty = ((history.sensor == name) & (history.fault == kind))[now.flight]
            if faulty.any():
                typical = SENSORS[name].noise_sd * (np.nanmedian(readings[name]) if SENSORS[name].relative else 1.0)
                size = rng.choice([-1.0, 1.0]) * rng.uniform(6.0, 15.0) * float(typical)
                readings[name] = with_sensor_fault(
                    rng, readings[name], flight=now.flight, faulty=faulty, kind=str(kind), size=size
                )
    wrong = rng.random(now.mach.size) < plan.operator.wrong_phase_share
    phase = np.where(wrong, rng.choice(_PHASES, now.mach.size), now.phase)
    moments = (now.time_s * 1e6).astype("timedelta64[us]") + np.datetime64(plan.start.replace(tzinfo=None), "us")
    keys = pl.DataFrame({"flight_id": plan.ids[now.flight], "report_time": moments, "phase_code": phase})
    keys = keys.with_columns(pl.col("report_time").dt.replace_time_zone("UTC"), pl.lit(pack, pl.Int32).alias("pack"))
    return pl.concat([keys, frame(air | readings)], how="horizontal").select(ACMS_COLUMNS)


def _recorded_units(true: dict[str, Array]) -> dict[str, Array]:
    return {
        "hx_in_degc": true["hot_in_k"] - ZERO_C,
        "hx_out_degc": true["hot_out_k"] - ZERO_C,
        "ram_door_pct": 100.0 * true["door"],
        "pack_flow_lbpm": true["pack_flow_kg_s"] / LB_PER_MIN,
        "ram_out_degc": true["ram_out_k"] - ZERO_C,
        "cc_speed_rpm": true["cc_speed_rad_s"] / RPM,
        "cc_in_degc": true["cc_in_k"] - ZERO_C,
        "cc_in_psia": true["cc_in_pa"] / PSI,
        "cc_out_degc": true["cc_out_k"] - ZERO_C,
        "cc_out_psia": true["cc_out_pa"] / PSI,
        "cc_flow_lbpm": true["cc_flow_kg_s"] / LB_PER_MIN,
        "vda_pos": true["vda"],
    }


def _diameter(
    rng: np.random.Generator, design: PackDesign, now: Conditions, history: PackHistory, dt_s: float
) -> tuple[Array, Array]:
    """Draw effective diameter, by equation (6) with scatter and the unit's wear, and the diffuser's position.

    Snapshots are independent; seconds are correlated.
    """
    low = np.clip(1.0 - now.altitude_m / 11000.0, 0.0, 1.0)
    n = now.mach.size
    vda = np.clip(340.0 + 320.0 * low**2 + 75.0 * _wandering(rng.standard_normal(n), dt_s), 20.0, 950.0)
    diameter = design.diameter_intercept_m + design.diameter_slope_m_per_count * vda + history.cc_scatter[now.flight]
    diameter = diameter + design.diameter_scatter_m * _wandering(rng.standard_normal(n), dt_s)
    # head is proportional to efficiency, and the effective diameter to its square root (equation 5)
    return diameter * np.sqrt(1.0 - history.cc_loss[now.flight]), vda


def _compressor(design: PackDesign, now: Conditions, diameter: Array, loss: Array) -> dict[str, Array]:
    """Compute compressor signals between the recovered outside air and the cabin's supply."""
    inlet_pa, exit_pa = compressor_pressures_pa(now)
    efficiency = design.cc_efficiency * (1.0 - loss)
    speed, exit_k = compressor_rows(
        diameter_m=diameter, inlet_k=now.tat_k, inlet_pa=inlet_pa, exit_pa=exit_pa, efficiency=efficiency
    )
    return {
        "cc_in_k": now.tat_k, "cc_in_pa": inlet_pa, "cc_out_pa": exit_pa, "cc_out_k": exit_k, "cc_speed_rad_s": speed
    }  # fmt: skip


def _gusty(rng: np.random.Generator, now: Conditions, dt_s: float) -> Conditions:
    """Add gusts of wind and turns on the ground to the ram flow; the door does not follow."""
    taxies = now.ram_mach > now.mach
    if not taxies.any():
        return now
    gusts = 1.0 + GUST_SD * taxies * _wandering(rng.standard_normal(now.mach.size), dt_s)
    return replace(now, ram_mach=now.ram_mach * gusts)


def _wandering(white: Array, dt_s: float) -> Array:
    """Filter white noise to unit variance with a memory of `WANDER_S`; unchanged where the rows are no time series."""
    if dt_s == 0.0:
        return white
    pole = np.exp(-dt_s / WANDER_S)
    gain = np.sqrt((1.0 - pole**2) ** 3 / (1.0 + pole**2))
    return np.asarray(lfilter([gain], [1.0, -2.0 * pole, pole**2], white))


def _lag(steady: Array, settling_s: Array, dt_s: float) -> Array:
    """Apply a first-order lag, exact for a piecewise constant input."""
    out = np.empty_like(steady)
    state = float(steady[0])
    decay = np.exp(-dt_s / settling_s)
    for k in range(steady.size):
        state = float(steady[k] + (state - steady[k]) * decay[k])
        out[k] = state
    return out
