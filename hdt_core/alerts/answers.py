"""Derive from the log of cases what engineers did: work as the maintenance log lists it, and alerts that it ends."""

from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import Any

import polars as pl

from hdt_core.alerts.cases import REPAIR
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.endings import FOUND_CLEAN, INSPECTIONS, RENEWED
from hdt_core.components import components
from hdt_core.components.declaration import NO_FAULT
from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import date_entries
from hdt_core.tables.raw import CASE, CLOSES, LOG, RawMaintenance

SAME_WORK = timedelta(days=3)
"""Largest distance of a line of the log and a finding about the same work: a log is some flights late."""
Row = dict[str, Any]


def work_from_cases(cases: pl.DataFrame) -> pl.DataFrame:
    """Convert rows of `raw_cases` to `raw_maintenance`: of each case the last closing, unless it was reopened."""
    last = cases.filter(pl.col("kind").is_in(["close", "reopen"])).sort("line").unique("case_id", keep="last")
    closings = last.filter(pl.col("kind") == "close").with_columns(source=pl.lit(CASE), **CLOSES)
    return RawMaintenance.conform(closings.sort("line"))


def with_findings(log: pl.DataFrame, cases: pl.DataFrame) -> pl.DataFrame:
    """Add engineers' findings to the maintenance log; work in both is listed once, as in the log.

    Parameters
    ----------
    log : DataFrame
        Rows of `raw_maintenance` whose source is the log.
    cases : DataFrame
        Rows of `raw_cases` of the same aircraft.
    """
    work = work_from_cases(cases)
    rows = RawMaintenance.conform(log).drop(*CLOSES).with_columns(source=pl.lit(LOG)).with_row_index("n")
    pairs = work.join(rows, on=[*PACK, "component", "action"], suffix="_log", validate="m:m").filter(
        (pl.col("done_on") - pl.col("done_on_log")).abs() <= SAME_WORK
    )
    matches = pairs.unique("n", keep="last").select("n", *CLOSES, case_finding="finding")
    rows = rows.join(matches, on="n", how="left", maintain_order="left", validate="m:1").with_columns(
        finding=pl.coalesce("finding", "case_finding")
    )
    work_of_cases_alone = work.join(pairs, on="closes_alert_id", how="anti", maintain_order="left")
    return pl.concat([RawMaintenance.conform(rows), work_of_cases_alone])


def log_now(log_then: pl.DataFrame, cases: pl.DataFrame) -> pl.DataFrame:
    """Return the maintenance log of a night with the findings that the log of cases holds now.

    Parameters
    ----------
    log_then : DataFrame
        Rows of `raw_maintenance` as the night stored them.
    cases : DataFrame
        Rows of `raw_cases` of the same aircraft, as they are now.

    Returns
    -------
    DataFrame
        Rows of `raw_maintenance`; `since_night` marks those that the night did not have.
    """
    rows = date_entries(with_findings(log_then.filter(pl.col("source") != CASE), cases))
    return rows.with_columns(since_night=~_in(rows, log_then))


def _in(rows: pl.DataFrame, others: pl.DataFrame) -> pl.Series:
    """Flag the rows that stand among others. (n,) bool"""
    columns = [c for c in rows.columns if c != "since_night"]
    known = others.select(columns).unique().with_columns(is_known=pl.lit(True))
    joined = rows.join(known, on=columns, how="left", nulls_equal=True, maintain_order="left", validate="m:1")
    return joined["is_known"].is_not_null()


def alerts_now(alerts: pl.DataFrame, log_then: pl.DataFrame, log: pl.DataFrame) -> pl.DataFrame:
    """Close the alerts that work since the night answers, and open those whose closing was taken back.

    Parameters
    ----------
    alerts : DataFrame
        Rows of `features_alerts` as the night stored them.
    log_then : DataFrame
        Rows of `raw_maintenance` of the same aircraft, as the night stored them.
    log : DataFrame
        The same as they are now, of `log_now`.
    """
    added = log.filter("since_night").to_dicts()
    gone = log_then.filter(~_in(log_then, log)).to_dicts()
    entries = log.to_dicts()
    rows = [_with_ending(row, entries, added, gone) for row in alerts.to_dicts()]
    return pl.DataFrame(rows, schema=alerts.schema, orient="row")


def _with_ending(alert: Row, entries: list[Row], added: list[Row], gone: list[Row]) -> Row:
    is_taken_back = _is_taken_back(alert, gone)
    end = None if is_taken_back else alert["closed_at"]
    reason = None if is_taken_back else alert["closed_reason"]
    first = min(_endings(alert, entries if is_taken_back else added), default=None)
    if first and (end is None or first[0] < end):
        end, reason = first
    return alert | {"closed_at": end, "closed_reason": reason}


def _is_taken_back(alert: Row, gone: list[Row]) -> bool:
    """Whether work that is not in the log any more had ended an alert: it was no later than the end."""
    if alert["closed_reason"] not in (RENEWED, FOUND_CLEAN):
        return False
    return any(at <= alert["closed_at"] for at, _ in _endings(alert, gone))


def _endings(alert: Row, entries: list[Row]) -> Iterator[tuple[datetime, str]]:
    """Yield when and why each entry ends an alert."""
    for entry in entries:
        reason = _reason(alert, entry)
        if reason and all(entry[c] == alert[c] for c in PACK) and entry["counts_from"] > alert["raised_at"]:
            yield entry["counts_from"], reason


def _reason(alert: Row, entry: Row) -> str | None:
    """Return why work ends an alert, by the rules of `diagnoses.close_after_work`; None where it does not."""
    kind = DIAGNOSES.get(alert["diagnosis"])
    part = components().get(alert["component"])
    ended_by = kind.ended_by if kind else part.ended_by if part else REPAIR
    is_own_part = entry["component"] == alert["component"]
    if is_own_part and entry["action"] in ended_by:
        return RENEWED
    is_sound = entry["action"] in INSPECTIONS and entry["finding"] == NO_FAULT
    closes_kind = (entry["closes_diagnosis"], entry["closes_sensor"]) == (alert["diagnosis"], alert["sensor"])
    closes = closes_kind or entry["closes_alert_id"] == alert["alert_id"]
    ends_sound = is_own_part and (kind is None or kind.ended_by_sound)
    return FOUND_CLEAN if is_sound and (ends_sound or closes) else None
