"""The report's first table: dates, chances and one action; work by diagnosis and action; alerts at other limits."""

import datetime as dt
from dataclasses import replace
from pathlib import Path

import pytest

from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.components import components
from pipelines.report import words
from pipelines.report.facts import Facts, read_facts
from pipelines.report.page import thresholds
from pipelines.report.rows import UnitRow, subject_of
from pipelines.report.tasks import ACTIONS, Task, action_of, read_tasks, tasks_of, work_text
from pipelines.report.tonight import tonight, tonight_with_cards
from pipelines.storage.catalog import connect
from pipelines.storage.objects import StoreError
from pipelines.words.evidence import stored_action


@pytest.fixture(scope="module")
def facts(sample_home: Path) -> Facts:
    return read_facts(sample_home)


def with_first(facts: Facts, **values) -> Facts:
    """The first pack's row alone, with other values."""
    first = facts.rows[0]
    return replace(facts, rows=[replace(first, values=first.values | values)])


def first_screen(facts: Facts, **values) -> dict:
    """The first row of the table, after changes of its values."""
    table = tonight(with_first(facts, **values), {}, 0.15)
    return (table["rows"] + table["rest"])[0]


@pytest.mark.parametrize(("days", "mark"), [(-1, 0.0), (0, 0.0), (60, 50.0), (130, 100.0)])
def test_dates_lie_on_an_axis(facts, days, mark):
    day = facts.until().date() + dt.timedelta(days=days)
    due = first_screen(facts, due_on=day, due_low_on=day, due_high_on=day, is_bound=False)["due"]
    assert (due["mark"], due["low"], due["text"]) == (mark, mark, f"{day}")


def test_bound_has_its_own_date(facts):
    low = dt.date(2024, 7, 1)
    middle = dt.date(2024, 9, 1)
    due = first_screen(facts, due_on=middle, due_low_on=low, due_high_on=None, is_bound=True)["due"]
    assert (due["mark"], due["text"]) == (None, "after 2024-07-01")


@pytest.mark.parametrize(
    ("kind", "chance", "text"),
    [
        ("by", 0.67, "67 % by A-check 2024-07-07"),
        ("at_least", 0.3, "more than 30 % by A-check 2024-07-07"),
        ("in_50", 0.2, "20 % in 50 flights"),
        ("in_50", None, "\N{EN DASH}"),
    ],
)
def test_chance_has_its_day(facts, kind, chance, text):
    check = {"check_name": "A-check", "until_on": dt.date(2024, 7, 7)}
    row = first_screen(facts, chance_kind=kind, chance=chance, message_at=None, **check)
    assert row["chance_text"] == text


def test_unit_without_alert_has_choices(facts):
    first = with_first(facts, urgency="plan", alert_id=None, is_contradicted=False)
    no_alert = replace(first, frames=facts.frames | {"alerts": facts["alerts"].clear()})

    (card,) = tonight_with_cards(no_alert, 0.15)["cards"]

    assert {"inspect", "wash", "replace"} < {name for name, *_ in card["stop"]["choices"]}


def test_recent_work_is_named(facts):
    row = first_screen(facts, work_action="CLEANED", work_on=dt.date(2024, 7, 1))
    assert "cleaned 2024-07-01, no flight since" in row["notes"]


def test_row_without_new_estimates_is_marked(facts):
    row = first_screen(facts, missing_since=dt.date(2024, 7, 1), missing_reason="NO_ROWS", missing_columns=None)
    assert "no estimate since 2024-07-01; the flights hold no row of this pack" in row["notes"]


FOULING = {
    "diagnosis": "HX_FOULING", "component": "HX", "units_in_90_days": 1, "action_phrases": stored_action("Wash it"),
    "choice": "wash",
}  # fmt: skip
CHOICES = [
    {"choice": "wash", "expected_cost": 3500.0, "currency": "USD"},
    {"choice": "defer", "expected_cost": 28700.0, "currency": "USD"},
]


@pytest.mark.parametrize(
    ("diagnosis", "units", "action", "to_do", "work"),
    [
        ("HX_FOULING", 1, "Wash it (ATA 21-52); look first", "Wash",
         "120 min, 2 people; 3,500 USD expected, 28,700 if it waits"),
        ("HX_FOULING", 3, "Find the cause upstream. Only then: wash it (ATA 21-52)", "Find the cause upstream",
         "45 min, 1 person"),
        ("HX_LOW_MARGIN", None, "Check target (ATA 21-53, rigging)", "Check target", "90 min, 2 people"),
    ],
)  # fmt: skip
def test_cost_is_the_actions_own(sample_home, facts, diagnosis, units, action, to_do, work):
    subject = {"diagnosis": diagnosis, "units_in_90_days": units, "action_phrases": stored_action(action)}
    alert = {"alert_id": "a", "alert_component": "HX"} | subject
    first = facts.rows[0]
    values = first.values | alert | {"urgency": "act", "choices": CHOICES}
    unit = UnitRow(values, tasks_of(read_tasks(sample_home), alert | {"component": "HX"}))
    assert (unit.to_do(), unit.work()) == (to_do, f"{to_do}; {work}")


def test_without_costs_wear_is_washed(sample_home, facts):
    alert = {"alert_id": "a", "alert_component": "HX"} | FOULING
    unpriced = [{"choice": "defer", "expected_cost": None}, {"choice": "wash", "expected_cost": None}]
    values = facts.rows[0].values | alert | {"urgency": "plan", "choices": unpriced}
    assert UnitRow(values, tasks_of(read_tasks(sample_home), alert | {"component": "HX"})).to_do() == "Wash"


