"""A component by declaration alone: known truth through the shared path, and a real cooler with recorded settings."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import polars as pl
import pytest
from by_hand import log
from cooler_rig import FAULTS, follow_rig
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.model_selection import GroupKFold, cross_val_predict

from hdt_core.calibration.component_fit import calibrate_component, flight_by_flight
from hdt_core.components.pack import HX
from hdt_core.estimation import ExtendedKalman
from hdt_core.health.residuals import component_residuals
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.tracking.component import DesignOffset, track_component

BUILT = HEAT_EXCHANGER.calibrated({"hx_ua_reference_w_k": 1700.0})
LOSS = np.repeat([0.0, 0.1, 0.25, 0.4], 30)
SAMPLES = 12


def fly(noise_k: float) -> pl.DataFrame:
    """A pack's exchanger over 120 flights of 12 samples, fouling in steps, both outlets with this noise."""
    rng = np.random.default_rng(5)
    n = LOSS.size * SAMPLES
    flight = np.repeat(np.arange(LOSS.size), SAMPLES)
    inputs = {
        "hot_flow_kg_s": rng.uniform(0.7, 1.1, n), "ram_flow_kg_s": rng.uniform(0.9, 2.2, n),
        "hot_in_k": rng.uniform(370.0, 405.0, n), "cold_in_k": rng.uniform(245.0, 260.0, n),
    }  # fmt: skip
    out = BUILT.predict({"hx_fouling": LOSS[flight]}, inputs)
    outputs = {name: value + noise_k * rng.standard_normal(n) for name, value in out.items()}
    start = datetime(2024, 1, 1, tzinfo=UTC)
    when = [start + timedelta(hours=6 * int(f), minutes=5 * (k % SAMPLES)) for k, f in enumerate(flight)]
    key = {"operator": "TST", "tail": "T-00", "flight_id": [f"T-00_{f:03d}" for f in flight], "time_utc": when}
    return pl.DataFrame(key | inputs | outputs).with_columns(pl.lit(1, pl.Int32).alias("pack"))


@pytest.fixture(scope="module")
def samples() -> pl.DataFrame:
    return fly(0.5)


@pytest.fixture(scope="module")
def flights(samples) -> pl.DataFrame:
    return flight_by_flight(samples, BUILT, ["hx_fouling"])


def track_fouling(flights: pl.DataFrame) -> pl.DataFrame:
    """The track of an exchanger whose design is the one it is judged by, but for its sensors."""
    return track_both(flights).filter(parameter="hx_fouling")


def track_both(flights: pl.DataFrame) -> pl.DataFrame:
    """The track, and the smoothed one."""
    return track_component(flights, replace(HX, model=BUILT), log(), DesignOffset(0.0, 0.0)).health


def test_losses_scatter_as_stated(flights):
    """Each flight's loss lies where its own standard deviation says, 120 times over."""
    z = (flights["hx_fouling"].to_numpy() - LOSS) / flights["hx_fouling_sd"].to_numpy()
    assert set(flights["status"]) == {"converged"}
    assert np.abs(z).max() < 4.0
    assert 0.8 < z.std() < 1.2


def test_failed_flight_is_predicted(flights):
    status = pl.when(pl.col("flight_id") == "T-00_050").then(pl.lit("diverged")).otherwise("status")
    track = track_fouling(flights.with_columns(status.alias("status")))
    assert track["status"].to_list() == ["predicted" if k == 50 else "ok" for k in range(120)]
    assert track["value"][50] == pytest.approx(track["value"][49], abs=2e-3)
    assert track["sd"][50] > track["sd"][49]


def test_estimators_agree_on_losses(samples, flights):
    some = samples.filter(pl.col("flight_id") < "T-00_010")
    other = flight_by_flight(some, BUILT, ["hx_fouling"], estimator=ExtendedKalman())
    np.testing.assert_allclose(other["hx_fouling"], flights["hx_fouling"][:10], atol=2e-3)


