"""A pack without reserve is told of though its exchanger is hardly worn; one that is worn is called worn."""

from datetime import UTC, datetime, timedelta

import polars as pl

from hdt_core.alerts.alerts import raise_alerts

FLIGHTS = 40


def fleet(passage: float, loss: float, flights: int = FLIGHTS) -> pl.DataFrame:
    start = datetime(2024, 5, 1, 6, tzinfo=UTC)
    at = [start + timedelta(hours=8 * k) for k in range(flights)]
    rows = pl.DataFrame({"departed_at": at, "flight_id": [f"LX-T01_{d:%Y%m%d}_{d.hour // 8 + 1:02d}" for d in at]})
    late = pl.int_range(pl.len()) >= 10
    return rows.with_columns(
        pl.col("departed_at").cast(pl.Datetime("us", "UTC")),
        operator=pl.lit("XXX"), tail=pl.lit("LX-T01"), pack=pl.lit(1, pl.Int32),
        hx_fouling=pl.when(late).then(loss).otherwise(0.0), hx_fouling_sd=pl.lit(0.01),
        hx_fouling_flight=pl.when(late).then(loss).otherwise(0.0),
        hx_fouling_slope_30_per_flight=pl.lit(0.0002), hx_fouling_slope_100_per_flight=pl.lit(0.0002),
        hx_fouling_step_3=pl.lit(0.0), running=pl.lit(True), door_full_open_share=pl.lit(0.3),
        hx_passage_100=pl.when(late).then(passage / 2).otherwise(0.0),
        hx_passage_300=pl.when(late).then(passage).otherwise(0.0),
        hx_margin_k=pl.lit(-2.0), hx_margin_hot_day_k=pl.lit(-7.0), hx_margin_design_k=pl.lit(6.0),
        hx_margin_ambient_k=pl.lit(-8.0), overheat_p20_k=pl.lit(2.0),
    )  # fmt: skip


LOG = pl.DataFrame(
    schema={
        "operator": pl.String, "tail": pl.String, "pack": pl.Int32, "done_on": pl.Date, "component": pl.String,
        "action": pl.String,
    }
)  # fmt: skip
HEALTH = pl.DataFrame()


def hx(alerts: pl.DataFrame) -> list[str]:
    return alerts.filter(component="HX")["diagnosis"].to_list()


def test_little_reserve_on_a_sound_exchanger_is_its_own_diagnosis():
    cases = raise_alerts(fleet(0.97, 0.04), HEALTH, LOG)
    assert hx(cases) == ["HX_LOW_MARGIN"]
    row = cases.row(0, named=True)
    assert "2 K above its level" in row["evidence"]
    assert "7 K above it on a hot day" in row["evidence"]
    assert "air outside -8 K" in row["evidence"]
    assert "Not a new exchanger alone" in row["recommended_action"]
    assert row["closed_at"] is None


def test_a_worn_exchanger_is_called_worn():
    assert hx(raise_alerts(fleet(0.97, 0.25), HEALTH, LOG)) == ["HX_FOULING"]


def test_it_ends_with_the_unit():
    flights = fleet(0.97, 0.04)
    done = flights["departed_at"][25].date()
    log = pl.DataFrame(
        {
            "operator": ["XXX"],
            "tail": ["LX-T01"],
            "pack": [1],
            "done_on": [done],
            "component": ["HX"],
            "action": ["REPLACED"],
        },
        schema=LOG.schema,
    )
    cases = raise_alerts(flights, HEALTH, log).filter(diagnosis="HX_LOW_MARGIN").sort("raised_at")
    assert cases["closed_at"][0] is not None
    assert cases["closed_at"][0].date() > done
    # the next unit has as little reserve, and its message may come within twenty flights
    assert cases["raised_at"].to_list()[1] - cases["closed_at"][0] <= timedelta(hours=8 * 7)
