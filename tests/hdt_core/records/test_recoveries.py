"""The maintenance log verdicts by the flights: on time, late, elsewhere, not done."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest
from worn_positions import CLEAN, FLIGHTS, RENEWED, WORN, departure, fly, judge, log, messages_after

from hdt_core.records.recoveries import as_known, find_recoveries, settle, units_as_known


def test_recovery_is_located():
    loss = np.where(np.arange(100) < 40, 0.2, np.where(np.arange(100) < 43, 0.17, 0.02))

    assert find_recoveries(loss, np.full(100, 0.01)) == [43]


@pytest.mark.parametrize(("loss", "sd"), [(0.049, 0.001), (0.2, 0.06), (np.nan, 0.01)])
def test_small_fall_is_no_recovery(loss, sd):
    track = np.where(np.arange(100) < 40, loss, 0.0)

    assert find_recoveries(track, np.full(100, sd)) == []


@pytest.mark.parametrize(
    ("entry", "verdict", "position", "from_flight"),
    [
        ((1, RENEWED), "logged", 1, RENEWED),
        ((1, RENEWED + 10), "logged", 1, RENEWED + 10),
        ((1, RENEWED + 30), "late", 1, RENEWED),
        ((2, RENEWED), "elsewhere", 1, RENEWED),
        ((2, RENEWED + 30), "elsewhere", 1, RENEWED),
        ((1, RENEWED - 30), "not_seen", 1, RENEWED - 30),
    ],
)
def test_verdict_follows_flights(entry, verdict, position, from_flight):
    verdicts = judge(fly(WORN, CLEAN), log(entry))

    columns = verdicts.select("verdict", "position", "flown_from")
    assert columns.row(0) == (verdict, position, departure(from_flight))


@pytest.mark.parametrize(
    "slip", [timedelta(days=365), timedelta(days=-365), timedelta(days=-30)], ids=["year on", "year back", "month back"]
)
def test_misdated_work_counts_at_recovery(slip):
    entry = log((1, RENEWED)).with_columns(pl.col("done_at") + slip)

    work = judge(fly(WORN[: RENEWED + 20]), entry)

    assert work.select("verdict", "flown_from").row(0) == ("misdated", departure(RENEWED))


def test_exchanged_day_is_misdated():
    """Work of 6 February, before flight 108, is logged under 2 June."""
    loss = np.where(np.arange(FLIGHTS) < 108, 0.3, 0.01)
    second_of_june = log((1, 460))

    assert judge(fly(loss), second_of_june)["verdict"].to_list() == ["misdated"]


@pytest.mark.parametrize(("messages", "verdict"), [((), "logged"), ((150 - 1,), "misdated")])
def test_possible_date_stays_without_message(messages, verdict):
    """A small loss shows no work; a month later the same part recovers from a large one."""
    loss = np.where(np.arange(200) < 100, 0.01, np.where(np.arange(200) < 150, 0.3, 0.01))
    entry = log((1, 150 - 3 * 30))

    work = judge(fly(loss), entry, messages_after(*messages))

    assert work["verdict"].to_list() == [verdict]


@pytest.mark.parametrize(("days", "verdict"), [(30, "logged"), (31, "ahead")])
def test_work_far_ahead_waits(days, verdict):
    last = departure(FLIGHTS - 1)
    entry = log((1, FLIGHTS - 1)).with_columns(done_at=pl.lit(last + timedelta(days=days)))

    work = judge(fly(np.full(FLIGHTS, 0.3)), entry)

    assert work["verdict"].to_list() == [verdict]


def test_closed_alert_counts_at_once():
    """An engineer who closes an alert knows what was done."""
    late = departure(FLIGHTS - 1) + timedelta(days=90)
    entry = log((1, FLIGHTS - 1)).with_columns(done_at=pl.lit(late), source=pl.lit("case"))

    assert judge(fly(np.full(FLIGHTS, 0.3)), entry)["in_force"].to_list() == [True]


def test_closed_alert_names_its_position():
    """Another position's recovery moves a line of the log, and no work that an engineer closed an alert with."""
    work = log((2, RENEWED + 30)).with_columns(source=pl.lit("case"))

    assert judge(fly(WORN, CLEAN), work)["position"].to_list() == [2]


@pytest.mark.parametrize("losses", [(CLEAN,), (np.full(FLIGHTS, np.nan),)])
def test_log_counts_without_evidence(losses):
    verdicts = judge(fly(*losses), log((1, RENEWED)))

    assert verdicts["in_force"].to_list() == [True]


@pytest.mark.parametrize(("since", "verdict"), [(9, "logged"), (10, "not_seen")])
def test_ten_flights_refute_work(since, verdict):
    worn = np.full(RENEWED + since, 0.3)

    assert judge(fly(worn), log((1, RENEWED)))["verdict"].to_list() == [verdict]


