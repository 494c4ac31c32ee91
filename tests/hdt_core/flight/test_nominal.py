"""Wear, unrest and strays of the index at their edges; distance from the nominal fleet."""

import numpy as np
import polars as pl
import pytest
from scipy.stats import chi2

from hdt_core.flight.nominal import IndexLevel, Scatter, judge_conductance, learn_level, learn_scatter
from hdt_core.records.keys import LEG

N = 50
FLIGHT = np.arange(N)
TEXT = dict.fromkeys(("operator", "tail", "component", "action"), pl.String)
NO_LOG = pl.DataFrame(schema=TEXT | {"pack": pl.Int32, "done_on": pl.Date})


def levels(level: np.ndarray, unrest: float = 0.0) -> pl.DataFrame:
    key = {
        "operator": "TST",
        "tail": "T",
        "flight_id": [f"F{k:02d}" for k in range(N)],
        "pack": 1,
        "flight_number": FLIGHT,
    }
    rows = pl.DataFrame(key | {"index_level": level, "index_unrest": unrest, "index_n": 8}).cast({"pack": pl.Int32})
    return rows.with_columns(
        departed_at=pl.datetime(2024, 3, 1, time_zone="UTC") + pl.duration(days=pl.col("flight_number"))
    )


UNKNOWN = IndexLevel()


def judge_levels(level: np.ndarray, fleet: IndexLevel = UNKNOWN, **more: float) -> pl.DataFrame:
    rows = judge_conductance(levels(level, **more), NO_LOG, fleet)
    return rows.sort(LEG)


@pytest.mark.parametrize(("drop", "worn"), [(0.091, True), (0.089, False)])
def test_worn_is_nine_hundredths_below_the_units_clean_level(drop, worn):
    rows = judge_levels(np.where(FLIGHT < 20, 1.0, 1.0 - drop))
    assert rows["worn"].to_list() == ((FLIGHT >= 20) & worn).tolist()


def test_clean_is_the_upper_decile_and_no_lower_than_the_fleets_less_two_deviations():
    few = np.where(FLIGHT < 6, 1.2, 1.0)  # above the decile on six flights of fifty
    assert judge_levels(few)["worn"].sum() == N - 6
    assert judge_levels(np.where(FLIGHT < 4, 1.2, 1.0))["worn"].sum() == 0
    assert judge_levels(np.full(N, 0.809), IndexLevel(clean=1.0))["worn"].all()
    assert not judge_levels(np.full(N, 0.811), IndexLevel(clean=1.0))["worn"].any()


@pytest.mark.parametrize(("unrest", "restless"), [(6.51, True), (6.5, False)])
def test_unrest_beyond_six_and_a_half(unrest, restless):
    assert judge_levels(np.full(N, 1.0), unrest=unrest)["unrest"].to_list() == [restless] * N


@pytest.mark.parametrize(
    ("off", "usual", "stray"),
    [
        (0.071, 0.0, True), (0.069, 0.0, False), (-0.071, 0.0, True), (4.51 * 1.4826 * 0.02, 0.02, True),
        (4.49 * 1.4826 * 0.02, 0.02, False),
    ],
)  # fmt: skip
def test_a_stray_leaves_its_neighbours(off, usual, stray):
    rows = judge_levels(1.0 + off * (FLIGHT == 25), IndexLevel(stray=usual))
    assert rows["stray"].to_list() == ((FLIGHT == 25) & stray).tolist()
    assert rows["index_off"][25] == pytest.approx(off)


def test_neighbours_are_seven_flights_and_a_level_learned_is_theirs():
    level = np.random.default_rng(1).normal(1.0, 0.02, N)
    smooth = [np.median(level[max(0, k - 3) : k + 4]) for k in FLIGHT]
    assert judge_levels(level)["index_off"].to_list() == pytest.approx((level - smooth).tolist())
    learned = learn_level(levels(level), NO_LOG)
    assert learned.stray == pytest.approx(np.median(np.abs(level - smooth)))
    assert learned.clean == pytest.approx(np.sort(smooth)[round(0.9 * (N - 1))])
    assert learn_level(levels(level).clear(), NO_LOG) == IndexLevel()
    lone = judge_conductance(levels(level).head(1), NO_LOG, UNKNOWN)
    assert lone["index_off"].to_list() == [None]


def test_outliers_lie_beyond_the_chi_square_quantile():
    edge = np.sqrt(chi2.ppf(0.9995, 2))
    scatter = Scatter(("a", "b"), (1.0, 0.0), ((4.0, 0.0), (0.0, 1.0)))
    rows = pl.DataFrame(
        {"a": [1.0 + 0.5 * 1.001 * edge, 1.0 + 0.5 * 0.999 * edge, 1.0], "b": [0.0, None, 1.001 * edge]}
    )
    assert scatter.flag_outliers(rows).to_list() == [True, False, True]


def test_a_scatter_wants_two_hundred_legs_that_move():
    rng = np.random.default_rng(0)
    rows = pl.DataFrame({"a": rng.normal(2.0, 0.1, 400), "b": np.where(np.arange(400) < 201, 0.0, 1.0)})
    learned = learn_scatter(rows, ["a", "b"])
    assert learned.columns == ("a",)
    assert learned.mean[0] == pytest.approx(2.0, abs=0.03)
    assert learned.precision[0][0] == pytest.approx(100.0, rel=0.25)
    moving = rows.with_columns(b=pl.Series(np.where(np.arange(400) < 199, 0.0, rng.normal(size=400))))
    assert learn_scatter(moving, ["a", "b"]).columns == ("a", "b")
    half = rows.with_columns(b=pl.Series(np.where(np.arange(400) < 200, 0.0, rng.normal(size=400))))
    assert learn_scatter(half, ["a", "b"]).columns == ("a",)
    gaps = rows.with_columns(b=pl.when(pl.col("b") > 0.0).then("a"))
    assert learn_scatter(gaps, ["a", "b"]).columns == ("a",)
    assert learn_scatter(rows.head(199), ["a"]) is None
    assert learn_scatter(rows.head(200), ["a"]) is not None
    assert learn_scatter(rows.clear(), ["a"]) is None
