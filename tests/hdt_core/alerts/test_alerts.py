"""Cases: raised once, for the right reason, by what was known then."""

from datetime import timedelta
from typing import Any

import numpy as np
import polars as pl
import pytest
from alter import alter

from hdt_core.alerts.alerts import raise_alerts
from hdt_core.alerts.cases import Case, Limits
from hdt_core.alerts.disturbances import may_feign_wear
from hdt_core.health.features import features
from hdt_core.health.sensor_checks import cross_checks
from hdt_core.tables.alerts import FeaturesAlerts
from hdt_core.tables.twin import Residuals

FLIGHTS = 90
FLIGHT = np.arange(FLIGHTS)


def track(samples: pl.DataFrame, loss: dict[int, np.ndarray], sd: float = 0.01) -> pl.DataFrame:
    """`hx_fouling` of each pack (0 where not given) as the twin would state it."""
    key = ["operator", "tail", "flight_id", "pack"]
    flights = samples.group_by(key).agg(pl.col("time_utc").min().alias("departed_at")).sort("pack", "departed_at")
    n = flights.height // 2
    value = np.concatenate([loss.get(p, np.zeros(n)) for p in (1, 2)])
    constants = {"component": "HX", "parameter": "hx_fouling", "unit": "-", "status": "ok", "estimator": "kalman"}
    own = (pl.lit(v).alias(k) for k, v in constants.items())
    return flights.with_columns(pl.Series("value", value), pl.lit(sd).alias("sd"), *own)


