"""The report's first table: dates on their axis, the chance before the next check, work just done, one action."""

import datetime as dt
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from pipelines.report.facts import Facts, read_facts
from pipelines.report.tonight import tonight


@pytest.fixture(scope="module")
def facts(sample_home: Path) -> Facts:
    return read_facts(sample_home)


def first_screen(facts: Facts, frames: dict, **row) -> dict:
    """The first row of the table, after changes of the ranking's first row and of other frames."""
    first = facts["ranking"].head(1).with_columns(**{k: pl.lit(v) for k, v in row.items()})
    frames = facts.frames | {"ranking": first, "components": facts["components"].clear()} | frames
    table = tonight(replace(facts, frames=frames), {}, 0.15)
    return (table["rows"] + table["rest"])[0]


def outlook_of(facts: Facts, **values) -> dict:
    """Frames with one outlook of the ranking's first pack."""
    key = facts["ranking"].select("operator", "tail", "pack").head(1).row(0, named=True)
    row = dict.fromkeys(facts["outlooks"].columns) | key | {"component": "HX", "due_status": "ok"} | values
    return {"outlooks": pl.DataFrame([row], schema=facts["outlooks"].schema)}


@pytest.mark.parametrize(
    ("days", "overdue", "mark"), [(-1, True, 0.0), (0, False, 0.0), (60, False, 50.0), (130, False, 100.0)]
)
def test_dates_lie_on_an_axis_of_120_days_and_one_that_passed_is_overdue(facts, days, overdue, mark):
    day = facts.until().date() + dt.timedelta(days=days)
    due = first_screen(facts, outlook_of(facts, due_on=day, due_low_on=day, due_high_on=day))["due"]
    assert (due["overdue"], due["mark"], due["low"]) == (overdue, mark, mark)
    assert due["text"] == f"{day}"
    beyond = outlook_of(facts, due_on=day, due_low_on=day, due_status="beyond_horizon")
    due = first_screen(facts, beyond)["due"]
    assert (due["overdue"], due["mark"], due["text"]) == (False, None, f"after {day}")
    assert due["low"] + due["width"] == 100.0 or days == 130


@pytest.mark.parametrize(
    ("outlook", "chance", "text"),
    [
        ({"chance": 0.67, "p_event_50": 0.2}, 0.67, "67 % by A-check 2024-07-07"),
        ({"chance_at_least": 0.3, "p_event_50": 0.2}, 0.3, "more than 30 % by A-check 2024-07-07"),
        ({"p_event_50": 0.2}, 0.2, "20 % in 50 flights"),
        ({}, None, "\N{EN DASH}"),
    ],
)
def test_the_chance_is_that_before_the_next_check_where_it_is_known(facts, outlook, chance, text):
    outlook = outlook | {"check_name": "A-check", "until_on": dt.date(2024, 7, 7)}
    row = first_screen(facts, outlook_of(facts, **outlook))
    assert (row["chance"], row["chance_text"]) == (chance, text)


def test_work_since_the_last_flight_is_named_and_the_margin_before_it_is_not(facts):
    row = first_screen(facts, {}, work_action="CLEANED", work_on=dt.date(2024, 7, 1))
    assert "cleaned 2024-07-01, no flight since" in row["notes"]
    assert row["margin_k"] is None


@pytest.mark.parametrize(
    ("diagnosis", "action", "to_do", "effort"),
    [
        ("HX_FOULING", "Plan a wash (ATA 21-52); look first", "Wash", "120 min, 2 people"),
        ("HX_FOULING", "Find the cause upstream. Only then: plan a wash (ATA 21-52)", "Find the cause upstream",
         "45 min, 1 person"),
        ("HX_LOW_MARGIN", "Not the core: check target (ATA 21-53, rigging)", "Not the core: check target",
         "90 min, 2 people"),
    ],
)  # fmt: skip
def test_one_action_is_the_cheapest_choice_unless_the_cause_lies_elsewhere(facts, diagnosis, action, to_do, effort):
    key = facts["ranking"].select("operator", "tail", "pack").head(1).row(0, named=True)
    alert = key | {"component": "HX", "diagnosis": diagnosis, "recommended_action": action, "raised_at": facts.until()}
    stop = key | {"component": "HX", "choice": "wash", "place": 1, "expected_cost": 3500.0, "defer_cost": 28700.0}
    frames = {
        "alerts": pl.DataFrame([alert | {"closed_at": None}], schema_overrides={"closed_at": pl.Datetime}),
        "stops": pl.DataFrame([stop | {"currency": "USD"}]),
    }
    assert first_screen(facts, frames, urgency="act")["to_do"] == (
        to_do, f"{effort}; 3,500 USD to expect, 28,700 deferred",
    )  # fmt: skip
