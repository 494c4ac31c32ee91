"""How every case stands at this moment: the last night's alerts, and all that was said of them since."""

from pathlib import Path
from typing import Any

import polars as pl

from pipelines.storage.cases import CaseLog
from pipelines.storage.catalog import connect, rows
from pipelines.storage.publication import views

_MADE = "create or replace view cases as"
OPEN = "state != 'closed'"


def list_cases(home: Path, where: str = OPEN, arguments: dict[str, Any] | None = None) -> list[dict[str, Any]]:
    """Rows of the view `cases` as of now, the most urgent first.

    Parameters
    ----------
    home : Path
        Holds the catalog and the log of cases.
    where : str
        SQL condition over the view's columns and those of `alert_states`, written by us; values go in `arguments`.
    arguments : dict, optional
        Values of its `$name` places.
    """
    asked = views()["cases"].partition(_MADE)[2].strip().removesuffix(";").replace("tables.raw_cases", "told_cases")
    with connect(home) as con:
        con.register("told_cases", CaseLog(home).entries().to_arrow())
        found = con.execute(
            f"""select c.*, s.now_loss, s.now_p_event_50, s.evidence_now, s.recommended_action, s.follows
            from ({asked}) as c join alert_states as s using (alert_id)
            left join open_alerts as o using (alert_id) where {where}
            order by o.place nulls last, c.raised_at, c.alert_id""",
            arguments or {},
        )
        return rows(found)


def find_case(home: Path, alert_id: str) -> dict[str, Any]:
    """One case by its alert's id, or by the first digits of it.

    Raises
    ------
    LookupError
        No alert, or several, begin like that.
    """
    found = list_cases(home, "starts_with(c.alert_id, $id)", {"id": alert_id}) if alert_id else []
    if len(found) != 1:
        raise LookupError(f"{'several alerts' if found else 'no alert'} {alert_id}; `hdt case list` names them")
    return found[0]


def outlooks(home: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of `due_dates`, when messages are due, and of `next_stop`, the choices at it, the best first."""
    with connect(home) as con:
        due = rows(con.execute("select * from due_dates"))
        return due, rows(con.execute("select * from next_stop order by place nulls last, choice"))


def history_of(home: Path, alert_id: str) -> list[dict[str, Any]]:
    """What was said of an alert, oldest first: rows of `raw_cases`."""
    return CaseLog(home).entries().filter(pl.col("alert_id") == alert_id).sort("line").to_dicts()
