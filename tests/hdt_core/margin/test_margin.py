"""The margin: outlet with the ram door full open against the level that is held, and the conductance between."""

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration import exchanger as hx
from hdt_core.margin.conditions import asked, repeated
from hdt_core.margin.curves import falls_through
from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K, LN_RATIOS, PARTS, full_open_outlet_k
from hdt_core.margin.first_passage import passage, wear_rate
from hdt_core.margin.margin import at_excess, exchanger_margin

CRUISE = {
    "altitude_m": 11_000.0, "mach": 0.84, "tat_k": 247.0, "total_pressure_pa": 36_000.0, "hx_in_k": 400.0,
    "hx_out_k": 300.0, "ram_door_open": 0.3, "pack_flow_kg_s": 0.8,
}  # fmt: skip


def cruise(**changed: float) -> dict[str, np.ndarray]:
    return {name: np.array([value]) for name, value in (CRUISE | changed).items()}


def test_a_worn_exchanger_lets_the_outlet_stand_warmer():
    outlet = full_open_outlet_k(cruise(), hx.MEAN, LN_RATIOS)[0]
    assert (np.diff(outlet) < 0.0).all()
    assert CRUISE["tat_k"] < outlet.min()
    assert outlet.max() < CRUISE["hx_in_k"]


def test_where_the_door_stands_now_does_not_matter():
    shut, open_ = (full_open_outlet_k(cruise(ram_door_open=d), hx.MEAN, LN_RATIOS) for d in (0.1, 0.9))
    np.testing.assert_array_equal(shut, open_)


def test_a_speed_that_reads_nothing_gives_no_answer_and_no_warning():
    still = cruise(mach=0.0, total_pressure_pa=22_632.0)
    assert np.isnan(full_open_outlet_k(still, hx.MEAN, LN_RATIOS)).all()


@pytest.mark.parametrize("changed", [{"tat_k": 262.0}, {"pack_flow_kg_s": 0.95}, {"hx_in_k": 425.0}])
def test_hotter_air_more_flow_and_warmer_bleed_take_margin(changed):
    plain, harder = (full_open_outlet_k(cruise(**c), hx.MEAN, np.zeros(1))[0, 0] for c in ({}, changed))
    assert harder > plain


def test_a_blocked_ram_side_takes_margin():
    clean, blocked = (full_open_outlet_k(cruise(), hx.MEAN, np.zeros(1), ln)[0, 0] for ln in (0.0, np.log(0.7)))
    assert blocked > clean


@pytest.mark.parametrize("held_k", [285.0, 300.0, 315.0])
def test_at_its_critical_ratio_the_outlet_stands_at_its_level(held_k):
    excess = full_open_outlet_k(cruise(), hx.MEAN, LN_RATIOS) - held_k
    ratio = falls_through(excess, LN_RATIOS, 0.0)
    # straight lines between the ratios asked: half a kelvin
    assert full_open_outlet_k(cruise(), hx.MEAN, ratio)[0, 0] == pytest.approx(held_k, abs=0.5)


def test_curves_are_read_between_and_beyond_their_points():
    line = -0.1 - 0.026 * np.array(EXCESS_K)
    for excess in (-25.0, -20.0, 3.0, 7.0, 14.0):
        assert at_excess(line[None, :], excess)[0] == pytest.approx(-0.1 - 0.026 * excess)


def flights(n: int, ratio: float, fouling: float) -> tuple[pl.DataFrame, pl.DataFrame]:
    key = pl.DataFrame({"operator": "XXX", "tail": "LX-T01", "flight_id": [f"F{k}" for k in range(n)]})
    key = key.with_columns(pl.lit(1, pl.Int32).alias("pack"))
    wide = key.with_columns(hx_fouling=pl.lit(fouling), ln_ua_ratio=pl.lit(ratio), hx_life=pl.lit(0))
    lines = {name: -0.1 - 0.026 * e for name, e in zip(CRITICAL, EXCESS_K * 2, strict=True)}
    hot = {name.replace("_p20_", "_hot_day_"): value for name, value in list(lines.items())[: len(EXCESS_K)]}
    parts = dict.fromkeys(PARTS, 1.0)
    asks = key.with_columns(pl.lit(v).alias(n) for n, v in (lines | hot | parts).items())
    return wide, asks.with_columns(
        held_status=pl.lit("flight"), overheat_p20_k=pl.lit(0.0), full_open_share=pl.lit(0.0)
    )


