"""What a fault does to its witness, and what it leaves alone."""

import numpy as np
import polars as pl
import pytest
from alter import alter
from hand_pack import FLIGHT, LAWS

from hdt_core.health.sensor_checks import CHECKS, cross_checks
from hdt_core.tables.raw import SIGNALS

FROM = 30


def late(samples: pl.DataFrame, pack: int = 1) -> pl.Expr:
    start = samples["time_utc"].unique().sort()
    return (pl.col("pack") == pack) & (pl.col("time_utc") >= start[FROM * 30])


def witnesses(samples: pl.DataFrame, pack: int = 1) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Witnesses of the pack before and after the fault began."""
    out = cross_checks(samples).filter(pl.col("pack") == pack).sort("departed_at")
    return out.head(FROM), out.slice(FROM)


@pytest.fixture(scope="module")
def sound(fly) -> pl.DataFrame:
    """Forty flights of a sound aircraft."""
    return fly(40)


def test_sound_aircraft_shows_nothing(sound):
    out = cross_checks(sound)
    assert out["running"].to_list() == [True] * 80
    assert out["door_span"].min() > 0.05
    assert out["door_peg_excess_k"].abs().max() < 1.3
    assert out["w_hx_out_between_packs_k"].std() < 2.0


def test_sound_sensors_move(sound):
    out = cross_checks(sound)
    empty = {sensor: out[f"{sensor}_lost_share"].max() for sensor in SIGNALS}
    assert empty == dict.fromkeys(SIGNALS, 0.0) | {"ram_out_k": 1.0}
    assert not out.select(pl.any_horizontal(f"{sensor}_still" for sensor in SIGNALS).any()).item()


def test_frozen_sensor_stands_still(sound):
    before, after = witnesses(alter(sound, late(sound), cc_flow_kg_s=0.8))
    assert not before["cc_flow_kg_s_still"].any()
    assert after["cc_flow_kg_s_still"].all()


def test_empty_readings_are_counted(sound):
    every_second = late(sound) & (pl.int_range(pl.len()) % 2 == 0)
    _, after = witnesses(alter(sound, every_second, hx_in_k=None))
    assert after["hx_in_k_lost_share"].to_list() == pytest.approx([0.5] * 10)


def both_packs() -> pl.DataFrame:
    """The flight of `hand_pack`, six samples of cruise, and a pack beside it that reads a little otherwise."""
    scaled = {"pack_flow_kg_s": 1.02, "cc_flow_kg_s": 0.99, "cc_out_pa": 1.01, "total_pressure_pa": 1.003}
    added = {"tat_k": 0.4, "hx_in_k": -2.0, "hx_out_k": 1.5, "cc_out_k": 3.0}
    other = FLIGHT.with_columns(
        pl.lit(2, pl.Int32).alias("pack"), ram_door_open=pl.lit(0.4),
        **{name: pl.col(name) * by for name, by in scaled.items()},
        **{name: pl.col(name) + by for name, by in added.items()},
    )  # fmt: skip
    return pl.concat([FLIGHT, other]).with_columns(source=pl.lit("acms"))


def first(samples: pl.DataFrame) -> dict[str, object]:
    return cross_checks(samples, LAWS).row(by_predicate=pl.col("pack") == 1, named=True)


S = {name: FLIGHT[name].to_numpy() for name in FLIGHT.columns}
ABOVE_K = S["hx_out_k"] - np.interp(S["tat_k"], (230.0, 250.0, 300.0), (-10.0, -10.0, 20.0))
"""Outlet above the schedule's shape."""
FREE = S["ram_door_open"] <= 0.95


