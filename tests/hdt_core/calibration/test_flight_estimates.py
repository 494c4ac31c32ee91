"""One flight alone: truth recovered, biases apart, poor records survived; location, witnesses and slopes by hand."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, START, with_bias
from known_fleet import fleet_with_truth

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import (
    complete_air_data,
    cruise_samples,
    flights_of,
    level_points,
    to_points,
)
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.compressor import compressor_flights, compressor_samples
from hdt_core.calibration.flight_estimates import _locate, estimate_flights
from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure
from hdt_core.records.keys import PACK
from hdt_core.tables.twin import TwinFlights, TwinHealth
from hdt_core.tracking.track import track

KEY = {"operator": "TST", "tail": "T-1", "pack": 1, "flight_id": "F"}


def location(values: list[float]) -> tuple[float, float]:
    """Huber's estimate with the spread of the median of deviations, drawn to 0.025 with the weight of five samples."""
    x, n = np.array(values), len(values)
    centre = np.median(x)
    scale = np.sqrt(((1.4826 * np.median(np.abs(x - centre))) ** 2 * n + 0.025**2 * 5.0) / (n + 5.0))
    for _ in range(6):
        weight = np.minimum(1.0, 1.345 * scale / np.maximum(np.abs(x - centre), 1e-300))
        centre = weight @ x / weight.sum()
    return centre, scale / np.sqrt(weight.sum())


@pytest.mark.parametrize("values", [[0.1], [0.0, 0.01, 0.03, 0.02, 0.6], [0.0, 0.1, 0.3, -0.2, 0.11, 0.07, -0.9, 0.0]])
def test_flight_value_is_huber_location(values):
    rows = pl.DataFrame({**KEY, "r": values}, schema_overrides={"r": pl.Float64})
    other = rows.with_columns(pack=pl.lit(2), r=pl.col("r") + 5.0)
    located = _locate(pl.concat([other, rows]), "r", "x")
    np.testing.assert_allclose(located.filter(pack=1).select("x", "x_sd").row(0), location(values), rtol=1e-10)
    np.testing.assert_allclose(located.filter(pack=2)["x"][0], location(values)[0] + 5.0)
    assert located["n"].to_list() == [len(values)] * 2


@pytest.fixture(scope="module")
def flown() -> pl.DataFrame:
    """Two flights of an aircraft, eight samples each."""
    return fleet_with_truth(1, 2, seed=3).samples


BIASED = with_bias(("T-00", 1), pack_flow_kg_s=0.01, hx_in_k=0.5, hx_out_k=-0.4, tat_k=0.3, ram_door_open=0.005)


