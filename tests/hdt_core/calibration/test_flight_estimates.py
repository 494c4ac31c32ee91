"""One flight alone: truth recovered, biases apart, poor records survived; location, witnesses and slopes by hand."""

from dataclasses import replace
from datetime import timedelta

import numpy as np
import polars as pl
import pytest
from alter import alter
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
from hdt_core.flight import quality
from hdt_core.flight.quality import flow_steps
from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure
from hdt_core.records.keys import PACK
from hdt_core.tables.twin import TwinFlights, TwinHealth
from hdt_core.tracking.track import track

KEY = {"operator": "TST", "tail": "T-1", "pack": 1, "flight_id": "F"}


def location(values: list[float]) -> tuple[float, float]:
    """Huber's estimate with the spread of the median of deviations, drawn to 0.025 with the weight of five samples."""
    x = np.array(values)
    centre = np.median(x)
    scale = np.sqrt(((1.4826 * np.median(np.abs(x - centre))) ** 2 * x.size + 0.025**2 * 5.0) / (x.size + 5.0))
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
def two_flights() -> pl.DataFrame:
    """Two flights of an aircraft, eight samples each."""
    return fleet_with_truth(1, 2, seed=3).samples


BIASED = with_bias(("T-00", 1), pack_flow_kg_s=0.01, hx_in_k=0.5, hx_out_k=-0.4, tat_k=0.3, ram_door_open=0.005)


BIAS = np.array(BIASED.packs[0].bias)[:, None]


def test_rounding_of_flow_widens_estimate(two_flights, monkeypatch):
    """By a twelfth of the step's square, whatever the number of samples."""
    step = 0.076
    flow = pl.col("pack_flow_kg_s") + 0.1 * pl.col("pack")
    coarse = two_flights.with_columns((flow / step).round() * step)
    flight = estimate_flights(coarse, DSM).row(0, named=True)
    step_ln = flow_steps(coarse).filter(flight_id=flight["flight_id"])["pack_flow_step_ln"].item()
    monkeypatch.setattr(quality, "COARSE_FLOW_KG_S", 1.0)
    random_sd = estimate_flights(coarse, DSM).row(0, named=True)["ln_ua_ratio_sd"]
    rounding_sd = flight["ratio_per_ln_flow"] * step_ln / np.sqrt(12.0)
    assert rounding_sd > 0.02
    assert flight["ln_ua_ratio_sd"] == pytest.approx(np.hypot(random_sd, rounding_sd))


@pytest.fixture(scope="module")
def own(two_flights) -> pl.DataFrame:
    """Samples of the first flight of the biased pack."""
    return two_flights.filter(pl.col("flight_id") == two_flights["flight_id"].min(), pack=1)


@pytest.fixture(scope="module")
def own_signals(own) -> dict[str, np.ndarray]:
    return {n: own[n].to_numpy().astype(float) for n in (*hx.SIGNALS, "ram_out_k")}


@pytest.fixture(scope="module")
def middle(own_signals) -> dict[str, np.ndarray]:
    """Its middle operating point."""
    return {n: np.array([np.median(v)]) for n, v in own_signals.items()}


@pytest.fixture(scope="module")
def estimate(two_flights) -> dict[str, object]:
    """What is estimated of it."""
    return estimate_flights(two_flights, BIASED).row(0, named=True)


@pytest.mark.parametrize(
    ("name", "ratio"), [("ln_ua_ratio", hx.ln_conductance_ratio), ("ln_ram_ratio", hx.ln_ram_flow_ratio)]
)
def test_ratio_is_cleared_of_bias(estimate, own_signals, name, ratio):
    expected = location(list(ratio(own_signals, DSM.design, BIAS)))
    assert (estimate[name], estimate[f"{name}_sd"]) == pytest.approx(expected)


def test_flight_figures_are_medians(estimate, own, own_signals):
    hot_in = own_signals["hx_in_k"] - 0.5
    effectiveness = (hot_in - (own_signals["hx_out_k"] + 0.4)) / (hot_in - (own_signals["tat_k"] - 0.3))
    expected = {
        "effectiveness": np.median(effectiveness), "n_samples": 8,
        "ua_w_k": estimate["ua_expected_w_k"] * np.exp(estimate["ln_ua_ratio"]),
        "flows_apart_ln": np.median(np.log(own["pack_flow_kg_s"] / own["cc_flow_kg_s"])),
        "tat_apart_k": (own["tat_k"] - own["cc_in_k"]).median(),
        "expected_diameter_m": 0.18 - 2e-5 * estimate["vda_counts"],
    }  # fmt: skip
    assert {name: estimate[name] for name in expected} == pytest.approx(expected)


