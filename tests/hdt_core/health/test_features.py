"""Features are what their names say, and know nothing of the future."""

from datetime import UTC, date, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from hdt_core.calibration.exchanger import BIAS_SD, NOISE_SD
from hdt_core.health.features import DROP, DROP_FLIGHTS, features, residual_column, since_maintenance, virtual_sensors
from hdt_core.tables.twin import Residuals

START = datetime(2024, 3, 1, 6, tzinfo=UTC)
NO_RESIDUALS = Residuals.create_empty()


def health(loss: np.ndarray, pack: int = 1, tail: str = "T-AAA") -> pl.DataFrame:
    """A track of `hx_fouling`, three flights a day."""
    n = len(loss)
    when = [START + timedelta(hours=8 * k) for k in range(n)]
    ids = [f"{tail}_{w:%Y%m%d}_{k % 3 + 1:02d}" for k, w in enumerate(when)]
    own = {
        "operator": "TST", "tail": tail, "pack": pack, "component": "HX", "parameter": "hx_fouling", "sd": 0.01,
        "unit": "-", "status": "ok", "estimator": "kalman",
    }  # fmt: skip
    typed = {"pack": pl.Int32, "departed_at": pl.Datetime("us", "UTC")}
    frame = pl.DataFrame({"flight_id": ids, "departed_at": when, "value": loss} | own).cast(typed)
    return frame.with_columns(pl.col("value").fill_nan(None))


def legs_of(long: pl.DataFrame) -> pl.DataFrame:
    return long.select("operator", "tail", "flight_id", "pack", "departed_at", pl.lit(True).alias("admitted"))


def describe(loss: np.ndarray, maintenance: pl.DataFrame) -> pl.DataFrame:
    """Features of a pack that loses so much."""
    return describe_track(health(loss), maintenance)


def describe_track(
    long: pl.DataFrame, maintenance: pl.DataFrame, means: pl.DataFrame = NO_RESIDUALS, **more: pl.DataFrame
) -> pl.DataFrame:
    return features(long, means, legs_of(long), maintenance, **more)


@pytest.fixture
def replacement_log(nothing_done) -> pl.DataFrame:
    row = {"operator": "TST", "tail": "T-AAA", "pack": 1, "done_on": date(2024, 3, 15), "component": "HX"}
    entry = row | {"action": "REPLACED", "finding": "FOULED"}
    return pl.concat([nothing_done, pl.DataFrame([entry], schema=nothing_done.schema)])


@pytest.mark.parametrize("n", [10, 30, 100])
def test_slopes_are_least_squares(nothing_done, n):
    loss = np.cumsum(np.random.default_rng(0).normal(0.001, 0.004, 120))
    slope = describe(loss, nothing_done)[f"hx_fouling_slope_{n}_per_flight"][-1]
    assert slope == pytest.approx(np.polyfit(np.arange(n), loss[-n:], 1)[0], rel=1e-6)


def test_slope_spans_gaps(nothing_done):
    loss = 0.0001 * np.arange(6000.0)
    loss[5990::3] = np.nan
    assert describe(loss, nothing_done)["hx_fouling_slope_10_per_flight"][-1] == pytest.approx(1e-4, rel=1e-6)


def test_slope_needs_four_values(nothing_done):
    slope = describe(0.001 * np.arange(6.0), nothing_done)["hx_fouling_slope_10_per_flight"].to_list()
    assert slope == [None] * 3 + [pytest.approx(0.001)] * 3


def test_recovery_restarts_trend(nothing_done):
    """Though no log tells of it."""
    loss = 0.001 * np.arange(100.0) - 0.06 * (np.arange(100) >= 60)

    last = describe(loss, nothing_done).row(-1, named=True)

    assert last["hx_fouling_slope_100_per_flight"] == pytest.approx(0.001, rel=1e-6)
    assert last["flights_since_drop"] == 100 - 60 - DROP_FLIGHTS


@pytest.mark.parametrize(("fall", "flights"), [(0.99 * DROP, 99), (1.01 * DROP, 100 - 60 - DROP_FLIGHTS)])
def test_noise_is_no_drop(nothing_done, fall, flights):
    loss = 0.2 - fall * (np.arange(100) >= 60)

    assert describe(loss, nothing_done)["flights_since_drop"][-1] == flights


