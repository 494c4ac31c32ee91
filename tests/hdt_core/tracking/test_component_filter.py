"""A declared component's filter, its readings and its prior by hand; an exchanger known by its temperatures."""

from dataclasses import replace
from datetime import UTC, date, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from by_hand import flights, log
from polars.testing import assert_frame_equal

from hdt_core.calibration.component_fit import design_prior
from hdt_core.components import Component, Limit, Reading, components
from hdt_core.components.unmetered_exchanger import UNMETERED, sprayed_hot_out_k
from hdt_core.flight.component_legs import component_samples
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.tracking.component import (
    DesignOffset,
    _loss,
    scatter_sd,
    track_component,
    wear_of,
    wear_settings,
)
from hdt_core.tracking.component_readings import component_readings
from hdt_core.tracking.component_units import commission, unit_health
from hdt_core.tracking.track import lumped_coefficients

VALVE = PhysicsModel(
    name="valve",
    inputs=(Signal("flow_kg_s", "kg/s"),),
    outputs=(Signal("drop_pa", "Pa", sigma=10.0),),
    params=(
        Param("area_m2", "m2", 1e-3, (1e-4, 1e-2), "design"),
        Param("valve_loss", "-", 0.0, (-0.1, 0.9), "health", drift=0.01),
    ),
    equations=lambda flow_kg_s, area_m2, valve_loss: (flow_kg_s / (area_m2 * (1.0 - valve_loss))) ** 2,
)
COMPONENT = Component("VALVE", "valve", "Area lost", VALVE, "valve_loss", Limit(0.2, 0.03, 0.02), 800.0, "Clean it")


LOSS = VALVE.param("valve_loss")
DEPOSIT = replace(LOSS, bounds=(-0.1, 1.5))
"""A loss that may exceed 1 is no share of anything."""


def test_wear_settings_scale_with_limit():
    """The exchanger fails at 38 % after 400 flights: a valve at 20 % after 800 wears less, and at half the rate."""
    size, own = wear_settings(COMPONENT, LOSS, DesignOffset(0.0, 0.1))
    assert size == pytest.approx(np.log(0.8) / np.log(0.62))
    expected = (0.0, 0.1 / size, 0.04 / size, 0.01 / size)
    assert (own.level, own.level_sd, own.unit_sd, own.wear_step) == pytest.approx(expected)
    assert (own.clog, own.fault_chance, own.offset_bin, own.wash_share) == ((0.2, 0.2), 1e-6, 0.03, 0.5)
    assert own.paces[1] == pytest.approx((0.45, 5e-4, 4e-4, 6e-5 / 8**0.5, 6e-5 / 8**0.5))


def test_component_without_wash_has_no_share():
    renewed_only = replace(COMPONENT, ended_by=("REPLACED",))
    assert wear_settings(renewed_only, LOSS, DesignOffset())[1].wash_share == 0.0


def test_declared_spread_of_units_counts():
    size, own = wear_settings(COMPONENT, replace(LOSS, unit_sd=0.07), DesignOffset())
    assert own.unit_sd == pytest.approx(0.07 / size)


def test_declared_share_of_new_units_counts():
    entries = wear_settings(replace(COMPONENT, new_share=0.9), LOSS, DesignOffset())[1].entries
    assert [e.share for e in entries] == pytest.approx([0.9, 0.04, 0.036, 0.024])


def test_deposit_wears_as_it_is():
    assert wear_settings(COMPONENT, DEPOSIT, DesignOffset())[0] == pytest.approx(0.2 / -np.log(0.62))


def test_wear_of_share_is_logarithmic():
    np.testing.assert_allclose(wear_of(np.array([0.5]), np.array([0.01]), LOSS), [[np.log(2.0)], [0.02]])


@pytest.fixture(params=[(8, 0.005), (9, (1.4826**2 * 0.03**2 / 2.0 - 0.01**2) ** 0.5)], ids=["few", "enough"])
def steps(request):
    """Losses of some flights that differ by turns, and their scatter: of eight steps on, less what each is unsure."""
    n, scatter = request.param
    return np.tile([0.0, 0.03], n)[:n], scatter


@pytest.mark.parametrize("gap", [[], [3]], ids=["whole", "missing"])
def test_scatter_follows_flight_steps(steps, gap):
    values, scatter = steps
    values = np.insert(values, gap, np.nan)
    assert scatter_sd(values, np.full(len(values), 0.01**2)) == pytest.approx(scatter)


