"""What a flight asks of an exchanger: the outlet with the door full open against the level that is held."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from alter import alter

from hdt_core.calibration import exchanger as hx
from hdt_core.margin import exchanger_demand as exchanger_demand_module
from hdt_core.margin.exchanger_demand import (
    CRITICAL,
    EXCESS_K,
    HOT_DAY,
    PARTS,
    exchanger_demand,
    falls_through,
    full_open_outlet_k,
)
from hdt_core.physics.air import hot_day_tat_k, reference_air
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance

LN_RATIOS = np.array([-1.2, -0.8, -0.55, -0.35, -0.2, -0.05, 0.1, 0.3, 0.6])
CRUISE = {
    "altitude_m": 11_000.0, "mach": 0.84, "tat_k": 247.0, "total_pressure_pa": 36_000.0, "hx_in_k": 400.0,
    "hx_out_k": 300.0, "ram_door_open": 0.3, "pack_flow_kg_s": 0.8,
}  # fmt: skip


def cruise(**changed: float) -> dict[str, np.ndarray]:
    return {name: np.array([value]) for name, value in (CRUISE | changed).items()}


def test_open_door_outlet_is_models():
    outlet = full_open_outlet_k(cruise(), hx.MEAN, np.array([-0.3, 0.0]), np.log(0.8))[0]
    full = cruise(ram_door_open=1.0)
    ram = 0.8 * clean_ram_flow_kg_s(full, hx.MEAN)
    for ln_ratio, k in zip((-0.3, 0.0), outlet, strict=True):
        ua = np.exp(ln_clean_conductance(full, ram, hx.MEAN) + ln_ratio)
        assert k == outlets_k(full["pack_flow_kg_s"], ram, full["hx_in_k"], full["tat_k"], ua)[0][0]


def test_open_door_outlet_ignores_position():
    shut, open_ = (full_open_outlet_k(cruise(ram_door_open=d), hx.MEAN, LN_RATIOS) for d in (0.1, 0.9))
    np.testing.assert_array_equal(shut, open_)


def test_no_speed_has_no_outlet():
    still = cruise(mach=0.0, total_pressure_pa=22_632.0)
    assert np.isnan(full_open_outlet_k(still, hx.MEAN, LN_RATIOS)).all()


@pytest.mark.parametrize("changed", [{"tat_k": 262.0}, {"pack_flow_kg_s": 0.95}, {"hx_in_k": 425.0}])
def test_harder_cruise_takes_margin(changed):
    plain, harder = (full_open_outlet_k(cruise(**c), hx.MEAN, np.zeros(1))[0, 0] for c in ({}, changed))
    assert harder > plain


@pytest.fixture
def s(flight) -> dict[str, np.ndarray]:
    """Signals of the flight."""
    return {name: flight[name].to_numpy().astype(float) for name in hx.SIGNALS}


def shape_k(tat_k: np.ndarray) -> np.ndarray:
    return np.interp(tat_k, (230.0, 250.0, 300.0), (-10.0, -10.0, 20.0))


@pytest.fixture
def trim_k(s) -> float:
    """Level above the shape where the door is not at its end: .3, .5, .95."""
    return float(np.median((s["hx_out_k"] - shape_k(s["tat_k"]))[[0, 1, 4]]))


@pytest.fixture
def row(dsm, laws, flight) -> dict[str, object]:
    return exchanger_demand(flight, dsm, laws).row(0, named=True)


def test_held_level_by_hand(row, s, trim_k):
    assert (row["high_n"], row["held_status"]) == (6, "flight")
    assert row["held_k"] == pytest.approx(np.median(shape_k(s["tat_k"]) + trim_k))
    assert row["full_open_share"] == pytest.approx(0.5)


def test_overheat_is_with_open_door(row, s, trim_k):
    over = np.where(s["ram_door_open"] > 0.95, np.maximum(s["hx_out_k"] - shape_k(s["tat_k"]) - trim_k, 0.0), 0.0)
    # the nearest sample to .8 of the way
    assert (row["overheat_p20_k"], row["overheat_p50_k"]) == pytest.approx(tuple(np.sort(over)[[4, 3]]))


def test_free_door_has_no_overheat(dsm, laws, flight):
    away = exchanger_demand(flight.with_columns(ram_door_open=pl.lit(0.3)), dsm, laws)
    assert away["overheat_p20_k"].to_list() == [0.0]


@pytest.mark.parametrize(("sample", "names"), [(4, CRITICAL[:5]), (3, CRITICAL[5:])], ids=["p20", "p50"])
def test_critical_ratios_by_hand(row, s, trim_k, sample, names):
    """The flow reads 1 % high, the temperatures by .5, -.4 and .3 K."""
    true = s | {"pack_flow_kg_s": s["pack_flow_kg_s"] * np.exp(-0.01), "hx_in_k": s["hx_in_k"] - 0.5}
    true |= {"tat_k": s["tat_k"] - 0.3}
    held_k = shape_k(s["tat_k"]) + trim_k + 0.4
    excess = np.sort(full_open_outlet_k(true, hx.MEAN, LN_RATIOS) - held_k[:, None], axis=0)[[sample]]
    by_hand = [falls_through(excess, LN_RATIOS, excess_k)[0] for excess_k in EXCESS_K]
    assert [row[name] for name in names] == pytest.approx(by_hand, abs=1e-9)


@pytest.fixture
def middle(s) -> dict[str, np.ndarray]:
    """The flight's middle operating point."""
    return {name: np.array([np.median(v)]) for name, v in s.items()}