SLOPES = {"ratio_per_exit_k": ("hx_out_k", 0.01), "ratio_per_tat_k": ("tat_k", 0.01),
          "ratio_per_inlet_k": ("hx_in_k", 0.01), "ratio_per_door": ("ram_door_open", 1e-4),
          "ratio_per_ln_flow": ("pack_flow_kg_s", 1e-4)}  # fmt: skip
"""A sensor that reads one unit more, the flow's by its logarithm; and the step of its difference."""


def ratio_at(signals: dict[str, np.ndarray], design: np.ndarray = DSM.design, bias: np.ndarray = BIAS) -> float:
    return hx.ln_conductance_ratio(signals, design, bias)[0]


@pytest.mark.parametrize(("name", "signal", "size"), [(n, *v) for n, v in SLOPES.items()])
def test_slopes_are_forward_differences(estimate, middle, name, signal, size):
    less = BIAS - size * (np.array(hx.BIASES) == signal)[:, None]
    slope = (ratio_at(middle, bias=less) - ratio_at(middle)) / size
    assert estimate[name] == pytest.approx(slope, rel=1e-8)


@pytest.mark.parametrize("name", SLOPES)
def test_slopes_are_of_readings(estimate, middle, name):
    signal, _ = SLOPES[name]
    unit = middle[signal] if name == "ratio_per_ln_flow" else 1.0
    up, down = (ratio_at(middle | {signal: middle[signal] + step * unit}) for step in (1e-4, -1e-4))
    assert estimate[name] == pytest.approx((up - down) / 2e-4, rel=1e-2)


@pytest.fixture(scope="module")
def gradient(middle) -> np.ndarray:
    """Slopes of the ratio by each value of the design."""
    steps = 1e-5 * np.eye(len(hx.NAMES))
    return np.array([ratio_at(middle, DSM.design + e) - ratio_at(middle, DSM.design - e) for e in steps]) / 2e-5


def test_map_error_follows_design(estimate, gradient):
    assert estimate["ln_ua_ratio_map_sd"] == pytest.approx(0.1 * np.linalg.norm(gradient), rel=1e-3)


def test_map_error_excludes_own_level(two_flights, gradient):
    """Half of the gradient is the model's own level's."""
    anchored = replace(BIASED, gradient=tuple(0.5 * gradient))
    half_sd = estimate_flights(two_flights, anchored)["ln_ua_ratio_map_sd"][0]
    assert half_sd == pytest.approx(0.05 * np.linalg.norm(gradient), rel=1e-3)


def test_design_gradient_is_central_difference(middle, gradient):
    here = hx.ln_conductance_ratio(middle, DSM.design, BIAS)
    np.testing.assert_allclose(hx.design_gradient(middle, DSM.design, BIAS, here)[0], gradient, rtol=1e-2, atol=1e-4)


@pytest.fixture(scope="module")
def climb(two_flights) -> pl.DataFrame:
    """Four samples of each flight as a climb, the door opened further."""
    return two_flights.filter(pack=1).group_by("flight_id", maintain_order=True).head(4).with_columns(
        phase=pl.lit("climb"), time_utc=pl.col("time_utc") - timedelta(hours=1),
        ram_door_open=pl.col("ram_door_open") + 0.1
    )  # fmt: skip


def test_climb_reveals_door_error(two_flights, climb):
    """Four samples or more, with air through the pack: their median over the cruise."""
    twin = estimate_flights(pl.concat([two_flights, climb]), DSM).filter(pack=1)
    first = climb.filter(pl.col("flight_id") == twin["flight_id"][0])
    signals = {n: first[n].to_numpy().astype(float) for n in hx.SIGNALS}
    ratio = np.median(hx.ln_conductance_ratio(signals, DSM.design, np.zeros((6, 1))))
    assert twin["door_apart_ln"][0] == pytest.approx(ratio - twin["ln_ua_ratio"][0])


@pytest.mark.parametrize(
    ("column", "value", "n_null"),
    [
        ("altitude_m", 2500.0, 4), ("altitude_m", 2501.0, 2), ("pack_flow_kg_s", 0.2, 4), ("pack_flow_kg_s", 0.201, 2),
        ("phase", "taxi", 4), ("phase", "descent", 2),
    ],
)  # fmt: skip
def test_climb_needs_four_samples(two_flights, climb, column, value, n_null):
    """Above 2,500 m, in climb or descent of a running pack; total pressure is known by height and Mach number."""
    silent = climb.with_columns(total_pressure_pa=pl.lit(None, pl.Float64))
    odd = alter(silent, pl.int_range(pl.len()).over("flight_id") == 0, **{column: pl.lit(value)})
    assert estimate_flights(pl.concat([two_flights, odd]), DSM)["door_apart_ln"].null_count() == n_null


