"""Likely causes of a wrong date: the shift that takes flights back to a hole in their aircraft's record."""

from collections.abc import Mapping, Sequence
from datetime import date, timedelta

import polars as pl

GPS_WEEKS = 1_024
"""Weeks after which the week number of GPS begins anew."""
DEFAULT_DATES = (date(1980, 1, 6), date(1999, 8, 22), date(2000, 1, 1), date(2019, 4, 7))
"""Days on which a clock begins that was never set: computers', and GPS in each of its eras."""
MAX_YEARS = 25
MAX_HALF_HOURS = 28
"""Longest difference between two zones, either way: 14 hours."""
NEAR = timedelta(days=3)
"""Longest gap to another flight of the aircraft once the shift is undone."""
SAME_FLIGHT = timedelta(minutes=30)
"""Difference of the first reports of one flight in two recorders' files."""
LATEST_YEAR = 2_200
"""Last year that a shift may lead to; a time beyond 2262 can't be stored."""


def likely_cause(group: pl.DataFrame, record: pl.DataFrame) -> str | None:
    """Name what misdated a group of flights of one aircraft; None where no shift takes all back to a hole.

    Parameters
    ----------
    group, record : DataFrame
        `flight_id, departed_at, landed_at, source` of an aircraft's flights that can't be right, and of those that can.
    """
    if group["departed_at"].dt.date().is_in(DEFAULT_DATES).any():
        return "default_date"
    flights = record.sort("departed_at")
    for cause, shifts in _SHIFTS.items():
        if any(_fits(group, flights, shift) for shift in shifts):
            return cause
    return None


def _shifts() -> Mapping[str, Sequence[pl.Expr]]:
    """Map each cause to the expressions that undo it."""
    at = pl.col("departed_at")
    weeks = pl.duration(weeks=GPS_WEEKS)
    time_of_day = at.dt.hour(), at.dt.minute(), at.dt.second()
    exchanged = pl.datetime(at.dt.year(), at.dt.day().clip(1, 12), at.dt.month(), *time_of_day, time_zone="UTC")
    years = [n for k in range(1, MAX_YEARS + 1) for n in (k, -k)]
    half_hours = [n for k in range(1, MAX_HALF_HOURS + 1) for n in (k, -k)]
    return {
        "week_rollover": (at + weeks, at - weeks),
        "year": [at.dt.offset_by(f"{n}y") for n in years],
        "month": (at.dt.offset_by("1mo"), at.dt.offset_by("-1mo")),
        "day_month_exchanged": (pl.when(at.dt.day() <= 12).then(exchanged),),
        "hours": [at + pl.duration(minutes=30 * n) for n in half_hours],
    }


_SHIFTS = _shifts()


def _fits(group: pl.DataFrame, record: pl.DataFrame, shift: pl.Expr) -> bool:
    """Return whether all shifted flights come near to others, overlap none and take no other flight's id.

    A flight on record at the shifted time and id is the same one, from another recorder.
    """
    if record.is_empty() or group["departed_at"].dt.year().max() > LATEST_YEAR:  # type: ignore[operator]
        return False
    duration = pl.col("landed_at") - pl.col("departed_at")
    shifted = group.select(
        "flight_id", "source", duration=duration, departed_at=shift.cast(record.schema["departed_at"])
    )
    if shifted["departed_at"].null_count():
        return False
    shifted = shifted.with_columns(landed_at=pl.col("departed_at") + pl.col("duration")).sort("departed_at")
    day = pl.col("departed_at").dt.strftime("_%Y%m%d")
    ids = pl.concat_str(pl.col("flight_id").str.head(-12), day, pl.col("flight_id").str.tail(3))
    namesakes = shifted.with_columns(ids.alias("flight_id")).join(
        record, on="flight_id", suffix="_taken", validate="m:1"
    )
    is_near = (pl.col("departed_at") - pl.col("departed_at_taken")).abs() <= SAME_FLIGHT
    is_same = is_near & (pl.col("source") != pl.col("source_taken"))
    if not namesakes.select(is_same.all()).item():
        return False
    record = record.join(namesakes, on="flight_id", how="anti")
    before = record.select("departed_at", last_at="landed_at")
    after = record.select("departed_at", next_at="departed_at")
    between_flights = shifted.join_asof(before, on="departed_at").join_asof(after, on="departed_at", strategy="forward")
    since = pl.col("departed_at") - pl.col("last_at")
    until = pl.col("next_at") - pl.col("landed_at")
    in_hole = (since >= timedelta(0)).fill_null(True).all() & (until >= timedelta(0)).fill_null(True).all()
    near = pl.min_horizontal(since.min(), until.min()) <= NEAR
    return bool(between_flights.select((in_hole & near).fill_null(False)).item())