def test_ratio_is_cleared_of_bias(flown):
    twin = estimate_flights(flown, BIASED)
    own = flown.filter(pl.col("flight_id") == twin["flight_id"][0], pack=1)
    signals = {n: own[n].to_numpy().astype(float) for n in (*hx.SIGNALS, "ram_out_k")}
    bias = np.array(BIASED.packs[0].bias)[:, None]
    row = twin.row(0, named=True)
    ratio, balance = (f(signals, DSM.design, bias) for f in (hx.ln_conductance_ratio, hx.ln_ram_flow_ratio))
    assert (row["ln_ua_ratio"], row["ln_ua_ratio_sd"]) == pytest.approx(location(list(ratio)))
    assert (row["ln_ram_ratio"], row["ln_ram_ratio_sd"]) == pytest.approx(location(list(balance)))
    hot_in, hot_out, tat = signals["hx_in_k"] - 0.5, signals["hx_out_k"] + 0.4, signals["tat_k"] - 0.3
    assert row["effectiveness"] == pytest.approx(np.median((hot_in - hot_out) / (hot_in - tat)))
    assert row["ua_w_k"] == pytest.approx(row["ua_expected_w_k"] * np.exp(row["ln_ua_ratio"]))
    assert row["flows_apart_ln"] == pytest.approx(np.median(np.log(own["pack_flow_kg_s"] / own["cc_flow_kg_s"])))
    assert row["tat_apart_k"] == pytest.approx((own["tat_k"] - own["cc_in_k"]).median())
    assert row["expected_diameter_m"] == pytest.approx(0.18 - 2e-5 * row["vda_counts"])
    assert row["n_samples"] == 8
    # a sensor that reads one unit more, the flow's by its logarithm: forward differences
    at = {n: np.array([np.median(v)]) for n, v in signals.items()}
    here = hx.ln_conductance_ratio(at, DSM.design, bias)
    for name, signal, size in (("ratio_per_exit_k", "hx_out_k", 0.01), ("ratio_per_tat_k", "tat_k", 0.01),
                               ("ratio_per_inlet_k", "hx_in_k", 0.01), ("ratio_per_door", "ram_door_open", 1e-4),
                               ("ratio_per_ln_flow", "pack_flow_kg_s", 1e-4)):  # fmt: skip
        less = bias - size * (np.array(hx.BIASES) == signal)[:, None]
        slope = (hx.ln_conductance_ratio(at, DSM.design, less) - here)[0] / size
        assert row[name] == pytest.approx(slope, rel=1e-8)
    for name, signal, size in (("ratio_per_exit_k", "hx_out_k", 1e-3), ("ratio_per_tat_k", "tat_k", 1e-3),
                               ("ratio_per_inlet_k", "hx_in_k", 1e-3), ("ratio_per_door", "ram_door_open", 1e-4),
                               ):  # fmt: skip
        up, down = (hx.ln_conductance_ratio(at | {signal: at[signal] + d}, DSM.design, bias) for d in (size, -size))
        assert row[name] == pytest.approx((up - down)[0] / (2 * size), rel=1e-2)
    scaled = [at | {"pack_flow_kg_s": at["pack_flow_kg_s"] * f} for f in (1.001, 0.999)]
    flows = [hx.ln_conductance_ratio(s, DSM.design, bias)[0] for s in scaled]
    assert row["ratio_per_ln_flow"] == pytest.approx((flows[0] - flows[1]) / 0.002, rel=1e-2)
    gradient = np.array([
        (hx.ln_conductance_ratio(at, DSM.design + e, bias) - hx.ln_conductance_ratio(at, DSM.design - e, bias))[0]
        for e in 1e-5 * np.eye(len(hx.NAMES))
    ]) / 2e-5  # fmt: skip
    assert row["ln_ua_ratio_map_sd"] == pytest.approx(0.1 * np.linalg.norm(gradient), rel=1e-3)
    anchored = replace(BIASED, gradient=tuple(0.5 * gradient))  # half of it is the model's own level's
    half_sd = estimate_flights(flown, anchored)["ln_ua_ratio_map_sd"][0]
    assert half_sd == pytest.approx(0.05 * np.linalg.norm(gradient), rel=1e-3)
    np.testing.assert_allclose(hx.design_gradient(at, DSM.design, bias, here)[0], gradient, rtol=1e-2, atol=1e-4)


def test_climb_reveals_door_error(flown):
    """Four samples or more, with air through the pack: their median over the cruise."""
    climb = flown.filter(pack=1).group_by("flight_id", maintain_order=True).head(4).with_columns(
        phase=pl.lit("climb"), time_utc=pl.col("time_utc") - timedelta(hours=1),
        ram_door_open=pl.col("ram_door_open") + 0.1
    )  # fmt: skip
    both = pl.concat([flown, climb])
    twin = estimate_flights(both, DSM).filter(pack=1)
    own = climb.filter(pl.col("flight_id") == twin["flight_id"][0])
    signals = {n: own[n].to_numpy().astype(float) for n in hx.SIGNALS}
    ratio = np.median(hx.ln_conductance_ratio(signals, DSM.design, np.zeros((6, 1))))
    assert twin["door_apart_ln"][0] == pytest.approx(ratio - twin["ln_ua_ratio"][0])
    late = pl.int_range(pl.len()).over("flight_id") == 0
    climb = climb.with_columns(total_pressure_pa=pl.lit(None, pl.Float64))  # by height and Mach number
    limits = {"altitude_m": (2500.0, 2501.0), "pack_flow_kg_s": (0.2, 0.201), "phase": ("taxi", "descent")}
    for column, (off, on) in limits.items():
        for value, n_null in ((off, 4), (on, 2)):
            odd = climb.with_columns(pl.when(late).then(pl.lit(value)).otherwise(column).alias(column))
            assert estimate_flights(pl.concat([flown, odd]), DSM)["door_apart_ln"].null_count() == n_null


