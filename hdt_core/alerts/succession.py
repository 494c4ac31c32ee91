"""Follow cases from alert to alert.

An alert's id is a function of the data: where the model is estimated again its first flight moves, and it has another
id. A case keeps its own: it goes on with the alert of the same pack, diagnosis and sensor that was open at the same
time. A case has the id of its first alert. The night writes lines of two kinds into the log of cases, and only where
something moved: `follow` (the case goes on with this alert) and `withdraw` (its alert is gone, and was open then).

Of several cases and alerts each new alert continues the case whose raising and closing are nearest; a case that is left
over joins the alert that is nearest, whose case keeps its id; an alert that is left over begins a case.
"""

from collections.abc import Callable
from datetime import UTC, datetime
from secrets import token_hex
from typing import Any, NamedTuple, cast

import polars as pl

FOLLOW, WITHDRAW = KINDS_OF_NIGHT = ("follow", "withdraw")
_KIND = ["operator", "tail", "pack", "component", "diagnosis"]
_SPAN = ["raised_at", "closed_at"]
Row = dict[str, Any]


class Line(NamedTuple):
    """A line for the log of cases: its kind, the alert's columns, and those that not every line has."""

    kind: str
    alert: Row
    body: Row


def lines_of_night(
    entries: pl.DataFrame, before: pl.DataFrame, now: pl.DataFrame, departures: pl.Series,
    new_id: Callable[[], str] = lambda: token_hex(8),
) -> list[Line]:  # fmt: skip
    """Return the lines to add to the log of cases because alerts moved; none where none did.

    Parameters
    ----------
    entries : DataFrame
        Rows of `raw_cases` of some aircraft.
    before, now : DataFrame
        Rows of `features_alerts` of the same aircraft: as stored by the night before, and as made by this one.
    departures : Series
        When their flights departed.

    Returns
    -------
    list of Line
    """
    last_at = cast("datetime | None", departures.max())
    held_cases = _held_cases(entries, now)
    lost_cases = _lost_cases(entries, before, now)
    old_ids = {*before["alert_id"], *held_cases.values()}
    alerts = {row["alert_id"]: row for row in now.to_dicts()}
    new_ids = alerts.keys() - old_ids
    followed = _assign(_pairs(lost_cases, now, last_at), new_ids)
    joined = set(followed.values())
    in_use = {*entries["case_id"], *followed}
    # a case that others join is written down before them, and one whose name is another's by now gets a name
    own_cases = {a: new_id() if a in in_use else a for a in sorted(alerts.keys() - set(held_cases.values()))}
    begun = {c: a for a, c in own_cases.items() if (a in joined and a not in new_ids) or (a not in joined and c != a)}
    pairs = [*begun.items(), *followed.items()]
    lines = [_line(FOLLOW, case_id, alerts[alert_id], last_at) for case_id, alert_id in pairs]
    withdrawn = set(_last_lines(entries).filter(kind=WITHDRAW)["case_id"])
    ended_cases = lost_cases.filter(~pl.col("case_id").is_in([*followed, *withdrawn]))
    lines += [_line(WITHDRAW, row["case_id"], row, last_at) for row in ended_cases.to_dicts()]
    return lines


def _line(kind: str, case_id: str, alert: Row, last_at: datetime | None) -> Line:
    span = {"raised_then": alert["raised_at"], "last_then": alert["closed_at"] or last_at or alert["raised_at"]}
    body = {"case_id": case_id, "sensor": alert["sensor"]} | span
    return Line(kind, {c: alert[c] for c in ("alert_id", *_KIND)}, {k: v for k, v in body.items() if v is not None})


def _last_lines(entries: pl.DataFrame) -> pl.DataFrame:
    """Return the last line of each case."""
    return entries.sort("line").unique("case_id", keep="last", maintain_order=True)


