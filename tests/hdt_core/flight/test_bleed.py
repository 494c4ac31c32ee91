"""Legs whose printed reports tell of odd bleed are turned away, and no others."""

from datetime import UTC, datetime, timedelta

import polars as pl
import pytest

from hdt_core.flight.bleed import BLEED, reject_odd_bleed
from hdt_core.tables.raw import RawReports

DAY = datetime(2026, 3, 5, 6, tzinfo=UTC)
SOUND = {"pack_1_flow_kg_s": 1.2, "pack_2_flow_kg_s": 1.2, "bleed_1_open": True, "bleed_2_open": True,
         "crossfeed_open": False, "altitude_m": 10_000.0, "report": "08", "file": "f", "file_version": "v",
         "operator": "AAA", "tail": "X-1"}  # fmt: skip


def reports(hours: float, **values: object) -> pl.DataFrame:
    """One report, so many hours after the first departure."""
    row = SOUND | {"reported_at": DAY + timedelta(hours=hours), "mach": 0.8} | values
    return pl.DataFrame([row], schema=dict(RawReports.create_empty().schema))


@pytest.fixture
def legs() -> pl.DataFrame:
    """Two flights of an aircraft and one of another, two packs each; one leg was turned away already."""
    flights = [("X-1", "a", 0), ("X-1", "b", 5), ("X-2", "c", 0)]
    rows = [("AAA", t, f, p, DAY + timedelta(hours=h)) for t, f, h in flights for p in (1, 2)]
    frame = pl.DataFrame(rows, schema=["operator", "tail", "flight_id", "pack", "departed_at"], orient="row")
    sick = (pl.col("flight_id") == "a") & (pl.col("pack") == 2)
    return frame.with_columns(reason=pl.when(sick).then(pl.lit("ICING")).otherwise(pl.lit(""))).with_columns(
        admitted=pl.col("reason") == "", n_nominal=pl.lit(7, pl.Int64)
    )


ODD = [{"bleed_2_open": False}, {"crossfeed_open": True}, {"pack_1_flow_kg_s": 0.02}]


@pytest.mark.parametrize("values", ODD)
def test_both_packs_of_the_flight_are_turned_away_and_an_earlier_reason_stays(legs, values):
    rows = reject_odd_bleed(legs, reports(1.5, **values))
    assert rows["reason"].to_list() == [BLEED, "ICING", "", "", "", ""]
    assert rows["admitted"].to_list() == [False, False, True, True, True, True]
    assert rows["n_nominal"].to_list() == [0, 7, 7, 7, 7, 7]
    assert rows.columns == legs.columns


@pytest.mark.parametrize(
    "values",
    [{}, {"crossfeed_open": True, "altitude_m": 3_000.0}, {"crossfeed_open": True, "altitude_m": None},
     {"crossfeed_open": True, "tail": "X-9"}, dict.fromkeys(("bleed_1_open", "crossfeed_open", "pack_2_flow_kg_s"))],
)  # fmt: skip
def test_what_is_normal_low_unknown_or_of_another_aircraft_turns_nothing_away(legs, values):
    assert reject_odd_bleed(legs, reports(1.5, **values)).equals(legs)


@pytest.mark.parametrize(
    ("values", "hours", "turned"),
    [
        ({"pack_1_flow_kg_s": 0.1999}, 1.0, 1), ({"pack_1_flow_kg_s": 0.2}, 1.0, 0),
        ({"crossfeed_open": True, "altitude_m": 4572.0}, 1.0, 0),
        ({"crossfeed_open": True, "altitude_m": 4572.1}, 1.0, 1),
        ({"crossfeed_open": True}, 25.0, 2), ({"crossfeed_open": True}, 25.1, 0),
    ],
)  # fmt: skip
def test_what_is_odd_and_how_long_a_flight_may_last(legs, values, hours, turned):
    rows = reject_odd_bleed(legs, reports(hours, **values))
    assert (rows["reason"] == BLEED).sum() == turned


def test_a_report_belongs_to_the_last_departure_before_it(legs):
    rows = reject_odd_bleed(legs, reports(6.0, crossfeed_open=True))
    assert rows.filter(reason=BLEED)["flight_id"].unique().to_list() == ["b"]
    assert reject_odd_bleed(legs, reports(30.0, crossfeed_open=True)).equals(legs)
    assert reject_odd_bleed(legs, reports(-1.0, crossfeed_open=True)).equals(legs)