@pytest.mark.parametrize(("change", "status"), [
    ({"phase": "climb"}, "no_cruise"), ({"monitored": False}, "no_cruise"), ({"hx_out_k": None}, "no_cruise"),
    ({}, "ok"),
])  # fmt: skip
def test_flight_without_cruise_is_silent(flown, change, status):
    odd = flown.with_columns(pl.lit(v, dtype=flown.schema[c]).alias(c) for c, v in change.items())
    twin = estimate_flights(odd, DSM)
    assert twin["status"].unique().to_list() == [status]
    assert twin.height == 4
    assert (twin["n_samples"] == 0).all() == (status == "no_cruise")
    assert (twin["cc_n_samples"] > 0).all() == ("phase" not in change)


def test_flight_needs_three_samples(flown):
    pair, three = (flown.group_by("flight_id", "pack").head(n) for n in (2, 3))
    assert estimate_flights(pair, DSM)["status"].unique().to_list() == ["few_samples"]
    assert estimate_flights(three, DSM)["status"].unique().to_list() == ["ok"]
    at = hx.NAMES.index("ln_ua_reference")
    ratio = estimate_flights(flown, DSM)["ln_ua_ratio"][0]
    for off, status in ((4.99, "ok"), (5.01, "implausible"), (-5.01, "implausible")):
        design = list(DSM.exchanger)
        design[at] += ratio - off
        twin = estimate_flights(flown, type(DSM).from_dict(DSM.to_dict() | {"exchanger": design})).row(0, named=True)
        assert twin["status"] == status
        assert (twin["ln_ua_ratio"] is None) == (twin["ua_w_k"] is None) == (status != "ok")


def test_air_data_fill_gaps():
    rows = pl.DataFrame({**KEY, "altitude_m": [1e4, 1e4], "mach": [None, 0.8], "total_pressure_pa": [4e4, None]})
    filled = complete_air_data(rows)
    static = float(standard_pressure_pa(np.float64(1e4)))
    assert total_to_static_pressure(filled["mach"].to_numpy())[0] * static == pytest.approx(4e4)
    assert filled["total_pressure_pa"][1] == pytest.approx(static * total_to_static_pressure(np.float64(0.8)))
    assert (filled["mach"][1], filled["total_pressure_pa"][0]) == (0.8, 4e4)
    assert filled["cc_in_k"].null_count() == 2


def test_points_are_medians_of_levels(flown):
    """Levels of 300 m."""
    own = cruise_samples(flown).filter(pack=1)
    own = own.with_columns(altitude_m=pl.lit(10500.0) + pl.Series([0.0, 140.0, 160.0, -140.0, 0, 0, 0, 0] * 2))
    points = level_points(own, flights_of(own))
    assert points["n_samples"].to_list() == [7.0, 1.0] * 2
    assert points["order"].to_list() == [0, 0, 1, 1]
    first = own.filter(pl.col("flight_id") == points["flight_id"][0]).sort("time_utc")
    assert points["tat_k"][0] == first["tat_k"].gather([0, 1, 3, 4, 5, 6, 7]).median()
    packs = flown.select(PACK).unique().sort(PACK)
    assert to_points(points, packs).pack.tolist() == [0] * 4