def _held_cases(entries: pl.DataFrame, alerts: pl.DataFrame) -> dict[str, str]:
    """Map cases to their alert: the last of those their lines name that is among `alerts`."""
    present = entries.join(alerts, on="alert_id", how="semi")
    return dict(_last_lines(present).select("case_id", "alert_id").iter_rows())


def _lost_cases(entries: pl.DataFrame, before: pl.DataFrame, now: pl.DataFrame) -> pl.DataFrame:
    """Return cases none of whose alerts is raised now: case_id, and the alert as it was last known."""
    stored = before.select("alert_id", *_KIND, "sensor", *_SPAN)
    named = entries.select("line", "case_id", "alert_id")
    unnamed = stored.join(named, on="alert_id", how="anti").select(
        line=pl.lit(0, pl.Int64), case_id="alert_id", alert_id="alert_id"
    )
    from_store = pl.concat([unnamed, named]).join(stored, on="alert_id", maintain_order="left", validate="m:1")
    known_cases = pl.concat([_spans_in_log(entries), from_store], how="diagonal_relaxed").with_row_index("n")
    is_held = pl.col("case_id").is_in(list(_held_cases(entries, now)))
    is_raised = pl.col("alert_id").is_in(list(now["alert_id"]))
    # of what the night before stored the last, else what the log itself has
    lost_cases = known_cases.filter(~is_held & ~is_raised).sort("n")
    return lost_cases.unique("case_id", keep="last", maintain_order=True).drop("n", "line")


def _spans_in_log(entries: pl.DataFrame) -> pl.DataFrame:
    """Return each case's alert with its span as the lines have it; as moments where they are from before they had it.

    A line of such a log was written while the alert was on record: at its own time, or at that of the work.
    """
    moment = pl.coalesce("done_at", pl.col("done_on").cast(pl.Datetime("us")).dt.replace_time_zone("UTC"), "at")
    spans = entries.with_columns(first=moment.min().over("case_id"), last=moment.max().over("case_id"))
    ends = {"raised_at": pl.coalesce("raised_then", "first"), "closed_at": pl.coalesce("last_then", "last")}
    return _last_lines(spans.with_columns(**ends)).select("line", "case_id", "alert_id", *_KIND, "sensor", *_SPAN)


def _pairs(lost_cases: pl.DataFrame, now: pl.DataFrame, last_at: datetime | None) -> list[tuple[str, str]]:
    """Return lost cases with each alert of the same kind open at a common moment, the nearest first."""
    if lost_cases.is_empty() or now.is_empty():
        return []
    pairs = lost_cases.join(now, on=_KIND, suffix="_now", nulls_equal=True, validate="m:m")
    same_sensor = pl.col("sensor").is_null() | (pl.col("sensor") == pl.col("sensor_now"))  # old lines name none
    overlap = (pl.col("raised_at") <= _end("closed_at_now")) & (pl.col("raised_at_now") <= _end("closed_at"))
    distance = _apart(pl.col("raised_at"), pl.col("raised_at_now")) + _apart(
        pl.col("closed_at").fill_null(last_at), pl.col("closed_at_now").fill_null(last_at)
    )
    in_order = pairs.filter(same_sensor & overlap).sort(distance, "raised_at_now", "alert_id_now", "case_id")
    return in_order.select("case_id", "alert_id_now").rows()


def _end(column: str) -> pl.Expr:
    return pl.col(column).fill_null(datetime.max.replace(tzinfo=UTC))


def _apart(one: pl.Expr, other: pl.Expr) -> pl.Expr:
    """Time between two moments; none where one is unknown."""
    return (one - other).abs().fill_null(pl.duration())


def _assign(pairs: list[tuple[str, str]], new_ids: set[str]) -> dict[str, str]:
    """Give each lost case an alert: new ones to one case each, then cases left over to the nearest."""
    followed = dict[str, str]()
    for case_id, alert_id in pairs:
        if case_id not in followed and alert_id in new_ids and alert_id not in followed.values():
            followed[case_id] = alert_id
    for case_id, alert_id in pairs:
        followed.setdefault(case_id, alert_id)
    return followed
