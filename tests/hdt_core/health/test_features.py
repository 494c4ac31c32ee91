"""Features are what their names say, and know nothing of the future."""

from datetime import UTC, date, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from hdt_core.health.features import features, residual_column, since_maintenance
from hdt_core.health.residuals import SCHEMA as RESIDUALS

START = datetime(2024, 3, 1, 6, tzinfo=UTC)
NO_RESIDUALS = pl.DataFrame(schema=RESIDUALS)


def health(loss: np.ndarray, pack: int = 1, tail: str = "T-AAA") -> pl.DataFrame:
    """A track of `hx_fouling`, three flights a day."""
    n = len(loss)
    when = [START + timedelta(hours=8 * k) for k in range(n)]
    ids = [f"{tail}_{w:%Y%m%d}_{k % 3 + 1:02d}" for k, w in enumerate(when)]
    frame = pl.DataFrame({"flight_id": ids, "departed_at": when, "value": loss}).with_columns(
        pl.lit("TST").alias("operator"),
        pl.lit(tail).alias("tail"),
        pl.lit(pack, pl.Int32).alias("pack"),
        pl.col("departed_at").cast(pl.Datetime("us", "UTC")),
        pl.lit("HX").alias("component"),
        pl.lit("hx_fouling").alias("parameter"),
        pl.lit(0.01).alias("sd"),
        pl.lit("-").alias("unit"),
        pl.lit("ok").alias("status"),
        pl.lit("kalman").alias("estimator"),
    )
    return frame.with_columns(pl.col("value").fill_nan(None))


def legs_of(long: pl.DataFrame) -> pl.DataFrame:
    return long.select("operator", "tail", "flight_id", "pack", "departed_at", pl.lit(True).alias("admitted"))


def described(long: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    return features(long, NO_RESIDUALS, legs_of(long), maintenance)


@pytest.fixture
def replaced(nothing_done) -> pl.DataFrame:
    row = {"operator": "TST", "tail": "T-AAA", "pack": 1, "done_on": date(2024, 3, 15), "component": "HX"}
    return pl.concat(
        [nothing_done, pl.DataFrame([row | {"action": "REPLACED", "finding": "FOULED"}], schema=nothing_done.schema)]
    )


def test_slopes_are_least_squares(nothing_done) -> None:
    loss = np.cumsum(np.random.default_rng(0).normal(0.001, 0.004, 120))
    out = described(health(loss), nothing_done)
    for n in (10, 30, 100):
        expected = np.polyfit(np.arange(n), loss[-n:], 1)[0]
        assert out[f"hx_fouling_slope_{n}_per_flight"][-1] == pytest.approx(expected, rel=1e-6)


def test_slopes_stand_gaps_and_long_histories(nothing_done) -> None:
    loss = 0.0001 * np.arange(6000.0)
    loss[5990::3] = np.nan
    out = described(health(loss), nothing_done)
    assert out["hx_fouling_slope_10_per_flight"][-1] == pytest.approx(1e-4, rel=1e-6)


def test_a_step_shows_in_three_flights_and_wear_does_not(nothing_done) -> None:
    wear = 0.002 * np.arange(80.0)
    out = described(health(wear), nothing_done)
    assert out["hx_fouling_step_3"].drop_nulls().abs().max() < 0.02
    clogged = wear + np.where(np.arange(80) >= 60, 0.15, 0.0)
    step = described(health(clogged), nothing_done)["hx_fouling_step_3"]
    assert step[59] < 0.03
    assert step[61] > 0.12


def test_a_new_unit_starts_a_new_life(replaced) -> None:
    loss = np.where(np.arange(90) < 45, 0.3, 0.0) + 0.001 * np.arange(90)
    out = described(health(loss), replaced)
    day = out["departed_at"].dt.date()
    assert out.filter(day <= date(2024, 3, 15))["flights_since_replacement"].null_count() == 45
    assert out.filter(day > date(2024, 3, 15))["flights_since_replacement"].to_list() == list(range(45))
    # no slope reaches back over the replacement
    assert out["hx_fouling_slope_100_per_flight"][-1] == pytest.approx(0.001, rel=1e-6)


def test_the_age_of_a_unit_fitted_before_the_record_begins_is_not_known():
    long = health(np.zeros(9))
    log = pl.DataFrame({"operator": "TST", "tail": "T-AAA", "pack": 1, "component": "HX", "action": "REPLACED"})
    log = log.with_columns(pl.col("pack").cast(pl.Int32), done_on=pl.lit(date(1999, 1, 1)))
    assert features(long, NO_RESIDUALS, legs_of(long), log)["flights_since_replacement"].null_count() == 9


def test_nothing_leaks_from_the_future(replaced) -> None:
    loss = np.cumsum(np.random.default_rng(1).normal(0.002, 0.005, 90))
    long = pl.concat([health(loss), health(loss[::-1].copy(), pack=2)])
    whole = described(long, replaced)
    early = whole["departed_at"] < START + timedelta(days=20)
    part = described(long.filter(pl.col("departed_at") < START + timedelta(days=20)), replaced)
    assert_frame_equal(whole.filter(early), part, check_exact=False, rel_tol=1e-9, abs_tol=1e-9)


def test_row_order_and_other_tails_change_nothing(nothing_done) -> None:
    loss = np.cumsum(np.random.default_rng(2).normal(0.001, 0.004, 40))
    alone = described(health(loss), nothing_done)
    both = pl.concat([health(loss[::-1].copy(), tail="T-AAB"), health(loss)]).sample(fraction=1.0, shuffle=True, seed=1)
    assert_frame_equal(described(both, nothing_done).filter(pl.col("tail") == "T-AAA"), alone)


def test_packs_stand_side_by_side(nothing_done) -> None:
    long = pl.concat([health(np.full(10, 0.2)), health(np.full(10, 0.05), pack=2)])
    out = described(long, nothing_done)
    assert out.filter(pl.col("pack") == 1)["hx_fouling_between_packs"].to_list() == pytest.approx([0.15] * 10)
    assert out["flight_index"].to_list() == list(range(10)) * 2


def test_no_flights_no_rows(nothing_done) -> None:
    empty = health(np.zeros(1)).clear()
    assert described(empty, nothing_done).height == 0


def test_late_log_entry_counts_from_its_day(replaced) -> None:
    rows = legs_of(health(np.zeros(60)))
    out = since_maintenance(rows.with_columns(pl.lit(0).alias("flight_index")), replaced)
    assert out["hx_life"].to_list() == [0] * 45 + [1] * 15


@pytest.mark.parametrize(
    ("signal", "name"),
    [
        ("hx_out_k", "hx_out_d_k"),
        ("cc_flow_kg_s", "cc_flow_d_kg_s"),
        ("cc_effective_diameter_m", "cc_effective_diameter_d_m"),
    ],
)
def test_unit_ends_the_name(signal: str, name: str) -> None:
    assert residual_column(signal, "d") == name
