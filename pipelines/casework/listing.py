"""Read cases from the catalog and the log: the alerts of the last night, and what people did about them since."""

from pathlib import Path
from typing import Any

import polars as pl

from hdt_core.errors import UserError
from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import connect, fetch_dicts
from pipelines.storage.publication import views

_DEFINITION = "create or replace view cases as"
OPEN = "state != 'closed'"


def list_cases(home: Path, where: str = OPEN, **values: Any) -> list[dict[str, Any]]:
    """Return rows of the view `cases` as of now, the most urgent first.

    Parameters
    ----------
    home : Path
        Holds the catalog and the log of cases.
    where : str
        SQL condition over the view's columns and those of `alert_states`, written by us.
    values : Any
        Values of its `$name` places.
    """
    query = views()["cases"].partition(_DEFINITION)[2].strip().removesuffix(";")
    query = query.replace("tables.raw_cases", "case_log_rows")
    with connect(home) as con:
        con.register("case_log_rows", CaseLog(home).entries().to_arrow())
        result = con.execute(
            f"""select c.*, s.now_loss, s.now_p_event_50, s.evidence_now, s.recommended_action, s.follows
            from ({query}) as c
            join alert_states as s using (alert_id) left join open_alerts as o using (alert_id)
            where {where} order by o.place nulls last, c.raised_at, c.alert_id""",
            values,
        )
        return fetch_dicts(result)


def find_case(home: Path, alert_id: str) -> dict[str, Any]:
    """Return the case with this alert id, or the only one whose id starts so.

    Raises
    ------
    UserError
        No alert id, or several, start so.
    """
    cases = list_cases(home, "starts_with(c.alert_id, $id)", id=alert_id) if alert_id else []
    if len(cases) != 1:
        raise UserError(f"{'several alerts' if cases else 'no alert'} {alert_id}; `hdt case list` names them")
    return cases[0]


def history_of(home: Path, alert_id: str) -> list[dict[str, Any]]:
    """Return an alert's lines of the case log, oldest first: rows of `raw_cases`."""
    return CaseLog(home).entries().filter(pl.col("alert_id") == alert_id).sort("line").to_dicts()