def test_cross_checks_by_hand():
    ln = np.log
    static_pa = 22_632.0 * np.exp(-9.80665 * (S["altitude_m"] - 11_000.0) / (287.053 * 216.65))
    pitot_pa = static_pa * (1.0 + 0.2 * S["mach"] ** 2) ** 3.5
    delivery = np.interp(S["altitude_m"], (5000.0, 15_000.0), (0.06, -0.04)) + 0.17 * S["pack_flow_kg_s"] ** 2
    by_hand = {
        "w_inlet_minus_tat_k": np.median(S["cc_in_k"] - S["tat_k"]),
        "w_inlet_over_total_pressure_ln": np.median(ln(S["cc_in_pa"] / S["total_pressure_pa"])),
        "w_total_over_pitot_pressure_ln": np.median(ln(S["total_pressure_pa"] / pitot_pa)),
        "w_pack_over_compressor_flow_ln": np.median(ln(S["pack_flow_kg_s"] / S["cc_flow_kg_s"])),
        "w_tat_between_packs_k": -0.4, "w_total_pressure_between_packs_ln": -ln(1.003),
        "w_pack_flow_between_packs_ln": -ln(1.02), "w_compressor_flow_between_packs_ln": -ln(0.99),
        "w_cc_out_pressure_between_packs_ln": -ln(1.01), "w_hx_in_between_packs_k": 2.0,
        "w_cc_out_pressure_over_schedule_ln": np.median(ln(S["cc_out_pa"]) - delivery),
        "w_cc_out_between_packs_k": -3.0, "w_hx_out_minus_target_k": np.median(ABOVE_K[FREE]),
        "w_hx_out_between_packs_k": -1.5, "w_hx_out_between_packs_k_n": 3, "w_inlet_minus_tat_k_n": 6,
        "hx_out_target_sd_k": ABOVE_K[FREE].std(ddof=1),
    }  # fmt: skip
    row = first(both_packs())
    assert {name: row[name] for name in by_hand} == pytest.approx(by_hand, rel=1e-4, abs=2e-5)


def test_setting_by_hand():
    door = S["ram_door_open"]
    medians = {
        "tat_cruise_k": "tat_k", "altitude_cruise_m": "altitude_m", "mach_cruise": "mach", "hx_in_cruise_k": "hx_in_k",
        "hx_out_cruise_k": "hx_out_k", "pack_flow_cruise_kg_s": "pack_flow_kg_s",
        "cc_speed_cruise_rad_s": "cc_speed_rad_s", "door_median": "ram_door_open",
    }  # fmt: skip
    by_hand = {name: np.median(S[signal]) for name, signal in medians.items()} | {
        "door_span": np.quantile(door, 0.95, method="nearest") - np.quantile(door, 0.05, method="nearest"),
        "door_max": 1.0, "door_n": 6, "door_travel": np.abs(np.diff(door)).sum(), "door_full_open_share": 0.5,
        "n_snapshots": 6, "flight_hours": 5.0 / 60.0,
    }  # fmt: skip
    row = first(both_packs())
    assert {name: row[name] for name in by_hand} == pytest.approx(by_hand, rel=1e-4, abs=2e-5)


def test_door_at_limit_has_authority():
    at_limit = first(both_packs().with_columns(ram_door_open=pl.lit(0.95)))
    assert (at_limit["door_full_open_share"], at_limit["w_hx_out_minus_target_k_n"]) == (0.0, 6)


def test_open_door_has_no_peg_excess():
    """Where the door is widest it has no authority."""
    assert first(both_packs())["door_peg_excess_k"] is None


AT = pl.int_range(pl.len()).over("pack")


@pytest.mark.parametrize(("n_valid", "is_computed"), [(3, True), (2, False)])
def test_witness_needs_three_samples(n_valid, is_computed):
    row = first(both_packs().with_columns(cc_in_k=pl.when(n_valid > AT).then("cc_in_k")))
    assert (row["w_inlet_minus_tat_k"] is not None) is is_computed
    assert row["w_inlet_minus_tat_k_n"] == n_valid


@pytest.mark.parametrize(("check", "is_computed"), [("inlet_minus_tat_k", False), ("hx_out_minus_target_k", True)])
def test_inlet_needs_level_flight(check, is_computed):
    climb = first(alter(both_packs(), AT < 4, phase=pl.lit("climb")))
    assert (climb[f"w_{check}"] is not None) is is_computed


@pytest.mark.parametrize("pa", [0.0, -1.0])
@pytest.mark.parametrize(
    "check", ["cc_out_pressure_over_schedule_ln", "total_over_pitot_pressure_ln", "cc_out_pressure_between_packs_ln"]
)
def test_impossible_pressure_is_no_witness(pa, check):
    row = first(both_packs().with_columns(cc_out_pa=pl.lit(pa), total_pressure_pa=pl.lit(pa)))
    assert row[f"w_{check}"] is None


def test_impossible_sample_is_left_out():
    once = alter(both_packs(), pl.int_range(pl.len()) == 0, cc_in_pa=0.0)
    assert first(once)["w_inlet_over_total_pressure_ln_n"] == 5


