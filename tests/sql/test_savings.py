"""Leads to removals, savings, seasons and costs: fleets counted on fingers, and the sample counted again in Python."""

import datetime as dt
from collections import defaultdict

import duckdb
import pytest
from answers import rows
from small_catalog import OWN, START, alert, catalog, chances, flight, fouling, message, replaced

from pipelines.storage.catalog import CATALOG

COSTS = {"wash": 100.0, "replace": 1000.0, "at_check": 50.0, "message": 4000.0}
PRICED = {"component": "HX", "currency": "EUR", "horizon_days": 30, "source": "costs.toml"}
PRICES = [PRICED | {"item": k, "cost": v} for k, v in COSTS.items()]
DAYS = 100


def prognosis(n: int, chance: float) -> dict:
    own = {"pack": 1, "component": "HX", "rul_flights": 90.0, "rul_low": 9.0, "rul_high": 300.0}
    return flight(n) | chances(chance) | own


def fleet(**more: list[dict]) -> duckdb.DuckDBPyConnection:
    """A flight a day. Work counts from the end of its day: of days 20, 40, 60 and 80, the third a wash."""
    log = [
        replaced(20), replaced(40, "NO_FAULT_FOUND"), replaced(60) | {"action": "CLEANED"},
        replaced(80, component="RAM_DOOR"),
    ]  # fmt: skip
    tables = {
        "raw_flights": [flight(n) for n in range(DAYS)],
        "twin_health": [fouling(n, 0.1) for n in range(DAYS)],
        "prognoses": [prognosis(n, n / 100) for n in range(DAYS)],
        "raw_maintenance": log,
        "raw_messages": [message(15), message(16), message(90)],
        "features_alerts": [alert("a", 5, 21), alert("a2", 7, 21), alert("b", 30, 41), alert("c", 50, 61)],
        "raw_costs": PRICES,
    }
    return catalog(**tables | more)


def test_leads_run_from_first_alert():
    columns = "spell, alert_id, work_action, flights_to_work, days_to_work, flights_to_message, days_to_message"
    hours = 18 / 24  # flights leave at six, work counts from midnight
    assert rows(fleet(), f"select {columns} from removal_leads where component = 'HX' order by spell") == [
        (0, "a", "REPLACED", 15, 15 + hours, 10, pytest.approx(10 + 1 / 24)),
        (1, "b", "REPLACED", 10, 10 + hours, None, None),
        (2, "c", "CLEANED", 10, 10 + hours, None, None),
        (3, None, None, None, None, None, None),
    ]
    leads = rows(fleet(), "select spell, work_action from removal_leads where component = 'RAM_DOOR'")
    assert leads == [(0, "REPLACED")]


def test_message_before_alert_has_negative_lead():
    con = fleet(raw_messages=[message(2)])
    query = "select flights_to_message, days_to_message from removal_leads where component = 'HX' and spell = 0"
    assert rows(con, query) == [(None, pytest.approx(-3 + 1 / 24))]


def test_savings_follow_outcome_of_work():
    columns = "spell, outcome, saving_at_most, saving_expected, needless_cost, currency, cost_source"
    chance = (60 - 10.5) / 100  # flights 45 to 54: the last of them is the seventh before the end of day 60
    assert rows(fleet(), f"select {columns} from realised_savings order by spell") == [
        (0, "found", 0.0, 0.0, 0.0, "EUR", "costs.toml"),
        (1, "no_fault_found", 0.0, 0.0, 1000.0, "EUR", "costs.toml"),
        (2, "found", 4000.0, pytest.approx(4000 * chance), 0.0, "EUR", "costs.toml"),
    ]


def test_unpriced_work_has_no_saving():
    con = fleet(raw_costs=[])
    saved = rows(con, "select outcome, saving_at_most, saving_expected from realised_savings where spell = 2")
    assert saved == [("found", None, None)]
    assert rows(con, "select * from operator_costs") == []


def test_operator_costs_are_priced_events():
    columns = """n_flights, n_messages, n_removals, n_washes, n_needless, total_cost, cost_per_1000_flights,
        saving_at_most, expected_message_cost"""
    ((*counts, expected),) = rows(fleet(), f"select {columns} from operator_costs")
    total = 2 * 4000.0 + 2 * 1000.0 + 100.0
    assert counts == [DAYS, 2, 2, 1, 1, total, 10 * total, 4000.0]
    assert expected == pytest.approx(4000.0 * 0.99, rel=0.02)


