"""What an engineer found goes the road of the maintenance log, and work that both tell of is counted once."""

import datetime as dt

import polars as pl
from small_catalog import OWN

from hdt_core.records.unit_index import date_entries
from hdt_core.tables import TABLES
from pipelines.intake.findings import case_files, with_findings

DAY = dt.date(2024, 6, 19)


def log(**line: object) -> pl.DataFrame:
    entry = {"done_on": DAY, "component": "HX", "action": "INSPECTED", "finding": "NO_FAULT_FOUND", "reference": "WO1"}
    return TABLES["raw_maintenance"].schema.conform(pl.DataFrame([OWN | entry | line], infer_schema_length=None))


def case(line: int = 1, kind: str = "close", **values: object) -> dict:
    at = dt.datetime(2024, 6, 19, 5, tzinfo=dt.UTC)
    about = {"line": line, "at": at, "alert_id": "a1", "component": "HX", "diagnosis": "HX_FOULING", "kind": kind}
    answer = {"finding": "NO_FAULT_FOUND", "action": "INSPECTED", "done_on": DAY} if kind == "close" else {}
    return OWN | about | {"person": "Ada"} | answer | values


def cases(*rows: dict) -> pl.DataFrame:
    return TABLES["raw_cases"].schema.conform(pl.DataFrame(list(rows), infer_schema_length=None))


def test_the_same_finding_makes_the_same_line_whoever_tells_it():
    columns = ("operator", "tail", "pack", "component", "action", "finding", "done_on", "counts_from")
    by_log = date_entries(with_findings(log(), cases(case()).clear()))
    by_case = date_entries(with_findings(log().clear(), cases(case())))
    assert by_log.select(columns).equals(by_case.select(columns))
    assert (by_log["source"].item(), by_case["source"].item(), by_case["closes_alert_id"].item()) == (
        "log",
        "case",
        "a1",
    )


def test_work_that_both_tell_of_stands_once():
    finding = case(action="REPLACED", finding="FOULED", done_on=DAY - dt.timedelta(days=2))
    (row,) = with_findings(log(action="REPLACED", finding=None), cases(finding)).to_dicts()
    assert (row["done_on"], row["finding"], row["reference"], row["closes_alert_id"]) == (DAY, "FOULED", "WO1", "a1")
    assert with_findings(log(action="CLEANED"), cases(finding)).height == 2, "other work"
    assert with_findings(log(action="REPLACED", done_on=DAY + dt.timedelta(days=9)), cases(finding)).height == 2


def test_the_last_word_on_an_alert_counts_and_may_be_taken_back():
    again = case(2, finding="FOULED", action="CLEANED")
    assert with_findings(log().clear(), cases(case(), again))["finding"].to_list() == ["FOULED"]
    assert with_findings(log().clear(), cases(case(), case(2, "reopen"))).is_empty()


def test_only_what_was_found_makes_the_work_of_an_aircraft_new():
    """An acknowledgement is on record without a night that makes the twin again."""
    acknowledged = {kind: digest for _, _, _, kind, _, _, digest in case_files(cases(case(kind="acknowledge")))}
    assert set(acknowledged) == {"cases"}
    before = {f[3]: f[6] for f in case_files(cases(case(kind="acknowledge"), case(2)))}
    more = {f[3]: f[6] for f in case_files(cases(case(kind="acknowledge"), case(2), case(3, "watch")))}
    taken_back = {f[3]: f[6] for f in case_files(cases(case(), case(2), case(3, "reopen")))}
    assert before["findings"] == more["findings"] != taken_back["findings"]
    assert before["cases"] != more["cases"]