def test_flight_variance_adds_scatter(steps):
    values, scatter = steps
    size = wear_settings(COMPONENT, DEPOSIT, DesignOffset())[0]
    rows = flights(len(values), valve_loss=list(size * values), valve_loss_sd=0.01 * size)
    variance = _loss(rows, DEPOSIT, COMPONENT, DesignOffset()).observations[1]
    np.testing.assert_allclose(variance, 0.01**2 + scatter**2)


STATUS = pl.Series("status", ["converged", "diverged", "not_identifiable", "converged"])
HALF_SILENT = flights(4, valve_loss=[0.01, 0.7, 0.7, 0.02], valve_loss_sd=0.01).with_columns(STATUS)


def test_silent_flight_is_predicted():
    health = track_component(HALF_SILENT, COMPONENT, log()).health
    for _, track in health.group_by("parameter"):
        assert track["status"].to_list() == ["ok", "predicted", "predicted", "ok"]
    assert health["value"].max() < 0.1


def test_flight_counts_beyond_declared_design():
    """Its wear, of its own deviation and the least scatter."""
    loss = _loss(HALF_SILENT, LOSS, COMPONENT, DesignOffset(0.02))
    ratio, variance, exposure = loss.observations
    np.testing.assert_allclose(ratio, (np.log([0.99, np.nan, np.nan, 0.98]) - 0.02) / loss.size)
    first, last = (0.01 / np.array([0.99, 0.98]) / loss.size) ** 2 + 0.005**2
    np.testing.assert_allclose(variance, [first, 1.0, 1.0, last])
    np.testing.assert_array_equal(exposure, np.ones(4))


@pytest.fixture(scope="module")
def nights():
    """Flights, their track, and the track of the night before, its rows marked."""
    losses = 0.001 * np.arange(160) + np.tile([0.0, 0.01], 80)
    early, whole = (flights(n, valve_loss=losses[:n], valve_loss_sd=0.01) for n in (120, 160))
    at_once, before = (track_component(rows, COMPONENT, log(), seal="1") for rows in (whole, early))
    return whole, at_once, before._replace(health=before.health.with_columns(status=pl.lit("before")))


def test_night_continues_from_checkpoint(nights):
    """As if all had flown at once; rows stay of the last final segment and those before."""
    whole, at_once, before = nights
    after = track_component(whole, COMPONENT, log(), previous=before, seal="1")
    columns = [c for c in after.health.columns if c != "status"]
    assert_frame_equal(after.health.select(columns), at_once.health.select(columns), check_row_order=False)
    assert_frame_equal(after.checkpoints, at_once.checkpoints)
    assert after.health.filter(status="before").group_by("parameter").len()["len"].to_list() == [50, 50]


def test_changed_seal_begins_anew(nights):
    whole, _, before = nights
    anew = track_component(whole, COMPONENT, log(), previous=before, seal="2").health
    assert anew.filter(status="before").is_empty()


def test_design_prior_needs_every_deviation():
    sure = Param("a", "-", 2.0, (0.0, 5.0), "design", sd=0.3)
    unsure = Param("b", "-", 1.0, (0.0, 5.0), "design")
    both = replace(VALVE, params=(sure, replace(unsure, sd=0.5)), equations=lambda flow_kg_s, a, b: flow_kg_s * a * b)
    prior = design_prior(both)
    np.testing.assert_allclose(prior.mean, [2.0, 1.0])
    np.testing.assert_allclose(prior.cov, np.diag([0.09, 0.25]))
    assert design_prior(replace(both, params=(sure, unsure))) is None


def test_track_needs_a_flight():
    with pytest.raises(ValueError, match="no flight"):
        track_component(flights(0, valve_loss=0.1), COMPONENT, log())


COOLER = components()["HXT"]


def read(values: list[float | None], **changes: object) -> dict[str, object]:
    """The row of one flight with these samples of a channel."""
    plain = {"name": "hxt_x", "unit": "K", "meaning": "", "value": pl.col("hot_out_k"), "below": 400.0}
    reading = Reading(**(plain | changes))
    start = datetime(2024, 1, 1, tzinfo=UTC)
    samples = pl.DataFrame({
        "time_utc": [start + timedelta(seconds=k) for k in range(len(values))], "hot_out_k": values, "hot_in_k": 350.0,
        "tat_k": 280.0, "altitude_m": 3000.0, "mach": 0.4,
    }, schema_overrides={"hot_out_k": pl.Float64}).with_columns(
        operator=pl.lit("TST"), tail=pl.lit("T-1"), flight_id=pl.lit("F"), pack=pl.lit(1, pl.Int32)
    )  # fmt: skip
    return component_readings(samples, replace(COOLER, readings=(reading,))).row(0, named=True)