@pytest.mark.parametrize(("sd", "flights"), [(0.049, 100 - 60 - DROP_FLIGHTS), (0.051, 99)])
def test_fall_in_doubt_is_no_drop(nothing_done, sd, flights):
    """Within two standard deviations."""
    long = health(0.2 - 0.1 * (np.arange(100) >= 60)).with_columns(sd=sd)

    assert describe_track(long, nothing_done)["flights_since_drop"][-1] == flights


def late_step(loss: np.ndarray, k: int) -> float:
    """Median of three flights less that of the twelve before, less eight flights of the trend (0 to .004)."""
    past = loss[max(0, k - 32) : k - 2]
    slope = np.polyfit(np.arange(len(past)), past, 1)[0] if len(past) >= 4 else 0.0
    step = np.median(loss[k - 2 : k + 1]) - np.median(loss[max(0, k - 14) : k - 2])
    return float(step - 8.0 * min(max(slope, 0.0), 0.004))


@pytest.fixture(params=[-0.003, 0.002, 0.006])
def stepped_loss(request) -> np.ndarray:
    """A loss with a trend, noise and a step."""
    noise = np.random.default_rng(3).normal(0.0, 0.01, 60)
    return request.param * np.arange(60.0) + noise + 0.1 * (np.arange(60) >= 45)


def test_steps_by_hand(nothing_done, stepped_loss):
    """From four flights before the last three on."""
    step = describe(stepped_loss, nothing_done)["hx_fouling_step_3"].to_list()
    assert step[:6] == [None] * 6
    assert step[6:] == pytest.approx([late_step(stepped_loss, k) for k in range(6, 60)], abs=1e-9)


def test_jumps_by_hand(nothing_done, stepped_loss):
    jump = describe(stepped_loss, nothing_done)["hx_fouling_jump_10"].to_list()
    assert jump[:10] == [None] * 10
    assert jump[10:] == pytest.approx((stepped_loss[10:] - stepped_loss[:-10]).tolist())


def test_step_needs_two_of_three_flights(nothing_done):
    loss = np.full(12, 0.1)
    loss[[8, 10, 11]] = np.nan
    step = describe(loss, nothing_done)["hx_fouling_step_3"]
    assert step.is_null()[9:11].to_list() == [False, True]


@pytest.mark.parametrize(("name", "share"), [("hx_fouling_step_3", 1.0), ("ram_flow_loss_step_3", 0.5)])
def test_single_flights_step_first(nothing_done, name, share):
    """The track lags behind flights estimated alone."""
    long = health(np.full(20, 0.1))
    loss = np.where(np.arange(20) >= 18, 0.3, 0.1)
    alone = twin_rows(long).with_columns(ln_ua_ratio=np.log(1.0 - loss), ln_ram_ratio=np.log(1.0 - 0.5 * loss))
    out = describe_track(long, nothing_done, twin_flights=alone)
    assert out[name].to_list()[-3:] == pytest.approx([0.0, 0.0, 0.2 * share])


def test_corrected_sensor_makes_no_step(nothing_done):
    """The flight's own loss has the sensor's error still."""
    status = pl.when(pl.int_range(20) >= 17).then(pl.lit("sensor_corrected")).otherwise(pl.lit("ok"))
    long = health(np.full(20, 0.1)).with_columns(status=status)
    loss = np.where(np.arange(20) >= 16, 0.3, 0.1)
    alone = twin_rows(long).with_columns(ln_ua_ratio=np.log(1.0 - loss))
    step = describe_track(long, nothing_done, twin_flights=alone)["hx_fouling_step_3"].to_list()
    assert step[-5:] == pytest.approx([0.0, 0.0, 0.1, None, None])


def test_new_unit_restarts_steps(replacement_log):
    """A step needs four flights before the last three."""
    long = health(np.full(60, 0.1))
    step = describe_track(long, replacement_log, twin_flights=twin_rows(long))["ram_flow_loss_step_3"]
    assert step.is_null().to_list() == [True] * 6 + [False] * 39 + [True] * 6 + [False] * 9


