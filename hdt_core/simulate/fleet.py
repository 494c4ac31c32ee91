"""Simulate a fleet with known truth, one aircraft at a time: the files of its ground station, and the truth.

Any size, seeded: aircraft k of a fleet is the same whatever the others are, so a fleet can be made in parts.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl

from hdt_core.physics.terms import TERMS, record_signals
from hdt_core.robust import Array
from hdt_core.simulate.design import (
    CLIMB_S,
    DESCENT_S,
    Conditions,
    FleetSettings,
    Operator,
    PackDesign,
    conditions,
    draw_design,
    draw_operators,
    draw_schedule,
    snapshot_times,
)
from hdt_core.simulate.packs import loss_ratios
from hdt_core.simulate.recorder import SUITES, LogWriter, Plan, draw_biases, fleet_row, flight_ids, record
from hdt_core.simulate.signals import air_data, demand, pack_rows, pick, true_signals
from hdt_core.simulate.unit_histories import PackHistory, draw_history

PACKS = (1, 2)
PACK_SIGNALS = {"hx_in_k": "hot_in_k", "hx_out_k": "hot_out_k", "pack_flow_kg_s": "pack_flow_kg_s"}
_Weather = tuple[Conditions, dict[str, Array] | None]
"""Conditions of a flight and air data as recorded."""
UTC_US = pl.Datetime("us", "UTC")


@dataclass(frozen=True, slots=True)
class Aircraft:
    """One aircraft's files as frames in the recorder's units, and the truth.

    Attributes
    ----------
    operator, tail : str
        Operator and tail.
    fleet : DataFrame
        Its row of fleet.csv.
    snapshots : DataFrame
        All snapshots that arrived; columns the operator doesn't record are absent.
    cpl : dict of str to DataFrame
        1 Hz logs by flight id.
    messages, maintenance : DataFrame
        As in messages.csv and maintenance.csv.
    health, events : DataFrame
        Truth, one row a flight and pack, and one row a life or fault.
    """

    operator: str
    tail: str
    fleet: pl.DataFrame
    snapshots: pl.DataFrame
    cpl: dict[str, pl.DataFrame]
    messages: pl.DataFrame
    maintenance: pl.DataFrame
    health: pl.DataFrame
    events: pl.DataFrame


def simulate_fleet(seed: int, settings: FleetSettings | None = None) -> Iterator[Aircraft]:
    """Simulate the aircraft of a fleet, one after another.

    Parameters
    ----------
    seed : int
        Same seed and settings, same fleet.
    settings : FleetSettings, optional
        Size of the fleet.

    Yields
    ------
    Aircraft
        Recorded frames and truth.
    """
    size = settings or FleetSettings()
    rng = np.random.default_rng(seed)
    design = draw_design(rng)
    operators = draw_operators(rng, size)
    for number, draw in enumerate(operators):
        operator = draw if size.suite == "contract" else replace(draw, temperature_step_k=0.0, missing=())
        for place, tail in enumerate(operator.tails):
            yield _aircraft(np.random.default_rng([seed, number, place]), design, operator, tail, size)


def design_truth(seed: int) -> pl.DataFrame:
    """Return the design values of the fleet of that seed: operator (null: the type's own), tail, parameter, value."""
    design = draw_design(np.random.default_rng(seed))
    values = {
        "eq6_intercept_m": design.diameter_intercept_m,
        "eq6_slope_m_per_count": design.diameter_slope_m_per_count,
        "hx_ua_reference_w_k": design.hx_ua_reference_w_k,
        "hx_exponent_hot": design.hx_exponent_hot,
        "hx_exponent_cold": design.hx_exponent_cold,
    }
    return pl.DataFrame(
        {"operator": None, "tail": None, "parameter": list(values), "value": list(values.values())},
        schema={"operator": pl.String, "tail": pl.String, "parameter": pl.String, "value": pl.Float64},
    )


def by_month(snapshots: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """Split snapshots by the month of their flight's departure date, `YYYY-MM`, as in history_*.parquet."""
    month = pl.col("flight_id").str.extract(r"_(\d{8})_").str.slice(0, 6)
    parts = snapshots.with_columns(month.alias("month")).partition_by("month", as_dict=True, include_key=False)
    return {f"{key[0][:4]}-{key[0][4:]}": part for key, part in sorted(parts.items())}


def _aircraft(
    rng: np.random.Generator, design: PackDesign, operator: Operator, tail: str, size: FleetSettings
) -> Aircraft:
    plan = _plan(rng, design, operator, tail, size)
    now = conditions(rng, plan.schedule, *snapshot_times(rng, plan.schedule))
    probe = _air_as_recorded(now, size.missing)
    air = record(rng, air_data(probe), plan.biases[0], operator.temperature_step_k, plan.suite)
    has_arrived = rng.random(size.flights) > 0.01
    log_flights = np.nonzero(has_arrived & (rng.random(size.flights) < size.cpl_share))[0]
    rows = []
    truth = []
    book = LogWriter(plan)
    cpl: dict[str, list[pl.DataFrame]] = {}
    weather: dict[int, _Weather] = {}
    for pack in PACKS:
        load = demand(rng, design, now)
        history = draw_history(rng, operator, design, *pick(now, load, size.flights))
        true = true_signals(rng, design, now, load=load, history=history)
        signals = _pack_as_recorded(true, probe, size.missing)
        rows.append(pack_rows(rng, plan, now, true=signals, history=history, pack=pack, air=air))
        truth.append(health_truth(plan, now, true, history=history, pack=pack, has_arrived=has_arrived))
        book.write(rng, history, pack, truth[-1])
        for index in log_flights:
            cpl.setdefault(str(plan.ids[index]), []).append(
                _log_1hz(rng, plan, int(index), history, pack, size.missing, weather)
            )
    snapshots = pl.concat(rows).filter(pl.col("flight_id").is_in(plan.ids[has_arrived].tolist()))
    return Aircraft(
        operator=operator.name,
        tail=tail,
        fleet=fleet_row(rng, operator, tail),
        snapshots=snapshots.drop(operator.missing).sort("report_time", "pack"),
        cpl={key: pl.concat(parts).drop(operator.missing).sort("report_time", "pack") for key, parts in cpl.items()},
        messages=book.message_frame(),
        maintenance=book.maintenance_frame(),
        health=pl.concat(truth).sort("index", "pack"),
        events=book.event_frame(),
    )


def _plan(rng: np.random.Generator, design: PackDesign, operator: Operator, tail: str, size: FleetSettings) -> Plan:
    schedule = draw_schedule(rng, operator, size.flights)
    start = datetime.fromisoformat(size.first_day).replace(tzinfo=UTC)
    ids = flight_ids(tail, start, schedule.departed_s)
    biases = draw_biases(rng)
    has_ram_out = rng.random() < operator.ram_out_share
    return Plan(operator, design, tail, schedule, ids, start, biases, has_ram_out, SUITES[size.suite])


def _log_1hz(
    rng: np.random.Generator,
    plan: Plan,
    index: int,
    history: PackHistory,
    pack: int,
    missing: dict[str, float],
    weather: dict[int, _Weather],
) -> pl.DataFrame:
    """Simulate one flight at 1 Hz with the core's thermal lag.

    Both packs fly in the same air: the first pack's draw is kept in `weather`.
    """
    end_s = CLIMB_S + plan.schedule.cruise_s[index] + DESCENT_S
    after_s = np.arange(-plan.suite.taxi_s, end_s)
    # the log's weather is drawn again, as two recorders never agree exactly
    new_weather = conditions(rng, plan.schedule, np.full(after_s.size, index), after_s)
    now, first_air = weather.get(index, (new_weather, None))
    true = true_signals(rng, plan.design, now, load=demand(rng, plan.design, now), history=history, dt_s=1.0)
    probe = _air_as_recorded(now, missing)
    air = record(rng, air_data(probe), plan.biases[0], plan.operator.temperature_step_k, plan.suite)
    air = first_air or air | {"mach": np.maximum(air["mach"], plan.suite.least_mach)}
    weather[index] = now, air
    return pack_rows(
        rng, plan, now, true=_pack_as_recorded(true, probe, missing), history=history, pack=pack, air=air
    ).drop("phase_code")


def _air_as_recorded(now: Conditions, missing: Mapping[str, float]) -> Conditions:
    """Return outside conditions as the air data probes record them, without terms of the packs."""
    terms = {name: value for name, value in missing.items() if TERMS[name].signal == "tat_k"}
    return replace(now, tat_k=record_signals(_air(now), terms)["tat_k"])


def _pack_as_recorded(true: dict[str, Array], now: Conditions, missing: Mapping[str, float]) -> dict[str, Array]:
    """Return a pack's signals as recorded before the sensors' own errors; `now` as the probes record it."""
    terms = {name: value for name, value in missing.items() if TERMS[name].signal != "tat_k"}
    values = record_signals(_air(now) | {name: true[of] for name, of in PACK_SIGNALS.items()}, terms)
    return true | {of: values[name] for name, of in PACK_SIGNALS.items()}


def _air(now: Conditions) -> dict[str, Array]:
    return {n: getattr(now, n) for n in ("altitude_m", "mach", "tat_k", "total_pressure_pa")}


def health_truth(
    plan: Plan, now: Conditions, true: dict[str, Array], *, history: PackHistory, pack: int, has_arrived: Array
) -> pl.DataFrame:
    """Return the truth of one pack, one row a flight.

    `ua_ratio`, `apparent_ua_ratio`, `ram_flow_ratio` at the reference cruise; the rest are medians of the cruise.
    `nominal`: level cruise, loss below 8 %, nothing wrong. `contaminant`: loss above 15 % or something wrong.
    """
    flights = has_arrived.size
    ratio, apparent, ram = loss_ratios(plan.design, history.wear)
    loss = 1.0 - np.minimum(ratio, apparent)
    door_fault = ~np.isnan(history.door_stuck) | (history.door_reach < 1.0)
    wrong = history.icing | history.pack_off | door_fault | (history.sensor != "")
    departed_at = [plan.start + timedelta(seconds=float(s)) for s in plan.schedule.departed_s]
    return pl.DataFrame(
        {
            "operator": plan.operator.name,
            "tail": plan.tail,
            "flight_id": plan.ids,
            "pack": pack,
            "index": np.arange(flights),
            "departed_at": departed_at,
            "arrived": has_arrived,
            "arrives_on": [d.date() for d in departed_at],
            "ua_ratio": ratio,
            "apparent_ua_ratio": apparent,
            "ram_flow_ratio": ram,
            "blockage": history.blockage,
            "area_loss": history.area_loss,
            "film_k_w": history.film_k_w,
            "true_ua_w_k": _cruise_median(now, true["ua_w_k"], flights),
            "ram_flow_kg_s": _cruise_median(now, true["ram_flow_kg_s"], flights),
            "door_true_pct": 100.0 * _cruise_median(now, true["door"], flights),
            "unmet_k": _cruise_median(now, true["unmet_k"], flights),
            "cc_eff_diameter_m": _cruise_median(now, true["diameter_m"], flights),
            "cc_eff_loss": history.cc_loss,
            "icing": history.icing,
            "pack_off": history.pack_off,
            "door_fault": door_fault,
            "sensor_fault": history.sensor,
            "nominal": ~wrong & (loss < 0.08),
            "contaminant": wrong | (loss > 0.15),
            "hx_unit": history.hx_unit,
            "cc_unit": history.cc_unit,
        },
        schema_overrides={"departed_at": UTC_US, "pack": pl.Int64, "index": pl.Int64},
    )


def _cruise_median(now: Conditions, values: Array, flights: int) -> Array:
    rows = pl.DataFrame({"flight": now.flight[now.cruise], "v": values[now.cruise]})
    medians = rows.group_by("flight").agg(pl.col("v").median()).sort("flight")
    out = np.full(flights, np.nan)
    out[medians["flight"].to_numpy()] = medians["v"].to_numpy()
    return out
