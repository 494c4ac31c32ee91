"""Which flights are held: by their own record, their neighbours, their aircraft and the fleet."""

from datetime import datetime, timedelta

import polars as pl
import pytest

from hdt_core.record.judge import judge_flights
from hdt_core.tables.raw import RawFlights
from tests.support.flight_lists import NOW, START, fleet, flight, listed

NO_DELIVERIES = pl.DataFrame(schema={"operator": pl.String, "tail": pl.String, "delivered_on": pl.Date})


@pytest.fixture(scope="module")
def good() -> pl.DataFrame:
    return fleet()


def judge(*parts: pl.DataFrame, deliveries: pl.DataFrame = NO_DELIVERIES) -> pl.DataFrame:
    return judge_flights(pl.concat(parts), deliveries, NOW)


def reasons(rows: pl.DataFrame) -> dict[str, str]:
    return dict(rows.select("flight_id", "reason").iter_rows())


def nth(flights: pl.DataFrame, tail: str, *places: int) -> pl.DataFrame:
    """Some flights of an aircraft, by their places in order of departure."""
    own = flights.filter(tail=tail).sort("departed_at")
    return own[[p % own.height for p in places]]


def shift_flights(flights: pl.DataFrame, offset: str, leg: int | None = None) -> pl.DataFrame:
    """Flights at another time, under the id of their new day."""
    at = pl.col("departed_at", "landed_at").dt.offset_by(offset)
    own_leg = pl.col("flight_id").str.tail(2) if leg is None else pl.lit(f"{leg:02d}")
    day = pl.col("departed_at").dt.strftime("%Y%m%d")
    name = pl.concat_str("tail", day, own_leg, separator="_").alias("flight_id")
    return RawFlights.conform(flights.with_columns(at).with_columns(name))


def without(flights: pl.DataFrame, others: pl.DataFrame) -> pl.DataFrame:
    return flights.join(others, on="flight_id", how="anti")


@pytest.mark.parametrize(("n_aircraft", "n_days"), [(1, 1), (1, 60), (2, 1), (5, 3), (4, 120)])
def test_good_flights_are_not_held(n_aircraft, n_days):
    assert judge(fleet(n_days, n_aircraft)).is_empty()


@pytest.mark.parametrize(
    ("facts", "reason"),
    [
        ({"highest_mach": 0.0, "highest_altitude_m": 900.0}, "no_flight"),
        ({"highest_mach": None, "highest_altitude_m": 900.0}, "no_flight"),
        ({"highest_mach": None, "highest_altitude_m": 2_900.0, "first_altitude_m": 2_500.0}, "no_flight"),
        ({"highest_mach": 0.0}, None),
        ({"highest_mach": None, "highest_altitude_m": None, "first_altitude_m": None}, None),
        ({"clock_back_s": 3_600, "n_steps_back": 1}, "clock_set_back"),
        ({"clock_back_s": 3_600, "n_steps_back": 20}, None),
        ({"clock_back_s": 60, "n_steps_back": 1}, None),
    ],
)
def test_own_record_decides_reason(good, facts, reason):
    run = flight("LX-AA0", START + timedelta(days=3, hours=14), 4, **facts)

    assert reasons(judge(good, listed([run]))).get(run["flight_id"]) == reason


@pytest.mark.parametrize(("back_s", "cause"), [(86_400 - 300, "midnight"), (3_600, None)])
def test_midnight_is_the_likely_cause(good, back_s, cause):
    """A date that was not advanced then."""
    run = flight("LX-AA0", START + timedelta(days=3, hours=14), 4, clock_back_s=back_s, n_steps_back=1)

    assert judge(good, listed([run]))["likely_cause"].to_list() == [cause]


@pytest.mark.parametrize(("minutes", "reason"), [(-1, None), (1, "after_clock")])
def test_landing_after_clock_waits(minutes, reason):
    landed_at = NOW + timedelta(minutes=minutes)
    own = flight("LX-AA9", landed_at - timedelta(hours=1), 1, landed_at=landed_at)

    assert reasons(judge(listed([own]))).get(own["flight_id"]) == reason