def test_operator_without_events_costs_nothing():
    other = flight(3, tail="Z-1", operator="ZZZ")
    flown = {"raw_flights": [flight(n) for n in range(DAYS)] + [other], "twin_health": [fouling(3, 0.1) | other]}
    con = fleet(**flown, raw_costs=[*PRICES, *(p | {"component": "OIL"} for p in PRICES)])
    query = "select component, n_flights, n_messages, total_cost from operator_costs where operator = 'ZZZ'"
    assert rows(con, query) == [("HX", 1, 0, 0.0)]


@pytest.mark.parametrize(
    ("query", "sources"),
    [
        ("select distinct cost_source from operator_costs", ["default"]),
        ("select cost_source from realised_savings order by spell", ["costs.toml", "costs.toml", "default"]),
    ],
)
def test_default_price_is_marked(query, sources):
    con = fleet(raw_costs=[p | ({"source": "default"} if p["item"] == "wash" else {}) for p in PRICES])
    assert rows(con, query) == [(source,) for source in sources]


def test_season_has_chance_with_margin():
    margins = [flight(n) | {"pack": 1, "hx_margin_k": float(n)} for n in range(31)]
    query = "select p_event_50, margin_k, margin_worst_tenth_k from seasonality where calendar_month = 3"
    assert rows(fleet(features=margins), query) == [(pytest.approx(0.15), 15.0, 3.0)]


NEVER = dt.datetime.max.replace(tzinfo=START.tzinfo)


def days_between(start: dt.datetime, end: dt.datetime) -> float:
    return (end - start).total_seconds() / 86400


def lead(raised: tuple, work: dt.datetime | None, event: dt.datetime | None, departures: list[dt.datetime]) -> tuple:
    """Flights and days from an alert to the work and to the message; null where there is none, or no alert."""
    at, name = raised
    after = [d for d in departures if at and d > at]
    return (
        work, name,
        sum(d < work for d in after) if work and at else None,
        days_between(at, work) if work and at else None,
        sum(d <= event for d in after) if event and at and event >= at else None,
        days_between(at, event) if event and at else None,
    )  # fmt: skip


def test_sample_leads_equal_python_count(sample_home):
    with duckdb.connect(str(sample_home / CATALOG), read_only=True) as con:
        con.execute("set TimeZone = 'Pacific/Kiritimati'")
        own = "operator, tail, pack, component"
        works = rows(con, f"select {own}, counts_from, action from tables.raw_maintenance where pack is not null")
        alerts = rows(con, f"select {own}, raised_at, alert_id from alert_outcomes where outcome != 'recovered'")
        codes = dict(rows(con, "select message_code, component from tables.components where message_code is not null"))
        messages = rows(con, "select operator, tail, pack, code, message_time from tables.raw_messages")
        flights = defaultdict(list)
        for operator, tail, at in rows(con, "select operator, tail, departed_at from flights"):
            flights[operator, tail].append(at)
        columns = "work_at, alert_id, flights_to_work, days_to_work, flights_to_message, days_to_message"
        answer = {r[:5]: r[5:] for r in rows(con, f"select {own}, spell, {columns} from removal_leads")}
    first = dt.datetime.min.replace(tzinfo=START.tzinfo)
    again = {}
    for unit in {row[:4] for row in (*works, *alerts)}:
        events = [m[4] for m in messages if (*m[:3], codes.get(m[3])) == unit]
        ends = [*sorted({w[4] for w in works if w[:4] == unit and w[5] in ("REPLACED", "CLEANED")}), NEVER]
        for spell, (since, until) in enumerate(zip([first, *ends], ends, strict=False)):
            raised = min((a[4:] for a in alerts if a[:4] == unit and since <= a[4] < until), default=(None, None))
            event = min((at for at in events if since <= at < until), default=None)
            if (until, *raised, event) != (NEVER, None, None, None):
                work = None if until == NEVER else until
                again[*unit, spell] = lead(raised, work, event, flights[unit[:2]])
    assert len(answer) >= 8
    assert answer.keys() == again.keys()
    assert OWN["operator"] not in {key[0] for key in answer}
    for key, row in answer.items():
        assert row[:3] == again[key][:3]
        assert row[3:] == pytest.approx(again[key][3:])
