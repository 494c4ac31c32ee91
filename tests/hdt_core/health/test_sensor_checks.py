"""What a fault does to its witness, and what it leaves alone."""

import numpy as np
import polars as pl
import pytest
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


def test_sound_aircraft_shows_nothing(fly) -> None:
    out = cross_checks(fly(40))
    assert out.height == 80
    assert out["running"].all()
    for sensor in SIGNALS:
        expected = 1.0 if sensor == "ram_out_k" else 0.0
        assert out[f"{sensor}_lost_share"].max() == expected
        assert not out[f"{sensor}_still"].any()
    assert out["door_span"].min() > 0.05
    assert out["door_peg_excess_k"].abs().max() < 1.3
    assert out["w_hx_out_between_packs_k"].std() < 2.0
    samples = fly(40)
    fault = late(samples)
    frozen = samples.with_columns(pl.when(fault).then(0.8).otherwise(pl.col("cc_flow_kg_s")).alias("cc_flow_kg_s"))
    every_second = fault & (pl.int_range(pl.len()) % 2 == 0)
    empty = samples.with_columns(pl.when(every_second).then(None).otherwise("hx_in_k").alias("hx_in_k"))
    before, after = witnesses(frozen)
    assert not before["cc_flow_kg_s_still"].any()
    assert after["cc_flow_kg_s_still"].all()
    assert witnesses(empty)[1]["hx_in_k_lost_share"].to_list() == pytest.approx([0.5] * 10)


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


def test_cross_checks_by_hand() -> None:
    row, s = first(both_packs()), {name: FLIGHT[name].to_numpy() for name in FLIGHT.columns}
    ln, shape = np.log, np.interp(s["tat_k"], (230.0, 250.0, 300.0), (-10.0, -10.0, 20.0))
    static_pa = 22_632.0 * np.exp(-9.80665 * (s["altitude_m"] - 11_000.0) / (287.053 * 216.65))
    pitot_pa = static_pa * (1.0 + 0.2 * s["mach"] ** 2) ** 3.5
    delivery = np.interp(s["altitude_m"], (5000.0, 15_000.0), (0.06, -0.04)) + 0.17 * s["pack_flow_kg_s"] ** 2
    above, door = s["hx_out_k"] - shape, s["ram_door_open"]
    free = door <= 0.95
    by_hand = {
        "w_inlet_minus_tat_k": np.median(s["cc_in_k"] - s["tat_k"]),
        "w_inlet_over_total_pressure_ln": np.median(ln(s["cc_in_pa"] / s["total_pressure_pa"])),
        "w_total_over_pitot_pressure_ln": np.median(ln(s["total_pressure_pa"] / pitot_pa)),
        "w_pack_over_compressor_flow_ln": np.median(ln(s["pack_flow_kg_s"] / s["cc_flow_kg_s"])),
        "w_tat_between_packs_k": -0.4, "w_total_pressure_between_packs_ln": -ln(1.003),
        "w_pack_flow_between_packs_ln": -ln(1.02), "w_compressor_flow_between_packs_ln": -ln(0.99),
        "w_cc_out_pressure_between_packs_ln": -ln(1.01), "w_hx_in_between_packs_k": 2.0,
        "w_cc_out_pressure_over_schedule_ln": np.median(ln(s["cc_out_pa"]) - delivery),
        "w_cc_out_between_packs_k": -3.0, "w_hx_out_minus_target_k": np.median(above[free]),
        "w_hx_out_between_packs_k": -1.5, "w_hx_out_between_packs_k_n": 3, "w_inlet_minus_tat_k_n": 6,
        "door_span": np.quantile(door, 0.95, method="nearest") - np.quantile(door, 0.05, method="nearest"),
        "door_max": 1.0, "door_n": 6, "door_travel": np.abs(np.diff(door)).sum(), "door_median": np.median(door),
        "door_full_open_share": 0.5, "tat_cruise_k": np.median(s["tat_k"]),
        "altitude_cruise_m": np.median(s["altitude_m"]), "mach_cruise": np.median(s["mach"]),
        "hx_in_cruise_k": np.median(s["hx_in_k"]), "hx_out_cruise_k": np.median(s["hx_out_k"]),
        "pack_flow_cruise_kg_s": np.median(s["pack_flow_kg_s"]),
        "cc_speed_cruise_rad_s": np.median(s["cc_speed_rad_s"]), "n_snapshots": 6, "flight_hours": 5.0 / 60.0,
        "hx_out_target_sd_k": above[free].std(ddof=1),
    }  # fmt: skip
    for name, value in by_hand.items():
        assert row[name] == pytest.approx(value, rel=1e-4, abs=2e-5), name
    at_limit = first(both_packs().with_columns(ram_door_open=pl.lit(0.95)))
    assert (at_limit["door_full_open_share"], at_limit["w_hx_out_minus_target_k_n"]) == (0.0, 6)
    assert row["door_peg_excess_k"] is None  # where the door is widest it has no authority