@pytest.mark.parametrize(("change", "status"), [
    ({"phase": "climb"}, "no_cruise"), ({"monitored": False}, "no_cruise"), ({"hx_out_k": None}, "no_cruise"),
    ({}, "ok"),
])  # fmt: skip
def test_flight_without_cruise_is_silent(two_flights, change, status):
    odd = two_flights.with_columns(pl.lit(v, dtype=two_flights.schema[c]).alias(c) for c, v in change.items())
    twin = estimate_flights(odd, DSM)
    assert twin["status"].unique().to_list() == [status]
    assert twin.height == 4
    assert (twin["n_samples"] == 0).all() == (status == "no_cruise")
    assert (twin["cc_n_samples"] > 0).all() == ("phase" not in change)


@pytest.mark.parametrize(("n", "status"), [(2, "few_samples"), (3, "ok")])
def test_flight_needs_three_samples(two_flights, n, status):
    few = two_flights.group_by("flight_id", "pack").head(n)
    assert estimate_flights(few, DSM)["status"].unique().to_list() == [status]


@pytest.mark.parametrize(("off", "status"), [(4.99, "ok"), (5.01, "implausible"), (-5.01, "implausible")])
def test_implausible_ratio_is_withheld(two_flights, off, status):
    """No core is 150 times another."""
    design = list(DSM.exchanger)
    design[hx.NAMES.index("ln_ua_reference")] += estimate_flights(two_flights, DSM)["ln_ua_ratio"][0] - off
    row = estimate_flights(two_flights, replace(DSM, exchanger=tuple(design))).row(0, named=True)
    assert row["status"] == status
    assert (row["ln_ua_ratio"] is None) == (row["ua_w_k"] is None) == (status != "ok")


def test_air_data_fill_gaps():
    rows = pl.DataFrame({**KEY, "altitude_m": [1e4, 1e4], "mach": [None, 0.8], "total_pressure_pa": [4e4, None]})
    filled = complete_air_data(rows)
    static = float(standard_pressure_pa(np.float64(1e4)))
    mach, pressure = (filled[c].to_numpy() for c in ("mach", "total_pressure_pa"))
    assert (mach[1], pressure[0]) == (0.8, 4e4)
    np.testing.assert_allclose(static * total_to_static_pressure(mach), pressure, rtol=1e-6)
    assert filled["cc_in_k"].null_count() == 2


def test_points_are_medians_of_levels(two_flights):
    """Levels of 300 m."""
    own = cruise_samples(two_flights).filter(pack=1)
    own = own.with_columns(altitude_m=pl.lit(10500.0) + pl.Series([0.0, 140.0, 160.0, -140.0, 0, 0, 0, 0] * 2))
    points = level_points(own, flights_of(own))
    assert points["n_samples"].to_list() == [7.0, 1.0] * 2
    assert points["order"].to_list() == [0, 0, 1, 1]
    first = own.filter(pl.col("flight_id") == points["flight_id"][0]).sort("time_utc")
    assert points["tat_k"][0] == first["tat_k"].gather([0, 1, 3, 4, 5, 6, 7]).median()
    packs = two_flights.select(PACK).unique().sort(PACK)
    assert to_points(points, packs).pack.tolist() == [0] * 4


N = 7
MACHINE = pl.DataFrame({
    **KEY, "time_utc": [START + timedelta(minutes=k) for k in range(N)], "altitude_m": [1e4] * 6 + [1.1e4],
    "tat_k": [250.0 + k for k in range(N)], "cc_in_k": [252.0 + k for k in range(6)] + [None],
    "total_pressure_pa": [3e4] * N, "cc_in_pa": [2.7e4] * 5 + [2.4e4] * 2,
    "cc_out_pa": [9e4 + 100.0 * k**2 for k in range(N)],
    "cc_out_k": [400.0] * N, "cc_speed_rad_s": [3400.0] * 6 + [0.0], "cc_flow_kg_s": [0.8] * N,
})  # fmt: skip
CORRECTIONS = pl.DataFrame(
    {**{k: KEY[k] for k in PACK}, "inlet_bias_k": 1.0, "inlet_bias_ln": 0.01, "exit_bias_ln": 0.02}
)
INLET_K = np.array([253, 253.5, 254, 255, 255.5, 256, 258])
"""The air data's at the flight's own distance."""


