"""Cases: raised once, for the right reason, by what was known then."""

from datetime import date
from typing import Any

import numpy as np
import polars as pl
import pytest

from hdt_core.alerts.alerts import raise_alerts
from hdt_core.alerts.cases import Case, Limits
from hdt_core.alerts.disturbances import may_feign_wear
from hdt_core.health.features import features
from hdt_core.health.sensor_checks import cross_checks
from hdt_core.tables.features import FeaturesAlerts
from hdt_core.tables.twin import Residuals

FLIGHTS = 90


def track(samples: pl.DataFrame, loss: dict[int, np.ndarray], sd: float = 0.01) -> pl.DataFrame:
    """`hx_fouling` of each pack (0 where not given) as the twin would state it."""
    key = ["operator", "tail", "flight_id", "pack"]
    flights = samples.group_by(key).agg(pl.col("time_utc").min().alias("departed_at")).sort("pack", "departed_at")
    n = flights.height // 2
    value = np.concatenate([loss.get(p, np.zeros(n)) for p in (1, 2)])
    constants = {"component": "HX", "parameter": "hx_fouling", "unit": "-", "status": "ok", "estimator": "kalman"}
    own = (pl.lit(v).alias(k) for k, v in constants.items())
    return flights.with_columns(pl.Series("value", value), pl.lit(sd).alias("sd"), *own)


def alerts_of(samples: pl.DataFrame, health: pl.DataFrame, maintenance: pl.DataFrame, **kw: Any) -> pl.DataFrame:
    legs = health.select("operator", "tail", "flight_id", "pack", "departed_at")
    checks = cross_checks(samples)
    out = features(health, Residuals.create_empty(), legs, maintenance, cross_checks=checks)
    return raise_alerts(out, maintenance, **kw)


@pytest.fixture(scope="module")
def samples(fly) -> pl.DataFrame:
    return fly(FLIGHTS, seed=5)


def when(samples: pl.DataFrame, flight: int) -> Any:
    return samples["time_utc"].unique().sort()[flight * 30]


def fault(samples: pl.DataFrame, pack: int, first: int, last: int = FLIGHTS) -> pl.Expr:
    end = when(samples, last) if last < FLIGHTS else samples["time_utc"].max()
    return (pl.col("pack") == pack) & pl.col("time_utc").is_between(when(samples, first), end)


def replace(maintenance: pl.DataFrame, done_on: date, component: str, pack: int = 1) -> pl.DataFrame:
    row = {"operator": "TST", "tail": "T-AAA", "pack": pack, "done_on": done_on, "component": component}
    entry = pl.DataFrame([row | {"action": "REPLACED", "finding": ""}], schema=maintenance.schema)
    return pl.concat([maintenance, entry])


def says_everything(out: pl.DataFrame) -> bool:
    """By how many times its uncertainty, since when, what else, what waiting costs; the ATA task beside it."""
    parts = ("times (its|the) |of its readings|one value", "since", "Else:")
    words = pl.all_horizontal(pl.col("evidence").str.contains(w) for w in parts)
    cost = pl.col("evidence").str.contains("[Ww]aiting|Until|can't hold")
    return bool(out.select((words & cost & pl.col("recommended_action").str.contains("ATA 21-")).all()).item())


def test_sound_aircraft_raises_nothing(samples, nothing_done) -> None:
    out = alerts_of(samples, track(samples, {}), nothing_done)
    assert out.height == 0
    assert FeaturesAlerts.faults(out) == []
    without = samples.with_columns(pl.lit(None, pl.Float64).alias(c) for c in ("cc_out_k", "cc_flow_kg_s"))
    assert alerts_of(without, track(without, {}), nothing_done).height == 0
    none = samples.clear()
    out = raise_alerts(pl.DataFrame(schema=track(samples, {}).schema), nothing_done)
    assert out.height == 0
    assert cross_checks(none).height == 0