def test_reading_is_mean_of_samples():
    values = [298.0, 299.0, 300.0, 301.0, 302.0, 307.0, 308.9]
    row = read(values)
    assert (row["status"], row["value"]) == ("measured", pytest.approx(np.mean(values)))


@pytest.mark.parametrize(("away", "is_used"), [(7.3, True), (7.5, False)])
def test_reading_drops_spikes(away, is_used):
    """Five robust deviations from the median: the median deviation is 1, so 7.4 away."""
    calm = [299.0, 299.0, 300.0, 301.0, 301.0] * 2
    row = read([*calm, 300.0 + away])
    sound = [*calm, *([300.0 + away] if is_used else [])]
    assert (row["value"], row["sd"]) == pytest.approx((np.mean(sound), np.std(sound, ddof=1)))


@pytest.mark.parametrize(
    ("values", "where", "status"),
    [
        ([300.0] * 5, None, "measured"),
        ([300.0] * 4, None, "few_samples"),
        ([None] * 6, None, "not_recorded"),
        ([300.0] * 6, pl.col("mach") > 0.5, "off_nominal"),
        ([300.0] * 9 + [400.0], None, "one_or_more"),
        ([300.0] * 10 + [400.0], None, "measured"),
        ([300.0] * 9 + [399.9], None, "measured"),
    ],
)
def test_reading_status_follows_samples(values, where, status):
    row = read(values, where=where)
    assert row["status"] == status
    assert (row["value"] is None) == (status in ("few_samples", "not_recorded", "off_nominal"))


SPRAYED = COOLER.with_terms(["water_spray"])
TRUE = {"hxt_ntu": 1.75, "hxt_exponent": 0.3, "hxt_water_spray": 0.4}
NO_WORK = log()
SIGNALS = ["hot_in_k", "hot_out_k", "tat_k", "altitude_m", "mach"]


def fly(losses: list[float], spray: float = 0.4, sensor_k: float = 0.3) -> pl.DataFrame:
    """Climbs of one pack, a sample every ten seconds, in the long form of the store."""
    flights = []
    for k, loss in enumerate(losses):
        rng = np.random.default_rng(k)
        t = np.arange(0.0, 600.0, 10.0)
        start = datetime(2024, 1, 1, 8, tzinfo=UTC) + timedelta(days=k)
        signals = pl.DataFrame({
            "time_utc": [start + timedelta(seconds=s) for s in t], "altitude_m": 300.0 + 7.0 * t,
            "mach": 0.2 + 0.0006 * t, "tat_k": rng.uniform(292, 300) - 0.01 * t,
            "hot_in_k": 355.0 + 6.0 * np.sin(t / 90),
        }).with_columns(pl.lit(0.0).alias("hot_out_k"))  # fmt: skip
        derived = COOLER.record.derive(signals)
        inputs = {s.name: derived[s.name].to_numpy() for s in UNMETERED.inputs}
        out = sprayed_hot_out_k(**inputs, **(TRUE | {"hxt_water_spray": spray}), hxt_loss=np.float64(loss))
        noise = {c: sensor_k * rng.standard_normal(t.size) for c in ("hot_in_k", "hot_out_k")}
        flights.append(signals.with_columns(
            pl.Series("hot_out_k", out + noise["hot_out_k"]), pl.col("hot_in_k") + noise["hot_in_k"],
            flight_id=pl.lit(f"T-1_{start:%Y%m%d}_01"),
        ))  # fmt: skip
    named = pl.concat(flights).with_columns(operator=pl.lit("AAA"), tail=pl.lit("T-1"), component=pl.lit("HXT"),
                                            pack=pl.lit(1, pl.Int32))  # fmt: skip
    keys = ["operator", "tail", "flight_id", "pack", "time_utc", "component"]
    return named.unpivot(SIGNALS, index=keys, variable_name="signal")


def run_component(signals: pl.DataFrame, component) -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
    legs, design = commission(signals, NO_WORK, component)
    samples = component_samples(signals, component)
    health = unit_health(samples, legs, design, NO_WORK, component)[1].health
    return design, health, component_readings(samples, component)


