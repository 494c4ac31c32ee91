"""Windows about the log's entries, counted in flights of the tail."""

from datetime import UTC, date, datetime, timedelta

import polars as pl
import pytest

from hdt_core.flight.windows import AROUND_MAINTENANCE, AROUND_MESSAGE, baseline_flights, flag_windows, number_flights

START = datetime(2024, 3, 1, 6, tzinfo=UTC)


def legs(n: int = 60) -> pl.DataFrame:
    rows = [
        {"operator": "AQX", "tail": tail, "pack": pack, "departed_at": START + timedelta(days=k)}
        for tail in ("A", "B")
        for pack in (1, 2)
        for k in range(n)
    ]
    typed = pl.DataFrame(rows, schema_overrides={"pack": pl.Int32, "departed_at": pl.Datetime("us", "UTC")})
    return number_flights(typed.with_columns(pl.lit("x").alias("flight_id")))


def worked(component: str, action: str = "REPLACED", on: date = date(2024, 3, 31)) -> pl.DataFrame:
    return pl.DataFrame(
        {"operator": ["AQX"], "tail": "A", "done_on": on, "pack": 2, "component": component, "action": action}
    )


def warned(code: str) -> pl.DataFrame:
    return pl.DataFrame(
        {"operator": ["AQX"], "tail": "A", "message_time": START + timedelta(days=30, hours=1), "pack": 1, "code": code}
    )


NO_WORK, NO_MESSAGE = worked("HX").clear(), warned("21-52-HXTEMP").clear()


@pytest.mark.parametrize("component", AROUND_MAINTENANCE)
def test_window_reaches_as_many_flights_as_declared_and_only_that_pack(component):
    flagged = flag_windows(legs(), worked(component), NO_MESSAGE).filter("near_maintenance")
    before, after = AROUND_MAINTENANCE[component]
    assert flagged.select("tail", "pack").unique().rows() == [("A", 2)]
    # flight 29 left on the 30th of March, the last before the entry
    assert flagged["flight_number"].to_list() == list(range(29 - before, 29 + after + 1))


def test_a_time_of_day_opens_the_window_at_that_time():
    """The flight of six o'clock had left when the work was done at noon."""
    noon = worked("HX").with_columns(done_at=pl.lit(datetime(2024, 3, 31, 12, tzinfo=UTC)))
    flagged = flag_windows(legs(), noon, NO_MESSAGE).filter("near_maintenance")
    before, after = AROUND_MAINTENANCE["HX"]
    assert flagged["flight_number"].to_list() == list(range(30 - before, 30 + after + 1))


@pytest.mark.parametrize("action", ["INSPECTED", "CLEANED"])
def test_inspection_and_wash_open_no_window(action):
    assert not flag_windows(legs(), worked("HX", action), NO_MESSAGE)["near_maintenance"].any()


@pytest.mark.parametrize("code", ["21-52-HXTEMP", "21-51-CCFLOW"])
def test_message_of_the_exchanger_or_compressor_opens_a_window(code):
    flagged = flag_windows(legs(), NO_WORK, warned(code)).filter("near_message")
    before, after = AROUND_MESSAGE[code[:5]]
    assert flagged["flight_number"].to_list() == list(range(30 - before, 30 + after + 1))


def test_nuisance_message_opens_none():
    assert not flag_windows(legs(), NO_WORK, warned("21-61-TRIM"))["near_message"].any()


@pytest.mark.parametrize("on", [date(2023, 1, 1), date(2025, 1, 1)])
def test_entry_outside_the_record_flags_nothing(on):
    flagged = flag_windows(legs(), worked("HX", on=on), NO_MESSAGE)
    assert flagged.height == legs().height
    assert flagged["near_maintenance"].sum() == 0


def test_both_packs_share_their_flight_numbers():
    counts = legs().group_by("tail", "departed_at").agg(pl.col("flight_number").n_unique())
    assert set(counts["flight_number"]) == {1}


def test_windows_and_milestones_on_paper():
    assert AROUND_MAINTENANCE["RAM_DOOR"] == AROUND_MAINTENANCE["SENSOR"] == (15, 1)
    assert AROUND_MESSAGE == {"21-52": (10, 5), "21-51": (10, 5)}
    first = legs(400).filter(pl.col("tail") == "A", pl.col("pack") == 1)
    first = first.with_columns(flight_id=pl.col("flight_number").cast(pl.String).str.zfill(3))
    for n_flights, reached in (
        (9, 9),
        (10, 10),
        (19, 10),
        (20, 20),
        (40, 40),
        (79, 40),
        (80, 80),
        (159, 80),
        (400, 160),
    ):
        assert baseline_flights(first.head(n_flights).reverse()) == [f"{k:03d}" for k in range(reached)]


@pytest.mark.parametrize(("days", "reached"), [(21, True), (22, False)])
def test_an_entry_concerns_flights_of_three_weeks_before(days, reached):
    late = worked("HX", on=(START + timedelta(days=59 + days)).date())
    assert flag_windows(legs(), late, NO_MESSAGE)["near_maintenance"].any() == reached