def test_fouling_raises_one_alert(samples, nothing_done) -> None:
    loss = 0.1 + 0.0012 * np.arange(FLIGHTS)
    health = track(samples, {1: loss})
    out = alerts_of(samples, health, nothing_done)
    assert out["diagnosis"].to_list() == ["HX_FOULING"]
    assert says_everything(out)
    raised = health.filter(pl.col("flight_id") == out["raised_flight_id"][0])["value"].max()
    assert 0.15 <= raised <= 0.18
    assert out["closed_at"][0] is None
    assert FeaturesAlerts.faults(out) == []
    both = pl.concat([samples, samples.with_columns(operator=pl.lit("TSU"))])
    health = track(samples, {1: 0.1 + 0.0012 * np.arange(FLIGHTS)})
    health = pl.concat([health, health.with_columns(operator=pl.lit("TSU"))])
    assert alerts_of(both, health, nothing_done)["operator"].to_list() == ["TST", "TSU"]


def test_clog_is_raised_within_three_flights(samples, nothing_done) -> None:
    loss = np.where(np.arange(FLIGHTS) >= 60, 0.32, 0.04)
    out = alerts_of(samples, track(samples, {2: loss}), nothing_done)
    assert out["diagnosis"].to_list() == ["HX_SUDDEN_CLOG"]
    assert out["pack"].to_list() == [2]
    assert out["raised_at"][0] <= when(samples, 63)
    assert out["severity"][0] == "high"
    rng = np.random.default_rng(0)
    loss = 0.16 + 0.008 * rng.standard_normal(FLIGHTS)
    assert alerts_of(samples, track(samples, {1: loss}), nothing_done).height == 1
    flight = np.arange(FLIGHTS)
    loss = np.where(flight < 50, 0.006 * flight, 0.3 * np.exp(-(flight - 50) / 3.0))
    done = replace(nothing_done, when(samples, 50).date(), "HX")
    out = alerts_of(samples, track(samples, {1: loss}), done)
    assert out.height == 1
    assert out["closed_at"][0] is not None


def test_jam_is_door_fault_only(samples, nothing_done) -> None:
    hit = fault(samples, 1, 50, 70)
    noise = 0.005 * (pl.int_range(pl.len()) % 3 - 1)
    jammed = samples.with_columns(
        pl.when(hit).then(0.4 + noise).otherwise("ram_door_open").alias("ram_door_open"),
        pl.when(hit).then(pl.col("hx_out_k") + pl.col("altitude_m") / 900 - 6).otherwise("hx_out_k").alias("hx_out_k"),
    )
    feigned = np.where((np.arange(FLIGHTS) >= 50) & (np.arange(FLIGHTS) < 70), 0.22, 0.02)
    out = alerts_of(jammed, track(jammed, {1: feigned}), nothing_done)
    assert out.select("pack", "diagnosis").rows() == [(1, "RAM_DOOR_FAULT")]
    assert "40 %" in out["evidence"][0]
    assert says_everything(out)


@pytest.mark.parametrize(
    ("signal", "change", "within"),
    [
        ("hx_out_k", 4.0, 6), ("hx_out_k", -4.0, 6), ("cc_in_k", 2.0, 6), ("pack_flow_kg_s", 0.08, 8),
        ("cc_flow_kg_s", -0.08, 8), ("tat_k", 2.0, 6), ("total_pressure_pa", 400.0, 6),
    ],
)  # fmt: skip
def test_shifted_sensor_is_named(samples, nothing_done, signal: str, change: float, within: int) -> None:
    hit = fault(samples, 2, 50)
    shifted = samples.with_columns(pl.when(hit).then(pl.col(signal) + change).otherwise(pl.col(signal)).alias(signal))
    effect = {"hx_out_k": 0.028, "pack_flow_kg_s": -1.9, "tat_k": -0.02}.get(signal, 0.0)
    loss = np.where(np.arange(FLIGHTS) >= 50, 0.02 + effect * change, 0.02)
    out = alerts_of(shifted, track(shifted, {2: loss}), nothing_done)
    assert out.select("pack", "diagnosis").rows() == [(2, "SENSOR_FAULT")]
    assert signal in out["recommended_action"][0]
    assert says_everything(out)
    assert when(samples, 50) <= out["raised_at"][0] <= when(samples, 50 + within)