def test_the_margin_is_what_the_conductance_left_is_worth():
    said = exchanger_margin(*flights(5, -0.1 + 0.026 * 8.0, 0.05))
    assert said["hx_margin_k"].to_list() == pytest.approx([8.0] * 5)
    assert (said["hx_margin_sd_k"] > 0.5).all()
    assert said["hx_margin_status"].to_list() == ["ok"] * 5
    parts = said.select(pl.sum_horizontal(*PARTS[:-1], "hx_margin_wear_k", "hx_margin_profile_k"))
    assert parts.to_series().to_list() == pytest.approx([8.0] * 5)


def test_nothing_asked_or_nothing_known_is_said_so():
    wide, asks = flights(3, 0.0, 0.1)
    unknown = exchanger_margin(wide, asks.clear())
    assert unknown["hx_margin_k"].null_count() == 3
    assert unknown["hx_margin_status"].to_list() == ["not_known"] * 3
    blank = exchanger_margin(wide.with_columns(ln_ua_ratio=pl.lit(None, pl.Float64)), asks)
    assert blank["hx_margin_k"].null_count() == 3


def test_two_hot_flights_of_three_ask_for_the_lower_of_them():
    critical = np.array([[-0.5, -0.1, -0.4, -0.3, -0.9, -0.2]])
    assert repeated(critical)[0, 1:].tolist() == [-0.5, -0.4, -0.3, -0.9, -0.3]
    assert repeated(critical, of=1).tolist() == critical.tolist()


def test_what_was_asked_knows_nothing_of_later_flights():
    critical = np.random.default_rng(0).standard_normal((2, 300))
    critical[0, :20] = np.nan
    pack, flight = (i.ravel() for i in np.indices((2, 120)))
    whole, cut = asked(critical, pack, flight), asked(critical[:, :120], pack, flight)
    for name, values in whole.items():
        np.testing.assert_array_equal(values, cut[name], err_msg=name)
    assert np.isnan(whole["asked_50"][:20]).all()


def steady(ratio: float, rate: float, asks: float = -0.5) -> np.ndarray:
    one = np.ones(1)
    edges = np.array([0.0, 25.0, 50.0, 100.0, 200.0, 300.0])
    return passage(ratio * one, 0.001 * one, np.full((1, 6), asks), rate * one, 1e-6 * one, edges)[0]


def test_first_passage_comes_when_wear_has_used_up_the_reserve():
    by = steady(ratio=-0.3, rate=0.002)  # 0.2 left at 0.002 a flight: a hundred flights
    assert by[0] == 0.0
    assert (np.diff(by) >= 0.0).all()
    assert by[2] < 0.05
    assert by[4] > 0.95


def test_less_reserve_or_faster_wear_is_never_later():
    plain = steady(-0.2, 0.001)
    assert (steady(-0.3, 0.001) >= plain).all()
    assert (steady(-0.2, 0.002) >= plain).all()
    assert (steady(-0.2, 0.001, asks=-0.4) >= plain).all()


def test_a_slope_counts_the_more_the_longer_it_was_seen():
    slope = np.full(3, 0.005)
    rate, sd = wear_rate(slope, np.array([3.0, 20.0, 60.0]))
    assert (np.diff(rate) > 0.0).all()
    assert (np.diff(sd) < 0.0).all()
    assert rate[2] == pytest.approx(0.005, rel=0.15)