def test_twin_explains_the_loss(samples, flights):
    hot = component_residuals(samples, flights, BUILT, "HX").filter(signal="hot_out_k")
    by_kind = {k: f.sort("flight_id")["mean"].to_numpy() for (k,), f in hot.group_by("kind")}
    total = by_kind["sensor_minus_dsm"] + by_kind["dsm_minus_twin"]
    np.testing.assert_allclose(by_kind["sensor_minus_twin"], total, atol=1e-9)
    assert by_kind["sensor_minus_dsm"][LOSS == 0.4].min() > 10.0
    assert np.abs(by_kind["sensor_minus_twin"]).max() < 1.0


def test_missing_outputs_are_named(samples):
    with pytest.raises(ValueError, match="heat_exchanger: the samples hold no column of hot_out_k, ram_out_k"):
        flight_by_flight(samples.drop("hot_out_k", "ram_out_k"), BUILT, ["hx_fouling"])


def test_track_needs_a_flight(flights):
    with pytest.raises(ValueError, match="heat_exchanger: no flight to follow"):
        track_fouling(flights.clear())


@pytest.fixture(scope="module")
def filtered(flights) -> pl.DataFrame:
    return track_fouling(flights)


def test_filtering_reduces_scatter(flights, filtered):
    rough, smooth = (np.abs(f.to_numpy() - LOSS)[5:30].std() for f in (flights["hx_fouling"], filtered["value"]))
    assert smooth < 0.8 * rough
    assert filtered["sd"].max() < 0.05


def test_filter_ignores_later_flights(flights, filtered):
    """But for the scatter of flights, which is learned from all."""
    early = track_fouling(flights.head(60))
    np.testing.assert_allclose(early["value"], filtered["value"][:60], atol=5e-3)


def test_smoothing_nears_true_loss(flights, filtered):
    smoothed = track_both(flights).filter(parameter="hx_fouling_smoothed")
    assert smoothed.select("estimator", "status").unique().rows() == [("nls, smoothed", "ok")]
    assert smoothed["flight_id"].equals(filtered["flight_id"])
    far, near = (np.abs(f["value"].to_numpy() - LOSS).mean() for f in (filtered, smoothed))
    assert near < 0.8 * far
    assert smoothed["value"][-1] == pytest.approx(filtered["value"][-1])


def test_unidentifiable_design_is_refused():
    still = fly(0.5).head(SAMPLES)
    constant = [pl.col(s.name).first() for s in HEAT_EXCHANGER.inputs]
    with pytest.raises(ValueError, match=r"heat_exchanger: .* from 12 nominal samples: not_identifiable"):
        calibrate_component(HEAT_EXCHANGER, still.with_columns(constant))


def test_calm_flows_leave_exponents_open():
    narrow = fly(0.0).filter(pl.col("flight_id") < "T-00_010")
    middle = {s: narrow[s].mean() for s in ("hot_flow_kg_s", "ram_flow_kg_s")}
    calm = narrow.with_columns(*(((pl.col(s) - m) * 0.02 + m).alias(s) for s, m in middle.items()))
    outlets = HEAT_EXCHANGER.predict({}, {s.name: calm[s.name].to_numpy() for s in HEAT_EXCHANGER.inputs})
    rng = np.random.default_rng(0)
    noisy = [pl.Series(name, v + 0.5 * rng.standard_normal(v.size)) for name, v in outlets.items()]
    _, estimate = calibrate_component(HEAT_EXCHANGER, calm.with_columns(noisy))
    assert estimate.status == "weakly_identifiable"
    assert {"hx_exponent_hot", "hx_hot_share"} & set(estimate.weak)
    assert "Left open by the data" in estimate.summary()


def chiller_water_k(flow_kg_s, water_in_k, boiling_k, ua_w_k, flow_exponent, fouling):
    """Water cooled by a refrigerant that boils at one temperature; its film goes as a power of the water's flow."""
    ua = ua_w_k * (1.0 - fouling) * (flow_kg_s / 10.0) ** flow_exponent
    return boiling_k + (water_in_k - boiling_k) * np.exp(-ua / (flow_kg_s * 4186.0))