def test_witness_needs_three_samples() -> None:
    at, both = pl.int_range(pl.len()).over("pack"), both_packs()
    for n_valid, is_computed in ((3, True), (2, False)):
        row = first(both.with_columns(cc_in_k=pl.when(at < n_valid).then("cc_in_k")))
        assert (row["w_inlet_minus_tat_k"] is not None) is is_computed
        assert row["w_inlet_minus_tat_k_n"] == n_valid
    climb = first(both.with_columns(phase=pl.when(at < 4).then(pl.lit("climb")).otherwise("phase")))
    assert climb["w_inlet_minus_tat_k"] is None
    assert climb["w_hx_out_minus_target_k"] is not None
    for pa in (0.0, -1.0):
        row = first(both_packs().with_columns(cc_out_pa=pl.lit(pa), total_pressure_pa=pl.lit(pa)))
        assert row["w_cc_out_pressure_over_schedule_ln"] is None
        assert row["w_total_over_pitot_pressure_ln"] is None
        assert row["w_cc_out_pressure_between_packs_ln"] is None
    once = both_packs().with_columns(cc_in_pa=pl.when(pl.int_range(pl.len()) > 0).then("cc_in_pa").otherwise(0.0))
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
def test_resting_pack_is_no_witness(signal: str, check: str) -> None:
    for of in (1, 2):
        for flow, is_computed in ((0.2, False), (0.201, True)):
            rest = pl.when(pl.col("pack") == of).then(flow).otherwise(signal)
            value = first(both_packs().with_columns(rest.alias(signal)))[f"w_{check}"]
            if of == 1 or "between" in check:
                assert (value is not None) is is_computed


def test_still_sensor_needs_eight_readings() -> None:
    at = pl.int_range(pl.len())
    times = pl.col("time_utc").first() + pl.duration(minutes=2 * at)
    rows = pl.concat([FLIGHT, FLIGHT]).with_columns(times, source=pl.lit("acms"))
    for n, still in ((8, True), (7, False)):
        frozen = rows.with_columns(mach=pl.when(at < n).then(0.8))
        row = first(frozen)
        assert row["mach_still"] is still
        assert row["mach_lost_share"] == pytest.approx((12 - n) / 12)
        assert row["flight_hours"] == pytest.approx(22.0 / 60.0)
    moving = rows.with_columns(mach=0.8 + 0.001 * (at == 0))
    assert not first(moving)["mach_still"]


@pytest.mark.parametrize(
    ("pack_flow", "cc_flow", "running"), [(0.2, 0.2, 0), (0.201, 0.0, 1), (0.0, 0.201, 1), (None, 0.3, 1)]
)
def test_either_flow_marks_running_pack(pack_flow, cc_flow, running) -> None:
    flows = {"pack_flow_kg_s": pl.lit(pack_flow, pl.Float64), "cc_flow_kg_s": pl.lit(cc_flow, pl.Float64)}
    assert first(both_packs().with_columns(**flows))["running"] == bool(running)


def test_peg_excess_compares_stop() -> None:
    door = pl.Series("ram_door_open", [0.50, 0.49, 0.486, 0.485, 0.3, 0.2] * 2)
    s = both_packs().with_columns(door)
    row = first(s)
    above = FLIGHT["hx_out_k"].to_numpy() - np.interp(FLIGHT["tat_k"], (230.0, 250.0, 300.0), (-10.0, -10.0, 20.0))
    assert (row["door_peg_n"], row["door_off_peg_n"]) == (3, 3)
    assert row["door_peg_excess_k"] == pytest.approx(np.median(above[:3]) - np.median(above[3:]))


def test_jammed_door_leaves_target(fly) -> None:
    samples = fly(40)
    noise = 0.005 * (pl.int_range(pl.len()) % 3 - 1)
    door = pl.when(late(samples)).then(0.4 + noise).otherwise(pl.col("ram_door_open")).alias("ram_door_open")
    warm = pl.when(late(samples)).then(pl.col("hx_out_k") + pl.col("altitude_m") / 1000 - 6).otherwise("hx_out_k")
    before, after = witnesses(samples.with_columns(door, warm.alias("hx_out_k")))
    assert before["door_span"].min() > 0.05
    assert after["door_span"].max() < 0.02
    assert not after["ram_door_open_still"].any()
    assert after["hx_out_target_sd_k"].min() > 3 * before["hx_out_target_sd_k"].max()


def test_outlet_runs_warm_at_stop(fly) -> None:
    samples = fly(40)
    stop = 0.19
    lack = (pl.col("ram_door_open") - stop).clip(lower_bound=0.0)
    fault = late(samples)
    warm = pl.when(fault).then(pl.col("hx_out_k") + 100 * lack).otherwise(pl.col("hx_out_k")).alias("hx_out_k")
    door = pl.when(fault).then(pl.col("ram_door_open").clip(upper_bound=stop)).otherwise(pl.col("ram_door_open"))
    before, after = witnesses(samples.with_columns(warm, door.alias("ram_door_open")))
    assert before["door_peg_excess_k"].max() < 1.3
    assert after["door_peg_excess_k"].median() > 1.3


def test_pack_off_is_no_witness(fly) -> None:
    samples = fly(40)
    off = late(samples)
    flows = [pl.when(off).then(0.0).otherwise(pl.col(c)).alias(c) for c in ("pack_flow_kg_s", "cc_flow_kg_s")]
    out = cross_checks(samples.with_columns(flows))
    assert not out.filter(pl.col("pack") == 1).sort("departed_at").slice(FROM)["running"].any()
    other = out.filter(pl.col("pack") == 2).sort("departed_at").slice(FROM)
    assert other["running"].all()
    assert other["w_hx_out_between_packs_k"].null_count() == other.height
    out = cross_checks(fly(12).filter(pl.col("pack") == 1))
    assert out["w_hx_out_between_packs_k"].null_count() == out.height
    assert out["w_inlet_minus_tat_k"].null_count() == 0
    assert {f"w_{c}" for c in CHECKS} <= set(out.columns)
