"""What people do about alerts, seen at once, over a catalog made by hand."""

import datetime as dt
import shutil
from pathlib import Path

import pytest
from case_homes import case_home, publish_losses
from small_catalog import START

from hdt_core.loading import UserError
from pipelines.casework import RefusedError, change_case, find_case, history_of, list_cases
from pipelines.storage.cases import ConflictError

SOON = (dt.datetime.now(dt.UTC) + dt.timedelta(days=5)).date().isoformat()


@pytest.fixture(scope="module")
def template_home(tmp_path_factory) -> Path:
    return case_home(tmp_path_factory.mktemp("cases") / "home")


@pytest.fixture
def home(template_home: Path, tmp_path: Path) -> Path:
    """Two open alerts of one pack and a closed one."""
    return Path(shutil.copytree(template_home, tmp_path / "home"))


def change(home: Path, alert_id: str, *what: object, **fields: object) -> str:
    return change_case(home, find_case(home, alert_id), *what, **fields)


def state(home: Path, alert_id: str = "wear") -> str:
    return str(find_case(home, alert_id)["state"])


def test_a_change_is_seen_at_once(home):
    assert {c["alert_id"]: c["state"] for c in list_cases(home, "true")} == {
        "wear": "new", "clog": "new", "gone": "closed", "other": "new",
    }  # fmt: skip
    change(home, "wear", "acknowledge", "Ada")
    assert state(home) == "acknowledged"
    change(home, "wear", "assign", "Ada", assignee="Bo")
    change(home, "wear", "watch", "Cy")
    change(home, "wear", "watch", "Di")
    change(home, "wear", "unwatch", "Di")
    case = find_case(home, "wear")
    assert [case[c] for c in ("owner", "acknowledged_by", "watched_by", "last_by")] == ["Bo", "Ada", "Cy", "Di"]
    assert [h["kind"] for h in history_of(home, "wear")] == ["acknowledge", "assign", "watch", "watch", "unwatch"]


def test_a_muted_case_comes_back_by_its_date_or_when_it_is_worse(home):
    change(home, "wear", "mute", "Ada", until=SOON, note="parts on order")
    assert state(home) == "muted"
    for more, now in ((0.06, "worsened"), (0.04, "muted")):
        assert state(publish_losses(home, 0.2 + more)) == now
    change(home, "wear", "reopen", "Ada", note="parts came")
    assert state(home) == "new"


@pytest.mark.parametrize(
    ("finding", "action", "state_is", "message"),
    [
        ("clean", None, "answered", "raised as a sensor case"),
        ("fouled", "inspected", "confirmed", "stays open"),
        ("fouled", "cleaned", "answered", "restarts the part's estimate"),
    ],
)
def test_a_finding_answers_the_case(home, finding, action, state_is, message):
    day = START.date() + dt.timedelta(days=40)
    reply = change(home, "wear", "close", "Ada", finding=finding, action=action, on=str(day), note="ram face clean")
    assert message in reply
    case = find_case(home, "wear")
    assert (case["state"], case["found_by"], case["found_on"]) == (state_is, "Ada", day)
    change(home, "wear", "reopen", "Bo", note="wrong pack")
    assert state(home) == "new"


@pytest.mark.parametrize(
    ("component", "finding", "code", "note"),
    [
        ("SENSOR", "wiring fault", "DAMAGED", "wiring fault; left connector"),
        ("SENSOR", "reads correctly", "NO_FAULT_FOUND", "reads correctly; left connector"),
        ("RAM_DOOR", "jammed", "DAMAGED", "jammed; left connector"),
        ("CC", "eroded", "DAMAGED", "eroded; left connector"),
        ("PUMP", "worn", "DAMAGED", "worn; left connector"),
        ("SENSOR", "clean", "NO_FAULT_FOUND", "left connector"),
    ],
)
def test_each_component_has_findings_of_its_own(home, component, finding, code, note):
    case = find_case(home, "wear") | {"component": component}
    change_case(home, case, "close", "Ada", finding=finding, note="left connector")
    assert [(h["finding"], h["note"]) for h in history_of(home, "wear")] == [(code, note)]


@pytest.mark.parametrize(
    ("kind", "fields", "message"),
    [
        ("close", {"finding": "rusty"}, "finding is clean, fouled"),
        ("close", {"finding": "jammed"}, "finding is clean, fouled"),
        ("close", {"finding": "clean", "action": "polished"}, "action is inspected"),
        ("close", {"finding": "clean", "on": "2020-01-01"}, "when it was raised"),
        ("close", {"finding": "clean", "on": "2199-01-01"}, "to today"),
        ("close", {"finding": "clean", "on": "soon"}, "on is a day"),
        ("mute", {"until": SOON}, "needs a note"),
        ("mute", {"until": "2020-01-01", "note": "x"}, "until is a day within"),
        ("mute", {"until": "9999-12-31", "note": "x"}, "until is a day"),
        ("mute", {"until": "0001-01-01T00:00+14:00", "note": "x"}, "until is a day"),
        ("close", {"finding": "clean", "on": "9999-12-31"}, "on is a day"),
        ("close", {"finding": "clean", "on": "9999-12-31T23:59-14:00"}, "on is a day"),
        ("assign", {"assignee": " "}, "to is a person's name"),
        ("assign", {"assignee": "x" * 81}, "to is a person's name"),
        ("acknowledge", {"note": "x" * 1001}, "the limit is 1000"),
        ("reopen", {"note": "x"}, "nothing to take back"),
    ],
)
def test_what_makes_no_sense_is_refused_and_leaves_no_line(home, kind, fields, message):
    with pytest.raises(RefusedError, match=message):
        change(home, "wear", kind, "Ada", **fields)
    assert history_of(home, "wear") == []


def test_a_closed_alert_is_not_acknowledged_and_no_guess_is_made_between_two(home):
    with pytest.raises(RefusedError, match="closed on"):
        change(home, "gone", "acknowledge", "Ada")
    for name in ("", "x", "%", "_"):
        with pytest.raises(UserError):
            find_case(home, name)


def test_two_people_change_one_case(home):
    line = find_case(home, "wear")["last_line"]
    change(home, "wear", "assign", "Ada", line, assignee="Ada")
    with pytest.raises(ConflictError, match="Ada changed this case"):
        change(home, "wear", "assign", "Bo", line, assignee="Bo")
    assert find_case(home, "wear")["owner"] == "Ada"
