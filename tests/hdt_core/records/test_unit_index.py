"""Which unit was flying: one rule, one answer wherever it is asked, and what it costs where the truth is known."""

import datetime as dt

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdt_core.alerts.cases import Grid
from hdt_core.health.features import since_maintenance
from hdt_core.prognosis.unit_lives import episodes
from hdt_core.records.unit_index import REPLACEMENT, date_entries, first_flights, log_flags, log_kept, number_units
from hdt_core.simulate.design import FleetSettings
from hdt_core.simulate.fleet import simulate_fleet
from pipelines.report.plots import around_replacement

START = dt.datetime(2024, 3, 1, tzinfo=dt.UTC)
OWN = {"operator": "AAA", "tail": "T-1", "pack": 1}
UTC = pl.Datetime("us", "UTC")


def fly(hours: list[float]) -> pl.DataFrame:
    """Flights of one pack that depart so many hours after the start."""
    at = [START + dt.timedelta(hours=h) for h in sorted(hours)]
    ids = [f"T-1_{a:%Y%m%d}_{k:02d}" for k, a in enumerate(at)]
    return pl.DataFrame({"flight_id": ids, "departed_at": at}).with_columns(
        pl.lit("AAA").alias("operator"),
        pl.lit("T-1").alias("tail"),
        pl.lit(1, pl.Int32).alias("pack"),
        pl.col("departed_at").cast(UTC),
    )


def work(*entries: tuple[int, float | None], component: str = "HX", action: str = "REPLACED") -> pl.DataFrame:
    """Entries of a log: day from the start, and the hour of it where the log gives one."""
    rows = [
        OWN
        | {"component": component, "action": action, "finding": None}
        | {"done_on": (START + dt.timedelta(days=day)).date()}
        | {"done_at": None if hour is None else START + dt.timedelta(days=day, hours=hour)}
        for day, hour in entries
    ]
    schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String, "action": pl.String}
    return pl.DataFrame(rows, schema=schema | {"finding": pl.String, "done_on": pl.Date, "done_at": UTC})


def units(hours: list[float], log: pl.DataFrame) -> list[int]:
    return number_units(fly(hours), log)["unit"].to_list()


@pytest.mark.parametrize(
    ("log", "expected"),
    [
        (work((0, None)), [0, 0, 0, 1, 1]),
        (work((0, 8.0)), [0, 1, 1, 1, 1]),
        (work((0, 8.1)), [0, 0, 1, 1, 1]),
        (work((0, None)).drop("done_at"), [0, 0, 0, 1, 1]),
    ],
    ids=["day", "hour of a departure", "hour after it", "log without hours"],
)
def test_work_counts_from_its_moment(log, expected):
    """A day counts from its end."""
    assert units([2.0, 8.0, 23.9, 24.0, 30.0], log) == expected


@pytest.mark.parametrize(
    ("log", "expected"),
    [
        (work((0, None), component="CC"), [0, 0]),
        (work((0, None), action="CLEANED"), [0, 0]),
        (pl.concat([work((0, None)), work((0, None))]), [0, 1]),
        (work((0, None), (0, 10.0)), [0, 2]),
        (work((0, None)).with_columns(pack=pl.lit(None, pl.Int32)), [0, 0]),
    ],
    ids=["other component", "wash", "one job on two work orders", "two jobs of a day", "no pack"],
)
def test_only_replacements_install_units(log, expected):
    assert units([2.0, 30.0], log) == expected


@pytest.mark.parametrize(("hour", "hours"), [(None, []), (1.5, [2])])
def test_first_flight_follows_the_work(hour, hours):
    flights = first_flights(fly([1.0, 2.0]), work((0, hour)), ("HX",))
    assert flights["departed_at"].dt.hour().to_list() == hours


def answers(flights: pl.DataFrame, log: pl.DataFrame) -> dict[str, list[str]]:
    """Ids of the flights on which another unit flies first, as each part of the project answers."""
    units = number_units(flights, log).sort("departed_at")
    life = since_maintenance(flights, log).sort("departed_at")
    _, due = log_flags(flights, log, "HX")
    grid = Grid.from_frame(flights)
    ends = grid.worked_on(log, ("HX",), ("REPLACED",))[0][: flights.height]
    rows = flights.with_columns(row=pl.int_range(pl.len()))
    installed = set(first_flights(rows, log, ("HX",))["row"].to_list())
    ids = flights["flight_id"]
    return {
        "records": units.filter(pl.col("unit").diff() > 0)["flight_id"].to_list(),
        "features": life.filter(pl.col("hx_life").diff() > 0)["flight_id"].to_list(),
        "twin": ids.filter(pl.Series(due == REPLACEMENT))[0 if due[0] == 0 else 1 :].to_list(),
        "alerts": ids.filter(pl.Series(ends))[0 if not ends[0] else 1 :].to_list(),
        "prognosis": [i for k, i in enumerate(ids) if k > 0 and k in installed],
    }


