"""Keep the stored lines of a log that lie outside the time of a later delivery: a log of the last days erases nothing.

A delivery covers the time from its first to its last message or work done. A stored line within that time that it
lacks was taken out; one before or after stays. So was the work of the last day where that alone is missing after a log
that has nothing new: someone who entered work by mistake deletes it. Work that was not done reaches no further: an open
order of last year in a log of the last days, or a plan for the next, would have all between count as taken out.
"""

from dataclasses import replace
from datetime import datetime, timedelta

import polars as pl

from hdt_core.tables.base import UTC
from pipelines.intake.faults import Fault
from pipelines.intake.landing_file import FileIntake, LandingFile
from pipelines.intake.logs import is_done, or_stored

IDENTITY = {"messages": ("flight_id", "pack", "code"), "maintenance": ("reference", "pack", "component", "action")}
"""What a corrected line keeps; the first names it, where it is given and no other line has the same."""
TIME = {"messages": "message_time", "maintenance": "done_on"}
REDATED = timedelta(days=10)
"""Farthest that work without a reference is dated anew."""
MONTH, YEAR = timedelta(days=31), timedelta(days=366)
"""Farthest that work with one is; or a year, or with day and month exchanged. A check has its name again later."""
_REST_OF_DAY = timedelta(days=1, microseconds=-1)


def keep_lines(file: LandingFile, log: FileIntake, stored: pl.DataFrame) -> FileIntake:
    """Add to what was read of a log the lines `stored` of it that lie outside its time, with a note of their number.

    A stored line that a new one corrects is not kept: of the same reference, or flight of a message, at a time that may
    have been mistaken for it; or the same work without a reference, where the log's first or last line is new and at
    most `REDATED` from it.
    """
    if log.rows.is_empty() and log.quarantine.height:
        return or_stored(log, stored)
    new = _with_span(log.rows)
    old = _with_span(stored)
    first, last = _time_of(new)
    outside = pl.lit(True) if first is None else (pl.col("ends") < first) | (pl.col("begins") > last)
    same_line = [*IDENTITY[file.kind], TIME[file.kind]]
    missing = old.filter(outside).join(new, on=same_line, how="anti", nulls_equal=True)
    if file.kind == "maintenance" and last is not None:
        missing = _without_deleted(missing, new, old, last)
    lines_kept = _without_corrected(file.kind, missing, old, new)
    if lines_kept.is_empty():
        return log
    rows = pl.concat([log.rows, lines_kept], how="diagonal").select(log.rows.columns)
    quarantine = pl.concat([log.quarantine, file.quarantine([_note(lines_kept, first, last)])])
    return replace(log, rows=rows, quarantine=quarantine, n_delivered=log.n_delivered + lines_kept.height)


def _with_span(rows: pl.DataFrame) -> pl.DataFrame:
    """Add `begins` and `ends`: a time, or the whole day of work without one."""
    if "message_time" in rows.columns:
        return rows.with_columns(begins="message_time", ends="message_time")
    day = pl.col("done_on").cast(UTC)
    return rows.with_columns(begins=pl.coalesce("done_at", day), ends=pl.coalesce("done_at", day + _REST_OF_DAY))


def _time_of(new: pl.DataFrame) -> tuple[datetime | None, datetime | None]:
    """Return the begin of the first and the end of the last line; None without a message or work done."""
    lines = new.filter(is_done()) if "status" in new.columns else new
    first, last = lines.select(pl.col("begins").min(), pl.col("ends").max()).row(0)
    return first, last


def _without_deleted(missing: pl.DataFrame, new: pl.DataFrame, old: pl.DataFrame, last: datetime) -> pl.DataFrame:
    """Drop the missing work of the last day where it is all that is stored after a log with nothing new."""
    has_news = new.join(old, on=[*IDENTITY["maintenance"], "done_on"], how="anti", nulls_equal=True).height > 0
    after = missing.filter(pl.col("begins") > last, is_done())
    if has_news or after["done_on"].n_unique() != 1:
        return missing
    return missing.filter(pl.col("done_on") != after["done_on"].max())


def _without_corrected(kind: str, missing: pl.DataFrame, old: pl.DataFrame, new: pl.DataFrame) -> pl.DataFrame:
    """Drop the missing lines that a new line corrects."""
    identity = IDENTITY[kind]
    pairs = _once(old, identity).join(
        _once(new, identity), on=identity, suffix="_new", nulls_equal=True, validate="1:1"
    )
    named = pairs.filter(_may_be_mistaken(pl.col(TIME[kind]), pl.col(f"{TIME[kind]}_new")))
    rest = missing.join(named, on=identity, how="anti", nulls_equal=True)
    return _without_redated(rest, old, new) if kind == "maintenance" else rest


def _once(rows: pl.DataFrame, identity: tuple[str, ...]) -> pl.DataFrame:
    """Select the lines whose reference or flight names them alone."""
    return rows.filter(pl.col(identity[0]).is_not_null() & (pl.len().over(identity) == 1))


def _may_be_mistaken(one: pl.Expr, other: pl.Expr) -> pl.Expr:
    """Return whether one time may be a slip of the other: within a month, a year off, or day and month exchanged."""
    apart = (one - other).abs()
    is_year_off = apart.is_between(YEAR - timedelta(days=1), YEAR)
    is_exchanged = (one.dt.day() == other.dt.month()) & (one.dt.month() == other.dt.day())
    return (apart <= MONTH) | is_year_off | is_exchanged


def _without_redated(missing: pl.DataFrame, old: pl.DataFrame, new: pl.DataFrame) -> pl.DataFrame:
    """Drop missing work without a reference that a new first or last line dates a few days off.

    A log of other days begins and ends with lines that are stored, or repeats none: its work is other work.
    """
    identity = IDENTITY["maintenance"]
    fresh = new.join(old, on=[*identity, "done_on"], how="anti", nulls_equal=True)
    if missing.is_empty() or fresh.height == new.height:
        return missing
    first, last = _time_of(new)
    is_end = (pl.col("begins") == first) | (pl.col("ends") == last)
    unnamed_ends = fresh.filter(is_end & pl.col("reference").is_null())
    lines = missing.with_row_index("n")
    pairs = lines.join(unnamed_ends, on=identity, suffix="_new", nulls_equal=True, validate="m:m")
    redated = pairs.filter((pl.col("done_on") - pl.col("done_on_new")).abs() <= REDATED)
    return lines.join(redated, on="n", how="anti").drop("n")


def _note(lines_kept: pl.DataFrame, first: datetime | None, last: datetime | None) -> Fault:
    if first is None or last is None:
        return Fault("fewer_lines", detail=f"Kept: {lines_kept.height}.")
    n_before = lines_kept.filter(pl.col("ends") < first).height
    n_after = lines_kept.height - n_before
    detail = f"Kept: {lines_kept.height}, of these {n_before} before {first.date()} and {n_after} after {last.date()}."
    return Fault("fewer_lines", detail=detail)
