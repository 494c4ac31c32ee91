"""Simulated aircraft obey physics and the contract; lives end for their reason; wear keeps its shapes."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from hdt_core.physics.compressor import effective_diameter_m
from hdt_core.physics.heat_exchanger import mean_specific_heat_j_kg_k
from hdt_core.prognosis.base import join_unlogged_lives
from hdt_core.simulate import packs
from hdt_core.simulate.design import FleetSettings, draw_design
from hdt_core.simulate.episodes import LEAD, EpisodeSettings, draw_episodes
from hdt_core.simulate.fleet import by_month, design_truth, simulate_fleet
from hdt_core.simulate.recorder import SENSORS
from hdt_core.simulate.wear import SHAPES, WearSettings, draw_wear

SIZE = FleetSettings(operators=2, tails=1, flights=160, cpl_share=0.01)


@pytest.fixture(scope="module")
def fleet():
    return list(simulate_fleet(11, SIZE))


def test_same_seed_gives_same_fleet(fleet):
    again = next(iter(simulate_fleet(11, SIZE)))
    assert again.snapshots.equals(fleet[0].snapshots)
    assert again.health.equals(fleet[0].health)
    assert not next(iter(simulate_fleet(12, SIZE))).snapshots.equals(fleet[0].snapshots)


def test_snapshot_columns_follow_the_contract(fleet):
    columns = ["flight_id", "report_time", "phase_code", "pack", *SENSORS]
    for aircraft in fleet:
        names = aircraft.snapshots.columns
        assert names == [c for c in columns if c in names]
        assert aircraft.snapshots["report_time"].dtype == pl.Datetime("us", "UTC")


def test_flight_ids_follow_the_contract(fleet):
    for aircraft in fleet:
        assert aircraft.snapshots["flight_id"].str.contains(r"^[A-Z0-9-]{2,10}_\d{8}_\d{2}$").all()


def test_snapshots_have_no_nan(fleet):
    for aircraft in fleet:
        assert not aircraft.snapshots.select(pl.selectors.float().is_nan().any()).row(0)[0]


def test_months_divide_the_snapshots(fleet):
    for aircraft in fleet:
        assert sum(part.height for part in by_month(aircraft.snapshots).values()) == aircraft.snapshots.height


def test_truth_has_every_flight(fleet):
    for aircraft in fleet:
        assert aircraft.health.height == 2 * SIZE.flights
        assert aircraft.health.sort("index")["departed_at"].is_sorted()
        assert set(aircraft.snapshots["flight_id"]) == set(aircraft.health.filter("arrived")["flight_id"])


def test_truth_has_equation_6():
    assert {"eq6_intercept_m", "eq6_slope_m_per_count"} <= set(design_truth(11)["parameter"])


def pack_at_reference(seed: int, n: int):
    """Design of a pack; its conditions and demand, n times."""
    design = draw_design(np.random.default_rng(seed))
    one = np.ones(n)
    return design, packs.reference(one), packs.reference_demand(design, one), one


def test_sound_pack_conserves_heat():
    design, now, demand, one = pack_at_reference(0, 1)
    hot_k, ram_k, flow, _ = packs.outlets(design, now, demand, one * 0.4, packs.clean(one))
    cold_k = now.tat_k + design.ram_heating_k
    lost_w = demand.flow_kg_s * mean_specific_heat_j_kg_k(demand.hot_in_k, hot_k) * (demand.hot_in_k - hot_k)
    np.testing.assert_allclose(lost_w, flow * mean_specific_heat_j_kg_k(cold_k, ram_k) * (ram_k - cold_k), rtol=1e-9)


def test_worn_compressor_heats_the_exchanger():
    design, now, demand, one = pack_at_reference(1, 3)
    loss = np.array([0.0, 0.1, 0.2])
    inlet_pa, exit_pa = packs.compressor_pressures_pa(now)
    _, exit_k = packs.compressor_rows(
        diameter_m=one, inlet_k=now.tat_k, inlet_pa=inlet_pa, exit_pa=exit_pa,
        efficiency=design.cc_efficiency * (1.0 - loss),
    )  # fmt: skip
    hotter_k = packs.behind_worn_compressor(design, now, demand, loss).hot_in_k - demand.hot_in_k
    np.testing.assert_allclose(hotter_k, exit_k - exit_k[0], atol=1e-9)
    assert 5.0 < hotter_k[1] < 25.0


def test_controller_holds_its_target():
    """The door opens as the pack wears, and hides it while it can."""
    design, now, demand, one = pack_at_reference(1, 6)
    demand = packs.Demand(demand.flow_kg_s, demand.hot_in_k, one * packs.sized_target_k(design))
    blocked = packs.ExchangerWear(0.0 * one, np.linspace(0.0, 0.3, one.size), 0.0 * one, one)
    door = packs.controlled_door(design, now, demand, blocked)
    assert door[0] == pytest.approx(design.door_sizing, abs=0.002)
    assert (np.diff(door) > 0).all()
    hot_k = packs.outlets(design, now, demand, door, blocked)[0]
    np.testing.assert_allclose(hot_k[door < 0.99], demand.target_k[door < 0.99], atol=0.2)


def loss_ratios(film: list[float], blockage: list[float]):
    """Conductance left, as it appears to one who trusts the clean duct, and ram flow left."""
    one = np.ones(3)
    wear = packs.ExchangerWear(np.array(film), np.array(blockage), 0 * one, one)
    return packs.loss_ratios(draw_design(np.random.default_rng(2)), wear)


def test_blockage_exaggerates_apparent_loss():
    ratio, apparent, ram = loss_ratios([0.0] * 3, [0.0, 0.2, 0.4])
    np.testing.assert_allclose([ratio[0], apparent[0], ram[0]], 1.0, atol=1e-6)
    assert (apparent[1:] < ratio[1:]).all()
    assert (ram[1:] < 1.0).all()


def test_film_leaves_ram_flow():
    ratio, apparent, ram = loss_ratios([0.0, 1e-4, 2e-4], [0.0] * 3)
    np.testing.assert_allclose(ram, 1.0)
    np.testing.assert_allclose(ratio, apparent, atol=0.01)


def test_messages_follow_large_losses():
    failed = []
    for seed in (1, 2, 3, 4):
        for aircraft in simulate_fleet(seed, FleetSettings(operators=2, tails=3, flights=300)):
            hx = aircraft.events.filter((pl.col("component") == "HX") & pl.col("message_index").is_not_null())
            at = hx.join(aircraft.health, left_on=["pack", "message_index"], right_on=["pack", "index"])
            failed += (1.0 - at["apparent_ua_ratio"]).to_list()
    assert len(failed) >= 3
    assert 0.2 < np.median(failed) < 0.6


def test_diameter_follows_equation_5(fleet):
    for aircraft in fleet:
        running = (pl.col("phase_code") == "CR") & (pl.col("cc_speed_rpm") > 1e4)
        rows = aircraft.snapshots.filter(running).drop_nulls(["cc_in_psia", "cc_out_psia", "cc_in_degc"])
        diameter = effective_diameter_m(
            rows["cc_in_psia"].to_numpy(),
            rows["cc_out_psia"].to_numpy(),
            rows["cc_in_degc"].to_numpy() + 273.15,
            rows["cc_speed_rpm"].to_numpy() * np.pi / 30.0,
        )
        rows = rows.with_columns(seen=pl.Series(diameter)).group_by("flight_id", "pack").agg(pl.col("seen").median())
        both = rows.join(aircraft.health.with_columns(pl.col("pack").cast(pl.Int32)), on=["flight_id", "pack"])
        both = both.filter((pl.col("sensor_fault") == "") & ~pl.col("pack_off"))
        assert (both["seen"] - both["cc_eff_diameter_m"]).abs().median() < 0.0015


def test_one_hz_log_is_smooth(fleet):
    logs = [log for aircraft in fleet for log in aircraft.cpl.values()]
    assert logs
    log = logs[0].filter(pl.col("pack") == 1)
    step_s = log["report_time"].diff().dt.total_seconds().drop_nulls()
    assert (step_s == 1).all()
    assert "phase_code" not in log.columns
    cruise = log[2000:2600]["altitude_ft"].drop_nulls()
    assert (cruise - cruise.median()).abs().median() < 40.0


SMALL = EpisodeSettings(aircraft=40, flights=400)


def test_second_hot_flight_raises_message():
    lives = draw_episodes(1, SMALL)
    ended = np.nonzero(lives.message < SMALL.flights)[0]
    assert ended.size > 10
    hot = lives.overheat_k > SMALL.rule.excess_k
    for unit in ended:
        end = lives.message[unit]
        assert hot[unit, end]
        assert hot[unit, max(end - 2, 0) : end].any()
        assert not (hot[unit, 1:end] & hot[unit, : end - 1]).any()


def test_lives_end_once_demand_exceeds_ratio():
    exact = replace(SMALL, noise_sd=1e-9, drift_sd=0.0, map_error=0.0, pack_error=0.0)
    lives = draw_episodes(2, exact)
    ended = np.nonzero(lives.message < SMALL.flights)[0]
    demand = lives.demand[ended, LEAD + lives.message[ended]]
    # the flight's own scatter in what it is said to ask is 0.015
    assert (lives.ratio[ended, lives.message[ended]] < demand + 0.06).all()


def test_hazard_rises_with_loss():
    lives = draw_episodes(2, SMALL)
    left, failed = lives.remaining()
    at = (left >= 0) & failed
    soon = [(left[at & (lives.loss >= a) & (lives.loss < a + 0.1)] < 30).mean() for a in (0.0, 0.1, 0.2)]
    assert (np.diff(soon) > 0).all()


def test_offsets_spread_as_declared():
    quiet = replace(SMALL, noise_sd=1e-9, drift_sd=0.0, offset_sd=0.02, wash_share=0.0)
    lives = draw_episodes(3, quiet)
    offset = (lives.estimated_loss - lives.loss)[lives.age_known, 0]
    assert offset.std() == pytest.approx(0.01, rel=0.25)


def test_washed_units_wear_less():
    washed = draw_episodes(4, replace(SMALL, wash_share=1.0, wash_every_flights=100.0))
    never = draw_episodes(4, replace(SMALL, wash_share=0.0))
    assert washed.loss[:, -1].mean() < 0.7 * never.loss[:, -1].mean()


def test_unlogged_record_joins_next_life():
    lives = draw_episodes(5, SMALL)
    joined = join_unlogged_lives(np.random.default_rng(0), lives)
    left, failed = joined.remaining()
    unit = int(np.argmin(lives.message))
    assert left[unit, 0] == lives.message[unit]
    assert joined.loss[unit, lives.message[unit] + 12] < lives.loss[unit, lives.message[unit]]
    after = joined.message[unit]
    assert failed[unit, lives.message[unit] + 1] == (after < SMALL.flights)


def population(shape: str, units: int = 200, flights: int = 500, **kw: float) -> np.ndarray:
    shares = tuple(float(s == shape) for s in SHAPES)
    settings = WearSettings(shape_shares=shares, rate_log_sd=0.0, **({"clog_rate": 0.0} | kw))
    return draw_wear(np.random.default_rng(3), np.zeros(units), flights, settings).loss


@pytest.mark.parametrize("shape", SHAPES)
def test_wear_never_heals(shape):
    assert (np.diff(population(shape), axis=1) >= -1e-12).all()


@pytest.mark.parametrize("shape", SHAPES)
def test_wear_stays_a_fraction(shape):
    loss = population(shape)
    assert 0.0 <= loss.min() <= loss.max() <= 0.95


@pytest.mark.parametrize(("shape", "sign"), [("accelerating", 1), ("asymptotic", -1), ("falling_rate", -1)])
def test_shapes_bend_as_named(shape, sign):
    loss = population(shape)
    first = loss[:, 250] - loss[:, 0]
    second = loss[:, 499] - loss[:, 250]
    worn = loss[:, 499] < 0.85
    assert np.mean(sign * (second - first)[worn] > 0) > 0.95


def test_lives_end_at_reference_loss():
    loss = population("linear", life_log_sd=0.0, life_median_flights=400.0)
    assert np.median(loss[:, 400]) == pytest.approx(0.42, rel=0.02)


def test_clogs_come_at_declared_rate():
    settings = WearSettings(life_median_flights=1e9, clog_rate=1 / 1000, shape_shares=(1.0, 0, 0, 0, 0))
    clog = draw_wear(np.random.default_rng(0), np.zeros(400), 500, settings).clog
    started = (np.diff(clog, axis=1) > 0.015).sum() / 3
    assert started == pytest.approx(200, rel=0.25)


def test_same_seed_gives_same_wear():
    one, two = (draw_wear(np.random.default_rng(5), np.zeros(5), 50, WearSettings()).loss for _ in range(2))
    np.testing.assert_array_equal(one, two)
