"""What a fault does to its witness, and what it leaves alone."""

import polars as pl
import pytest

from hdt_core.health.sensor_checks import CHECKS, SENSORS, witnesses

FROM = 30


def late(samples: pl.DataFrame, pack: int = 1) -> pl.Expr:
    start = samples["time_utc"].unique().sort()
    return (pl.col("pack") == pack) & (pl.col("time_utc") >= start[FROM * 30])


def seen(samples: pl.DataFrame, pack: int = 1) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Witnesses of the pack before and after the fault began."""
    out = witnesses(samples).filter(pl.col("pack") == pack).sort("departed_at")
    return out.head(FROM), out.slice(FROM)


def test_sound_aircraft_shows_nothing(fly) -> None:
    out = witnesses(fly(40))
    assert out.height == 80
    assert out["running"].all()
    for sensor in SENSORS:
        expected = 1.0 if sensor == "ram_out_k" else 0.0
        assert out[f"{sensor}_lost_share"].max() == expected
        assert not out[f"{sensor}_still"].any()
    assert out["door_span"].min() > 0.05
    assert out["door_peg_excess_k"].abs().max() < 1.3
    assert out["w_hx_out_between_packs_k"].std() < 2.0


def test_frozen_and_empty_sensors(fly) -> None:
    samples = fly(40)
    fault = late(samples)
    frozen = samples.with_columns(pl.when(fault).then(0.8).otherwise(pl.col("cc_flow_kg_s")).alias("cc_flow_kg_s"))
    empty = samples.with_columns(
        pl.when(fault & (pl.int_range(pl.len()) % 2 == 0)).then(None).otherwise(pl.col("hx_in_k")).alias("hx_in_k")
    )
    before, after = seen(frozen)
    assert not before["cc_flow_kg_s_still"].any()
    assert after["cc_flow_kg_s_still"].all()
    assert seen(empty)[1]["hx_in_k_lost_share"].to_list() == pytest.approx([0.5] * 10)


@pytest.mark.parametrize(
    ("signal", "change", "check", "moves"),
    [
        ("hx_out_k", 3.0, "hx_out_between_packs_k", 3.0),
        ("cc_in_k", -2.0, "inlet_minus_tat_k", -2.0),
        ("tat_k", 2.0, "tat_between_packs_k", 2.0),
        ("pack_flow_kg_s", 0.08, "pack_over_compressor_flow_ln", 0.1),
        ("total_pressure_pa", 300.0, "total_over_pitot_pressure_ln", 0.008),
    ],
)
def test_a_shifted_sensor_moves_its_check(fly, signal: str, change: float, check: str, moves: float) -> None:
    samples = fly(40)
    moved = samples.with_columns(
        pl.when(late(samples)).then(pl.col(signal) + change).otherwise(pl.col(signal)).alias(signal)
    )
    before, after = seen(moved)
    assert after[f"w_{check}"].median() - before[f"w_{check}"].median() == pytest.approx(moves, rel=0.3)


def test_a_jam_stands_still_and_leaves_its_target(fly) -> None:
    samples = fly(40)
    noise = 0.005 * (pl.int_range(pl.len()) % 3 - 1)
    door = pl.when(late(samples)).then(0.4 + noise).otherwise(pl.col("ram_door_open")).alias("ram_door_open")
    warm = (
        pl.when(late(samples)).then(pl.col("hx_out_k") + pl.col("altitude_m") / 1000 - 6).otherwise(pl.col("hx_out_k"))
    )
    before, after = seen(samples.with_columns(door, warm.alias("hx_out_k")))
    assert before["door_span"].min() > 0.05
    assert after["door_span"].max() < 0.02
    assert not after["ram_door_open_still"].any()
    assert after["hx_out_target_sd_k"].min() > 3 * before["hx_out_target_sd_k"].max()


def test_a_stop_runs_warm_where_the_door_rests(fly) -> None:
    samples = fly(40)
    stop = 0.19
    lack = (pl.col("ram_door_open") - stop).clip(lower_bound=0.0)
    fault = late(samples)
    warm = pl.when(fault).then(pl.col("hx_out_k") + 100 * lack).otherwise(pl.col("hx_out_k")).alias("hx_out_k")
    door = pl.when(fault).then(pl.col("ram_door_open").clip(upper_bound=stop)).otherwise(pl.col("ram_door_open"))
    before, after = seen(samples.with_columns(warm, door.alias("ram_door_open")))
    assert before["door_peg_excess_k"].max() < 1.3
    assert after["door_peg_excess_k"].median() > 1.3


def test_pack_off_is_no_witness(fly) -> None:
    samples = fly(40)
    off = late(samples)
    flows = [pl.when(off).then(0.0).otherwise(pl.col(c)).alias(c) for c in ("pack_flow_kg_s", "cc_flow_kg_s")]
    out = witnesses(samples.with_columns(flows))
    assert not out.filter(pl.col("pack") == 1).sort("departed_at").slice(FROM)["running"].any()
    other = out.filter(pl.col("pack") == 2).sort("departed_at").slice(FROM)
    assert other["running"].all()
    assert other["w_hx_out_between_packs_k"].null_count() == other.height


def test_a_lone_pack_has_no_partner_but_keeps_its_own_checks(fly) -> None:
    out = witnesses(fly(12).filter(pl.col("pack") == 1))
    assert out["w_hx_out_between_packs_k"].null_count() == out.height
    assert out["w_inlet_minus_tat_k"].null_count() == 0
    assert {f"w_{c}" for c in CHECKS} <= set(out.columns)
