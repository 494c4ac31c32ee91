"""What an engineer found, through a night: the alert, its outcome and the prognosis answer."""

from nights import run

from pipelines.casework import change_case, find_case, list_cases
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger


def test_found_clean_it_closes_with_the_next_night_and_comes_back_as_the_sensors(own_home):
    landing, home = own_home
    (case,) = list_cases(home, "c.diagnosis = 'HX_FOULING' and c.closed_at is null and c.tail = 'A9-BAC'")
    change_case(home, case, "close", "Ada", finding="clean", on="2024-06-19", note="core face clean")
    assert find_case(home, case["alert_id"])["state"] == "answered"
    health = Ledger(home).cells("twin_health")
    night = run(landing, home)
    assert not night.failed
    assert night.new_files == 0
    remade = Ledger(home).cells("twin_health").join(health, on=health.columns, how="anti")
    assert remade["tail"].to_list() == ["A9-BAC"], "and no other aircraft is made again"
    with connect(home) as con:
        outcomes = con.execute(
            """select closed_on::varchar, closed_reason, outcome from alerts join alert_outcomes using (alert_id)
            where alert_id = $id""", {"id": case["alert_id"]},
        ).fetchall()  # fmt: skip
        after = con.execute("select diagnosis, closed_at from alerts where follows = $id", {"id": case["alert_id"]})
        assert outcomes == [("2024-06-20", "found_clean", "no_fault_found")]
        assert after.fetchall() == [("SENSOR_FAULT", None)], "the loss grew from 16 to 21 % after it"
        status = con.execute(
            """select distinct status from prognoses where tail = 'A9-BAC' and pack = 2 and component = 'HX'
            and departed_on > '2024-06-20'"""
        )
        assert status.fetchall() == [("contradicted",)]
        assert con.execute("select person, note from tables.raw_cases").fetchall() == [("Ada", "core face clean")]
    assert find_case(home, case["alert_id"])["state"] == "closed"
    assert run(landing, home).idle
    change_case(home, case, "watch", "Bo")
    assert run(landing, home).cells == 1, "a word alone makes nothing anew but its own table"
