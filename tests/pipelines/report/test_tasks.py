"""Work by diagnosis and action: defaults, a home's own values over them, and an error that names file and key."""

import pytest

from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.phrases import THEN
from hdt_core.components import components
from pipelines.report.tasks import ACTIONS, Task, action_of, read_tasks, tasks_of, work_text
from pipelines.storage.objects import StoreError

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


def test_a_declared_component_has_the_work_of_its_declaration(tmp_path):
    cac = components()["CAC"]
    alert = {"diagnosis": cac.diagnosis, "component": "CAC", "recommended_action": cac.action, "choice": None}
    assert work_text(read_tasks(tmp_path), alert) == f"Replace: {cac.action}"


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


def test_the_text_leaves_out_what_is_not_declared():
    assert Task(minutes=30, people=1).text() == "30 min, 1 person"
    assert Task(zone="193").text() == "zone 193"
    assert Task().text() == ""
