"""Flights about a message, and those that a tail is calibrated on."""

from datetime import UTC, datetime, timedelta

import polars as pl
import pytest

from hdt_core.components.pack import HX
from hdt_core.flight.legs import baseline_flights, flag_windows
from hdt_core.tables.raw import RawMaintenance, RawMessages

START = datetime(2024, 3, 1, 6, tzinfo=UTC)


def fly(n: int) -> pl.DataFrame:
    """Flights of a pack, one a day."""
    rows = pl.DataFrame({"flight_number": range(n)}, schema={"flight_number": pl.Int64})
    return rows.with_columns(
        operator=pl.lit("AAA"),
        tail=pl.lit("T-1"),
        pack=pl.lit(1, pl.Int32),
        flight_id=pl.format("T-1_{}", pl.col("flight_number").cast(pl.String).str.zfill(3)),
        departed_at=pl.lit(START) + pl.duration(days=pl.col("flight_number")),
    )


def test_message_reaches_ten_flights_back_and_five_on():
    message = {"operator": "AAA", "tail": "T-1", "pack": 1, "message_time": START + timedelta(days=20, hours=1)}
    messages = RawMessages.conform(pl.DataFrame([message | {"code": HX.message_code}]))

    flags = flag_windows(fly(40), RawMaintenance.create_empty(), messages)

    assert flags.filter("near_message")["flight_number"].to_list() == list(range(10, 26))


@pytest.mark.parametrize(("n", "n_baseline"), [(5, 5), (19, 10), (20, 20), (200, 160)])
def test_baseline_grows_by_milestones(n, n_baseline):
    assert baseline_flights(fly(n)) == fly(n)["flight_id"].to_list()[:n_baseline]
