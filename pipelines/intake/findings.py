"""Convert the findings of closed alerts into lines of the maintenance log."""

from datetime import timedelta

import polars as pl

from hdt_core.records.keys import PACK
from hdt_core.tables import TABLES
from pipelines.versions import digest

CASES, FINDINGS = "cases", "findings"
"""Kinds in the ledger of an aircraft's lines in the log of cases: all of them, and the work in them."""
LOG, CASE = "log", "case"
SAME_WORK = timedelta(days=3)
"""Largest distance of a line of the log and a finding about the same work: a log is some flights late."""


def work_from_cases(cases: pl.DataFrame) -> pl.DataFrame:
    """Convert rows of `raw_cases` to `raw_maintenance`: of each alert the last closing, unless it was reopened."""
    last = cases.filter(pl.col("kind").is_in(["close", "reopen"])).sort("line").unique("alert_id", keep="last")
    closings = last.filter(pl.col("kind") == "close").with_columns(source=pl.lit(CASE), closes_alert_id="alert_id")
    return TABLES["raw_maintenance"].schema.conform(closings.sort("line"))


def with_findings(log: pl.DataFrame, cases: pl.DataFrame) -> pl.DataFrame:
    """Add engineers' findings to the maintenance log; work in both is listed once, as in the log.

    Parameters
    ----------
    log : DataFrame
        Rows of `raw_maintenance` whose source is the log.
    cases : DataFrame
        Rows of `raw_cases` of the same aircraft.
    """
    schema, work = TABLES["raw_maintenance"].schema, work_from_cases(cases)
    rows = (
        schema.conform(log)
        .with_columns(source=pl.lit(LOG), closes_alert_id=pl.lit(None, pl.String))
        .with_row_index("n")
    )
    pairs = work.join(rows, on=[*PACK, "component", "action"], suffix="_log", validate="m:m").filter(
        (pl.col("done_on") - pl.col("done_on_log")).abs() <= SAME_WORK
    )
    matches = pairs.unique("n", keep="last").select("n", case_alert_id="closes_alert_id", case_finding="finding")
    rows = rows.join(matches, on="n", how="left", maintain_order="left", validate="m:1").with_columns(
        closes_alert_id=pl.col("case_alert_id"), finding=pl.coalesce("finding", "case_finding")
    )
    work_of_cases_alone = work.join(pairs, on="closes_alert_id", how="anti", maintain_order="left")
    return pl.concat([schema.conform(rows), work_of_cases_alone])


def case_files(cases: pl.DataFrame) -> list[tuple[str, str, str, str, int, int, str]]:
    """List each aircraft's lines in the log of cases as the ledger lists a delivered file.

    Returns
    -------
    list
        path, operator, tail, kind, number of lines, 0, digest.
    """
    files = []
    for (o, t), cases_of_aircraft in sorted(cases.partition_by("operator", "tail", as_dict=True).items()):
        # an acknowledgement must not have the twin computed again: work counts from the first closing on
        closed_cases = cases_of_aircraft.filter((pl.col("kind") == "close").any())
        for kind, rows in ((CASES, cases_of_aircraft), (FINDINGS, work_from_cases(closed_cases))):
            if kind == CASES or closed_cases.height:
                files.append((f"{kind}/{o}/{t}", o, t, kind, rows.height, 0, digest(*map(str, rows.rows()))))
    return files
