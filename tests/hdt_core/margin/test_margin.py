"""The margins read off straight critical curves by hand, with deviation, status and parts."""

from math import exp, hypot, log

import numpy as np
import polars as pl
import pytest

from hdt_core.margin.compressor_demand import CRITICAL_DIAMETER, FLOWS, WIDEST, read_across
from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K, HOT_DAY, PARTS, falls_through
from hdt_core.margin.margin import PRIOR_RULE, at_excess, compressor_margin, exchanger_margin, ln_ratio_margin

KEY = {"operator": "TST", "tail": "T", "pack": 1}


def flights(n: int, **columns: object) -> pl.DataFrame:
    rows = pl.DataFrame({"flight_id": [f"F{k:02d}" for k in range(n)]} | columns)
    return rows.with_columns(pl.lit(v).alias(k) for k, v in KEY.items())


def lines(at_zero: float, per_k: float, names: tuple[str, ...]) -> dict[str, list[float]]:
    return {name: [at_zero + per_k * e] for name, e in zip(names, EXCESS_K, strict=True)}


CURVES = lines(-0.10, -0.026, CRITICAL[:5]) | lines(-0.05, -0.020, HOT_DAY) | lines(-0.14, -0.030, CRITICAL[5:])
CLEAN = dict(zip(PARTS, ([1.0], [2.0], [4.0], [8.0], [16.0]), strict=True))


def margin(ratio: float | None = 0.108, target_source: str = "flight") -> dict[str, object]:
    """An exchanger at a ln ratio that asks for 8 K less in its hottest fifth: -.10 + .026 * 8."""
    demand = flights(1, **CURVES, **CLEAN, held_status=[target_source], overheat_p20_k=[0.0], full_open_share=[0.0])
    wide = flights(1, hx_fouling=[0.05], ln_ua_ratio=pl.Series([ratio], dtype=pl.Float64), hx_life=[0])
    return exchanger_margin(wide, demand).row(0, named=True)