@pytest.mark.parametrize(
    ("corrections", "off_k", "off_ln"), [(CORRECTIONS, 1.0, 0.01), (CORRECTIONS.clear(), 0.0, 0.0)], ids=["own", "none"]
)
def test_compressor_inlet_is_its_levels(corrections, off_k, off_ln):
    samples = compressor_samples(MACHINE, corrections)
    np.testing.assert_allclose(samples["inlet_k"], INLET_K - off_k)
    np.testing.assert_allclose(samples["inlet_pa"], 2.7e4 * np.exp(-off_ln))


@pytest.mark.parametrize(
    ("corrections", "off_k", "in_ln", "out_ln"),
    [(CORRECTIONS, 1.0, 0.01, 0.02), (CORRECTIONS.clear(), 0.0, 0.0, 0.0)],
    ids=["own", "none"],
)
def test_efficiency_averages_pressures(corrections, off_k, in_ln, out_ln):
    """Over five samples along a level."""
    raw = MACHINE["cc_out_pa"].to_numpy()
    means = np.array([raw[a:b].mean() for a, b in ((0, 3), (0, 4), (0, 5), (1, 6), (2, 6), (3, 6))])
    in_k = INLET_K[:6] - off_k
    rise = in_k * ((means * np.exp(-out_ln) / (2.7e4 * np.exp(-in_ln))) ** (0.4 / 1.4) - 1.0)
    efficiency = compressor_samples(MACHINE, corrections)["efficiency"][:6]
    np.testing.assert_allclose(efficiency, rise / (400.0 - in_k), rtol=2e-3)


def test_machine_at_rest_has_no_diameter():
    samples = compressor_samples(MACHINE, CORRECTIONS)
    assert samples["diameter_m"].null_count() == samples["group_m3"].null_count() == 1


@pytest.mark.parametrize(
    ("column", "value", "figure"), [("cc_flow_kg_s", 0.0, "group_m3"), ("cc_out_k", 240.0, "efficiency")]
)
def test_idle_machine_has_no_group(column, value, figure):
    """Nor has one that cools an efficiency."""
    idle = compressor_samples(MACHINE.with_columns(pl.lit(value).alias(column)), CORRECTIONS)
    assert idle[figure].null_count() == N


def test_flight_diameter_is_median():
    samples = compressor_samples(MACHINE, CORRECTIONS).with_columns(vda_counts=pl.lit(400.0))
    flight = compressor_flights(samples).row(0, named=True)
    d = samples["diameter_m"].drop_nulls().to_numpy()
    scatter = 1.4826 * np.median(np.abs(d - np.median(d)))
    expected = {
        "diameter_m": np.median(d), "diameter_m_se": scatter * 1.2533 / np.sqrt(6.0), "cc_n_samples": 6,
    }  # fmt: skip
    assert {name: flight[name] for name in expected} == pytest.approx(expected)


SIGNALS = ("hx_out_k", "hx_in_k", "pack_flow_kg_s")


def follow(fleet):
    model = calibrate(fleet.samples, fleet.legs, fleet.maintenance)
    return estimate_flights(fleet.samples, model), model


def fouling_of(twin: pl.DataFrame, fleet, model) -> pl.DataFrame:
    """Tracked loss of conductance."""
    return track(twin, fleet.maintenance, model).health.filter(parameter="hx_fouling")


def test_ratio_follows_true_loss(flights, fleet):
    """Whatever the offset of its pack."""
    joined = flights.join(fleet.truth, on=["tail", "flight_id", "pack"])
    offset = joined.group_by("tail", "pack").agg((pl.col("ln_ua_ratio") - (1.0 - pl.col("loss")).log()).std())
    assert offset["ln_ua_ratio"].max() < 0.03


def test_flight_tables_are_as_declared(flights, fleet, model):
    rows = flights.filter(TwinFlights.flight_id.col.str.len_chars() > 0)
    assert TwinFlights.faults(rows.with_columns(operator=pl.lit("TST"))) == []
    assert TwinHealth.faults(track(flights, fleet.maintenance, model).health) == []


def test_flight_is_estimated_alone(fleet, model, flights):
    one = pl.col("flight_id") == flights["flight_id"][17]
    alone = estimate_flights(fleet.samples.filter(one), model)
    columns = ("ln_ua_ratio", "ln_ua_ratio_sd", "diameter_m", "effectiveness")
    np.testing.assert_allclose(alone.select(columns), flights.filter(one).select(columns), rtol=1e-12)