@pytest.mark.parametrize(
    ("message", "verdict", "from_flight"), [(-1, "early", 0), (-5, "logged", -4), (0, "logged", -4)]
)
def test_message_after_entry_dates_work(message, verdict, from_flight):
    """An entry four flights before a recovery: of a message in between the work is the answer."""
    entry = log((1, RENEWED - 4))

    work = judge(fly(WORN), entry, messages_after(RENEWED + message))

    assert work.select("verdict", "flown_from").row(0) == (verdict, departure(RENEWED + from_flight))


TWICE = np.where((np.arange(FLIGHTS) < 30) | ((np.arange(FLIGHTS) >= 45) & (np.arange(FLIGHTS) < RENEWED)), 0.3, 0.01)
"""Losses of a position that recovers at flight 30 and at `RENEWED`."""


@pytest.mark.parametrize("pack", [1, 2], ids=["late", "elsewhere"])
def test_late_entry_is_of_the_last_recovery(pack):
    work = judge(fly(TWICE, CLEAN), log((pack, RENEWED + 20)))

    assert work["flown_from"].to_list() == [departure(RENEWED)]


def test_misdated_work_is_known_by_the_flights():
    """Long before the date that the log gives."""
    work = judge(fly(WORN), log((1, RENEWED)).with_columns(pl.col("done_at") + timedelta(days=365)))

    assert work["known_from"].to_list() == [departure(RENEWED + 10)]


@pytest.mark.parametrize(("day", "verdict"), [(12, "misdated"), (13, "not_seen")])
def test_twelfth_may_be_december(day, verdict):
    """Work of 2 December is logged under a day of February."""
    loss = np.where(np.arange(1_050) < 1_008, 0.3, 0.01)
    entry = log((1, 0)).with_columns(done_at=datetime(2024, 2, day, 8, tzinfo=UTC))

    assert judge(fly(loss), entry)["verdict"].to_list() == [verdict]


def test_single_low_loss_spares_work():
    """Too uncertain for a recovery."""
    loss = np.full(FLIGHTS, 0.3)
    loss[RENEWED + 3] = 0.1

    assert judge(fly(loss, sd=0.06), log((1, RENEWED)))["verdict"].to_list() == ["logged"]


def test_settled_log_corrects_its_entry():
    settled = settle(judge(fly(WORN, CLEAN), log((2, RENEWED + 30))))

    assert settled.select("pack", "counts_from").row(0) == (1, departure(RENEWED))


def test_undone_work_counts_until_known():
    entries = as_known(judge(fly(np.full(FLIGHTS, 0.3)), log((1, RENEWED))))

    assert entries.select("counts_from", "until").row(0) == (departure(RENEWED), departure(RENEWED + 9))


@pytest.mark.parametrize(
    ("loss", "entry", "units"),
    [
        (WORN, RENEWED, [(0, 0), (RENEWED, RENEWED)]),
        (WORN, RENEWED + 30, [(0, 0), (RENEWED + 30, RENEWED)]),
        (np.full(FLIGHTS, 0.3), RENEWED, [(0, 0), (RENEWED, RENEWED), (RENEWED + 9, 0)]),
    ],
    ids=["on time", "late", "not done"],
)
def test_units_follow_contemporary_record(loss, entry, units):
    flights = fly(loss)

    numbers = units_as_known(flights, judge(flights, log((1, entry))))

    assert numbers.select("known_row", "first_row").rows() == units


def test_undone_work_leaves_the_last_unit():
    worn_again = np.where((np.arange(FLIGHTS) >= RENEWED) & (np.arange(FLIGHTS) < 75), 0.01, 0.3)
    flights = fly(worn_again)

    numbers = units_as_known(flights, judge(flights, log((1, RENEWED), (1, 95))))

    units = [(0, 0), (RENEWED, RENEWED), (95, 95), (104, RENEWED)]
    assert numbers.select("known_row", "first_row").rows() == units


def test_last_flight_may_refute_work():
    flights = fly(np.full(RENEWED + 10, 0.3))

    numbers = units_as_known(flights, judge(flights, log((1, RENEWED))))

    assert numbers.select("known_row", "first_row").rows()[-1] == (RENEWED + 9, 0)


def test_early_entry_counts_as_logged_at_first():
    flights = fly(WORN)
    entry = log((1, RENEWED - 4))

    numbers = units_as_known(flights, judge(flights, entry, messages_after(RENEWED - 1)))

    logged, settled = (RENEWED - 4, RENEWED - 4), (RENEWED + 10, RENEWED)
    assert numbers.select("known_row", "first_row").rows() == [(0, 0), logged, settled]


@pytest.mark.parametrize("loss", [WORN, np.full(FLIGHTS, 0.3)], ids=["late", "not done"])
def test_units_need_no_later_flight(loss):
    entries = log((1, RENEWED + 30) if loss is WORN else (1, RENEWED))
    whole = fly(loss)
    early = fly(loss[:95])

    then, now = (units_as_known(f, judge(f, entries)) for f in (early, whole))

    assert then.rows() == now.filter(pl.col("known_row") < 95).rows()
