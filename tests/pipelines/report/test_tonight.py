"""The report's first table: dates, chances and one action; work by diagnosis and action; alerts at other limits."""

import datetime as dt
from dataclasses import replace
from pathlib import Path

import polars as pl
import pytest

from hdt_core.alerts.alerts import VALUES
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.phrases import THEN
from hdt_core.components import components
from pipelines.report import words
from pipelines.report.facts import Facts, read_facts
from pipelines.report.page import thresholds
from pipelines.report.tasks import ACTIONS, Task, action_of, read_tasks, tasks_of, work_text
from pipelines.report.tonight import tonight
from pipelines.storage.catalog import connect
from pipelines.storage.objects import StoreError


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


FOULING = {"diagnosis": "HX_FOULING", "component": "HX", "recommended_action": "Wash", "choice": "wash"}


def test_each_diagnosis_has_the_work_of_its_action(tmp_path):
    tasks = read_tasks(tmp_path)
    for d in DIAGNOSES.values():
        alert = {"diagnosis": d.code, "component": d.component, "recommended_action": d.action, "choice": None}
        own = tasks_of(tasks, alert)
        work = own[action_of(alert, own)]
        assert work.minutes
        assert work.people
        assert all((work.tools, work.part, work.zone, work.task))


def test_a_declared_component_has_the_work_of_its_declaration_and_no_more(tmp_path):
    cac = components()["CAC"]
    alert = {"diagnosis": cac.diagnosis, "component": "CAC", "recommended_action": cac.action, "choice": None}
    assert work_text(read_tasks(tmp_path), alert) == f"Replace: {cac.action}"
    assert Task(minutes=30, people=1).text() == "30 min, 1 person"
    assert Task(zone="193").text() == "zone 193"
    assert Task().text() == ""


def test_a_home_replaces_single_values_and_a_diagnosis_takes_the_rest_of_its_component(tmp_path):
    (tmp_path / "tasks.toml").write_text('[HX.wash]\nminutes = 95\n[HX_SUDDEN_CLOG.inspect]\nzone = "193"\n')
    tasks = read_tasks(tmp_path)
    assert work_text(tasks, FOULING).startswith("Wash: 95 min, 2 people; task 21-52-00-100-801; zone 191/192; part: ")
    clog = {"diagnosis": "HX_SUDDEN_CLOG", "component": "HX"}
    assert tasks_of(tasks, clog)["inspect"].zone == "193"
    assert tasks_of(tasks, clog)["inspect"].minutes == tasks_of(tasks, FOULING)["inspect"].minutes == 45
    assert tasks_of(tasks, FOULING)["inspect"].zone == "191/192"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("minutes = 5", "has no setting 'minutes'; there are CAC, CC, "),
        ("HX = 5", "HX is no table of actions"),
        ("[XX.wash]\nminutes = 5", "has no setting 'XX'"),
        ("[HX.paint]\nminutes = 5", "HX.paint is no action; there are inspect, wash, replace"),
        ("[HX.defer]\nminutes = 5", "HX.defer is no action"),
        ("[HX.wash]\nhours = 5", "HX.wash.hours means nothing; there are minutes, people"),
        ("[HX.wash]\nminutes = 0", "HX.wash.minutes is 0 and ought to be a whole number from 1 to 10000"),
        ("[HX.wash]\npeople = true", "HX.wash.people is True"),
        ("[HX.wash]\ntools = 'a\\tb'\npart = \"a\\nb\"", "HX.wash.part is 'a\\nb' and ought to be one line"),
        (f"[HX.wash]\nzone = '{'a' * 201}'", "HX.wash.zone"),
        ("[HX", "can't be read: no TOML"),
    ],
)
def test_what_is_wrong_is_named_with_file_and_key(tmp_path, text, says):
    (tmp_path / "tasks.toml").write_text(text)
    with pytest.raises(StoreError) as error:
        read_tasks(tmp_path)
    assert f"{tmp_path / 'tasks.toml'}" in str(error.value)
    assert says in str(error.value)


def test_one_action_the_cheapest_where_wear_is_the_cause_else_a_look(tmp_path):
    tasks = read_tasks(tmp_path)
    own = tasks_of(tasks, FOULING)
    assert action_of(FOULING, own) == "wash"
    assert action_of(FOULING | {"choice": "defer"}, own) == "defer"
    assert work_text(tasks, FOULING | {"choice": "defer"}) == "Defer to the check"
    assert action_of(FOULING | {"choice": None}, own) == "wash"
    assert action_of(FOULING | {"recommended_action": f"Find the cause upstream{THEN}wash"}, own) == "inspect"
    assert action_of(FOULING | {"diagnosis": "HX_LOW_MARGIN"}, own) == "inspect"
    assert action_of(FOULING | {"choice": None}, {}) == "inspect"
    assert set(ACTIONS) == {"inspect", "wash", "replace", "defer"}


def test_at_the_limits_in_service_the_alerts_are_those_of_the_catalog(sample_home):
    by_diagnosis = {row["diagnosis"]: row for row in thresholds(sample_home) if row["in_service"]}
    assert set(by_diagnosis) == set(VALUES)
    with connect(sample_home) as con:
        rates = {row["diagnosis"]: row for row in con.sql("select * from alert_hit_rates").pl().to_dicts()}
    assert rates
    for diagnosis, row in by_diagnosis.items():
        rate = rates.get(diagnosis, {"n_alerts": 0, "n_right": 0, "n_judged": 0, "n_open": 0})
        assert (row["alerts"], row["confirmed"], row["open"]) == (rate["n_alerts"], rate["n_right"], rate["n_open"])
        assert row["false"] == rate["n_judged"] - rate["n_right"]


def test_why_there_is_no_estimate_is_written_in_the_words_of_the_pack_or_of_the_component():
    row = {"operator": "AQX", "tail": "LX-AAA", "pack": 1, "urgency": "unknown", "missing_since": None}
    unit = {"name": "oil cooler", "component": "OIL"}
    for own, reason, text in (
        (unit, "NOT_COMMISSIONED", "too few steady flights of the component as built"),
        (unit, "FEW_SAMPLES", "fewer than five samples to which the component's model applies"),
        ({}, "NO_CRUISE", words.REASONS["NO_CRUISE"]),
    ):
        assert f"; {text}." in words.unknown([row | own | {"missing_reason": reason}])[0]