CHILLER = PhysicsModel(
    name="chiller",
    inputs=(Signal("flow_kg_s", "kg/s"), Signal("water_in_k", "K"), Signal("boiling_k", "K")),
    outputs=(Signal("water_out_k", "K", sigma=0.1),),
    params=(
        Param("ua_w_k", "W/K", 50e3, (10e3, 200e3), "design"),
        Param("flow_exponent", "-", 0.6, (0.2, 1.2), "design"),
        Param("fouling", "-", 0.0, (-0.1, 0.9), "health", drift=0.01),
    ),
    equations=chiller_water_k,
)


@pytest.mark.parametrize(("flow_spread", "weak"), [(0.01, ("flow_exponent",)), (0.2, ())])
def test_steady_flow_leaves_exponent_open(flow_spread, weak):
    """An exponent of 0.8 +- 0.26 is an optimum, and no ground for a loss at other flows."""
    rng = np.random.default_rng(4)
    n = 300
    nominal = pl.DataFrame(
        {
            "flow_kg_s": 10.0 * np.exp(flow_spread * rng.standard_normal(n)),
            "water_in_k": rng.uniform(284.0, 287.0, n),
            "boiling_k": rng.uniform(277.0, 279.0, n),
        }
    )
    water_k = chiller_water_k(*nominal, 60e3, 0.8, 0.0).to_numpy() + 0.1 * rng.standard_normal(n)
    _, estimate = calibrate_component(CHILLER, nominal.with_columns(water_out_k=water_k))
    assert estimate.weak == weak
    assert estimate.status == ("weakly_identifiable" if weak else "converged")
    assert (estimate.belief.sd[1] > 0.2) == bool(weak)
    assert abs(estimate.belief.mean[1] - 0.8) < 4.0 * estimate.belief.sd[1]


def test_stray_flight_moves_little(flights, filtered):
    stray = pl.when(pl.col("flight_id") == "T-00_045").then(pl.col("hx_fouling") - 0.3).otherwise("hx_fouling")
    struck = track_fouling(flights.with_columns(stray.alias("hx_fouling")))
    difference = (struck["value"] - filtered["value"]).abs()
    assert difference[45:].max() < 2.0 * filtered["sd"][45]


def test_step_is_followed_from_second_flight(filtered):
    late = np.abs(filtered["value"].to_numpy() - LOSS)
    assert late[[30, 60, 90]].min() > 0.05  # a flight alone may be an outlier
    assert late[[31, 61, 91]].max() < 0.02


@pytest.fixture(scope="module")
def rig() -> dict[str, Any]:
    """Tables of the rig."""
    return follow_rig()


def accuracy_pct(rows: pl.DataFrame) -> float:
    """Share of the cycles whose cooler setting follows from UA, by ten folds of whole runs. [%]"""
    x = rows.select(pl.col("ua_w_k").log()).to_numpy()
    y = rows["cooler_pct"].to_numpy()
    predicted = cross_val_predict(LinearDiscriminantAnalysis(), x, y, groups=rows["run"].to_numpy(), cv=GroupKFold(10))
    return 100.0 * float((predicted == y).mean())


def test_every_cycle_has_its_answer(rig):
    assert rig["flights"].height == rig["cycles"].height == 2205
    assert set(rig["flights"]["status"]) == {rig["fit"].status} == {"converged"}


def test_rules_leave_nominal_cycles(rig):
    counts = (rig["cycles"]["steady"].sum(), rig["ruled"].height, rig["nominal"].height, rig["settled"].height)
    assert counts == (2165, 489, 487, 1449)


def median_by_setting(rig: dict[str, Any], column: str) -> dict[int, float]:
    return dict(rig["settled"].group_by("cooler_pct").agg(pl.col(column).median()).rows())


def test_conductance_follows_rig_settings(rig):
    """Near 174, 83 and 54 W/K, from four channels by hand; within a tenth, and in order."""
    ua = median_by_setting(rig, "ua_w_k")
    assert ua == pytest.approx({100: 174.0, 20: 83.0, 3: 54.0}, rel=0.1)
    assert ua == pytest.approx({100: 173.8, 20: 84.2, 3: 51.1}, abs=0.05)
    assert rig["dsm"].nominal["hc_ua_w_k"] == pytest.approx(174.0, abs=0.05)


def test_loss_follows_rig_settings(rig):
    assert median_by_setting(rig, "hc_fouling") == pytest.approx({100: 0.001, 20: 0.516, 3: 0.706}, abs=5e-4)