def test_compressor_samples_by_hand():
    """Inlet by the air data at the flight's own distance; pressures averaged over five samples along a level."""
    n = 7
    rows = pl.DataFrame({
        **KEY, "time_utc": [START + timedelta(minutes=k) for k in range(n)], "altitude_m": [1e4] * 6 + [1.1e4],
        "tat_k": [250.0 + k for k in range(n)], "cc_in_k": [252.0 + k for k in range(6)] + [None],
        "total_pressure_pa": [3e4] * n, "cc_in_pa": [2.7e4] * 5 + [2.4e4] * 2,
        "cc_out_pa": [9e4 + 100.0 * k**2 for k in range(n)],
        "cc_out_k": [400.0] * n, "cc_speed_rad_s": [3400.0] * 6 + [0.0], "cc_flow_kg_s": [0.8] * n,
    })  # fmt: skip
    none = pl.DataFrame({**{k: KEY[k] for k in PACK}, "inlet_bias_k": 1.0, "inlet_bias_ln": 0.01, "exit_bias_ln": 0.02})
    result = compressor_samples(rows, none)
    np.testing.assert_allclose(result["inlet_k"], np.array([253, 253.5, 254, 255, 255.5, 256, 258]) - 1.0)
    np.testing.assert_allclose(result["inlet_pa"], 2.7e4 * np.exp(-0.01))
    plain = compressor_samples(rows, none.clear())  # a pack without corrections
    np.testing.assert_allclose(plain["inlet_k"], result["inlet_k"] + 1.0)
    np.testing.assert_allclose(plain["inlet_pa"], 2.7e4)
    raw = rows["cc_out_pa"].to_numpy()
    spans = ((0, 3), (0, 4), (0, 5), (1, 6), (2, 6), (3, 6))
    means = np.array([raw[a:b].mean() for a, b in spans])
    out_pa, in_pa, in_k = means * np.exp(-0.02), 2.7e4 * np.exp(-0.01), result["inlet_k"].to_numpy()[:6]
    rise = in_k * ((out_pa / in_pa) ** (0.4 / 1.4) - 1.0)
    np.testing.assert_allclose(result["efficiency"][:6], rise / (400.0 - in_k), rtol=2e-3)
    plain_rise = plain["inlet_k"].to_numpy()[:6] * ((means / 2.7e4) ** (0.4 / 1.4) - 1.0)
    np.testing.assert_allclose(plain["efficiency"][:6], plain_rise / (401.0 - in_k - 2.0), rtol=2e-3)
    assert result["diameter_m"].null_count() == result["group_m3"].null_count() == 1
    # a machine without flow has no group, one that cools no efficiency
    idle = compressor_samples(rows.with_columns(cc_flow_kg_s=pl.lit(0.0), cc_out_k=pl.lit(240.0)), none)
    assert idle["group_m3"].null_count() == idle["efficiency"].null_count() == n
    flight = compressor_flights(result.with_columns(vda_counts=pl.lit(400.0))).row(0, named=True)
    d = result["diameter_m"].drop_nulls().to_numpy()
    assert flight["diameter_m"] == pytest.approx(np.median(d))
    scatter = 1.4826 * np.median(np.abs(d - np.median(d)))
    assert flight["diameter_m_se"] == pytest.approx(scatter * 1.2533 / np.sqrt(6.0))
    assert flight["cc_n_samples"] == 6


SIGNALS = ("hx_out_k", "hx_in_k", "pack_flow_kg_s")


def followed(fleet):
    model = calibrate(fleet.samples, fleet.legs, fleet.maintenance)
    return estimate_flights(fleet.samples, model), model


def test_ratio_follows_true_loss(flights, fleet, model):
    """Whatever the offset of its pack."""
    joined = flights.join(fleet.truth, on=["tail", "flight_id", "pack"])
    offset_column = (pl.col("ln_ua_ratio") - (1.0 - pl.col("loss")).log()).alias("offset")
    offset = joined.with_columns(offset_column).group_by("tail", "pack").agg(pl.col("offset").std())
    assert offset["offset"].max() < 0.03
    rows = flights.filter(TwinFlights.flight_id.col.str.len_chars() > 0)
    named = rows.with_columns(operator=pl.lit("TST"))
    assert TwinFlights.faults(named) == []
    assert TwinHealth.faults(track(flights, fleet.maintenance, model).health) == []


def test_flight_is_estimated_alone(fleet, model, flights):
    one = flights["flight_id"][17]
    alone = estimate_flights(fleet.samples.filter(pl.col("flight_id") == one), model)
    among = flights.filter(pl.col("flight_id") == one)
    for column in ("ln_ua_ratio", "ln_ua_ratio_sd", "diameter_m", "effectiveness"):
        np.testing.assert_allclose(alone[column].to_numpy(), among[column].to_numpy(), rtol=1e-12)
    tail = fleet.samples.filter(pl.col("tail") == "T-00")
    even = pl.int_range(pl.len()).over("flight_id", "pack") % 2 == 0
    logged = tail.with_columns(source=pl.when(even).then(pl.lit("cpl")).otherwise(pl.lit("acms")))
    both = estimate_flights(logged, model)
    for source in ("cpl", "acms"):
        only = estimate_flights(logged.filter(pl.col("source") == source), model)
        assert (only["n_samples"] < both["n_samples"]).all()
        assert (only["status"] == "ok").all()
        apart = only["ln_ua_ratio"] - both["ln_ua_ratio"]
        assert apart.abs().max() < 6.0 * only["ln_ua_ratio_sd"].max()