def test_exchanger_margin_by_hand():
    """What the conductance left is worth, beside its level's doubt."""
    row = margin()
    middle = 0.248 / 0.030
    expected = {
        "hx_ln_ua_ratio": 0.108, "hx_margin_k": 0.208 / 0.026, "hx_margin_sd_k": hypot(0.025 / 0.026, 0.5),
        "hx_margin_hot_day_k": 0.158 / 0.020, "hx_margin_hot_day_sd_k": hypot(0.025 / 0.020, 0.5),
        "hx_margin_wear_k": middle - (1.0 + 2.0 + 4.0 + 8.0), "hx_margin_profile_k": 8.0 - middle,
    }  # fmt: skip
    assert {name: row[name] for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize(
    ("target_source", "sd_k", "status"),
    [
        ("flight", hypot(0.025 / 0.026, 0.5), "ok"), ("pack", hypot(0.025 / 0.026, 2.0), "level_of_pack"),
        ("unknown", None, "ok"),
    ],
)  # fmt: skip
def test_margin_states_source_of_level(target_source, sd_k, status):
    row = margin(target_source=target_source)
    assert row["hx_margin_sd_k"] == pytest.approx(sd_k)
    assert row["hx_margin_status"] == status


def test_unknown_ratio_has_no_margin():
    row = margin(ratio=None)
    assert (row["hx_margin_k"], row["hx_margin_wear_k"], row["hx_margin_status"]) == (None, None, "not_known")


def ratios(loss: list[float], ratio: list[float | None], life: list[int]) -> list[float | None]:
    frame = flights(len(loss), loss=loss, life=life, seen=pl.Series(ratio, dtype=pl.Float64))
    return frame.select(ln_ratio_margin(pl.col("seen"), "loss", "life"))[:, 0].to_list()


def test_ratio_is_level_less_wear():
    """The median of what there is, and of the last thirty flights."""
    level = [0.001 * k for k in range(40)]
    left = ratios([0.1] * 40, [v + log(0.9) for v in level], [0] * 40)
    assert (left[4], left[39]) == pytest.approx((0.002 + log(0.9), 0.0245 + log(0.9)))


def test_gap_takes_level_before():
    """A new unit takes its own."""
    left = ratios([0.2, 0.2, 0.0], [0.03 + log(0.8), None, 0.05], [0, 0, 1])
    assert left == pytest.approx([0.03 + log(0.8), 0.03 + log(0.8), 0.05])


def test_unmet_speed_limit_bounds_margin():
    unmet = delivery(limit_met=False)
    assert unmet["cc_flow_margin_status"] == "at_least"
    assert unmet["cc_flow_margin_sd_kg_s"] is not None


def test_narrow_map_bounds_margin():
    """Hot and high it is 1.096 of the flow: within the map."""
    narrow = delivery(widest=1.2)
    assert narrow["cc_flow_margin_kg_s"] == pytest.approx(0.8 * 0.2)
    names = ("cc_flow_margin_sd_kg_s", "cc_flow_margin_status", "cc_flow_margin_hot_high_status")
    assert [narrow[name] for name in names] == [None, "at_least", "ok"]


def test_prior_rule_is_as_declared():
    rule = (PRIOR_RULE.share, PRIOR_RULE.excess_k, PRIOR_RULE.excess_sd_k, PRIOR_RULE.of, PRIOR_RULE.messages)
    assert rule == (0.2, 7.0, 2.5, 3, 0)


def delivery(*, loss: float = 0.04, limit_met: bool = True, widest: float = 2.0) -> dict[str, object]:
    """A compressor whose critical ln diameter is -.30 (-.26 hot and high) and .2 a share of flow."""
    curves = {
        name: [at_zero + 0.2 * share]
        for where, at_zero in (("p20", -0.30), ("hot_high", -0.26))
        for name, share in zip(CRITICAL_DIAMETER[where], FLOWS, strict=True)
    }
    bounds = {name: [widest] for name in WIDEST.values()}
    demand = flights(1, **curves, **bounds, cc_flow_asked_kg_s=[0.8], cc_speed_limit_met=[limit_met])
    wide = flights(
        1, cc_diameter_loss=[loss], cc_diameter_loss_sd=[0.006], diameter_m=[0.16 * (1 - loss)],
        expected_diameter_m=[0.16], cc_life=[0],
    )  # fmt: skip
    return compressor_margin(wide, demand).row(0, named=True)


@pytest.fixture
def row() -> dict[str, object]:
    """Margins of a compressor that has lost 4 % of its diameter."""
    return delivery()


def test_flow_margin_by_hand(row):
    """The flow beyond what is asked."""
    hard, hot = (0.8 * ((log(0.96) + at) / 0.2 - 1.0) for at in (0.30, 0.26))
    sd = 0.8 / 0.2 * hypot(0.006, 0.0025)
    expected = {
        "cc_ln_diameter_ratio": log(0.96), "cc_flow_margin_kg_s": hard, "cc_flow_margin_hot_high_kg_s": hot,
        "cc_flow_margin_sd_kg_s": sd, "cc_flow_margin_hot_high_sd_kg_s": sd,
    }  # fmt: skip
    assert {name: row[name] for name in expected} == pytest.approx(expected)
    assert (row["cc_flow_margin_status"], row["cc_flow_margin_hot_high_status"]) == ("ok", "ok")


def test_diameter_left_by_hand(row):
    spare, spare_hot = (1.0 - exp(at - log(0.96)) for at in (-0.10, -0.06))
    expected = {
        "cc_diameter_left": spare, "cc_diameter_left_sd": (1.0 - spare) * hypot(0.006, 0.0025),
        "cc_diameter_left_hot_high": spare_hot,
    }  # fmt: skip
    assert {name: row[name] for name in expected} == pytest.approx(expected)


@pytest.mark.parametrize(("value", "at"), [(3.0, 0.5), (1.5, 2.0), (2.0, 1.0), (5.0, -0.5), (0.5, 4.0)])
def test_falling_curve_is_inverted(value, at):
    # 4 at 0, 2 at 1, 1 at 3
    """Between two points and beyond them."""
    assert falls_through(np.array([[4.0, 2.0, 1.0]]), np.array([0.0, 1.0, 3.0]), value)[0] == pytest.approx(at)


@pytest.mark.parametrize(
    ("at", "value", "slope"),
    [(0.5, 15.0, 10.0), (2.0, 40.0, 20.0), (1.0, 20.0, 10.0), (-1.0, 0.0, 10.0), (5.0, 100.0, 20.0)],
)
def test_rising_grid_is_interpolated(at, value, slope):
    # 10 at 0, 20 at 1, 60 at 3
    read = read_across(np.array([[0.0, 1.0, 3.0]]), np.array([10.0, 20.0, 60.0]), np.array([at]))
    assert [float(r[0]) for r in read] == pytest.approx([value, slope])


@pytest.mark.parametrize(
    ("excess_k", "value"), [(-25.0, -0.5), (-15.0, 0.5), (0.0, 4.0), (3.0, 7.0), (7.0, 11.8), (12.0, 18.8)]
)
def test_curve_over_excesses(excess_k, value):
    # 0, 1, 4, 9, 16 at -20, -10, 0, 5, 10 K
    assert at_excess(np.array([[0.0, 1.0, 4.0, 9.0, 16.0]]), excess_k)[0] == pytest.approx(value)