@pytest.mark.parametrize(("cycles", "expected", "off"), [("cycles", 99.77, 0.005), ("settled", 100.0, 0.0)])
def test_setting_follows_from_conductance(rig, cycles, expected, off):
    assert accuracy_pct(rig[cycles]) == pytest.approx(expected, abs=off)


@pytest.fixture(scope="module")
def conductances(rig) -> pl.DataFrame:
    """Settled cycles, off the median of their setting: in per cent of it, and of the conductance as built."""
    middle = pl.col("ua_w_k").median().over("cooler_pct")
    off_w_k = pl.col("ua_w_k") - middle
    nominal_w_k = rig["dsm"].nominal["hc_ua_w_k"]
    return rig["settled"].with_columns(share=100.0 * off_w_k / middle, points=100.0 * off_w_k / nominal_w_k)


def test_other_faults_hardly_move_conductance(conductances):
    """On average over the settings."""
    by_level = [conductances.group_by(fault).agg(pl.col("share").mean().abs()) for fault in FAULTS]
    assert max(level["share"].max() for level in by_level) == pytest.approx(3.2, abs=0.05)


def test_other_faults_hardly_move_settings(conductances):
    """By setting, of each fault's level the median."""
    share_points = pl.col("share", "points")
    by_cell = [conductances.group_by("cooler_pct", fault).agg(share_points.median().abs()) for fault in FAULTS]
    cells = pl.concat(cell.select("cooler_pct", "share", "points") for cell in by_cell)
    assert cells["points"].max() == pytest.approx(2.6, abs=0.05)
    worst = dict(cells.group_by("cooler_pct").agg(pl.col("share").max()).rows())
    assert worst == pytest.approx({100: 1.5, 20: 0.9, 3: 8.8}, abs=0.05)
    assert cells.filter(pl.col("cooler_pct") > 3).height == 22


def test_changed_faults_hardly_move_conductance(rig):
    """From the last three cycles before a change of valve, pump or accumulator to the first three after it."""
    runs = (
        rig["settled"]
        .group_by("run", maintain_order=True)
        .agg(
            pl.col("cooler_pct").first(),
            pl.col("ua_w_k").head(3).median().alias("first"),
            pl.col("ua_w_k").tail(3).median().alias("last"),
        )
    )
    before = pl.col("last").shift(1).over("cooler_pct")
    at_change = runs.select(100.0 * (pl.col("first") / before - 1.0).abs()).to_series().drop_nulls()
    assert at_change.len() == 141
    assert (at_change.max(), at_change.median()) == pytest.approx((4.2, 0.6), abs=0.05)


def test_twin_explains_the_rig(rig):
    """As cycles go by, what is left is below the declared noise of the sensor."""
    left = rig["residuals"].filter(pl.col("kind") == "sensor_minus_twin")
    assert left["rms"].median() < 0.1
    assert left["rms"].quantile(0.95) < 0.2
    rms = dict(rig["residuals"].group_by("kind").agg(pl.col("rms").median()).rows())
    assert rms == pytest.approx({"sensor_minus_dsm": 5.15, "dsm_minus_twin": 5.15, "sensor_minus_twin": 0.06}, abs=5e-3)


def test_steps_show_only_rig_repairs(rig):
    """Its cooler was opened twice, before cycles 732 and 1464, and its loss settles within five cycles of the start: a
    median of three cycles shows it from the second or third on, and the twelve before hold it up that long."""
    by_cycle = rig["described"].sort("cycle")
    stepped = by_cycle.filter(pl.col("hc_fouling_step_3").abs() > 0.1)["cycle"].to_list()
    assert stepped == [6, 7, 8, *range(735, 741), *range(1466, 1475)]
    since = [cycle - max(opened for opened in (0, 732, 1464) if opened <= cycle) for cycle in stepped]
    assert max(since) < 15
    assert since.count(3) == 2
    assert by_cycle["hc_fouling_step_3"].min() < -0.15


def test_rig_slopes_are_finite(rig):
    assert rig["described"]["hc_fouling_slope_30_per_flight"].drop_nulls().is_finite().all()