def features_of(samples: pl.DataFrame, health: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    legs = health.select("operator", "tail", "flight_id", "pack", "departed_at")
    return features(health, Residuals.create_empty(), legs, maintenance, cross_checks=cross_checks(samples))


def alerts_of(samples: pl.DataFrame, health: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    return raise_alerts(features_of(samples, health, maintenance), maintenance)


def alerts_with_loss(samples: pl.DataFrame, maintenance: pl.DataFrame, **loss: np.ndarray) -> pl.DataFrame:
    """Alerts of packs that lose so much: `pack_1`, `pack_2`."""
    return alerts_of(samples, track(samples, {int(name[-1]): value for name, value in loss.items()}), maintenance)


@pytest.fixture(scope="module")
def samples(fly) -> pl.DataFrame:
    return fly(FLIGHTS, seed=5)


def when(samples: pl.DataFrame, flight: int) -> Any:
    return samples["time_utc"].unique().sort()[flight * 30]


def fault(samples: pl.DataFrame, pack: int, first: int, last: int = FLIGHTS) -> pl.Expr:
    end = when(samples, last) if last < FLIGHTS else samples["time_utc"].max()
    return (pl.col("pack") == pack) & pl.col("time_utc").is_between(when(samples, first), end)


def states_everything(out: pl.DataFrame) -> bool:
    """By how many times its uncertainty, since when, what else, what waiting costs; the ATA task beside it."""
    parts = ("times (its|the) |of its readings|one value", "since", "Else:")
    words = pl.all_horizontal(pl.col("evidence").str.contains(w) for w in parts)
    cost = pl.col("evidence").str.contains("[Ww]aiting|Until|can't hold")
    return bool(out.select((words & cost & pl.col("recommended_action").str.contains("ATA 21-")).all()).item())


def diagnoses(out: pl.DataFrame) -> list[tuple[int, str]]:
    return out.select("pack", "diagnosis").rows()


def test_sound_aircraft_raises_nothing(samples, nothing_done):
    out = alerts_with_loss(samples, nothing_done)
    assert out.height == 0
    assert FeaturesAlerts.faults(out) == []


def test_unrecorded_columns_raise_nothing(samples, nothing_done):
    without = samples.with_columns(pl.lit(None, pl.Float64).alias(c) for c in ("cc_out_k", "cc_flow_kg_s"))
    assert alerts_with_loss(without, nothing_done).height == 0


def test_no_flights_raise_nothing(samples, nothing_done):
    assert raise_alerts(track(samples, {}).clear(), nothing_done).height == 0
    assert cross_checks(samples.clear()).height == 0


@pytest.fixture(scope="module")
def fouling_track(samples) -> pl.DataFrame:
    """Losses of a first pack that fouls."""
    return track(samples, {1: 0.1 + 0.0012 * FLIGHT})


def test_fouling_raises_one_alert(samples, nothing_done, fouling_track):
    out = alerts_of(samples, fouling_track, nothing_done)
    raised = fouling_track.filter(pl.col("flight_id") == out["raised_flight_id"][0])["value"].max()
    assert out.select("diagnosis", "closed_at").rows() == [("HX_FOULING", None)]
    assert 0.15 <= raised <= 0.18
    assert states_everything(out)
    assert FeaturesAlerts.faults(out) == []


def test_operators_tails_are_apart(samples, nothing_done, fouling_track):
    """Two operators have a tail of the same name."""
    both = (pl.concat([rows, rows.with_columns(operator=pl.lit("TSU"))]) for rows in (samples, fouling_track))
    assert alerts_of(*both, nothing_done)["operator"].to_list() == ["TST", "TSU"]


def test_clog_is_raised_within_three_flights(samples, nothing_done):
    out = alerts_with_loss(samples, nothing_done, pack_2=np.where(FLIGHT >= 60, 0.32, 0.04))
    assert out.select("pack", "diagnosis", "severity").rows() == [(2, "HX_SUDDEN_CLOG", "high")]
    assert out["raised_at"][0] <= when(samples, 63)


def test_wavering_loss_is_one_case(samples, nothing_done):
    loss = 0.16 + 0.008 * np.random.default_rng(0).standard_normal(FLIGHTS)
    assert alerts_with_loss(samples, nothing_done, pack_1=loss).height == 1


def test_new_unit_closes_case(samples, nothing_done):
    """Though the track takes some flights to come down."""
    loss = np.where(FLIGHT < 50, 0.006 * FLIGHT, 0.3 * np.exp(-(FLIGHT - 50) / 3.0))
    entry = {"operator": "TST", "tail": "T-AAA", "pack": 1, "done_on": when(samples, 50).date(), "component": "HX"}
    log = pl.DataFrame([entry | {"action": "REPLACED", "finding": ""}], schema=nothing_done.schema)
    out = alerts_with_loss(samples, log, pack_1=loss)
    assert out["closed_at"].is_not_null().to_list() == [True]


def test_jam_is_door_fault_only(samples, nothing_done):
    noise = 0.005 * (pl.int_range(pl.len()) % 3 - 1)
    warm = pl.col("hx_out_k") + pl.col("altitude_m") / 900 - 6
    jammed = alter(samples, fault(samples, 1, 50, 70), ram_door_open=0.4 + noise, hx_out_k=warm)
    feigned = np.where((FLIGHT >= 50) & (FLIGHT < 70), 0.22, 0.02)
    out = alerts_with_loss(jammed, nothing_done, pack_1=feigned)
    assert diagnoses(out) == [(1, "RAM_DOOR_FAULT")]
    assert "40 %" in out["evidence"][0]
    assert states_everything(out)


@pytest.mark.parametrize(
    ("signal", "change", "within"),
    [
        ("hx_out_k", 4.0, 6), ("hx_out_k", -4.0, 6), ("cc_in_k", 2.0, 6), ("pack_flow_kg_s", 0.08, 8),
        ("cc_flow_kg_s", -0.08, 8), ("tat_k", 2.0, 6), ("total_pressure_pa", 400.0, 6),
    ],
)  # fmt: skip
def test_shifted_sensor_is_named(samples, nothing_done, signal: str, change: float, within: int):
    shifted = alter(samples, fault(samples, 2, 50), **{signal: pl.col(signal) + change})
    effect = {"hx_out_k": 0.028, "pack_flow_kg_s": -1.9, "tat_k": -0.02}.get(signal, 0.0)
    out = alerts_with_loss(shifted, nothing_done, pack_2=np.where(FLIGHT >= 50, 0.02 + effect * change, 0.02))
    assert diagnoses(out) == [(2, "SENSOR_FAULT")]
    assert signal in out["recommended_action"][0]
    assert states_everything(out)
    assert when(samples, 50) <= out["raised_at"][0] <= when(samples, 50 + within)


def test_sensor_fault_leaves_other_packs_wear(samples, nothing_done):
    shifted = alter(samples, fault(samples, 2, 40), hx_out_k=pl.col("hx_out_k") - 4.0)
    out = alerts_with_loss(shifted, nothing_done, pack_1=np.clip(0.01 * (FLIGHT - 45), 0.0, 0.2))
    past = 45 + int(100 * Limits().fouling)
    assert diagnoses(out) == [(2, "SENSOR_FAULT"), (1, "HX_FOULING")]
    assert when(samples, past) <= out["raised_at"][1] <= when(samples, past + 6)


def test_common_probe_is_named_on_both(samples, nothing_done):
    late = pl.col("time_utc") - when(samples, 40)
    drifting = alter(samples, late >= timedelta(0), tat_k=pl.col("tat_k") + 0.1 * late.dt.total_hours() / 6.0)
    out = alerts_with_loss(drifting, nothing_done)
    assert diagnoses(out.sort("pack")) == [(1, "SENSOR_FAULT"), (2, "SENSOR_FAULT")]
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
def test_flattering_sensor_excuses_no_wear(sensor, channel, shift, feigned):
    # by heat balance: an outlet that reads cold, an inlet, TAT or flow that reads high show too good a core
    facts = {"sensor": sensor, "channel": channel, "moved": shift, "biased": True}
    assert may_feign_wear(Case(0, "SENSOR", "SENSOR_FAULT", 5, None, facts)) == feigned


@pytest.mark.parametrize("kind", ["frozen", "empty", "nulled"])
def test_silent_sensor_alert_closes_with_readings(samples, nothing_done, kind: str):
    every_second = pl.when(pl.int_range(pl.len()) % 2 == 1).then("pack_flow_kg_s")
    value = {"frozen": 0.83, "empty": every_second, "nulled": None}[kind]
    silent = alter(samples, fault(samples, 1, 50, 60), pack_flow_kg_s=value)
    out = alerts_with_loss(silent, nothing_done)
    assert diagnoses(out) == [(1, "SENSOR_FAULT")]
    assert out["raised_at"][0] <= when(samples, 52)
    assert out["closed_at"][0] is not None
    assert states_everything(out)


def test_alerts_ignore_later_flights(samples, nothing_done):
    shifted = alter(samples, fault(samples, 2, 50), hx_out_k=pl.col("hx_out_k") + 4.0)
    health = track(shifted, {1: 0.004 * FLIGHT})
    whole = alerts_of(shifted, health, nothing_done)
    stays = ["alert_id", "evidence"]
    for last in (45, 55, 70):
        cut = when(samples, last)
        before = health.filter(pl.col("departed_at") < cut)
        part = alerts_of(shifted.filter(pl.col("time_utc") < cut), before, nothing_done)
        assert part.select(stays).rows() == whole.filter(pl.col("raised_at") < cut).select(stays).rows()


def test_door_at_lower_stop_is_sound(samples, nothing_done):
    """Types differ in where the door rests: at 12 % it does so in cold air, from climb to descent."""
    stop = 0.12 + 0.005 * (pl.int_range(pl.len()) % 3 - 1)
    cold = samples["time_utc"].is_between(when(samples, 40), when(samples, 60))
    resting = samples.with_columns(ram_door_open=pl.max_horizontal("ram_door_open", stop))
    cooler = pl.col("hx_out_k") - 0.002 * (pl.col("tat_k") - 250.0) ** 2
    out = alerts_with_loss(alter(resting, cold, ram_door_open=stop, hx_out_k=cooler), nothing_done)
    assert "RAM_DOOR_FAULT" not in out["diagnosis"].to_list()


@pytest.mark.parametrize(("excess_k", "raised"), [(6.0, True), (0.6, False)])
def test_warm_stop_is_lost_travel(samples, nothing_done, excess_k, raised):
    """One flight is enough where the outlet is far above its target."""
    wide = samples.with_columns(ram_door_open=3.0 * pl.col("ram_door_open"))
    reach = 0.8 * wide["ram_door_open"].max()
    short = fault(wide, 1, 60, 61) & (pl.col("ram_door_open") > reach)
    stuck = alter(wide, short, ram_door_open=reach, hx_out_k=pl.col("hx_out_k") + excess_k)
    assert diagnoses(alerts_with_loss(stuck, nothing_done)) == ([(1, "RAM_DOOR_FAULT")] if raised else [])


def sensor_faults(samples: pl.DataFrame, maintenance: pl.DataFrame, loss: dict, shifts: dict) -> pl.DataFrame:
    """Sensors' alerts where the model's cross checks of the first pack shift from flight 50 on."""
    rows = features_of(samples, track(samples, loss), maintenance)
    rng = np.random.default_rng(2)
    noise = {"w_hx_in_over_discharge_k": 0.7, "w_conductance_off_cruise_ln": 0.018, "hx_fouling_flight": 0.016}
    rows = rows.with_columns(**{name: pl.Series(sd * rng.standard_normal(rows.height)) for name, sd in noise.items()})
    hit = (pl.col("pack") == 1) & (pl.col("departed_at") >= when(samples, 50))
    rows = alter(rows, hit, **{name: pl.col(name) + shift for name, shift in shifts.items()})
    return raise_alerts(rows, maintenance).filter(diagnosis="SENSOR_FAULT")


@pytest.mark.parametrize(
    ("shifts", "words"),
    [
        # two sensors may share the blame for an inlet; the door's signature is its own
        ({"w_hx_in_over_discharge_k": 2.8, "hx_fouling_flight": -0.03}, ""),
        ({"w_hx_in_over_discharge_k": -2.8, "hx_fouling_flight": 0.03}, ""),
        (
            {"w_hx_in_over_discharge_k": 5.2, "w_conductance_off_cruise_ln": -0.14, "hx_fouling_flight": 0.13},
            "ram_door_open",
        ),
    ],
    ids=["inlet reads high", "inlet reads low", "door reads high"],
)
def test_model_checks_name_sensor(samples, nothing_done, shifts, words):
    out = sensor_faults(samples, nothing_done, {}, shifts)
    assert out["pack"].to_list() == [1]
    assert words in out["recommended_action"][0]


def test_blockage_is_no_sensor_fault(samples, nothing_done):
    shifts = {"w_hx_in_over_discharge_k": 2.5, "w_conductance_off_cruise_ln": 0.02, "hx_fouling_flight": 0.15}
    assert sensor_faults(samples, nothing_done, {1: np.where(FLIGHT >= 50, 0.12, 0.0)}, shifts).height == 0