def test_sensor_fault_leaves_other_packs_wear(samples, nothing_done) -> None:
    hit = fault(samples, 2, 40)
    shifted = samples.with_columns(pl.when(hit).then(pl.col("hx_out_k") - 4.0).otherwise("hx_out_k").alias("hx_out_k"))
    worn = np.clip(0.01 * (np.arange(FLIGHTS) - 45), 0.0, 0.2)
    out = alerts_of(shifted, track(shifted, {1: worn}), nothing_done)
    assert out.select("pack", "diagnosis").rows() == [(2, "SENSOR_FAULT"), (1, "HX_FOULING")]
    past = 45 + int(100 * Limits().fouling)
    assert when(samples, past) <= out["raised_at"][1] <= when(samples, past + 6)
    late = pl.col("time_utc") >= when(samples, 40)
    drift = 0.1 * (pl.col("time_utc") - when(samples, 40)).dt.total_hours() / 6.0
    shifted = samples.with_columns(pl.when(late).then(pl.col("tat_k") + drift).otherwise("tat_k").alias("tat_k"))
    out = alerts_of(shifted, track(shifted, {}), nothing_done)
    assert out.sort("pack").select("pack", "diagnosis").rows() == [(1, "SENSOR_FAULT"), (2, "SENSOR_FAULT")]
    assert out["recommended_action"].str.contains("tat_k").all()


@pytest.mark.parametrize(
    ("sensor", "channel", "shift", "feigned"),
    [
        ("hx_out_k", "hx_out_minus_target_k", 4.0, True),
        ("hx_out_k", "hx_out_between_packs_k", -4.0, False),
        ("hx_in_k", "hx_in_over_discharge_k", 3.0, False),
        ("tat_k", "inlet_minus_tat_k", -2.0, False),
        ("tat_k", "inlet_minus_tat_k", 2.0, True),
        ("pack_flow_kg_s", "pack_over_compressor_flow_ln", -0.07, True),
    ],
)
def test_flattering_sensor_excuses_no_wear(sensor, channel, shift, feigned) -> None:
    # by heat balance: an outlet that reads cold, an inlet, TAT or flow that reads high show too good a core
    facts = {"sensor": sensor, "channel": channel, "moved": shift, "biased": True}
    assert may_feign_wear(Case(0, "SENSOR", "SENSOR_FAULT", 5, None, facts)) == feigned


@pytest.mark.parametrize("kind", ["frozen", "empty", "nulled"])
def test_silent_sensor_alert_closes_with_readings(samples, nothing_done, kind: str) -> None:
    hit = fault(samples, 1, 50, 60)
    some = pl.int_range(pl.len()) % 2 == 0
    values = {"frozen": pl.lit(0.83), "empty": pl.when(~some).then("pack_flow_kg_s"), "nulled": pl.lit(None)}
    value = values[kind]
    silent = samples.with_columns(pl.when(hit).then(value).otherwise(pl.col("pack_flow_kg_s")).alias("pack_flow_kg_s"))
    out = alerts_of(silent, track(silent, {}), nothing_done)
    assert out.select("pack", "diagnosis").rows() == [(1, "SENSOR_FAULT")]
    assert out["raised_at"][0] <= when(samples, 52)
    assert out["closed_at"][0] is not None
    assert says_everything(out)


def test_alerts_ignore_later_flights(samples, nothing_done) -> None:
    hit = fault(samples, 2, 50)
    shifted = samples.with_columns(pl.when(hit).then(pl.col("hx_out_k") + 4.0).otherwise("hx_out_k").alias("hx_out_k"))
    health = track(shifted, {1: 0.004 * np.arange(FLIGHTS)})
    whole = alerts_of(shifted, health, nothing_done)
    for last in (45, 55, 70):
        cut = when(samples, last)
        before = health.filter(pl.col("departed_at") < cut)
        part = alerts_of(shifted.filter(pl.col("time_utc") < cut), before, nothing_done)
        then = whole.filter(pl.col("raised_at") < cut)
        assert part["alert_id"].to_list() == then["alert_id"].to_list()
        assert part["evidence"].to_list() == then["evidence"].to_list()