def test_hot_day_by_hand(row, middle, trim_k):
    hot_k = hot_day_tat_k(middle["altitude_m"], middle["mach"])
    hot = middle | {"tat_k": hot_k, "hx_in_k": middle["hx_in_k"] + hot_k - middle["tat_k"]}
    excess = full_open_outlet_k(hot, hx.MEAN, LN_RATIOS) - shape_k(hot_k) - trim_k
    by_hand = [falls_through(excess, LN_RATIOS, excess_k)[0] for excess_k in EXCESS_K]
    assert [row[name] for name in HOT_DAY] == pytest.approx(by_hand)


def test_parts_by_hand(row, s, middle, trim_k, flight):
    def margin(signals: dict[str, np.ndarray], level_k: float, ln_ram: float = 0.0) -> float:
        outlet = full_open_outlet_k(signals, hx.MEAN, np.array([0.05]), ln_ram)[0, 0]
        return float(shape_k(signals["tat_k"])[0] + level_k - outlet)

    usual = reference_air(1) | {"hx_in_k": np.array([390.0]), "pack_flow_kg_s": np.array([0.7])}
    flown = usual | {name: middle[name] for name in ("hx_in_k", "pack_flow_kg_s")}
    bias = np.array([0.01, 0.5, -0.4, 0.3, 0.01, 0.2])[:, None]
    ln_ram = float(np.median(hx.ln_ram_flow_ratio(s | {"ram_out_k": flight["ram_out_k"].to_numpy()}, hx.MEAN, bias)))
    steps = [margin(usual, 301.0), margin(usual, trim_k), margin(flown, trim_k), margin(middle, trim_k)]
    steps.append(margin(middle, trim_k, ln_ram))
    assert [row[name] for name in PARTS] == pytest.approx([steps[0], *np.diff(steps)], abs=1e-9)


def test_own_level_needs_two_samples(dsm, laws, flight):
    two = exchanger_demand(alter(flight, pl.col("ram_door_open") == 0.95, ram_door_open=1.0), dsm, laws)
    assert two["held_status"].to_list() == ["flight"]


def test_single_sample_takes_packs_level(dsm, laws, flight, s):
    shut = alter(flight, pl.int_range(pl.len()) > 0, ram_door_open=1.0)
    one = exchanger_demand(shut, dsm, laws).row(0, named=True)
    assert one["held_status"] == "pack"
    assert one["held_k"] == pytest.approx(302.0 + np.median(shape_k(s["tat_k"])))


@pytest.mark.parametrize(("name", "value"), [("altitude_m", 4572.0), ("pack_flow_kg_s", 0.2), ("hx_in_k", None)])
def test_low_sample_asks_nothing(dsm, laws, flight, name, value):
    """Nor one of a pack at rest, nor a gap."""
    rest = alter(flight, pl.int_range(pl.len()) == 0, **{name: value})
    assert exchanger_demand(rest, dsm, laws)["high_n"].to_list() == [5]


def test_high_running_samples_ask(dsm, laws, flight):
    just = flight.with_columns(altitude_m=pl.lit(4572.1), pack_flow_kg_s=pl.lit(0.201))
    assert exchanger_demand(just, dsm, laws)["high_n"].to_list() == [6]


def test_low_flight_asks_nothing(dsm, laws, flight):
    none = exchanger_demand(flight.with_columns(altitude_m=pl.lit(4000.0)), dsm, laws)
    assert none.select("high_n", "held_status", CRITICAL[0]).rows() == [(0, "unknown", None)]


def test_blockage_needs_ram_outlet(dsm, laws, flight, row):
    blind = exchanger_demand(flight.with_columns(ram_out_k=pl.lit(None, pl.Float64)), dsm, laws)
    names = ("hx_margin_blockage_k", "hx_margin_ambient_k")
    assert blind.select(names).row(0) == (None, row["hx_margin_ambient_k"])


def test_unmet_pack_has_sound_sensors(dsm, laws, flight):
    stranger = exchanger_demand(flight.with_columns(tail=pl.lit("T-99")), dsm, laws)
    sound = replace(dsm, packs=(replace(dsm.packs[0], bias=(0.0,) * 6, inlet_bias_k=0.0),))
    same = exchanger_demand(flight, sound, laws)
    assert stranger[CRITICAL[2]].to_list() == pytest.approx(same[CRITICAL[2]].to_list())


def test_stored_ratios_interpolate_well():
    """To a quarter of a kelvin, to a twentieth where exchangers work."""
    stored = exchanger_demand_module.LN_RATIOS
    assert (stored[0], stored[-1]) == (-1.2, 0.6)
    off = []
    for low, high in pairwise(stored):
        at = np.linspace(low, high, 101)
        outlet = full_open_outlet_k(cruise(), hx.MEAN, at)[0]
        off.append(np.abs(outlet - np.interp(at, (low, high), outlet[[0, -1]])).max())
    np.testing.assert_array_less(off, [0.13, 0.028, 0.049, 0.041, 0.048, 0.054, 0.1, 0.23])


def test_excesses_are_as_declared():
    assert EXCESS_K == (-20.0, -10.0, 0.0, 5.0, 10.0)


def test_columns_name_share_with_excess():
    assert (*CRITICAL[:3], CRITICAL[9], HOT_DAY[0], HOT_DAY[4]) == (
        "critical_ln_ratio_p20_minus_20k", "critical_ln_ratio_p20_minus_10k", "critical_ln_ratio_p20_0k",
        "critical_ln_ratio_p50_10k", "critical_ln_ratio_hot_day_minus_20k", "critical_ln_ratio_hot_day_10k",
    )  # fmt: skip