@pytest.mark.parametrize("column", SIGNALS)
def test_missing_signal_gives_no_estimate(fleet, model, column):
    deaf = (pl.col("tail") == "T-01") & (pl.col("pack") == 2)
    samples = fleet.samples.with_columns(pl.when(~deaf).then(pl.col(column)).alias(column))
    twin = estimate_flights(samples, model)
    silent = twin.filter(deaf)
    assert silent.height == 120
    assert silent["status"].unique().to_list() == ["no_cruise"]
    rows = track(twin, fleet.maintenance, model).health.filter(deaf & (pl.col("parameter") == "hx_fouling"))
    assert rows["status"].unique().to_list() == ["predicted"]
    assert (rows["sd"] > 0.04).all()


def test_climb_only_gives_no_estimate(fleet, model, flights):
    climbing = fleet.only("T-00").samples.with_columns(phase=pl.lit("climb"))
    twin = estimate_flights(climbing, model)
    assert twin["status"].unique().to_list() == ["no_cruise"]
    rows = track(twin, fleet.maintenance, model).health
    assert set(rows["status"]) == {"predicted", "not_recorded", "not_identifiable"}
    blind = fleet_with_truth(5, 120, ram_out=False)
    twin, guess = followed(blind)
    assert twin["ln_ram_ratio"].null_count() == twin.height
    tracks = (track(f, blind.maintenance, m).health for f, m in ((twin, guess), (flights, model)))
    rows, metered = (health.filter(pl.col("parameter") == "hx_fouling") for health in tracks)
    assert rows["sd"].mean() > metered["sd"].mean()
    off = rows.join(blind.truth, on=["tail", "flight_id", "pack"]).with_columns(e=pl.col("value") - pl.col("loss"))
    assert off.select((pl.col("e").abs() < 1.645 * pl.col("sd")).mean()).item() > 0.75


@pytest.mark.parametrize(("tails", "n_flights"), [(1, 30), (1, 3), (2, 1)])
def test_small_fleet_has_wide_doubt(tails, n_flights):
    fleet = fleet_with_truth(tails, n_flights, seed=5)
    twin, model = followed(fleet)
    rows = track(twin, fleet.maintenance, model).health.filter(pl.col("parameter") == "hx_fouling")
    assert rows.height == 2 * tails * n_flights
    assert rows["sd"].min() > 0.015
    off = (rows.join(fleet.truth, on=["tail", "flight_id", "pack"])["value"] - 0.0).abs()
    assert off.max() < 0.2


def test_climb_separates_door_from_wear(fleet, model):
    climb = (
        fleet.samples.filter(pl.col("phase") == "cruise")
        .group_by("operator", "tail", "pack", "flight_id")
        .head(6)
        .with_columns(phase=pl.lit("climb"), time_utc=pl.col("time_utc") - pl.duration(hours=3))
        # less air is asked for lower down: a smaller opening does
        .with_columns(ram_door_open=0.5 * pl.col("ram_door_open"))
    )
    both = pl.concat([fleet.samples, climb.select(fleet.samples.columns)])
    still = climb.select(fleet.samples.columns).with_columns(mach=pl.lit(0.0), total_pressure_pa=pl.lit(2e4))
    estimate_flights(pl.concat([fleet.samples, still]), model)  # no ram pressure: no word, no warning
    sound = estimate_flights(both, model)["door_apart_ln"]
    off = estimate_flights(both.with_columns(pl.col("ram_door_open") + 0.05), model)["door_apart_ln"]
    worn = estimate_flights(both.with_columns(pl.col("hx_out_k") + 3.0), model)["door_apart_ln"]
    assert sound.is_not_null().mean() > 0.9
    assert (off - sound).median() < -0.03
    assert abs((worn - sound).median()) < 0.5 * abs((off - sound).median())