@pytest.mark.parametrize(
    ("signal", "check"),
    [
        ("pack_flow_kg_s", "pack_over_compressor_flow_ln"), ("cc_flow_kg_s", "pack_over_compressor_flow_ln"),
        ("pack_flow_kg_s", "hx_in_between_packs_k"), ("pack_flow_kg_s", "cc_out_between_packs_k"),
        ("pack_flow_kg_s", "cc_out_pressure_between_packs_ln"), ("pack_flow_kg_s", "cc_out_pressure_over_schedule_ln"),
        ("cc_flow_kg_s", "compressor_flow_between_packs_ln"), ("pack_flow_kg_s", "pack_flow_between_packs_ln"),
    ],
)  # fmt: skip
@pytest.mark.parametrize(("flow", "is_computed"), [(0.2, False), (0.201, True)])
def test_resting_pack_is_no_witness(signal: str, check: str, flow: float, is_computed: bool):
    for pack in (1, 2) if "between" in check else (1,):
        row = first(alter(both_packs(), pl.col("pack") == pack, **{signal: flow}))
        assert (row[f"w_{check}"] is not None) is is_computed


@pytest.fixture
def twelve() -> pl.DataFrame:
    """Twelve samples two minutes apart."""
    times = pl.col("time_utc").first() + pl.duration(minutes=2 * pl.int_range(pl.len()))
    return pl.concat([FLIGHT, FLIGHT]).with_columns(times, source=pl.lit("acms"))


@pytest.mark.parametrize(("n", "still"), [(8, True), (7, False)])
def test_still_sensor_needs_eight_readings(twelve, n, still):
    row = first(twelve.with_columns(mach=pl.when(pl.int_range(pl.len()) < n).then(0.8)))
    assert row["mach_still"] is still
    assert (row["mach_lost_share"], row["flight_hours"]) == pytest.approx(((12 - n) / 12, 22.0 / 60.0))


def test_moving_sensor_is_not_still(twelve):
    assert not first(twelve.with_columns(mach=0.8 + 0.001 * (pl.int_range(pl.len()) == 0)))["mach_still"]


@pytest.mark.parametrize(
    ("pack_flow", "cc_flow", "running"), [(0.2, 0.2, 0), (0.201, 0.0, 1), (0.0, 0.201, 1), (None, 0.3, 1)]
)
def test_either_flow_marks_running_pack(pack_flow, cc_flow, running):
    flows = {"pack_flow_kg_s": pl.lit(pack_flow, pl.Float64), "cc_flow_kg_s": pl.lit(cc_flow, pl.Float64)}
    assert first(both_packs().with_columns(**flows))["running"] == bool(running)


def test_peg_excess_compares_stop():
    """Outlet at the stop against the rest."""
    door = pl.Series("ram_door_open", [0.50, 0.49, 0.486, 0.485, 0.3, 0.2] * 2)
    row = first(both_packs().with_columns(door))
    assert (row["door_peg_n"], row["door_off_peg_n"]) == (3, 3)
    assert row["door_peg_excess_k"] == pytest.approx(np.median(ABOVE_K[:3]) - np.median(ABOVE_K[3:]))


def test_jammed_door_leaves_target(sound):
    noise = 0.005 * (pl.int_range(pl.len()) % 3 - 1)
    warm = pl.col("hx_out_k") + pl.col("altitude_m") / 1000 - 6
    before, after = witnesses(alter(sound, late(sound), ram_door_open=0.4 + noise, hx_out_k=warm))
    assert before["door_span"].min() > 0.05
    assert after["door_span"].max() < 0.02
    assert not after["ram_door_open_still"].any()
    assert after["hx_out_target_sd_k"].min() > 3 * before["hx_out_target_sd_k"].max()


def test_outlet_runs_warm_at_stop(sound):
    door = pl.col("ram_door_open")
    warm = pl.col("hx_out_k") + 100 * (door - 0.19).clip(lower_bound=0.0)
    before, after = witnesses(alter(sound, late(sound), hx_out_k=warm, ram_door_open=door.clip(upper_bound=0.19)))
    assert before["door_peg_excess_k"].max() < 1.3
    assert after["door_peg_excess_k"].median() > 1.3


@pytest.fixture(scope="module")
def one_off(sound) -> pl.DataFrame:
    """The aircraft with its first pack off from flight 30 on."""
    return alter(sound, late(sound), pack_flow_kg_s=0.0, cc_flow_kg_s=0.0)


def test_pack_without_flow_is_off(one_off):
    assert not witnesses(one_off)[1]["running"].any()


def test_pack_off_is_no_witness(one_off):
    _, other = witnesses(one_off, pack=2)
    assert other["running"].all()
    assert other["w_hx_out_between_packs_k"].null_count() == other.height


def test_lone_pack_keeps_own_checks(fly):
    out = cross_checks(fly(12).filter(pl.col("pack") == 1))
    assert out["w_hx_out_between_packs_k"].null_count() == out.height
    assert out["w_inlet_minus_tat_k"].null_count() == 0
    assert {f"w_{c}" for c in CHECKS} <= set(out.columns)