def test_few_flights_keep_prior():
    few = [run_component(fly([0.0] * n, spray=0.0), COOLER) for n in (1, 9)]
    for design, health, _ in few:
        assert design["n_flights"].unique().to_list() == [0]
        assert not design["identifiable"].any()
        assert health["status"].unique().to_list() == ["prior_only"]
        assert health["value"].abs().max() < COOLER.warn_loss
    one, nine = (health["sd"][-1] for _, health, _ in few)
    assert 0.8 * one < nine < COOLER.warn_loss  # what they share does not average out


def test_effectiveness_above_one_keeps_prior():
    _, health, readings = run_component(fly([0.0, 0.0]), COOLER)
    status = dict(readings.filter(flight_id="T-1_20240101_01").select("parameter", "status").rows())
    assert status["hxt_effectiveness"] == status["hxt_effectiveness_fast"] == "one_or_more"
    assert health.select("value", "status").rows() == [(0.0, "prior_only")] * 2


def test_logged_unit_counts_as_new():
    signals = fly([0.0] * 35 + [0.06] * 5)  # as made, the second unit is 6 % smaller
    work = pl.DataFrame([("AAA", "T-1", 1, "HXT", "REPLACED", date(2024, 2, 5))], NO_WORK.schema, orient="row")
    samples = component_samples(signals, SPRAYED)
    legs, design = commission(signals, work, SPRAYED)
    healths = (unit_health(samples, legs, design, entries, SPRAYED)[1].health for entries in (work, NO_WORK))
    new, old = (health.sort("departed_at")[-1] for health in healths)
    assert new["status"].item() == old["status"].item() == "ok"
    assert new["value"].item() < 0.025
    assert new["sd"].item() < 0.025
    assert old["value"].item() - 1.645 * old["sd"].item() < 0.06 < old["value"].item() + 1.645 * old["sd"].item()


def test_recovers_accepted_spray():
    design, health, _ = run_component(fly([0.0] * 60 + [0.3] * 5), SPRAYED)
    values = dict(design.select("parameter", "value").rows())
    assert values["hxt_ntu"] == pytest.approx(TRUE["hxt_ntu"], rel=0.03)
    assert values["hxt_water_spray"] == pytest.approx(TRUE["hxt_water_spray"], abs=0.03)
    assert health["value"][:60].abs().max() < 0.05
    assert health["value"][-1] == pytest.approx(0.3, abs=0.06)
    assert set(health["status"]) == {"ok"}


def test_missing_signal_is_reported():
    signals = fly([0.0]).filter(~pl.col("signal").is_in(["mach", "altitude_m"]))
    legs, _ = commission(signals, NO_WORK, COOLER)
    assert legs["reason"].to_list() == ["NOT_RECORDED"]
    readings = component_readings(component_samples(signals, COOLER), COOLER)
    status = dict(readings.select("parameter", "status").rows())
    assert status["hxt_effectiveness_fast"] == "not_recorded"
    assert status["hxt_effectiveness"] in {"measured", "one_or_more"}


def test_lumped_coefficients_need_outlet_difference():
    """The outlets are known to 1 K each: their difference must be four times its deviation."""
    outlets = [300.0, 315.0, 330.0, None]
    at = {"hx_in_k": 400.0, "hx_out_k": 320.0, "tat_k": 250.0, "pack_flow_kg_s": 0.8, "ram_flow_kg_s": 1.6}
    rows = lumped_coefficients(flights(4, ram_out_k=outlets, **at))
    first = rows.filter(flight_id="T-1_000").sort("parameter", descending=True)
    assert first["parameter"].to_list() == ["hx_h_hot_w_k", "hx_h_cold_w_k"]
    expected = [0.8 * 1009.0 * 80.0 / 20.0, 1.6 * 1005.0 * 50.0 / 20.0]
    np.testing.assert_allclose(first["value"], expected, rtol=1e-6)
    shares = np.hypot(np.hypot(1.0, 1.0) / 20.0, [0.02, 0.08])
    np.testing.assert_allclose(first["sd"], shares * expected, rtol=1e-6)
    assert rows["status"].to_list() == ["ok", *["not_identifiable"] * 3] * 2
    assert rows["value"].null_count() == rows["sd"].null_count() == 6


@pytest.mark.parametrize(("across_k", "is_ok"), [(5.6, False), (5.7, True)])
def test_difference_counts_from_four_deviations(across_k, is_ok):
    row = flights(1, hx_in_k=400.0, hx_out_k=300.0 + across_k, tat_k=250.0, ram_out_k=300.0, pack_flow_kg_s=0.8,
                   ram_flow_kg_s=1.6)  # fmt: skip
    assert (lumped_coefficients(row)["status"] == "ok").all() == is_ok