TWIN = {
    "ram_flow_kg_s": 1.2, "pack_flow_kg_s": 0.8, "hx_in_k": 400.0, "hx_out_k": 300.0, "tat_k": 250.0, "n_samples": 9.0,
    "effectiveness": 0.66, "ua_w_k": 2000.0, "ln_ua_ratio": -0.2, "ln_ua_ratio_sd": 0.03, "ln_ua_ratio_map_sd": 0.04,
    "ln_ram_ratio": -0.1, "ln_ram_ratio_sd": 0.02, "diameter_m": 0.16, "diameter_m_se": 0.001,
    "expected_diameter_m": 0.165, "efficiency": 0.75, "inlet_apart_k": 1.5, "door_apart_ln": 0.07,
}  # fmt: skip


def twin_rows(long: pl.DataFrame) -> pl.DataFrame:
    rows = long.select("operator", "tail", "flight_id", "pack")
    return rows.with_columns(pl.lit(v).alias(k) for k, v in TWIN.items())


def test_virtual_sensors_by_hand():
    row = virtual_sensors(twin_rows(health(np.zeros(1)))).row(0, named=True)
    # 80 kW of bleed air at 1,011 J/kg K over 1.2 kg/s of ram air at 1,005
    rise_k = row["ram_outlet_k"] - 250.0
    assert rise_k == pytest.approx(0.8 * 100.0 / 1.2 * 1011.0 / 1005.0, rel=0.003)
    reading_sd_k = np.hypot(NOISE_SD["hx_out_k"] / 3.0, BIAS_SD["hx_out_k"])
    assert row | {"ram_outlet_k": 0.0} == pytest.approx(
        {
            "operator": "TST", "tail": "T-AAA", "flight_id": "T-AAA_20240301_01", "pack": 1, "ram_flow_kg_s": 1.2,
            "ram_flow_kg_s_sd": 0.06, "ram_outlet_k": 0.0, "ram_outlet_k_sd": 0.05 * rise_k, "effectiveness": 0.66,
            "effectiveness_sd": reading_sd_k / 150.0, "ua_w_k": 2000.0, "ua_w_k_sd": 100.0,
            "ram_flow_loss": 1.0 - np.exp(-0.1), "ram_flow_loss_sd": 0.02 * np.exp(-0.1),
            "hx_fouling_flight": 1.0 - np.exp(-0.2), "hx_fouling_flight_sd": 0.03 * np.exp(-0.2),
            "cc_diameter_deficit": 1.0 - 160.0 / 165.0, "cc_diameter_deficit_sd": 1.0 / 165.0,
            "w_hx_in_over_discharge_k": 1.5, "w_hx_in_over_pressure_k": None, "w_conductance_off_cruise_ln": 0.07,
        }
    )  # fmt: skip


def test_virtual_sensors_without_discharge():
    """Nor any sample."""
    silent = twin_rows(health(np.zeros(1))).with_columns(efficiency=pl.lit(None, pl.Float64), n_samples=pl.lit(0.0))
    row = virtual_sensors(silent).row(0, named=True)
    assert (row["w_hx_in_over_discharge_k"], row["w_hx_in_over_pressure_k"]) == (None, 1.5)
    assert row["effectiveness_sd"] == pytest.approx(np.hypot(NOISE_SD["hx_out_k"], BIAS_SD["hx_out_k"]) / 150.0)


@pytest.fixture(scope="module")
def two_packs(nothing_done) -> pl.DataFrame:
    """Features of two packs that flew thrice and lost a fifth and a twentieth."""
    long = pl.concat([health(np.full(3, 0.2)), health(np.full(3, 0.05), pack=2)])
    checks = legs_of(long).drop("admitted", "departed_at").with_columns(
        flight_hours=pl.lit(2.5), door_median=0.1 * pl.col("pack"), door_max=pl.lit(0.7), hx_fouling=pl.lit(9.0)
    )  # fmt: skip
    return describe_track(long, nothing_done, cross_checks=checks)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("usage_hours", [2.5, 5.0, 7.5] * 2), ("ram_door_margin", [0.3] * 6),
        ("ram_door_open_cruise", [0.1] * 3 + [0.2] * 3), ("door_median_between_packs", [-0.1] * 3 + [0.1] * 3),
        ("hx_fouling_between_packs", [0.15] * 3 + [-0.15] * 3), ("flight_index", [0, 1, 2] * 2),
        ("flights_seen_of_unit", [0, 1, 2] * 2),
    ],
)  # fmt: skip
def test_usage_features_by_hand(two_packs, name, values):
    assert two_packs[name].to_list() == pytest.approx(values)