@pytest.mark.parametrize(
    ("offset", "cause"),
    [
        ("1y", "year"), ("-1y", "year"), ("2y", "year"), ("1mo", "month"), ("-1mo", "month"),
        ("-1024w", "week_rollover"), ("100d", None), ("-47d", None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("place", [5, 44, -1])
def test_misdated_flight_is_held(good, offset, cause, place):
    right = nth(good, "LX-AA1", place)
    wrong = shift_flights(right, offset)

    rows = judge(without(good, right), wrong)

    is_in_reach = START - timedelta(days=10) < wrong["departed_at"][0] < START + timedelta(days=40)
    expected = {} if is_in_reach else dict.fromkeys(wrong["flight_id"], cause)
    assert dict(rows.select("flight_id", "likely_cause").iter_rows()) == expected


@pytest.mark.parametrize("n_aircraft", [1, 4])
def test_week_rollover_is_held(n_aircraft):
    good = fleet(60, n_aircraft)
    late = nth(good, "LX-AA0", *range(120, 180))

    rows = judge(without(good, late), shift_flights(late, "-1024w"))

    assert rows["likely_cause"].to_list() == ["week_rollover"] * 60


def test_second_recorder_hides_no_rollover():
    good = fleet(60, 4)
    late = nth(good, "LX-AA0", *range(120, 180))
    right = late[30:31].with_columns(source=pl.lit("cpl"))

    rows = judge(without(good, late), shift_flights(late, "-1024w"), right)

    assert rows["likely_cause"].to_list() == ["week_rollover"] * 60


def test_day_exchanged_with_month_is_named(good):
    right = good.filter(pl.col("departed_at").dt.date() == datetime(2024, 3, 9).date(), tail="LX-AA2").head(1)
    wrong = shift_flights(right, "178d")  # 3 September

    assert judge(without(good, right), wrong)["likely_cause"].to_list() == ["day_month_exchanged"]


@pytest.mark.parametrize("day", [(1980, 1, 6), (1999, 8, 22), (2000, 1, 1), (2019, 4, 7)])
def test_default_date_is_named(good, day):
    wrong = listed([flight("LX-AA1", datetime(*day, 3, tzinfo=START.tzinfo), 1)])

    assert judge(good, wrong)["likely_cause"].to_list() == ["default_date"]


@pytest.mark.parametrize("parked", [range(30, 180), range(30, 300)])
def test_parked_aircraft_is_not_held(parked):
    good = fleet(120)

    assert judge(without(good, nth(good, "LX-AA1", *parked))).is_empty()


@pytest.mark.parametrize("n_aircraft", [2, 6])
def test_fleet_resumes_after_pause(n_aircraft):
    good = fleet(60, n_aircraft)
    later = shift_flights(fleet(2, n_aircraft), "200d")

    assert judge(good, later).is_empty()


@pytest.mark.parametrize(("delivered_on", "n_held"), [(START.date(), 1), (None, 0)])
def test_delivery_date_is_evidence(good, delivered_on, n_held):
    others_before = shift_flights(fleet(60), "-60d").filter(pl.col("tail") != "LX-AA1")
    early = shift_flights(nth(good, "LX-AA1", 0), "-40d")
    deliveries = pl.DataFrame({"operator": ["AQX"], "tail": ["LX-AA1"], "delivered_on": [delivered_on]})

    rows = judge(others_before, good, early, deliveries=deliveries.cast(NO_DELIVERIES.schema))

    assert rows["flight_id"].to_list() == early["flight_id"].to_list()[:n_held]


@pytest.mark.parametrize(("offset", "values"), [("0s", 600), ("1s", 600), ("1s", 590), ("-1s", 590), ("10m", 600)])
def test_copy_is_held(good, offset, values):
    right = nth(good, "LX-AA1", 10, 11, 30)
    copies = shift_flights(right.with_columns(n_values=pl.lit(values, pl.Int64)), offset)
    renumbered = copies.with_columns(
        flight_id=pl.col("flight_id").str.head(-2) + pl.lit("2") + pl.col("flight_id").str.tail(1)
    )

    rows = judge(good, renumbered)

    assert rows.select("flight_id", "reason", "other_flight_id").rows() == [
        (copy, "copy_of_flight", flight_id)
        for copy, flight_id in zip(renumbered["flight_id"], right["flight_id"], strict=True)
    ]


@pytest.mark.parametrize(
    ("name", "change", "n_held"),
    [
        ("mean_altitude_m", 50.0, 1),
        ("mean_altitude_m", 51.0, 0),
        ("mean_tat_k", 0.299, 1),
        ("mean_tat_k", 0.301, 0),
        ("mean_hx_in_k", 0.499, 1),
        ("mean_hx_in_k", 0.501, 0),
    ],
)
def test_copy_has_equal_means(good, name, change, n_held):
    """Another decoding has a decimal less; the times differ."""
    right = nth(good, "LX-AA1", 40)
    copy = shift_flights(right.with_columns(pl.col(name) + change), "10m", leg=22)

    held = judge(good, copy).filter(reason="copy_of_flight")

    assert held.height == n_held


@pytest.mark.parametrize(("seconds", "n_held"), [(120, 1), (121, 0)])
@pytest.mark.parametrize("end", ["departed_at", "landed_at"])
def test_copy_begins_or_ends_together(good, end, seconds, n_held):
    right = nth(good, "LX-AA1", 40).with_columns(mean_altitude_m=pl.lit(1_000.0))
    other = "landed_at" if end == "departed_at" else "departed_at"
    copy = right.with_columns(
        pl.col(end).dt.offset_by(f"{seconds}s"),
        pl.col(other).dt.offset_by("10m"),
        mean_altitude_m=pl.lit(2_000.0),
        flight_id=pl.col("flight_id").str.head(-2) + "22",
    )

    held = judge(good, copy).filter(reason="copy_of_flight")

    assert held.height == n_held


def test_sparser_copy_is_held(good):
    right = nth(good, "LX-AA1", 10)
    better = right.with_columns(n_values=pl.lit(700, pl.Int64), flight_id=pl.lit("LX-AA1_20240307_25"))

    assert judge(good, better)["flight_id"].to_list() == right["flight_id"].to_list()


@pytest.mark.parametrize("offset", ["-119h", "-120h30m"], ids=["begins in it", "ends in it"])
def test_overlapping_flight_is_held(good, offset):
    right = nth(good, "LX-AA1", 40)
    wrong = shift_flights(right, offset, leg=9)  # a ninth leg at the time of the second

    assert reasons(judge(without(good, right), wrong)) == dict.fromkeys(wrong["flight_id"], "overlaps_flight")


@pytest.mark.parametrize(
    ("pause_min", "altitude_m", "reason"),
    [(5, 11_000.0, "continuation"), (40, 11_000.0, None), (5, 800.0, None), (1, 5_000.0, None), (20, 800.0, None)],
)
def test_rest_of_split_flight_is_held(pause_min, altitude_m, reason):
    first = flight("LX-AA0", START, 1, last_altitude_m=11_000.0)
    rest = flight("LX-AA0", START + timedelta(minutes=90 + pause_min), 2, 9, first_altitude_m=altitude_m)

    assert reasons(judge(listed([first, rest]))).get(rest["flight_id"]) == reason


def test_flight_is_held_for_its_first_reason():
    first = flight("LX-AA0", START, 1, last_altitude_m=11_000.0)
    rest = flight(
        "LX-AA0", START + timedelta(minutes=95), 2, 9, first_altitude_m=11_000.0, source="both", log_fault="log_clock"
    )

    assert judge(listed([first, rest]))["reason"].to_list() == ["continuation"]


def test_other_operator_is_not_continued():
    first = flight("LX-AA0", START, 1, last_altitude_m=11_000.0, operator="AQW")
    rest = flight("LX-AA0", START + timedelta(minutes=95), 2, 9, first_altitude_m=11_000.0)

    assert rest["flight_id"] not in reasons(judge(listed([first, rest])))


@pytest.mark.parametrize(("n", "n_held"), [(9, 9), (10, 0)])
def test_ten_distant_flights_need_a_cause(good, n, n_held):
    right = nth(good, "LX-AA1", *range(n))

    assert judge(without(good, right), shift_flights(right, "100d")).height == n_held


@pytest.mark.parametrize(
    ("back_s", "cause"), [(86_400, "midnight"), (86_401, None), (75_600, "midnight"), (75_599, None)]
)
def test_midnight_takes_a_day_back(good, back_s, cause):
    """But for the time between two reports."""
    run = flight("LX-AA0", START + timedelta(days=3, hours=14), 4, clock_back_s=back_s, n_steps_back=1)

    verdict = judge(good, listed([run]))

    assert verdict["likely_cause"].to_list() == [cause]


@pytest.mark.parametrize(("back_s", "n_held"), [(60, 0), (61, 1)])
def test_clock_set_back_by_minutes(good, back_s, n_held):
    run = flight("LX-AA0", START + timedelta(days=3, hours=14), 4, clock_back_s=back_s, n_steps_back=1)

    assert judge(good, listed([run])).height == n_held
