"""What engineers found when they closed alerts, as lines of the maintenance log: one road for both."""

from datetime import timedelta

import polars as pl

from hdt_core.records.keys import PACK
from hdt_core.tables import TABLES
from pipelines.versions import digest

CASES, FINDINGS = "cases", "findings"
"""Kinds under which the ledger knows what a home's log of cases says of an aircraft: all of it, and the work in it."""
LOG, CASE = "log", "case"
SAME_WORK = timedelta(days=3)
"""A line of the log and an engineer's word about the same work may be so far apart, for a log is some flights late."""


def work_found(cases: pl.DataFrame) -> pl.DataFrame:
    """Rows of `raw_maintenance` from rows of `raw_cases`: of each alert the last closing that was not taken back."""
    last = cases.filter(pl.col("kind").is_in(["close", "reopen"])).sort("line").unique("alert_id", keep="last")
    found = last.filter(pl.col("kind") == "close").with_columns(source=pl.lit(CASE), closes_alert_id="alert_id")
    return TABLES["raw_maintenance"].schema.conform(found.sort("line"))


def with_findings(log: pl.DataFrame, cases: pl.DataFrame) -> pl.DataFrame:
    """The maintenance log and what engineers found; work that both tell of stands once, as the log has it.

    Parameters
    ----------
    log : DataFrame
        Rows of `raw_maintenance` whose source is the log.
    cases : DataFrame
        Rows of `raw_cases` of the same aircraft.
    """
    schema, found = TABLES["raw_maintenance"].schema, work_found(cases)
    rows = (
        schema.conform(log)
        .with_columns(source=pl.lit(LOG), closes_alert_id=pl.lit(None, pl.String))
        .with_row_index("n")
    )
    both = found.join(rows, on=[*PACK, "component", "action"], suffix="_log", validate="m:m").filter(
        (pl.col("done_on") - pl.col("done_on_log")).abs() <= SAME_WORK
    )
    told = both.unique("n", keep="last").select("n", said="closes_alert_id", saw="finding")
    rows = rows.join(told, on="n", how="left", maintain_order="left", validate="m:1").with_columns(
        closes_alert_id=pl.col("said"), finding=pl.coalesce("finding", "saw")
    )
    alone = found.join(both, on="closes_alert_id", how="anti", maintain_order="left")
    return pl.concat([schema.conform(rows), alone])


def case_files(cases: pl.DataFrame) -> list[tuple[str, str, str, str, int, int, str]]:
    """What the log of cases says of each aircraft, as the ledger knows a delivered file.

    Returns
    -------
    list
        path, operator, tail, kind, number of lines, 0, digest.
    """
    files = []
    for (o, t), own in sorted(cases.partition_by("operator", "tail", as_dict=True).items()):
        # an acknowledgement must not make the twin anew: work counts from the first closing on
        closed = own.filter((pl.col("kind") == "close").any())
        for kind, told in ((CASES, own), (FINDINGS, work_found(closed))):
            if kind == CASES or closed.height:
                files.append((f"{kind}/{o}/{t}", o, t, kind, told.height, 0, digest(*map(str, told.rows()))))
    return files