@pytest.mark.parametrize("d", DIAGNOSES.values(), ids=DIAGNOSES)
def test_each_diagnosis_has_its_work(tmp_path, d):
    texts = {"units_in_90_days": None, "action_phrases": stored_action(d.action)}
    alert = {"diagnosis": d.code, "component": d.component, "choice": None, **texts}
    own = tasks_of(read_tasks(tmp_path), alert)
    work = own[action_of(alert, own)]
    assert all((work.minutes, work.people, work.tools, work.part, work.zone, work.task))


CAC = components()["CAC"]
WORN = {
    "diagnosis": CAC.diagnosis, "component": "CAC", "units_in_90_days": None,
    "action_phrases": stored_action(CAC.action),
}  # fmt: skip


@pytest.mark.parametrize("choice", [None, "wash", "replace"])
def test_declared_component_has_its_action_alone(tmp_path, choice):
    assert work_text(read_tasks(tmp_path), WORN | {"choice": choice}) == CAC.action.partition(" (")[0]


def test_home_has_work_of_declared_component(tmp_path):
    (tmp_path / "tasks.toml").write_text("[CAC.replace]\nminutes = 95\n")
    assert work_text(read_tasks(tmp_path), WORN | {"choice": "replace"}) == "Replace: 95 min"


def test_declared_component_needs_no_alert():
    row = {"alert_id": None, "outlook_component": "CAC", "component": "CAC"}
    assert subject_of(row)["action_phrases"] == stored_action(CAC.action)


@pytest.mark.parametrize(
    ("task", "text"),
    [(Task(minutes=30, people=1), "30 min, 1 person"), (Task(zone="193"), "zone 193"), (Task(), "")],
)
def test_task_names_what_is_set(task, text):
    assert task.text() == text


def test_home_replaces_single_values(tmp_path):
    (tmp_path / "tasks.toml").write_text("[HX.wash]\nminutes = 95\n")
    text = work_text(read_tasks(tmp_path), FOULING)
    assert text.startswith("Wash: 95 min, 2 people; task 21-52-00-100-801; zone 191/192; part: ")


def test_diagnosis_extends_its_component(tmp_path):
    (tmp_path / "tasks.toml").write_text('[HX_SUDDEN_CLOG.inspect]\nzone = "193"\n')
    alerts = {"diagnosis": "HX_SUDDEN_CLOG", "component": "HX"}, FOULING
    clog, fouling = (tasks_of(read_tasks(tmp_path), alert)["inspect"] for alert in alerts)
    assert (clog.zone, clog.minutes) == ("193", 45)
    assert (fouling.zone, fouling.minutes) == ("191/192", 45)


@pytest.mark.parametrize(
    ("text", "message"),
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
def test_wrong_task_is_named(tmp_path, text, message):
    (tmp_path / "tasks.toml").write_text(text)
    with pytest.raises(StoreError) as error:
        read_tasks(tmp_path)
    assert f"{tmp_path / 'tasks.toml'}" in str(error.value)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("changes", "action"),
    [
        ({}, "wash"),
        ({"choice": "defer"}, "defer"),
        ({"choice": None}, "wash"),
        ({"units_in_90_days": 3}, "inspect"),
        ({"diagnosis": "HX_LOW_MARGIN"}, "inspect"),
    ],
)
def test_action_fits_the_alert(tmp_path, changes, action):
    """The cheapest where wear is the cause, else a look."""
    assert action_of(FOULING | changes, tasks_of(read_tasks(tmp_path), FOULING)) == action


def test_alert_without_work_is_inspected():
    assert action_of(FOULING | {"choice": None}, {}) == "inspect"


def test_deferred_work_is_nothing(tmp_path):
    assert work_text(read_tasks(tmp_path), FOULING | {"choice": "defer"}) == "Nothing until then"


def test_actions_are_four():
    assert set(ACTIONS) == {"inspect", "wash", "replace", "defer"}


def test_service_limits_give_catalog_alerts(sample_home):
    by_diagnosis = {row["diagnosis"]: row for row in thresholds(sample_home) if row["in_service"]}
    assert set(by_diagnosis) == {code for code, kind in DIAGNOSES.items() if kind.limit}
    with connect(sample_home) as con:
        rates = {row["diagnosis"]: row for row in con.sql("select * from alert_hit_rates").pl().to_dicts()}
    assert rates
    for diagnosis, row in by_diagnosis.items():
        rate = rates.get(diagnosis, {"n_alerts": 0, "n_right": 0, "n_judged": 0, "n_open": 0})
        assert (row["alerts"], row["right"], row["open"]) == (rate["n_alerts"], rate["n_right"], rate["n_open"])
        assert row["false"] == rate["n_judged"] - rate["n_right"]


OIL = {"name": "oil cooler", "component": "OIL"}


@pytest.mark.parametrize(
    ("own", "reason", "text"),
    [
        (OIL, "NOT_COMMISSIONED", "too few steady flights of the component as built"),
        (OIL, "FEW_SAMPLES", "fewer than five samples to which the component's model applies"),
        ({"component": None}, "NO_CRUISE", words.REASONS["NO_CRUISE"]),
    ],
)
def test_missing_estimate_has_its_reason(own, reason, text):
    """In the words of the pack, or of the component."""
    row = {"operator": "AQX", "tail": "LX-AAA", "pack": 1, "urgency": "unknown", "missing_since": None}
    assert f"; {text}." in words.unknown([row | own | {"missing_reason": reason}])[0]