@pytest.mark.parametrize("source", ["cpl", "acms"])
def test_one_source_estimates_like_both(fleet, model, source):
    even = pl.int_range(pl.len()).over("flight_id", "pack") % 2 == 0
    tail = fleet.only("T-00").samples.with_columns(source=pl.when(even).then(pl.lit("cpl")).otherwise(pl.lit("acms")))
    both, only = (estimate_flights(rows, model) for rows in (tail, tail.filter(source=source)))
    assert (only["n_samples"] < both["n_samples"]).all()
    assert (only["status"] == "ok").all()
    assert (only["ln_ua_ratio"] - both["ln_ua_ratio"]).abs().max() < 6.0 * only["ln_ua_ratio_sd"].max()


@pytest.mark.parametrize("column", SIGNALS)
def test_missing_signal_gives_no_estimate(fleet, model, column):
    """It has rows all the same."""
    deaf = (pl.col("tail") == "T-01") & (pl.col("pack") == 2)
    twin = estimate_flights(alter(fleet.samples, deaf, **{column: None}), model)
    rows = fouling_of(twin, fleet, model).filter(deaf)
    assert twin.filter(deaf)["status"].to_list() == ["no_cruise"] * 120
    assert rows["status"].unique().to_list() == ["predicted"]
    assert (rows["sd"] > 0.04).all()


def test_climb_only_gives_no_estimate(fleet, model):
    climbing = fleet.only("T-00").samples.with_columns(phase=pl.lit("climb"))
    twin = estimate_flights(climbing, model)
    rows = track(twin, fleet.maintenance, model).health
    assert twin["status"].unique().to_list() == ["no_cruise"]
    assert set(rows["status"]) == {"predicted", "not_recorded", "not_identifiable"}


@pytest.fixture(scope="module")
def blind():
    """The fleet without a ram outlet's sensor."""
    return fleet_with_truth(5, 120, ram_out=False)


@pytest.fixture(scope="module")
def blind_twin(blind):
    return follow(blind)


def test_unmetered_ram_outlet_gives_no_ratio(blind_twin):
    twin, _ = blind_twin
    assert twin["ln_ram_ratio"].null_count() == twin.height


def test_unmetered_ram_outlet_widens_doubt(blind, blind_twin, fleet, model, flights):
    rows, metered = (fouling_of(*t) for t in ((blind_twin[0], blind, blind_twin[1]), (flights, fleet, model)))
    assert rows["sd"].mean() > metered["sd"].mean()


def test_unmetered_intervals_hold(blind, blind_twin):
    twin, model = blind_twin
    rows = fouling_of(twin, blind, model).join(blind.truth, on=["tail", "flight_id", "pack"])
    error = (pl.col("value") - pl.col("loss")).abs()
    assert rows.select((error < 1.645 * pl.col("sd")).mean()).item() > 0.75


@pytest.mark.parametrize(("tails", "n_flights"), [(1, 30), (1, 3), (2, 1)])
def test_small_fleet_has_wide_doubt(tails, n_flights):
    fleet = fleet_with_truth(tails, n_flights, seed=5)
    twin, model = follow(fleet)
    rows = fouling_of(twin, fleet, model)
    assert rows.height == 2 * tails * n_flights
    assert rows["sd"].min() > 0.015
    assert rows["value"].abs().max() < 0.2


@pytest.fixture(scope="module")
def climbs(fleet) -> pl.DataFrame:
    """Six samples of each flight as a climb; less air is asked for lower down: a smaller opening does."""
    cruise = fleet.samples.filter(pl.col("phase") == "cruise")
    climb = cruise.group_by("operator", "tail", "pack", "flight_id").head(6).with_columns(
        phase=pl.lit("climb"), time_utc=pl.col("time_utc") - pl.duration(hours=3),
        ram_door_open=0.5 * pl.col("ram_door_open"),
    )  # fmt: skip
    return climb.select(fleet.samples.columns)


def test_climb_without_ram_pressure_is_silent(fleet, model, climbs):
    """No word, no warning."""
    still = climbs.with_columns(mach=pl.lit(0.0), total_pressure_pa=pl.lit(2e4))
    estimate_flights(pl.concat([fleet.samples, still]), model)


def test_climb_separates_door_from_wear(fleet, model, climbs):
    both = pl.concat([fleet.samples, climbs])
    readings = (pl.col("ram_door_open"), pl.col("ram_door_open") + 0.05, pl.col("hx_out_k") + 3.0)
    sound, off, worn = (estimate_flights(both.with_columns(r), model)["door_apart_ln"] for r in readings)
    assert sound.is_not_null().mean() > 0.9
    assert (off - sound).median() < -0.03
    assert abs((worn - sound).median()) < 0.5 * abs((off - sound).median())
