"""A line of the log of cases counts in every output at once; the next night comes to the same."""

import pytest
from answers import query
from case_homes import case_home
from nights import run

from pipelines.casework import change_case, find_case, list_cases
from pipelines.digest.orders import work_orders
from pipelines.orchestration.around_night import lock_home
from pipelines.report.tasks import read_tasks
from pipelines.storage import publication
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import connect
from pipelines.storage.publication import HASH, publish

RANKED = "select urgency, work_action, hx_fouling from fleet_ranking where tail = 'T-1'"
CLOSED = "select closed_reason, outcome from alerts join alert_outcomes using (alert_id) where alert_id = 'wear'"
ALERTS = "select alert_id, closed_at, closed_reason from alerts order by alert_id"
RANKING = "select place, tail, pack, urgency, hx_fouling, work_action from fleet_ranking order by place"


@pytest.fixture
def home(tmp_path):
    return case_home(tmp_path / "home")


def close(home, alert="wear", **fields):
    change_case(home, find_case(home, alert), "close", "Ada", **({"finding": "fouled"} | fields))


def test_wash_empties_the_row(home):
    close(home, action="cleaned")
    assert query(home, RANKED) == [("none", "CLEANED", None)]


def test_wash_ends_its_alerts(home):
    close(home, action="cleaned")
    assert query(home, "select alert_id from alerts where tail = 'T-1' and closed_at is null") == []


def test_wash_ends_its_work_orders(home):
    close(home, action="cleaned")
    with connect(home) as con:
        assert work_orders(con, read_tasks(home))["alert_id"].to_list() == ["other"]


def test_clean_finding_ends_the_alert(home):
    close(home, finding="clean")
    assert query(home, CLOSED) == [("found_clean", "no_fault_found")]


def test_remaining_fault_keeps_alert_open(home):
    close(home, action="inspected")
    assert find_case(home, "wear")["state"] == "confirmed"


def test_reopened_case_counts_no_more(home):
    before = query(home, RANKED)
    close(home, action="cleaned")
    change_case(home, find_case(home, "wear"), "reopen", "Ada", note="wrong pack")
    assert query(home, RANKED) == before


def test_running_night_blocks_no_change(home):
    with lock_home(home):
        close(home, action="cleaned")
    assert query(home, RANKED)[0][1] == "CLEANED"


def test_unpublished_line_is_read(home):
    case = find_case(home, "wear")
    CaseLog(home).append(case, "acknowledge", "Ada")
    assert find_case(home, "wear")["acknowledged_by"] == "Ada"


def test_night_publishes_later_lines(home):
    case = find_case(home, "wear")
    CaseLog(home).append(case, "acknowledge", "Ada")
    publish(home)
    assert query(home, "select acknowledged_by from cases where alert_id = 'wear'") == [("Ada",)]


@pytest.mark.parametrize("is_renamed", [True, False])
def test_killed_rename_loses_no_line(home, monkeypatch, is_renamed):
    def write_until_killed(folder, hashes):
        if is_renamed and len(hashes) == 1:
            raise KeyboardInterrupt
        (folder / HASH).write_text(" ".join(hashes))
        if not is_renamed:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(publication, "_note_hashes", write_until_killed)
        with pytest.raises(KeyboardInterrupt):
            publish(home)
    close(home, action="cleaned")
    assert query(home, RANKED)[0][1] == "CLEANED"


def test_next_night_agrees(own_home):
    landing, home = own_home
    washed, clean, *_ = list_cases(home, "c.component = 'HX' and c.closed_at is null")
    change_case(home, washed, "close", "Ada", finding="fouled", action="cleaned")
    change_case(home, clean, "close", "Ada", finding="clean")
    at_once = [query(home, sql) for sql in (ALERTS, RANKING)]
    run(landing, home)
    assert [query(home, sql) for sql in (ALERTS, RANKING)] == at_once