def test_door_at_lower_stop_is_sound(samples, nothing_done) -> None:
    """Types differ in where the door rests: at 12 % it does so in cold air, from climb to descent."""
    noise = 0.005 * (pl.int_range(pl.len()) % 3 - 1)
    cold = samples["time_utc"].is_between(when(samples, 40), when(samples, 60))
    resting = pl.when(cold).then(0.12 + noise).otherwise(pl.max_horizontal("ram_door_open", 0.12 + noise))
    warm = pl.when(cold).then(pl.col("hx_out_k") - 0.002 * (pl.col("tat_k") - 250.0) ** 2).otherwise(pl.col("hx_out_k"))
    cold_samples = samples.with_columns(resting.alias("ram_door_open"), warm.alias("hx_out_k"))
    out = alerts_of(cold_samples, track(samples, {}), nothing_done)
    assert "RAM_DOOR_FAULT" not in out["diagnosis"].to_list()


@pytest.mark.parametrize(("excess_k", "raised"), [(6.0, True), (0.6, False)])
def test_warm_stop_is_lost_travel(samples, nothing_done, excess_k, raised) -> None:
    """One flight is enough where the outlet is far above its target."""
    wide = samples.with_columns(ram_door_open=3.0 * pl.col("ram_door_open"))
    reach = 0.8 * wide["ram_door_open"].max()
    short = fault(wide, 1, 60, 61) & (pl.col("ram_door_open") > reach)
    stuck = wide.with_columns(
        pl.when(short).then(reach).otherwise("ram_door_open").alias("ram_door_open"),
        pl.when(short).then(pl.col("hx_out_k") + excess_k).otherwise("hx_out_k").alias("hx_out_k"),
    )
    out = alerts_of(stuck, track(stuck, {}), nothing_done)
    assert out.select("pack", "diagnosis").rows() == ([(1, "RAM_DOOR_FAULT")] if raised else [])


@pytest.mark.parametrize(
    ("shifts", "sensor"),
    [
        ({"w_hx_in_over_discharge_k": 2.8, "hx_fouling_flight": -0.03}, "hx_in_k"),
        ({"w_hx_in_over_discharge_k": -2.8, "hx_fouling_flight": 0.03}, "hx_in_k"),
        (
            {"w_hx_in_over_discharge_k": 5.2, "w_conductance_off_cruise_ln": -0.14, "hx_fouling_flight": 0.13},
            "ram_door_open",
        ),
        ({"w_hx_in_over_discharge_k": 2.5, "w_conductance_off_cruise_ln": 0.02, "hx_fouling_flight": 0.15}, None),
    ],
    ids=["inlet reads high", "inlet reads low", "door reads high", "a blockage"],
)
def test_model_checks_separate_sensor_from_blockage(samples, nothing_done, shifts, sensor) -> None:
    health = track(samples, {1: np.where(np.arange(FLIGHTS) >= 50, 0.12, 0.0)} if sensor is None else {})
    legs = health.select("operator", "tail", "flight_id", "pack", "departed_at")
    rows = features(health, Residuals.create_empty(), legs, nothing_done, cross_checks=cross_checks(samples))
    rng, hit = np.random.default_rng(2), (pl.col("pack") == 1) & (pl.col("departed_at") >= when(samples, 50))
    noise = {"w_hx_in_over_discharge_k": 0.7, "w_conductance_off_cruise_ln": 0.018, "hx_fouling_flight": 0.016}
    shift = {name: pl.when(hit).then(shifts.get(name, 0.0)).otherwise(0.0) for name in noise}
    scatter = {name: pl.Series(sd * rng.standard_normal(rows.height)) for name, sd in noise.items()}
    checks = [(scatter[name] + shift[name]).alias(name) for name in noise]
    out = raise_alerts(rows.with_columns(checks), nothing_done)
    named = out.filter(diagnosis="SENSOR_FAULT")
    if sensor is None:
        assert named.height == 0
    else:
        # two sensors may share the blame; the door's signature is its own
        assert named["pack"].to_list() == [1]
        assert sensor == "hx_in_k" or sensor in named["recommended_action"][0]