@settings(max_examples=60, deadline=None)
@given(
    hours=st.lists(st.floats(0.0, 239.0), min_size=2, max_size=30, unique=True),
    days=st.lists(st.tuples(st.integers(0, 9), st.none() | st.floats(0.0, 23.9)), max_size=4),
)
def test_modules_agree_on_units(hours, days):
    results = answers(fly(hours), work(*days))
    assert all(answer == results["records"] for answer in results.values()), results


def test_entry_is_open_for_a_day_about_it():
    is_open, due = log_flags(fly([31.9, 32.0, 60.0, 79.9, 80.0]), work((2, 8.0)), "HX")

    assert (is_open == REPLACEMENT).tolist() == [False, True, True, True, False]
    assert (due == REPLACEMENT).tolist() == [False, False, True, False, False]


@pytest.mark.parametrize(("hour", "is_due"), [(6.0, False), (6.1, True)])
def test_record_may_begin_within_a_day_of_work(hour, is_due):
    _, due = log_flags(fly([30.0, 60.0]), work((0, hour)), "HX")

    assert (due == REPLACEMENT).tolist() == [is_due, False]


def test_log_is_kept_from_its_first_entry_on():
    """Of those within the record."""
    flights = fly([10.0, 30.0, 50.0])

    assert log_kept(flights, work((0, 5.0), (0, 20.0), (1, 16.0))).tolist() == [False, True, True]
    assert log_kept(flights, work((0, 5.0))).tolist() == [False] * 3


FLIGHTS = fly([24.0 * day + 6.0 * leg for day in range(60) for leg in range(4)])
LOG = work((40, None))


def test_message_ends_the_old_life():
    """On the day of the replacement."""
    message = FLIGHTS.slice(161, 1).select("operator", "tail", "pack", "flight_id", message_time="departed_at")
    lives = episodes(FLIGHTS, message.with_columns(code=pl.lit("21-52-HXTEMP")), LOG).filter(component="HX")
    assert lives.select("first_row", "end_row", "failed").rows() == [(0, 161, True), (164, 240, False)]


def test_figure_begins_at_first_new_flight():
    before = pl.col("departed_at") < FLIGHTS["departed_at"][164]
    share = FLIGHTS.with_columns(ua_share=pl.when(before).then(0.7).otherwise(1.0))
    _, rows = around_replacement(share, LOG)
    assert rows.filter(n=0)["flight_id"].to_list() == [FLIGHTS["flight_id"][164]]


@pytest.fixture(scope="module")
def truths() -> list[tuple[pl.DataFrame, pl.DataFrame]]:
    """What really flew, and the log, of fleets whose entries come up to five flights late."""
    size = FleetSettings(operators=1, tails=3, flights=400, cpl_share=0.0)
    return [(a.health, a.maintenance.with_columns(operator=pl.lit(a.operator), tail=pl.lit(a.tail)))
            for seed in (3, 4) for a in simulate_fleet(seed, size)]  # fmt: skip


def count_errors(truths: list[tuple[pl.DataFrame, pl.DataFrame]], shift: dt.timedelta) -> tuple[int, int, int]:
    """Flights of an old part given to the new one, of a new one to the old, and how many replacements there were, where
    a day counts from its end less `shift`."""
    early = late = replacements = 0
    for health, log in truths:
        counted = date_entries(log).with_columns(pl.col("counts_from") - shift)
        flights = health.with_columns(pl.col("pack").cast(pl.Int32))
        for component, true in (("HX", "hx_unit"), ("CC", "cc_unit")):
            units = number_units(flights, counted, component)
            early += units.filter(pl.col("unit") > pl.col(true)).height
            late += units.filter(pl.col("unit") < pl.col(true)).height
            replacements += log.filter(component=component, action="REPLACED").height
    return early, late, replacements


def test_no_old_unit_counts_as_new(truths):
    early, _, replacements = count_errors(truths, dt.timedelta())
    assert replacements >= 6
    assert early == 0


def test_few_new_flights_count_as_old(truths):
    """The price: flights of the new unit at the end of the old one's record."""
    _, late, replacements = count_errors(truths, dt.timedelta())
    assert late < 8 * replacements


def test_beginning_of_day_errs_early(truths):
    """Counted from its beginning, the day would make old units new."""
    assert count_errors(truths, dt.timedelta(days=1))[0] > 0