def test_helper_columns_are_dropped(two_packs):
    assert not [name for name in two_packs.columns if name.startswith("other_") or name.endswith("_life")]


def test_residual_means_have_names(nothing_done):
    long = health(np.zeros(1))
    row = long.select("operator", "tail", "flight_id", "pack").row(0, named=True)
    values = (("hx_out_k", "sensor_minus_dsm", 3.0), ("hx_out_k", "d", 5.0), ("x", "d", 4.0))
    rows = [row | {"signal": s, "kind": k, "mean": m} for s, k, m in values]
    means = pl.DataFrame(rows, schema_overrides={"pack": pl.Int32})
    names = ("hx_out_sensor_minus_dsm_k", "hx_out_excess_k", "x_d", "hx_out_d_k")
    assert describe_track(long, nothing_done, means).select(names).rows() == [(3.0, 3.0, 4.0, 5.0)]


def test_row_order_changes_no_feature(nothing_done):
    loss = np.cumsum(np.random.default_rng(2).normal(0.001, 0.004, 40))
    both = pl.concat([health(loss[::-1].copy(), tail="T-AAB"), health(loss)]).sample(fraction=1.0, shuffle=True, seed=1)
    shuffled = describe_track(both, nothing_done).filter(pl.col("tail") == "T-AAA")
    assert_frame_equal(shuffled, describe(loss, nothing_done))


def test_no_flights_have_no_features(nothing_done):
    assert describe_track(health(np.zeros(1)).clear(), nothing_done).height == 0


def test_new_unit_starts_new_life(replacement_log):
    rows = legs_of(health(np.zeros(60)))
    out = since_maintenance(rows.with_columns(pl.lit(0).alias("flight_index")), replacement_log)
    assert out["hx_life"].to_list() == [0] * 45 + [1] * 15


@pytest.fixture
def renewed_features(replacement_log) -> pl.DataFrame:
    """Features of a pack whose unit was replaced after forty-five flights."""
    return describe(np.where(np.arange(90) < 45, 0.3, 0.0) + 0.001 * np.arange(90), replacement_log)


def test_age_counts_from_replacement(renewed_features):
    assert renewed_features["flights_since_replacement"].to_list() == [None] * 45 + list(range(45))


def test_slope_ends_at_replacement(renewed_features):
    assert renewed_features["hx_fouling_slope_100_per_flight"][-1] == pytest.approx(0.001, rel=1e-6)


def test_features_ignore_later_flights(replacement_log):
    loss = np.cumsum(np.random.default_rng(1).normal(0.002, 0.005, 90))
    long = pl.concat([health(loss), health(loss[::-1].copy(), pack=2)])
    early = pl.col("departed_at") < START + timedelta(days=20)
    whole, part = (describe_track(rows, replacement_log) for rows in (long, long.filter(early)))
    assert_frame_equal(whole.filter(early), part, check_exact=False, rel_tol=1e-9, abs_tol=1e-9)


def test_age_of_first_unit_is_unknown(replacement_log):
    """Its replacement is in the log, long before the first flight."""
    out = describe(np.zeros(9), replacement_log.with_columns(done_on=pl.lit(date(1999, 1, 1))))
    assert out["flights_since_replacement"].null_count() == 9


@pytest.mark.parametrize(
    ("signal", "name"),
    [
        ("hx_out_k", "hx_out_d_k"), ("cc_flow_kg_s", "cc_flow_d_kg_s"),
        ("cc_effective_diameter_m", "cc_effective_diameter_d_m"), ("cc_speed_rad_s", "cc_speed_d_rad_s"),
        ("ua_w_k", "ua_d_w_k"), ("vda_counts", "vda_d_counts"), ("cc_out_pa", "cc_out_d_pa"), ("mach", "mach_d"),
    ],
)  # fmt: skip
def test_unit_ends_the_name(signal: str, name: str):
    assert residual_column(signal, "d") == name
